"""Reports as text or JSON for standard output."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import msgspec

__all__ = ["dumps", "left_out_text", "reasons_text", "table", "told_once"]

MOST_NAMES = 6
"""Names told on one line: half a line of a terminal."""


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


def told_once(texts: Iterable[tuple[str, str]]) -> list[str]:
    """One line per text.

    Parameters
    ----------
    texts : iterable of (str, str)
        Name of a vehicle or drive, and what is to be said of it.

    Returns
    -------
    list of str
        Each text once, after the names it is about: the first few of many, and how many more there are.
    """
    names: dict[str, list[str]] = {}
    for name, text in texts:
        names.setdefault(text, []).append(name)
    return [f"{_few(found)}: {text}" for text, found in names.items()]


def reasons_text(title: str, reasons: Mapping[str, str], most: int = 10) -> str:
    """What is said of vehicles, one line per text with the vehicles that share it; empty if there is none."""
    if not reasons:
        return ""
    lines = told_once((name, reason or "no more is known") for name, reason in reasons.items())
    more = [f"  and {len(lines) - most} other lines, see the parameter files"] if len(lines) > most else []
    return "\n".join([f"{title}:", *(f"  {line}" for line in lines[:most]), *more])


def left_out_text(left_out: Mapping[str, str]) -> str:
    """One line per reason why things were left out; empty if nothing was."""
    return "\n".join(["left out:", *(f"  {line}" for line in told_once(left_out.items()))]) if left_out else ""


def _few(names: Sequence[str]) -> str:
    if len(names) <= MOST_NAMES:
        return ", ".join(names)
    return f"{', '.join(names[:MOST_NAMES])} and {len(names) - MOST_NAMES} more"
