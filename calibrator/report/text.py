"""Reports as text or JSON for standard output."""

from collections.abc import Mapping, Sequence
from typing import Any

import msgspec

__all__ = ["dumps", "left_out_text", "table", "undecided_text"]


def dumps(value: Any) -> str:
    """JSON text, indented; not-a-number and infinity become null."""
    return msgspec.json.format(msgspec.json.encode(value), indent=2).decode()


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Columns of text: the first flush left, the others flush right."""
    lines = [list(header), *map(list, rows)]
    widths = [max(len(line[k]) for line in lines) for k in range(len(header))]
    return "\n".join(
        "  ".join(
            cell.ljust(w) if k == 0 else cell.rjust(w) for k, (cell, w) in enumerate(zip(line, widths, strict=True))
        ).rstrip()
        for line in lines
    )


def undecided_text(undecided: Mapping[str, str], most: int = 10) -> str:
    """One line per vehicle of which nothing can be told, and what would decide; empty if there is none."""
    if not undecided:
        return ""
    lines = [f"  {name}: {reason or 'no explanation stands out'}" for name, reason in list(undecided.items())[:most]]
    more = [f"  and {len(undecided) - most} more, see their parameter files"] if len(undecided) > most else []
    return "\n".join(["cannot tell:", *lines, *more])


def left_out_text(left_out: Mapping[str, str]) -> str:
    """One line per thing that was left out, and why; empty if there is none."""
    if not left_out:
        return ""
    return "\n".join(["left out:", *(f"  {name}: {reason}" for name, reason in left_out.items())])
