"""Records of experiments: rows of figures, ours beside the paper's, and what is needed to repeat them."""

import os
import platform
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import msgspec
from scipy.stats import beta

from calibrator.errors import FleetError
from calibrator.time_of_run import time_of_run
from ecu_node import __version__

__all__ = ["Bin", "ExperimentResult", "Figure", "Row", "Settings", "made_now", "read_results", "share"]

Settings = Mapping[str, bool | int | float | str]
"""What is needed to repeat an experiment, by name; records of before version 1.0 hold flags as texts."""
CONFIDENCE = 0.95
"""Of the intervals beside shares. [1]"""


@dataclass(frozen=True, kw_only=True)
class Figure:
    """One figure of merit.

    Attributes
    ----------
    mean, sd : float
        Over all vehicles of all repetitions, and standard deviation over repetitions; 0 for a single one.
    paper : float or None
        What the paper states, where it does.
    hits, of : int or None
        Of a share: how many of how many it is; None in records of before version 2.
    expected : float or None
        How many hits the method itself expects.
    """

    mean: float
    sd: float = 0.0
    paper: float | None = None
    hits: int | None = None
    of: int | None = None
    expected: float | None = None

    @property
    def interval(self) -> tuple[float, float] | None:
        """95 % interval of a share (Clopper and Pearson [1]_), for which vehicles are independent; None if no share.

        .. [1] C. Clopper, E. Pearson, "The use of confidence or fiducial limits ...", Biometrika 26 (1934).
        """
        if self.hits is None or not self.of:
            return None
        tail, misses = (1.0 - CONFIDENCE) / 2.0, self.of - self.hits
        low = float(beta.ppf(tail, self.hits, misses + 1)) if self.hits else 0.0
        high = float(beta.ppf(1.0 - tail, self.hits + 1, misses)) if misses else 1.0
        return low, high


def share(hits: int, of: int, expected: float | None = None) -> Figure:
    """Share as a figure; NaN of nothing."""
    return Figure(mean=hits / of if of else float("nan"), hits=hits, of=of, expected=expected)


@dataclass(frozen=True, kw_only=True)
class Bin:
    """Vehicles with about the same confidence.

    Attributes
    ----------
    low : float
        Lower end of the tenth of the scale. [1]
    count : int
        Vehicles.
    confidence, recovered : float
        Their mean confidence, and the share that is recovered. [1]
    """

    low: float
    count: int
    confidence: float
    recovered: float


@dataclass(frozen=True, kw_only=True)
class Row:
    """One method under one setting.

    Attributes
    ----------
    x : float
        Value of what the experiment varies.
    series : str
        What else it varies; empty if nothing.
    method : str
        Name of the method.
    figures : mapping of str to Figure
        By the names of :mod:`calibrator.experiments.outcome`, those that have a meaning here.
    bins : tuple of Bin
        Vehicles by confidence; empty for a method without one.
    pit : tuple of int
        Deployed parameters by tenths of their probability integral transform; equal if the posterior is right.
    """

    x: float
    series: str = ""
    method: str
    figures: Mapping[str, Figure]
    bins: tuple[Bin, ...] = ()
    pit: tuple[int, ...] = ()


@dataclass(frozen=True, kw_only=True)
class ExperimentResult:
    """All rows of an experiment, and what is needed to repeat it.

    Attributes
    ----------
    name, title : str
        Name on the command line, and what it shows.
    x_label, series_label : str
        What the experiment varies, with units; the latter is empty if rows have no series.
    settings : mapping
        Seed, repetitions, drive, and what all its settings have in common.
    rows : tuple of Row
        Figures.
    paper : mapping of float to float
        Best recovery rate that the paper prints, by x, whatever methods were run.
    note : str
        What is to be known of the settings, for the captions.
    made : str
        Version, machine and day, as :func:`made_now` says; empty for an experiment that was called as a function.
    """

    name: str
    title: str
    x_label: str
    series_label: str = ""
    settings: Settings
    rows: tuple[Row, ...]
    paper: Mapping[float, float] = field(default_factory=dict)
    note: str = ""
    made: str = ""

    def row(self, *, x: float, method: str, series: str = "") -> Row:
        """Return the row of a method under a setting; KeyError if there is none."""
        for row in self.rows:
            if (row.x, row.method, row.series) == (x, method, series):
                return row
        raise KeyError(f"no row for x={x:g}, series '{series}' and method '{method}'")

    @property
    def methods(self) -> tuple[str, ...]:
        """Methods in the order of their first rows."""
        return tuple(dict.fromkeys(row.method for row in self.rows))

    def to_json(self) -> bytes:
        """Encode as JSON, UTF-8."""
        return msgspec.json.format(msgspec.json.encode(self), indent=2) + b"\n"


def made_now() -> str:
    """Version of the calibrator, machine and day, in words."""
    return (
        f"calibrator {__version__}, Python {platform.python_version()} on {platform.machine()} with "
        f"{os.cpu_count()} cores, {time_of_run()[:10]}"
    )


def read_results(folder: Path, names: Iterable[str]) -> list[ExperimentResult]:
    """Read the records ``NAME.json`` of a folder in the given order; those that are not there are left out.

    Raises
    ------
    FleetError
        If one is no record of an experiment.
    """
    found = []
    for path in (folder / f"{name}.json" for name in names):
        if path.is_file():
            try:
                found.append(msgspec.json.decode(path.read_bytes(), type=ExperimentResult))
            except (msgspec.DecodeError, UnicodeDecodeError) as error:
                raise FleetError(
                    f"{path}: not a record of an experiment: {error}; expected what 'calibrator experiment --out' "
                    "writes; remove it, or run the experiment again"
                ) from None
    return found
