"""What the dependencies are licensed under, from what is installed: writes docs/licences.md.

    cd tools && python -m release.licences

Ends with 1 where a licence does not go with Apache-2.0, or is not known.
"""

import re
import sys
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from importlib.metadata import Distribution, distribution

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from release.clean_venv import ROOT

__all__ = ["DOCUMENT", "EXTRAS", "Package", "document", "licence_of", "packages", "problems"]

DOCUMENT = ROOT / "docs" / "licences.md"
PROJECT = "hv-current-correction"
EXTRAS = ("", "metrics", "calibrator", "cluster", "mf4", "demo", "docs", "bench", "dev")
"""From the lightest on; a package is told with the first that needs it. "" is the node alone."""
PERMISSIVE = {
    *("0BSD", "Apache-2.0", "BSD", "BSD-2-Clause", "BSD-3-Clause", "CC0-1.0", "ISC", "LLVM-exception", "MIT", "MIT-0"),
    *("MIT-CMU", "PSF", "PSF-2.0", "Python-2.0", "Unlicense", "Zlib", "public domain"),
}
COPYLEFT_OF_FILES = {"MPL-2.0"}
COPYLEFT_OF_LIBRARIES = {"LGPL", "LGPL-2.1-or-later", "LGPL-3.0-only", "LGPL-3.0-or-later"}
ACCEPTED = PERMISSIVE | COPYLEFT_OF_FILES | COPYLEFT_OF_LIBRARIES
REVIEWED = {
    "docutils": ("BSD-2-Clause AND public domain", "GPL is only an Emacs mode, which no wheel has: its COPYING.rst"),
    "fastsim": ("Apache-2.0", "its LICENSE; the classifier says proprietary"),
}
"""Licence of packages whose metadata mislead, and where it is told."""
_SPDX = {
    "apache 2.0": "Apache-2.0",
    "apache software license": "Apache-2.0",
    "3-clause bsd": "BSD-3-Clause",
    "bsd 3-clause license": "BSD-3-Clause",
    "bsd license": "BSD",
    "gnu lesser general public license v3 (lgplv3)": "LGPL-3.0-only",
    "gnu lesser general public license v3 or later (lgplv3+)": "LGPL-3.0-or-later",
    "isc license": "ISC",
    "isc license (iscl)": "ISC",
    "lgplv3+": "LGPL-3.0-or-later",
    "mit license": "MIT",
    "mozilla public license 2.0 (mpl 2.0)": "MPL-2.0",
    "public domain": "public domain",
    "python software foundation license": "PSF",
}
"""Words for what the list of SPDX has a name."""


@dataclass(frozen=True, kw_only=True)
class Package:
    """One installed dependency.

    Attributes
    ----------
    name, version, licence : str
        As its metadata say; the licence in the words of SPDX where there are some.
    extra : str
        The lightest extra that needs it.
    """

    name: str
    version: str
    licence: str
    extra: str


def packages() -> list[Package]:
    """All dependencies that are installed, with the lightest extra that needs each, in the order of the document."""
    found: dict[str, Package] = {}
    for extra in EXTRAS:
        for one in _closure(Requirement(f"{PROJECT}[{extra}]" if extra else PROJECT)):
            name = canonicalize_name(one.metadata["Name"])
            if name != PROJECT:
                found.setdefault(name, Package(name=name, version=one.version, licence=licence_of(one), extra=extra))
    return sorted(found.values(), key=lambda package: (EXTRAS.index(package.extra), package.name))


def _closure(wanted: Requirement) -> Iterator[Distribution]:
    """Distributions that one needs on this machine, itself the first."""
    seen: set[tuple[str, str]] = set()
    left = [(wanted, "")]
    while left:
        item, asked_by = left.pop()
        if item.marker is not None and not item.marker.evaluate({"extra": asked_by}):
            continue
        one = distribution(item.name)
        for extra in ("", *item.extras):
            if (canonicalize_name(item.name), extra) not in seen:
                seen.add((canonicalize_name(item.name), extra))
                left += [(Requirement(text), extra) for text in one.requires or []]
        yield one


def licence_of(one: Distribution) -> str:
    """Licence of a distribution, in the words of SPDX where its metadata have these; "unknown" if they tell none."""
    name = canonicalize_name(one.metadata["Name"])
    if name in REVIEWED:
        return REVIEWED[name][0]
    if expressions := one.metadata.get_all("License-Expression"):
        return str(expressions[0])
    field = _named(one.metadata.get_all("License") or [])
    classifiers = [text for text in one.metadata.get_all("Classifier") or [] if text.startswith("License ::")]
    by_classifiers = _named(text.rpartition(" :: ")[2] for text in classifiers)
    return next((text for text in (field, by_classifiers) if text and not _unknown(text)), field or "unknown")


def _named(texts: Iterable[str]) -> str:
    """Licences in the words of SPDX, in alphabetical order; texts of whole licences are none."""
    short = [text.strip() for text in texts if text.strip() and "\n" not in text.strip()]
    return " AND ".join(sorted({_SPDX.get(text.lower(), text) for text in short}))


def _unknown(licence: str) -> set[str]:
    """Names in an expression that are not accepted."""
    return set(re.split(r" (?:AND|OR|WITH) ", licence.replace("(", "").replace(")", ""))) - ACCEPTED


def problems(found: Iterable[Package]) -> list[str]:
    """What does not go with Apache-2.0 as a dependency, or is not known; one line each."""
    return [
        f"{package.name} {package.version}: licence {package.licence!r} is not among those that are accepted; read it, "
        "then choose another package, or add it to tools/release/licences.py"
        for package in found
        if _unknown(package.licence)
    ]


def document(found: list[Package]) -> str:
    """Text of the document."""
    parts = [
        _HEAD.format(reviewed="\n".join(f"- {name}: {licence}; {why}." for name, (licence, why) in REVIEWED.items()))
    ]
    for extra in EXTRAS:
        rows = [f"| {p.name} | {p.version} | {p.licence} |" for p in found if p.extra == extra]
        title = f"Extra `{extra}`, beside these" if extra else "The node alone"
        parts.append("\n".join([f"## {title}", "", "| package | version | licence |", "|---|---|---|", *rows]))
    return "\n\n".join(parts) + "\n"


_HEAD = """# Licences of dependencies

hv-current-correction is Apache-2.0. What it needs is installed beside it, unchanged and not part of its files. This
list is written by `make licences`, from the metadata of what is installed with Python 3.11 on Linux. A test refuses
licences that do not go with Apache-2.0 (GPL, AGPL) or are not known; there is none.

- LGPL: python-can (of the node), asammdf (extra `mf4`), casadi and sippy-unipi (extra `bench`). A program under any
  licence may use them as long as whoever gets the program can exchange them, as here. Who ships them inside a product,
  such as a vehicle's computer, must pass on their licence and source, and what is needed to exchange them there.
- MPL-2.0: changes to files of these packages must be passed on; nothing is changed here.
- Libraries inside wheels, such as OpenSSL in that of cryptography and the run-time libraries of GCC (GPL with an
  exception for programs) in those of numpy and scipy, have notices in the licence files of these packages.

Read by hand, as their metadata mislead:

{reviewed}"""


def main() -> int:
    """Write the document; exit code 1 if there is a problem."""
    found = packages()
    for problem in problems(found):
        print(f"licences: {problem}", file=sys.stderr)
    DOCUMENT.write_text(document(found))
    print(f"{DOCUMENT}: {len(found)} packages")
    return 1 if problems(found) else 0


if __name__ == "__main__":
    sys.exit(main())
