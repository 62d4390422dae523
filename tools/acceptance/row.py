"""One promise and what became of it."""

from collections.abc import Sequence
from dataclasses import dataclass

__all__ = ["MissingFigureError", "Promise", "at_least", "at_most"]


class MissingFigureError(Exception):
    """A step ran and did not give a figure that a row judges."""


@dataclass(frozen=True, kw_only=True)
class Promise:
    """One line of the table.

    Attributes
    ----------
    what, bar, figure : str
        In words: what is promised, what it must reach, and what was measured.
    met : bool
        Whether it does.
    """

    what: str
    bar: str
    figure: str
    met: bool


def at_least(what: str, bars: Sequence[float], figures: Sequence[float], *, unit: str = "") -> Promise:
    """A promise of figures that must not be below their bars."""
    met = all(figure >= bar for figure, bar in zip(figures, bars, strict=True))
    return Promise(what=what, bar=f"at least {_text(bars, unit)}", figure=_text(figures, unit), met=met)


def at_most(what: str, bars: Sequence[float], figures: Sequence[float], *, unit: str = "") -> Promise:
    """A promise of figures that must not be above their bars."""
    met = all(figure <= bar for figure, bar in zip(figures, bars, strict=True))
    return Promise(what=what, bar=f"at most {_text(bars, unit)}", figure=_text(figures, unit), met=met)


def _text(numbers: Sequence[float], unit: str) -> str:
    return " / ".join(f"{number:.4g}" for number in numbers) + (f" {unit}" if unit else "")
