"""Results of experiments: rows of figures, ours beside the paper's."""

from collections.abc import Mapping
from dataclasses import dataclass

import msgspec

__all__ = ["ExperimentResult", "Figure", "Row"]


@dataclass(frozen=True, kw_only=True)
class Figure:
    """One figure of merit.

    Attributes
    ----------
    mean, sd : float
        Over repetitions; the deviation is 0 for a single one.
    paper : float or None
        What the paper states, where it does.
    """

    mean: float
    sd: float
    paper: float | None = None


@dataclass(frozen=True, kw_only=True)
class Row:
    """One method under one setting.

    Attributes
    ----------
    x : float
        Value of what the experiment varies.
    method : str
        Name of the method.
    figures : mapping of str to Figure
        By name: recovery_rate, recovery_rate_25, f2, complexity, failed.
    """

    x: float
    method: str
    figures: Mapping[str, Figure]


@dataclass(frozen=True, kw_only=True)
class ExperimentResult:
    """All rows of an experiment, and what is needed to repeat it.

    Attributes
    ----------
    name, title : str
        Name on the command line, and what it shows.
    x_label : str
        What the experiment varies, with its unit.
    settings : mapping
        Seed, repetitions, fleet law, drive.
    rows : tuple of Row
        Figures.
    """

    name: str
    title: str
    x_label: str
    settings: Mapping[str, float | int | str]
    rows: tuple[Row, ...]

    def row(self, *, x: float, method: str) -> Row:
        """Return the row of a method under a setting; KeyError if there is none."""
        for row in self.rows:
            if row.x == x and row.method == method:
                return row
        raise KeyError(f"no row for x={x:g} and method '{method}'")

    def to_json(self) -> bytes:
        """Encode as JSON, UTF-8."""
        return msgspec.json.format(msgspec.json.encode(self), indent=2) + b"\n"
