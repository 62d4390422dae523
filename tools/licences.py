#!/usr/bin/env python3
"""List installed packages with their licences; exit code 1 if one does not go with Apache-2.0 or is not stated."""

import sys
from importlib.metadata import Distribution, distributions

GOOD = ("apache", "bsd", "mit", "isc", "psf", "python", "mpl", "mozilla", "lgpl", "lesser", "unlicense", "zlib", "cc0",
        "public domain", "0bsd")  # fmt: skip
"""Words of licences that a dependency of Apache-2.0 software may have; for LGPL and MPL see docs/dependencies.md."""
READ = {"docutils": "BSD-2-Clause AND public domain", "fastsim": "Apache-2.0"}
"""Licences read by hand, as their metadata mislead: COPYING.rst, LICENSE."""


def licence_of(one: Distribution) -> str:
    """Return the licence that the metadata state, in one line; of several a good one if any, empty without any."""
    name, found = one.metadata["Name"], one.metadata.get_all("License-Expression") or []
    classifiers = [text.rpartition(" :: ")[2] for text in one.metadata.get_all("Classifier") or [] if "License" in text]
    stated = [text for text in one.metadata.get_all("License") or [] if "\n" not in text and len(text) < 60]
    texts = [READ.get(name, ""), *found, " AND ".join(classifiers), *stated]
    return next((text for text in texts if is_good(text)), next((text for text in texts if text), ""))


def is_good(licence: str) -> bool:
    """Check whether a licence allows its software as a dependency of Apache-2.0 software."""
    return any(word in licence.lower() for word in GOOD)


def main() -> int:
    """Print a line for each package, and return the exit code."""
    bad = 0
    for one in sorted(distributions(), key=lambda one: one.metadata["Name"].lower()):
        licence = licence_of(one)
        good = is_good(licence)
        bad += not good
        print(
            f"{one.metadata['Name']:<28} {one.version:<14} {licence or 'not stated'}{'' if good else '   <- read it'}"
        )
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
