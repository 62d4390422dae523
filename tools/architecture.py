#!/usr/bin/env python3
"""Draw the rooms of the house from its imports, and check that nothing in it goes round in circles.

A room is a folder of ``calibrator``, or a module there that imports from one. Rooms that import no other are the ground
floor, which everybody may stand on. ``ecu_node`` must stay light: nothing of the calibrator, and few packages.
"""

import ast
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated

import typer

from calibrator.terminal.command_line import command_app
from ecu_node.errors import UserError

ROOT = Path(__file__).parents[1]
PICTURE = ROOT / "docs" / "images" / "architecture.svg"
DOORS = frozenset({"cli", "__main__"})
"""Import every room, to start it."""
NODE_PACKAGES = frozenset({"can", "cantools", "cryptography", "e2e", "fastcrc", "msgspec", "rfc8785"})
"""What the base install has."""
NODE_EXTRAS = {"monitor": {"rich"}, "metrics": {"prometheus_client"}}
"""What modules of that name may import besides: they are imported when their command is given."""

app = command_app()
Graph = dict[str, set[str]]


@app.command()
def main(
    *,
    check: Annotated[bool, typer.Option("--check", help="Only check; exit code 1 if a rule is broken.")] = False,
    out: Annotated[Path, typer.Option("--out", help="Picture to write (SVG).")] = PICTURE,
) -> None:
    """Check the rules, and draw the picture of docs/architecture.md."""
    broken = [*problems_of_node(), *problems_of_rooms(room_imports())]
    if broken:
        raise UserError("; ".join(broken))
    if not check:
        out.write_text(drawing(room_imports()))


def imported_modules(path: Path) -> Iterator[str]:
    """Dotted names that a file imports anywhere, in functions too."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module is not None:
            yield node.module
        elif isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)


def problems_of_node() -> list[str]:
    """What ``ecu_node`` imports that it must not."""
    found = []
    for path in sorted((ROOT / "ecu_node").rglob("*.py")):
        extras = NODE_EXTRAS.get(path.stem.partition("_")[0], set())
        allowed = NODE_PACKAGES | extras | sys.stdlib_module_names | {"ecu_node"}
        for module in imported_modules(path):
            if module.partition(".")[0] not in allowed:
                found.append(f"{path.relative_to(ROOT)} imports {module}, which is not of the base install")
    return found


def room_imports() -> Graph:
    """Rooms of the calibrator, and the rooms that each imports from; the ground floor is left out."""
    graph: Graph = {}
    for path in sorted((ROOT / "calibrator").rglob("*.py")):
        room = path.relative_to(ROOT / "calibrator").with_suffix("").parts[0]
        if room not in DOORS and room != "__init__":
            used = {name.split(".")[1] for name in imported_modules(path) if name.startswith("calibrator.")}
            graph.setdefault(room, set()).update(used - {room})
    while ground := {room for room, used in graph.items() if not used}:
        if all(graph[room] <= ground for room in ground_users(graph, ground)):
            break
        graph = {room: used - ground for room, used in graph.items() if room not in ground}
        break
    return graph


def drawing(graph: Mapping[str, set[str]]) -> str:
    return ""
