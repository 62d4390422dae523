"""What a figure depends on: the files that a step runs, with all that they import, and a digest of what they say."""

import ast
import hashlib
import subprocess
import sys
from collections.abc import Iterator, Sequence
from functools import cache
from pathlib import Path

__all__ = ["digest", "files_that_run"]

SOURCES = (".", "tools")
"""Folders of a checkout that modules are imported from."""
PINS = "constraints.txt"
"""Versions of everything that is installed: part of every digest."""


def files_that_run(root: Path, entries: Sequence[str]) -> frozenset[Path]:
    """Files behind entries: what is a file or a folder, and of Python files also what they import from the checkout.

    Parameters
    ----------
    root : Path
        The checkout.
    entries : sequence of str
        Files and folders that are committed in it.

    Returns
    -------
    frozenset of Path
        Imports within functions are followed too; names that are put together while a program runs are not.

    Raises
    ------
    FileNotFoundError
        If nothing of an entry is committed.
    """
    root = root.resolve()
    waiting = [path for entry in entries for path in _files(root, entry)]
    found: set[Path] = set()
    imported: set[str] = set()
    while waiting:
        path = waiting.pop()
        if path in found:
            continue
        found.add(path)
        if path.suffix == ".py":
            names = set(_names(path.read_text(encoding="utf-8"))) - imported
            imported |= names
            waiting += [module for name in names for module in _modules(root, name)]
    return frozenset(found)


def digest(root: Path, entries: Sequence[str]) -> str:
    """Digest of names and contents of :func:`files_that_run`, and of the pinned versions."""
    root, total = root.resolve(), hashlib.sha256()
    for path in sorted(files_that_run(root, [*entries, PINS])):
        total.update(f"{path.relative_to(root)} {hashlib.sha256(path.read_bytes()).hexdigest()}\n".encode())
    return total.hexdigest()


def _files(root: Path, entry: str) -> list[Path]:
    listed = subprocess.run(
        ("git", "ls-files", "-z", "--", entry), cwd=root, check=True, capture_output=True, text=True
    )
    names = listed.stdout.split("\0")[:-1]
    if not names:
        raise FileNotFoundError(f"{root / entry}: nothing of it is committed")
    return [root / name for name in names]


@cache
def _names(source: str) -> tuple[str, ...]:
    """What a source imports, with what it takes out of each module: these may be modules, too."""
    found: list[str] = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module is not None:
            found += [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
    return tuple(found)


def _modules(root: Path, name: str) -> Iterator[Path]:
    """The file of a module of this checkout and of the packages around it; nothing for what is installed."""
    parts = name.split(".")
    for source in SOURCES if parts[0] not in sys.stdlib_module_names else ():
        for depth in range(1, len(parts) + 1):
            place = (root / source).joinpath(*parts[:depth])
            candidates = (place / "__init__.py", place.with_suffix(".py"))
            yield from (candidate.resolve() for candidate in candidates if candidate.is_file())
