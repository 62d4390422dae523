"""The live picture of ``ecu-node monitor`` as lines for a terminal of any width and height.

What has no room beside the numbers is told below the table; columns that are left out, and lines, are named.
"""

import textwrap
from collections.abc import Sequence
from typing import NamedTuple

from ecu_node.monitor_text import COLUMNS, LEFT, Row, node_line, notes, rows
from ecu_node.monitor_view import View

__all__ = ["Line", "picture"]

_WIDE_GAP, _NARROW_GAP = 2, 1
"""Blanks between columns: where all of them have room, and where they have not."""
_LEAST_NUMBER = len("+999.99")
"""Columns of currents do not become wider while the vehicle drives."""
_TOLD_BELOW = ("quality", "faults")
"""Columns of words that become lines of their own where they have no room."""
_LEAVE_OUT = ("faults", "answers [1/s]", "age [s]", "rate [1/s]", "correction [A]", "quality")
"""Columns that are left out of a table that is too wide, the first one first."""


class Line(NamedTuple):
    """One line of the picture, not wider than the terminal."""

    text: str
    style: str = ""
    """As rich names it: bold, dim, yellow, or none."""


def picture(view: View, where: str, more: Sequence[str] = (), *, width: int, height: int) -> list[Line]:
    """Draw what is seen.

    Parameters
    ----------
    view : View
        What is to be shown.
    where : str
        Name of the bus.
    more : sequence of str
        Further lines.
    width, height : int
        Of the terminal. [character]

    Returns
    -------
    list of Line
        At most as many as the terminal is high.
    """
    table = rows(view)
    left_out, gap = _arrangement(table, width)
    hidden = [name.partition(" ")[0] for name in COLUMNS if name in left_out and name not in _TOLD_BELOW]
    texts = [*notes(view), *more, *([f"a wider terminal also shows: {', '.join(hidden)}"] if hidden else [])]
    head, body = _drawn(table, [name for name in COLUMNS if name not in left_out], gap)
    branches = len(view.branches)
    lines = [
        *_wrapped(f"{where}: {node_line(view)}", width, "bold"),
        Line(""),
        *head,
        *body[:branches],
        Line(""),
        *body[branches:],
        *(line for row in table for line in _told_below(row, left_out, width)),
        *(line for text in texts for line in _wrapped(text, width)),
    ]
    return [Line(line.text[:width], line.style) for line in _cropped(lines, height)]


def _arrangement(table: Sequence[Row], width: int) -> tuple[frozenset[str], int]:
    """Columns for which there is no room, and the blanks between the others."""
    for number in range(len(_LEAVE_OUT) + 1):
        left_out = frozenset(_LEAVE_OUT[:number])
        widths = [_column_width(table, name) for name in COLUMNS if name not in left_out]
        for gap in (_WIDE_GAP, _NARROW_GAP):
            if sum(widths) + gap * (len(widths) - 1) <= width:
                return left_out, gap
    return left_out, _NARROW_GAP


def _column_width(table: Sequence[Row], name: str) -> int:
    column = COLUMNS.index(name)
    least = _LEAST_NUMBER if name.endswith("[A]") else 0
    return max(least, *map(len, name.split()), *(len(row.cells[column]) for row in table))


def _drawn(table: Sequence[Row], names: Sequence[str], gap: int) -> tuple[list[Line], list[Line]]:
    """Head, and a line per row."""
    widths = [_column_width(table, name) for name in names]

    def line(cells: Sequence[str]) -> str:
        pairs = zip(names, cells, widths, strict=True)
        padded = [cell.ljust(width) if name in LEFT else cell.rjust(width) for name, cell, width in pairs]
        return (gap * " ").join(padded).rstrip()

    above = [name.split()[0] if " " in name else "" for name in names]
    rule = (sum(widths) + gap * (len(widths) - 1)) * "─"
    head = [Line(line(above)), Line(line([name.split()[-1] for name in names])), Line(rule)]
    columns = [COLUMNS.index(name) for name in names]
    return head, [Line(line([row.cells[column] for column in columns]), _style(row)) for row in table]


def _style(row: Row) -> str:
    return "yellow" if row.is_faulty else "" if row.is_seen else "dim"


def _told_below(row: Row, left_out: frozenset[str], width: int) -> list[Line]:
    told = [row.cells[COLUMNS.index(name)] for name in _TOLD_BELOW if name in left_out]
    text = ", ".join(cell for cell in told if cell.strip("-"))
    return _wrapped(f"{row.cells[0]}: {text}", width, _style(row)) if text else []


def _wrapped(text: str, width: int, style: str = "") -> list[Line]:
    return [Line(part, style) for part in textwrap.wrap(text, width, subsequent_indent="  ")]


def _cropped(lines: list[Line], height: int) -> list[Line]:
    """What a terminal of this height can show: if need be without empty lines, and with how many are missing."""
    if len(lines) > height:
        lines = [line for line in lines if line.text]
    if len(lines) <= height:
        return lines
    shown = height - 1
    return [*lines[:shown], Line(f"{len(lines) - shown} more lines do not fit", "yellow")]
