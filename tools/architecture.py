#!/usr/bin/env python3
"""Draw the calibrator's rooms from its imports, and check that none goes round in circles and the node stays light.

A room is a folder of ``calibrator``. Modules beside the rooms, and the few rooms that nearly all others stand on, are
the ground floor; it imports nothing but itself. Rooms import rooms above them in the picture, so that data goes down.
"""

import ast
import sys
from collections.abc import Iterator, Mapping, Sequence
from graphlib import CycleError, TopologicalSorter
from html import escape
from pathlib import Path
from typing import Annotated

import typer

from calibrator.terminal.command_line import command_app, run_tool
from ecu_node.errors import UserError

ROOT = Path(__file__).parents[1]
PICTURE = ROOT / "docs" / "images" / "architecture.svg"
GROUND = frozenset({"files", "processes", "terminal"})
"""Rooms of the ground floor."""
DOORS = frozenset({"__init__", "__main__", "cli"})
"""They import every room, to start it."""
NODE_PACKAGES = frozenset({"_typeshed", "can", "cantools", "e2e", "fastcrc", "msgspec"})
"""What the base install has, and what only type checkers see."""
_UPDATE_PACKAGES = frozenset({"cryptography", "securesystemslib", "tuf", "urllib3"})
NODE_EXTRAS = {
    "telemetry": frozenset({"prometheus_client"}),
    **dict.fromkeys(("client", "command", "signers", "sources"), _UPDATE_PACKAGES),
}
"""What rooms or modules of this name may import besides: an extra brings it, and only their command needs it."""
BOX_HEIGHT, ROW_HEIGHT, CHARACTER, GAP, WIDTH = 30, 92, 8.2, 22, 900
"""Sizes of the picture. [px]"""

app = command_app()
Graph = Mapping[str, frozenset[str]]
"""Rooms, and those that each imports from."""


@app.command()
def main(
    *,
    check: Annotated[bool, typer.Option("--check", help="Only check; exit code 1 if a rule is broken.")] = False,
    out: Annotated[Path, typer.Option("--out", help="Picture to write (SVG).")] = PICTURE,
) -> None:
    """Check the rules, and draw the picture of docs/architecture.md."""
    broken = [*problems_of_node(), *problems_of_ground(), *problems_of_rooms(room_imports())]
    if broken:
        raise UserError("; ".join(broken))
    if not check:
        out.write_text(drawing(room_imports()), encoding="utf-8")


