#!/usr/bin/env python3
"""Pick the pins that the node alone needs, and those that build it, out of constraints.txt.

constraints.txt pins everything, the calibrator and the tests included. A vehicle's computer gets the base install only;
pip checks hashes only of files that name every package to be installed. Run this after 'make constraints'.
"""

import re
import tomllib
from importlib.metadata import requires
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[1]
BASE, BUILD = ROOT / "deploy" / "requirements.txt", ROOT / "deploy" / "requirements-build.txt"


def pins(constraints: str) -> dict[str, str]:
    """Blocks of a constraints file, name, version, marker and hashes, by the name of the package."""
    blocks = re.split(r"\n(?=[A-Za-z0-9])", constraints.strip())
    return {canonicalize_name(re.split(r"[=<>! ;\[]", block, maxsplit=1)[0]): block for block in blocks}


def closure(wanted: list[str]) -> set[str]:
    """Names of packages and of all that they need on Linux, as the installed ones say; no extras."""
    found: set[str] = set()
    left = [Requirement(text) for text in wanted]
    while left:
        item = left.pop()
        name = canonicalize_name(item.name)
        if name in found or (item.marker is not None and not item.marker.evaluate({"extra": ""})):
            continue
        found.add(name)
        left += map(Requirement, requires(name) or [])
    return found


def picked(wanted: list[str]) -> str:
    """The pins of packages and of all that they need."""
    known = pins((ROOT / "constraints.txt").read_text())
    return "\n".join(known[name] for name in sorted(closure(wanted))) + "\n"


def files() -> dict[Path, str]:
    """What the two files must hold."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    head = "# By deploy/requirements.py, out of constraints.txt: change that, and run it again.\n"
    return {
        BASE: head + picked(project["project"]["dependencies"]),
        BUILD: head + picked(project["build-system"]["requires"]),
    }


if __name__ == "__main__":
    for path, text in files().items():
        path.write_text(text)
