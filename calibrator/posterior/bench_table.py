"""Bench readings as a CSV table: one line per sensor that was checked.

Columns ``vehicle, branch`` and ``drift, drift_sd`` or ``offset_a, offset_sd_a`` or both pairs; a pair of empty cells
was not read. measured = (1 + drift) * true + offset; drifts are pure numbers, offsets in A.
"""

import csv
import io
import math
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

import numpy as np

from calibrator.errors import FleetError
from calibrator.evidence.readings import Readings
from calibrator.posterior.slab import WIDEST

__all__ = ["BenchReadings", "read_bench_readings", "readings_of", "vehicles_named"]

KEYS = ("vehicle", "branch")
PAIRS = (("drift", "drift_sd"), ("offset_a", "offset_sd_a"))
COLUMNS = (*KEYS, *PAIRS[0], *PAIRS[1])
LEAST_SD = 1e-5
"""Least standard deviation of a reading: no bench is sharper; over full scale. [1]"""

BenchReadings = Mapping[tuple[str, str], tuple[float, float, float, float]]
"""Drift, its standard deviation, offset and its standard deviation by vehicle and branch; NaN where not read."""


def read_bench_readings(
    path: Path,
    vehicles: Collection[str],
    branches: Collection[str],
    *,
    left_out: Mapping[str, str],
    full_scale_a: float,
) -> BenchReadings:
    """Read a table of bench readings.

    Parameters
    ----------
    path : Path
        CSV file with a header.
    vehicles, branches : collection of str
        Names that may stand in it.
    left_out : mapping of str to str
        Vehicles that have no usable drive, and why.
    full_scale_a : float
        Full scale of the junction. [A]

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
        raise FleetError(f"{path}: cannot read the bench readings: {error.strerror}; give a CSV table") from None
    except UnicodeDecodeError:
        raise FleetError(f"{path}: not a table of bench readings: the file is not UTF-8 text") from None
    table = csv.reader(io.StringIO(text, newline=""), skipinitialspace=True)
    found: dict[tuple[str, str], tuple[float, float, float, float]] = {}
    try:
        header = [cell.strip() for cell in next(table, [])]
        _check_header(header, path)
        for cells in table:
            if not any(cells):
                continue
            place = f"{path}: line {table.line_num}"
            if len(cells) > len(header):
                raise FleetError(f"{place}: {len(cells)} cells, and the header has {len(header)} columns")
            row = dict(zip(header, (cell.strip() for cell in cells), strict=False))
            sensor = _sensor(row, vehicles, branches, left_out=left_out, place=place)
            if sensor in found:
                raise FleetError(f"{place}: the {sensor[1]} sensor of {sensor[0]} stands there twice; give it one line")
            found[sensor] = _reading(row, place, full_scale_a)
    except csv.Error as error:
        raise FleetError(f"{path}: line {table.line_num}: not a table of bench readings: {error}") from None
    if not found:
        raise FleetError(f"{path}: no reading below the header; leave --readings out if there is none")
    return found


def vehicles_named(path: Path) -> set[str]:
    """Vehicles that stand in a table, as far as it can be read: what is wrong with it is told when it is read."""
    try:
        text = path.read_text(encoding="utf-8-sig")
        rows = csv.DictReader(io.StringIO(text, newline=""), skipinitialspace=True)
        return {str(row.get("vehicle") or "").strip() for row in rows}
    except (OSError, UnicodeDecodeError, csv.Error):
        return set()


def _check_header(header: Sequence[str], path: Path) -> None:
    if (
        set(KEYS) <= set(header) <= set(COLUMNS)
        and any(set(pair) <= set(header) for pair in PAIRS)
        and len(set(header)) == len(header)
    ):
        return
    raise FleetError(
        f"{path}: line 1: columns {', '.join(header) or 'none'}; expected each of {', '.join(COLUMNS)} once, one pair "
        f"of the last four may be left out"
    )


def _sensor(
    row: Mapping[str, str],
    vehicles: Collection[str],
    branches: Collection[str],
    *,
    left_out: Mapping[str, str],
    place: str,
) -> tuple[str, str]:
    """Vehicle and branch of a line."""
    vehicle, branch = row.get("vehicle", ""), row.get("branch", "")
    if vehicle in left_out and vehicle not in vehicles:
        raise FleetError(f"{place}: vehicle {vehicle!r} is left out: {left_out[vehicle]}")
    for name, known, what in ((vehicle, vehicles, "vehicle"), (branch, branches, "branch")):
        if name not in known:
            raise FleetError(f"{place}: no {what} {name!r} in this fleet; known are {_some(known)}")
    return vehicle, branch


def _reading(row: Mapping[str, str], place: str, full_scale_a: float) -> tuple[float, float, float, float]:
    """The two pairs of a line, each a pair of NaN where it was not read."""
    (drift, drift_sd), (offset_a, offset_sd_a) = (_pair(row, pair, place) for pair in PAIRS)
    if math.isnan(drift) and math.isnan(offset_a):
        raise FleetError(f"{place}: nothing was read; give drift and drift_sd, or offset_a and offset_sd_a")
    bounds = (
        ("drift", abs(drift), 0.0, WIDEST.high, "a relative gain error; 2 % is 0.02"),
        ("drift_sd", drift_sd, LEAST_SD, WIDEST.high, "a standard deviation; 0.1 % is 0.001"),
        ("offset_a", abs(offset_a), 0.0, WIDEST.high * full_scale_a, "in A"),
        ("offset_sd_a", offset_sd_a, LEAST_SD * full_scale_a, WIDEST.high * full_scale_a, "in A"),
    )
    for name, value, low, high, what in bounds:
        if not math.isnan(value) and not low <= value <= high:
            size = "a magnitude" if name in {"drift", "offset_a"} else "a number"
            raise FleetError(f"{place}: {name} is {row[name]}; expected {size} from {low:g} to {high:g}: {what}")
    return drift, drift_sd, offset_a, offset_sd_a


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


def _pair(row: Mapping[str, str], names: tuple[str, str], place: str) -> tuple[float, float]:
    """A value and its standard deviation; NaN if both are empty."""
    cells = [row.get(name, "") for name in names]
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
    return numbers[0], numbers[1]


def _some(names: Collection[str], most: int = 5) -> str:
    ordered = sorted(names)
    return ", ".join(ordered[:most]) + (", ..." if len(ordered) > most else "")
