"""The node is light, and packages of the calibrator import only those that docs/architecture.md names before them."""

import ast
import re
import sys
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[2]
NODE_PACKAGES = {"_typeshed", "can", "cantools", "e2e", "fastcrc", "msgspec"}
"""Packages of the base install, and one that only type checkers see."""
NODE_EXTRAS = {"update": {"cryptography", "tuf", "securesystemslib", "urllib3"}}
"""What packages or modules of this name may import besides: an extra brings it, and only their commands need it."""
ENTRIES = {"__init__", "__main__", "cli"}
"""Modules that may import every package, as they start the program."""


def imported(path: Path) -> Iterator[str]:
    """Dotted names that a file imports anywhere, in functions too."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module is not None:
            yield node.module
        elif isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)


def test_node_imports_only_its_base_install_and_not_the_calibrator() -> None:
    heavy = []
    for path in sorted((ROOT / "ecu_node").rglob("*.py")):
        extras = set[str]().union(*(NODE_EXTRAS.get(name, ()) for name in (path.parent.name, path.stem)))
        allowed = NODE_PACKAGES | extras | sys.stdlib_module_names | {"ecu_node"}
        names = (name for name in imported(path) if name.partition(".")[0] not in allowed)
        heavy += [f"{path.relative_to(ROOT)} imports {name}" for name in names]
    assert heavy == []


def test_packages_import_only_those_listed_before_them_in_the_architecture_document() -> None:
    page = (ROOT / "docs" / "architecture.md").read_text()
    rows = re.findall(r"(?m)^\| (`.+?`) \|", page.partition("| package of `calibrator`")[2])
    level = {package: number for number, row in enumerate(rows) for package in re.findall(r"`(\w+)`", row)}
    packages = {path.name for path in (ROOT / "calibrator").iterdir() if path.is_dir() and any(path.glob("*.py"))}
    assert packages <= level.keys(), "each package is named in the table"
    wrong = set()
    for path in sorted((ROOT / "calibrator").rglob("*.py")):
        package = path.relative_to(ROOT / "calibrator").with_suffix("").parts[0]
        if package not in ENTRIES:
            used = {name.split(".")[1] for name in imported(path) if name.startswith("calibrator.")} & packages
            # modules beside the packages come before all packages
            own = level.get(package, 0)
            wrong |= {f"{path.relative_to(ROOT)} imports {each}" for each in used if level[each] > own}
    assert wrong == set()
