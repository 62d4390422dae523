"""Reports as text or JSON for standard output."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import msgspec
import typer

from calibrator.errors import INTERNAL_ERROR as INTERNAL
from ecu_node.program import INTERNAL_ERROR, say_error, write_output

__all__ = [
    "Notice",
    "counted",
    "dumps",
    "end_if_internal",
    "few",
    "few_reasons",
    "figure",
    "left_out_text",
    "merged_notices",
    "print_report",
    "reasons_text",
    "table",
    "told_once",
]

MOST_NAMES = 6
"""Most names on one line: they take half a line of a terminal."""
MOST_REASONS = 5
"""Most vehicles whose reasons are in one message."""


def print_report(report: Any, *, json: bool) -> None:
    """Print a report, by its ``as_json`` or its ``as_text``, on standard output."""
    write_output(report.as_json() if json else report.as_text())


def dumps(value: Any) -> str:
    """Return a value as indented JSON text; not-a-number and infinity become null."""
    return msgspec.json.format(msgspec.json.encode(value), indent=2).decode()


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Format a header and rows of cells as lines with aligned columns: the first flush left, the others flush right."""
    lines = [header, *rows]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    return "\n".join(
        "  ".join([line[0].ljust(widths[0]), *map(str.rjust, line[1:], widths[1:])]).rstrip() for line in lines
    )


def told_once(texts: Iterable[tuple[str, str]]) -> list[str]:
    """Make one line of each text, however many names it is about.

    Parameters
    ----------
    texts : iterable of (str, str)
        Name of a vehicle or drive, and a text about it.

    Returns
    -------
    list of str
        Each text once, after the names it is about: the first few of many, and how many more there are.
    """
    names: dict[str, list[str]] = {}
    for name, text in texts:
        names.setdefault(text, []).append(name)
    return [f"{few(found)}: {text}" for text, found in names.items()]


def reasons_text(title: str, reasons: Mapping[str, str], most: int = 10) -> str:
    """Format the reasons of vehicles below a title: one line per reason, with the vehicles that have it.

    Beyond ``most`` lines it only says how many more there are; the text is empty without reasons.
    """
    lines = told_once((name, reason or "no more is known") for name, reason in reasons.items())
    more = [f"and {len(lines) - most} other lines, see the parameter files"] if len(lines) > most else []
    return "\n  ".join([f"{title}:", *lines[:most], *more]) if lines else ""


def left_out_text(left_out: Mapping[str, str]) -> str:
    """Format why vehicles or files are left out, one line per reason; empty if there are none."""
    return reasons_text("left out", left_out, most=len(left_out))


def end_if_internal(left_out: Mapping[str, str]) -> None:
    """If vehicles are left out because of internal errors, name the first few and end the command with exit code 70."""
    failed = {name: why.removeprefix(INTERNAL) for name, why in left_out.items() if why.startswith(INTERNAL)}
    if failed:
        lines = "; ".join(told_once(failed.items())[:MOST_REASONS])
        say_error(f"calibrator: internal error in {counted(len(failed), 'vehicle')}, which are left out: {lines}")
        raise typer.Exit(INTERNAL_ERROR)


def few(names: Sequence[str]) -> str:
    """Return names with commas between; of many only the first few, and how many more there are."""
    if len(names) <= MOST_NAMES:
        return ", ".join(names)
    return f"{', '.join(names[:MOST_NAMES])} and {len(names) - MOST_NAMES} more"


def few_reasons(reasons: Mapping[str, str]) -> str:
    """Return ``"; NAME: why"`` for each of the first :data:`MOST_REASONS`, and how many more there are."""
    text = "".join(f"; {name}: {why}" for name, why in list(reasons.items())[:MOST_REASONS])
    more = len(reasons) - MOST_REASONS
    return f"{text}; and {more} more" if more > 0 else text


def figure(value: float, digits: int = 3) -> str:
    """Format a number as people write it: ``50``, ``2.4``, ``0.035``, ``4,096``; a dash for NaN and infinity.

    Parameters
    ----------
    value : float
        The number.
    digits : int
        Significant digits; those before the decimal point are never rounded away.

    Returns
    -------
    str
        Without an exponent and without zeros at the end.
    """
    if not math.isfinite(value):
        return "-"
    decimals = min(max(digits - 1 - math.floor(math.log10(abs(value))), 0), 9) if value else 0
    text = f"{value:,.{decimals}f}"
    bare = text.rstrip("0").rstrip(".") if "." in text else text
    return "0" if bare == "-0" else bare


def counted(number: int, what: str) -> str:
    """Return a number with what it counts, in the plural if needed: ``1 drive``, ``2 drives``."""
    return f"{number} {what}" if number == 1 else f"{number} {what}s"


@dataclass(frozen=True, kw_only=True)
class Notice:
    """Something that a user should know about a drive.

    Attributes
    ----------
    text : str
        Text with ``{}`` for every count, such as ``{} frames are damaged``; notices with the same text are merged.
    counts : tuple of int
        Numbers of frames, lines, ...; they add up over several drives.
    """

    text: str
    counts: tuple[int, ...] = ()

    def __str__(self) -> str:
        """Return the text with the counts of this drive."""
        return self.text.format(*self.counts)


def merged_notices(notices: Mapping[tuple[str, str], Sequence[Notice]]) -> list[str]:
    """Return one line for all notices with the same text, with the sums of their counts.

    Parameters
    ----------
    notices : mapping of (vehicle, drive) to sequence of Notice
        Notices of each drive.

    Returns
    -------
    list of str
        One line per text, after the drive, or the number of drives or vehicles, that it is about.
    """
    found: dict[str, dict[tuple[str, str], tuple[int, ...]]] = {}
    for drive, items in notices.items():
        for item in items:
            found.setdefault(item.text, {})[drive] = item.counts
    totals = {text: map(sum, zip(*counts.values(), strict=True)) for text, counts in found.items()}
    return [f"{_where(list(drives))}: {text.format(*totals[text])}" for text, drives in found.items()]


def _where(drives: Sequence[tuple[str, str]]) -> str:
    vehicles = len({vehicle for vehicle, _ in drives})
    if len(drives) == 1:
        return "/".join(drives[0])
    if vehicles == 1:
        return f"in {len(drives)} drives of {drives[0][0]}"
    return f"in {vehicles} vehicles" if vehicles == len(drives) else f"in {len(drives)} drives of {vehicles} vehicles"
