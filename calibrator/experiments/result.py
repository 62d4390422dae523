"""Results of experiments: rows of figures, ours beside the paper's."""

import os
import platform
from collections.abc import Mapping
from dataclasses import dataclass, field

import msgspec
from scipy.stats import beta

from calibrator.errors import FleetError
from calibrator.time_of_run import time_of_run
from ecu_node import __version__

__all__ = ["BOUND", "Bin", "ExperimentResult", "Figure", "Row", "Settings", "decode_result", "made_now", "share"]

Settings = Mapping[str, bool | int | float | str]
"""What is needed to repeat an experiment, by name; records of before version 1.0 hold flags as texts."""


BOUND = 0.95
"""One-sided confidence of the upper bounds beside rare counts. [1]"""


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
    def upper(self) -> float | None:
        """Upper bound of the share with a confidence of 95 % (Clopper and Pearson), also for 0 of n; else None."""
        if self.hits is None or not self.of:
            return None
        return 1.0 if self.hits == self.of else float(beta.ppf(BOUND, self.hits + 1, self.of - self.hits))


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
        Seed, repetitions, fleet law, drive.
    rows : tuple of Row
        Figures.
    paper : mapping of float to float
        Best recovery rate that the paper prints, by x, whatever methods were run; empty in records of before version
        1.0, whose rows say the same.
    note : str
        What is to be known of the settings, for the captions.
    made : str
        Version, machine and day, as :func:`made_now` says, of what the command ran; empty in records of before version
        1.0, and for an experiment that was called as a function.
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
            if row.x == x and row.method == method and row.series == series:
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


def decode_result(record: bytes, where: str) -> ExperimentResult:
    """Decode what :meth:`ExperimentResult.to_json` wrote.

    Parameters
    ----------
    record : bytes
        JSON.
    where : str
        The file, for the message.

    Returns
    -------
    ExperimentResult
        The result.

    Raises
    ------
    FleetError
        If it is no record of an experiment.
    """
    try:
        return msgspec.json.decode(record, type=ExperimentResult)
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise FleetError(
            f"{where}: not a record of an experiment: {error}; expected what 'calibrator experiment --out' writes; "
            "remove it, or run the experiment again"
        ) from None
