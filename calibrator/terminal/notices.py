"""Notices that many drives share, told once: counts are added up, vehicles are counted."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

__all__ = ["Notice", "merged_notices"]


@dataclass(frozen=True, kw_only=True)
class Notice:
    """What a user should know of a drive.

    Attributes
    ----------
    text : str
        With ``{}`` for every count; notices of one text are the same notice.
    counts : tuple of int
        How many frames, lines, ...; over several drives they add up.
    """

    text: str
    counts: tuple[int, ...] = ()

    def __str__(self) -> str:
        """The notice of this drive."""
        return self.text.format(*self.counts)


def merged_notices(notices: Mapping[tuple[str, str], Sequence[Notice]]) -> list[str]:
    """Tell equal notices once.

    Parameters
    ----------
    notices : mapping of (vehicle, drive) to sequence of Notice
        What is to be said of each drive.

    Returns
    -------
    list of str
        One line per notice, with the drive or the number of vehicles it is about.
    """
    found: dict[str, dict[tuple[str, str], Notice]] = {}
    for drive, items in notices.items():
        for item in items:
            found.setdefault(item.text, {})[drive] = item
    return [f"{_where(list(drives))}: {_sum(text, list(drives.values()))}" for text, drives in found.items()]


def _where(drives: Sequence[tuple[str, str]]) -> str:
    vehicles = len({vehicle for vehicle, _ in drives})
    if len(drives) == 1:
        return "/".join(drives[0])
    if vehicles == 1:
        return f"in {len(drives)} drives of {drives[0][0]}"
    return f"in {vehicles} vehicles" if vehicles == len(drives) else f"in {len(drives)} drives of {vehicles} vehicles"


def _sum(text: str, items: Sequence[Notice]) -> str:
    totals = (sum(counts) for counts in zip(*(item.counts for item in items), strict=True))
    return str(Notice(text=text, counts=tuple(totals)))