def imported_modules(path: Path) -> Iterator[str]:
    """Dotted names that a file imports anywhere, in functions too."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and node.module is not None:
            yield node.module
        elif isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)


def problems_of_node() -> list[str]:
    """What ``ecu_node`` imports that it must not."""
    found = []
    for path in sorted((ROOT / "ecu_node").rglob("*.py")):
        extras = frozenset().union(*(NODE_EXTRAS.get(name, ()) for name in (path.parent.name, path.stem)))
        allowed = NODE_PACKAGES | extras | sys.stdlib_module_names | {"ecu_node"}
        heavy = [module for module in imported_modules(path) if module.partition(".")[0] not in allowed]
        found += [f"{path.relative_to(ROOT)} imports {module}, which its base install lacks" for module in heavy]
    return found


def problems_of_ground() -> list[str]:
    """What the ground floor imports from the rooms above it."""
    rooms = room_imports()
    return [
        f"{path.relative_to(ROOT)} is of the ground floor and imports from the room {used}"
        for room, path in _sources()
        if room not in rooms and room not in DOORS
        for used in sorted(_used_rooms(path) & rooms.keys())
    ]


def problems_of_rooms(graph: Graph) -> list[str]:
    """Rooms that import each other."""
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        return [f"rooms import each other: {' -> '.join(reversed(error.args[1]))}"]
    return []


def room_imports() -> Graph:
    """Rooms above the ground floor, and those of them that each imports from."""
    graph: dict[str, set[str]] = {}
    for room, path in _sources():
        if room not in GROUND | DOORS and (ROOT / "calibrator" / room).is_dir():
            graph.setdefault(room, set()).update(_used_rooms(path) - {room})
    return {room: frozenset(used & graph.keys()) for room, used in graph.items()}


def _sources() -> Iterator[tuple[str, Path]]:
    """Room, or module beside the rooms, and file."""
    for path in sorted((ROOT / "calibrator").rglob("*.py")):
        yield path.relative_to(ROOT / "calibrator").with_suffix("").parts[0], path


def _used_rooms(path: Path) -> set[str]:
    names = (module.split(".") for module in imported_modules(path))
    return {parts[1] for parts in names if parts[0] == "calibrator" and len(parts) > 1}


def direct_imports(graph: Graph) -> Graph:
    """The imports of each room that are not also those of a room it imports."""
    reached: dict[str, frozenset[str]] = {}
    for room in TopologicalSorter(graph).static_order():
        reached[room] = graph[room].union(*(reached[used] for used in graph[room]))
    return {room: used - frozenset().union(*(reached[other] for other in used)) for room, used in graph.items()}


def rows_of(graph: Graph) -> list[list[str]]:
    """Rooms from top to bottom, each below all that it imports; those that no other knows are in the last row."""
    depth: dict[str, int] = {}
    for room in TopologicalSorter(graph).static_order():
        depth[room] = 1 + max((depth[used] for used in graph[room]), default=-1)
    alone = graph.keys() - {room for room, used in graph.items() if used}.union(*graph.values())
    depth |= dict.fromkeys(alone, max(depth.values()))
    rows: list[list[str]] = []
    position: dict[str, float] = {}
    for level in range(max(depth.values()) + 1):
        here = sorted(room for room in graph if depth[room] == level)
        row = sorted(here, key=lambda room: _middle([position[used] for used in graph[room]]))
        position |= {room: (k + 0.5) / len(row) for k, room in enumerate(row)}
        rows.append(row)
    return rows


def _middle(values: Sequence[float]) -> float:
    return sum(values) / len(values) if values else 0.5


def drawing(graph: Graph) -> str:
    """The picture as SVG: one box per room, one arrow per direct import, from what is used to what uses it."""
    arrows, rows = direct_imports(graph), rows_of(graph)
    x: dict[str, float] = {}
    y: dict[str, float] = {}
    for level, row in enumerate(rows):
        for k, room in enumerate(row):
            x[room], y[room] = WIDTH * (k + 0.5) / len(row), 20.0 + ROW_HEIGHT * level
    height = 20 + ROW_HEIGHT * len(rows) + 40
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {height}" font-family="sans-serif"',
        ' font-size="14">',
        "<title>Rooms of the calibrator; arrows go from what is imported to what imports it</title>",
        '<defs><marker id="tip" viewBox="0 0 8 8" refX="8" refY="4" markerWidth="7" markerHeight="7" orient="auto">'
        '<path d="M0 0L8 4L0 8z" fill="#56748a"/></marker></defs>',
        f'<rect width="{WIDTH}" height="{height}" fill="white"/>',
    ]
    for room in sorted(arrows):
        parts += [_arrow(x[used], y[used] + BOX_HEIGHT, x[room], y[room]) for used in sorted(arrows[room])]
    parts += [_box(room, x[room], y[room], len(room) * CHARACTER + GAP, "#e3eef6") for room in sorted(x)]
    ground = f"ground floor, for all: {', '.join(sorted(GROUND))}, and the modules beside the rooms"
    parts.append(_box(ground, WIDTH / 2, height - 45, WIDTH - 40, "#eeeeee"))
    return "\n".join([*parts, "</svg>", ""])


def _arrow(x0: float, y0: float, x1: float, y1: float) -> str:
    bend = (y1 - y0) / 2
    return (
        f'<path d="M{x0:.0f} {y0:.0f}C{x0:.0f} {y0 + bend:.0f} {x1:.0f} {y1 - bend:.0f} {x1:.0f} {y1:.0f}" '
        'fill="none" stroke="#56748a" marker-end="url(#tip)"/>'
    )


def _box(text: str, x: float, y: float, width: float, colour: str) -> str:
    return (
        f'<rect x="{x - width / 2:.0f}" y="{y:.0f}" width="{width:.0f}" height="{BOX_HEIGHT}" rx="5" fill="{colour}" '
        f'stroke="#56748a"/><text x="{x:.0f}" y="{y + 20:.0f}" text-anchor="middle">{escape(text)}</text>'
    )


if __name__ == "__main__":
    run_tool(app, "architecture")
