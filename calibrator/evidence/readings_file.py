"""Bench readings as a CSV table: one line per sensor that was checked.

Columns ``vehicle, branch`` and ``drift, drift_sd`` or ``offset_a, offset_sd_a`` or both pairs; a pair of empty cells
was not read. measured = (1 + drift) * true + offset; drifts are pure numbers, offsets in A.
"""

import csv
import math
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

import numpy as np

from calibrator.errors import FleetError
from calibrator.evidence.readings import Readings

__all__ = ["BenchReadings", "read_bench_readings", "readings_of"]

KEYS = ("vehicle", "branch")
PAIRS = (("drift", "drift_sd"), ("offset_a", "offset_sd_a"))
COLUMNS = (*KEYS, *PAIRS[0], *PAIRS[1])

BenchReadings = Mapping[tuple[str, str], tuple[float, float, float, float]]
"""Drift, its standard deviation, offset and its standard deviation by vehicle and branch; NaN where not read."""


def read_bench_readings(path: Path, vehicles: Collection[str], branches: Collection[str]) -> BenchReadings:
    """Read a table of bench readings.

    Parameters
    ----------
    path : Path
        CSV file with a header.
    vehicles, branches : collection of str
        Names that may stand in it.

    Returns
    -------
    mapping
        The readings by vehicle and branch.

    Raises
    ------
    FleetError
        Naming file, line, what was expected.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise FleetError(f"{path}: cannot read the bench readings: {error.strerror}") from None
    except UnicodeDecodeError:
        raise FleetError(f"{path}: not a table of bench readings: the file is not UTF-8 text") from None
    table = csv.DictReader(text.splitlines(), skipinitialspace=True)
    header = table.fieldnames or ()
    if not set(KEYS) <= set(header) <= set(COLUMNS) or not any(set(pair) <= set(header) for pair in PAIRS):
        raise FleetError(
            f"{path}: line 1: columns {', '.join(header) or 'none'}; expected {', '.join(COLUMNS)}, one pair of the "
            f"last four may be left out"
        )
    found: dict[tuple[str, str], tuple[float, float, float, float]] = {}
    for row in table:
        place = f"{path}: line {table.line_num}"
        if None in row:
            raise FleetError(f"{place}: more cells than the {len(header)} columns of the header")
        sensor = (row["vehicle"] or "").strip(), (row["branch"] or "").strip()
        for name, known, what in zip(sensor, (vehicles, branches), KEYS, strict=True):
            if name not in known:
                raise FleetError(f"{place}: no {what} {name!r} in this fleet; known are {_some(known)}")
        if sensor in found:
            raise FleetError(f"{place}: the {sensor[1]} sensor of {sensor[0]} stands there twice; give it one line")
        drift, offset = (_pair(row, pair, place) for pair in PAIRS)
        if math.isnan(drift[0]) and math.isnan(offset[0]):
            raise FleetError(f"{place}: nothing was read; give drift and drift_sd, or offset_a and offset_sd_a")
        if drift[0] <= -1.0:
            raise FleetError(f"{place}: drift {drift[0]:g}; expected a relative gain error above -1, such as 0.02")
        found[sensor] = (*drift, *offset)
    return found


def readings_of(readings: BenchReadings, vehicles: Sequence[str], branches: Sequence[str]) -> Readings:
    """Bench readings as arrays.

    Parameters
    ----------
    readings : mapping
        From :func:`read_bench_readings`.
    vehicles, branches : sequence of str
        Names of N vehicles and K branches.

    Returns
    -------
    Readings
        NaN where nothing was read.
    """
    values = np.full((len(vehicles), len(branches), 4), np.nan)
    for j, vehicle in enumerate(vehicles):
        for k, branch in enumerate(branches):
            values[j, k] = readings.get((vehicle, branch), math.nan)
    drift, drift_sd, offset_a, offset_sd_a = np.moveaxis(values, 2, 0)
    return Readings(drift=drift, drift_sd=drift_sd, offset_a=offset_a, offset_sd_a=offset_sd_a)


def _pair(row: Mapping[str, str | None], names: tuple[str, str], place: str) -> tuple[float, float]:
    """A value and its standard deviation; NaN if both are empty."""
    cells = [(row.get(name) or "").strip() for name in names]
    if not any(cells):
        return math.nan, math.nan
    numbers = []
    for name, cell in zip(names, cells, strict=True):
        try:
            numbers.append(float(cell))
        except ValueError:
            numbers.append(math.nan)
        if not math.isfinite(numbers[-1]):
            raise FleetError(f"{place}: {name} is {cell!r}; expected a number, and {names[0]} together with {names[1]}")
    value, sd = numbers
    if not sd > 0.0:
        raise FleetError(f"{place}: {names[1]} is {sd:g}; expected the positive standard deviation of the reading")
    return value, sd


def _some(names: Collection[str], most: int = 5) -> str:
    ordered = sorted(names)
    return ", ".join(ordered[:most]) + (", ..." if len(ordered) > most else "")
