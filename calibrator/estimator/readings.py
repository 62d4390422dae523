"""Direct readings of single sensors: bench checks, zero-current windows, trusted vehicles.

A zero-current window (contactors open) shows the offset itself; a bench check shows gain error (drift) and offset; the
sensors of a trusted vehicle were all found faultless. Each is one more Gaussian row of the evidence. The bench table is
a CSV file with one line per sensor that was checked: columns ``vehicle, branch`` and ``drift, drift_sd`` or ``offset_a,
offset_sd_a`` or both pairs; a pair of empty cells was not read. measured = (1 + drift) * true + offset.
"""

import csv
import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import NamedTuple

import numpy as np

from calibrator.drive import Array, Mask
from calibrator.errors import FleetError
from calibrator.estimator.evidence import UNKNOWN_VARIANCE, EvidenceRows
from calibrator.summaries.vehicle_summary import VehicleSummary, weighted_mean
from calibrator.terminal.text import few
from ecu_node.documents import read_user_file
from ecu_node.layout import UnmeasuredLoad
from ecu_node.parameters import SensorFinding

__all__ = [
    "FEWEST_TRUSTED",
    "FLOWS",
    "TRUSTED_DRIFT_SD",
    "TRUSTED_OFFSET_SD",
    "BenchReading",
    "BenchTable",
    "bench_readings",
    "current_flows",
    "flow_findings",
    "flows_in_fleet",
    "merge_readings",
    "read_bench_table",
    "untrusted_vehicles",
    "window_readings",
    "with_knowledge",
]

TRUSTED_DRIFT_SD = 0.002
"""Accuracy of a bench check of the gain, as of a laboratory shunt. [1]"""
TRUSTED_OFFSET_SD = 0.0005
"""Accuracy of a bench check of the zero, in fractions of full scale. [1]"""
FEWEST_TRUSTED = 3
"""Least number of trusted vehicles that can carry the reference."""
CONTRADICTION = 4.0
"""Difference of two readings of one sensor, in standard deviations, above which they contradict each other. [1]"""
CANCEL_SD, FLOW_SD = 3.0, 10.0
"""Standard deviations up to which the sum of two readings counts as zero, and above which the readings are far from it:
a current that flows always cancels; offsets of two sensors do by chance, the more rarely the better they are known.
[1]"""
LEAST_FLOWS, FLOWS_SHARE, SMALL_FLOW_SD = 3, 0.6, 4.0
"""Vehicles, and share of those with windows, in which the same two sensors cancel, and median size in standard
deviations, from which on a current flows in the whole fleet: small offsets of two sensors cancel in fewer. [1]"""
FLOWS = "two sensors show the same current with opposite signs while the contactors count as open, so one flows"
"""What :func:`current_flows` finds, in words."""
LEAST_GAIN, LEAST_OFFSET = 0.003, 0.001
"""Standard deviations that causes other than sensors add to a gain ratio, and to the junction constant over full scale.
[1]"""
MOST_LOAD = 0.015
"""Largest load without a sensor that a trusted vehicle may have, over full scale: a DC/DC converter or a cooler that
always runs. A fleet may share more (``prior.LARGEST_SHARED``), but trust in a vehicle must not hide that much. [1]"""

PAIRS = (("drift", "drift_sd"), ("offset_a", "offset_sd_a"))
COLUMNS = ("vehicle", "branch", *PAIRS[0], *PAIRS[1])
MEANING = {
    "drift": "a relative gain error; 2 % is 0.02",
    "drift_sd": "its standard deviation; 0.1 % is 0.001",
    "offset_a": "in A",
    "offset_sd_a": "its standard deviation in A",
}
LEAST_SD = 1e-5
"""Least standard deviation of a reading (of offsets: over full scale), as no bench is more exact. [1]"""
MOST_BYTES = 100_000_000
"""Largest size of a bench table: enough for a million vehicles. [byte]"""
LARGEST = 0.9
"""Largest fault that is accepted: a larger one is a typing error, such as a drift of 2 that means 2 %. [1]"""


class BenchReading(NamedTuple):
    """Bench reading of one sensor: drifts [1], offsets [A]; NaN where they were not read."""

    drift: float
    drift_sd: float
    offset_a: float
    offset_sd_a: float


BenchTable = Mapping[tuple[str, str], BenchReading]
"""Bench readings by vehicle and branch."""


def window_readings(vehicles: Sequence[VehicleSummary]) -> Array:
    """Return offsets that sensors showed in zero-current windows, in the form of :func:`bench_readings`; drifts NaN.

    They are NaN for the vehicles that :func:`current_flows` finds.
    """
    shown = np.array([(each.zero_current.offset_a, each.zero_current.sd_a) for each in vehicles])
    shown[current_flows(vehicles)] = np.nan
    return np.stack([np.full_like(shown, np.nan), shown]).transpose(2, 0, 1, 3)


def current_flows(vehicles: Sequence[VehicleSummary]) -> Mask:
    """Return for each of N vehicles whether a current flows from one sensor to another in its zero-current windows."""
    return np.asarray(np.any([(rest < CANCEL_SD) & (shown > FLOW_SD) for rest, shown in _pairs(vehicles)], axis=0))


def flows_in_fleet(vehicles: Sequence[VehicleSummary]) -> bool:
    """Return whether a current flows between the same two sensors in the windows of most vehicles, however small."""
    for rest, shown in _pairs(vehicles):
        known = np.isfinite(rest)
        fewest = max(LEAST_FLOWS, FLOWS_SHARE * np.count_nonzero(known))
        if np.count_nonzero(rest < CANCEL_SD) >= fewest and np.median(shown[known]) > SMALL_FLOW_SD:
            return True
    return False


def _pairs(vehicles: Sequence[VehicleSummary]) -> Iterator[tuple[Array, Array]]:
    """Yield for each two sensors |sum| and the smaller of both window readings, in standard deviations, (N,) each."""
    offset_a = np.array([each.zero_current.offset_a for each in vehicles])
    sd_a = np.array([each.zero_current.sd_a for each in vehicles])
    for p, r in combinations(range(offset_a.shape[1]), 2):
        one, other, sd = offset_a[:, p], offset_a[:, r], np.hypot(sd_a[:, p], sd_a[:, r])
        yield np.abs(one + other) / sd, np.minimum(np.abs(one), np.abs(other)) / sd


def flow_findings(vehicle: VehicleSummary) -> list[SensorFinding]:
    """Return a finding if :func:`current_flows` in the zero-current windows of a vehicle, else none."""
    text = f"{FLOWS}; its zero-current windows are not used; check [contactor] in the layout"
    finding = SensorFinding(branch=None, cause="window", probability=1.0, text=text)
    return [finding] if current_flows([vehicle])[0] else []


def bench_readings(bench: BenchTable, vehicles: Sequence[str], branches: Sequence[str]) -> Array:
    """Return the readings of N vehicles and K branches, by their names in a bench table, as one array.

    Returns
    -------
    ndarray of shape (2, 2, N, K)
        Value and its standard deviation, each of drift [1] and offset [A]; NaN where a sensor was not read.
    """
    unread = BenchReading(np.nan, np.nan, np.nan, np.nan)
    read = [[bench.get((vehicle, branch), unread) for branch in branches] for vehicle in vehicles]
    return np.array(read).reshape(len(vehicles), len(branches), 2, 2).transpose(3, 2, 0, 1)


def with_knowledge(
    rows: EvidenceRows,
    readings: Array | None,
    trusted: Mask,
    *,
    order: Sequence[int],
    full_scale_a: float,
    load: UnmeasuredLoad | None,
    zero: bool = True,
) -> EvidenceRows:
    """Return the evidence with what is known from other sources than the drives: readings, trust and load.

    Parameters
    ----------
    rows : EvidenceRows
        Evidence of N vehicles.
    readings : ndarray of shape (2, 2, N, K), or None
        Direct readings of their sensors, see :func:`bench_readings`, branches in the vehicles' own order.
    trusted : ndarray of bool of shape (N,)
        Vehicles whose sensors are all known to be right.
    order : sequence of int
        Branches in the order of the rows: branch k of the rows is branch ``order[k]`` of the vehicles.
    full_scale_a : float
        Full scale of the junction. [A]
    load : UnmeasuredLoad or None
        Load that no branch measures, if it is known.
    zero : bool
        Whether the offsets of trusted vehicles are known to be zero, too, and not only their gain errors.

    Returns
    -------
    EvidenceRows
        Evidence with rows for the readings; the variance of the junction constant includes that of the load.
    """
    at, N, K = rows.places, len(rows), rows.branches
    given = np.full((2, 2, N, K), np.nan) if readings is None else readings
    accuracy = np.array([[0.0, 0.0], [TRUSTED_DRIFT_SD, TRUSTED_OFFSET_SD * full_scale_a]])
    right = np.where(trusted[:, None], accuracy[:, :, None, None], np.nan) * np.ones(K)
    if not zero:
        right[:, 1] = np.nan
    known = np.array(weighted_mean((given[0], given[1]), (right[0], right[1])))[..., list(order)]
    (drift, offset_a), (drift_sd, offset_sd_a) = known
    value = np.array([np.log1p(drift), offset_a / full_scale_a])
    sd = np.array([drift_sd / (1.0 + drift), offset_sd_a / full_scale_a])
    read = np.isfinite(value) & np.isfinite(sd)
    values, covariance, row = rows.values.copy(), rows.covariance.copy(), np.r_[at.gain_reads, at.offset_reads]
    values[:, row] = np.hstack([*np.where(read, value, 0.0)])
    covariance[:, row, row] = np.hstack([*np.where(read, sd**2, UNKNOWN_VARIANCE)])
    if load is not None:
        covariance[:, at.junction, at.junction] += (load.sd_a / full_scale_a) ** 2
    return replace(rows, values=values, covariance=covariance)


def _text(path: Path) -> str:
    try:
        return read_user_file(path, largest_bytes=MOST_BYTES).decode("utf-8-sig")
    except OSError as error:
        raise FleetError(f"{path}: cannot read the bench readings: {error.strerror}; give a CSV table") from None
    except UnicodeDecodeError:
        raise FleetError(f"{path}: not a table of bench readings: the file is not UTF-8 text") from None


def read_bench_table(
    source: Path | str | None,
    branches: Collection[str],
    problems: Mapping[str, str],
    *,
    trusted: Collection[str],
    full_scale_a: float,
) -> BenchTable:
    """Read a table of bench readings from a CSV file or text.

    Parameters
    ----------
    source : Path, str or None
        CSV file with a header, or the CSV text of a data frame; None: no sensor was read.
    branches : collection of str
        Names of the K branches.
    problems : mapping of str to str
        Why a vehicle cannot be used, by vehicle; empty if it can.
    trusted : collection of str
        Vehicles whose sensors are said to be faultless.
    full_scale_a : float
        Full scale of the junction. [A]

    Returns
    -------
    mapping
        The readings by vehicle and branch.

    Raises
    ------
    FleetError
        If the table cannot be used, a vehicle does not exist or is left out, or a reading contradicts the trust in its
        vehicle; the message names file, line and what was expected.
    """
    if source is None:
        return {}
    bench: dict[tuple[str, str], BenchReading] = {}
    text, where = (source, "readings") if isinstance(source, str) else (_text(source), str(source))
    rows = csv.DictReader(text.splitlines(), skipinitialspace=True, restval="")
    try:
        rows.fieldnames = header = [name.strip() for name in rows.fieldnames or ()]
        lines = [(cells, rows.line_num) for cells in rows]
    except csv.Error as error:
        raise FleetError(f"{where}: line {rows.line_num}: not a table of bench readings: {error}") from None
    complete = {"vehicle", "branch"} <= set(header) <= set(COLUMNS) and len(set(header)) == len(header)
    if not complete or not any(set(pair) <= set(header) for pair in PAIRS):
        raise FleetError(
            f"{where}: columns {', '.join(header) or 'none'}; expected each of {', '.join(COLUMNS)} once, one pair of "
            f"the last four may be left out"
        )
    for cells, number in lines:
        if not any(cells.values()):
            continue
        # rows of a data frame count from 0, without the header
        place = f"{where}: row {number - 2}" if isinstance(source, str) else f"{where}: line {number}"
        if None in cells:
            raise FleetError(f"{place}: more cells than the {len(header)} columns of the header")
        row = {name: cell.strip() for name, cell in cells.items()}
        vehicle, branch = row["vehicle"], row["branch"]
        if vehicle not in problems:
            known = few(sorted(name for name, why in problems.items() if not why))
            raise FleetError(f"{place}: no vehicle {vehicle!r} in this fleet; there are, for example, {known}")
        if problems[vehicle]:
            raise FleetError(f"{place}: vehicle {vehicle!r} is left out: {problems[vehicle]}")
        if branch not in branches:
            raise FleetError(f"{place}: no branch {branch!r} in this fleet; known are {few(sorted(branches))}")
        if (vehicle, branch) in bench:
            raise FleetError(f"{place}: the {branch} sensor of {vehicle} stands there twice; give it one line")
        bench[vehicle, branch] = reading = _reading(row, place, full_scale_a)
        drift_sd = math.hypot(reading.drift_sd, TRUSTED_DRIFT_SD)
        offset_sd_a = math.hypot(reading.offset_sd_a, TRUSTED_OFFSET_SD * full_scale_a)
        apart = abs(reading.drift) / drift_sd, abs(reading.offset_a) / offset_sd_a  # NaN: not read
        if vehicle in trusted and any(each > CONTRADICTION for each in apart):
            raise FleetError(
                f"{place}: the {branch} sensor of {vehicle} was read as faulty, and {vehicle} is trusted; a trusted "
                f"vehicle is one whose sensors were all found faultless"
            )
    if not bench:
        raise FleetError(f"{where}: no reading below the header; leave --readings out if there is none")
    return bench


def _reading(row: Mapping[str, str], place: str, full_scale_a: float) -> BenchReading:
    """Read the numbers of one line; a pair is NaN where both of its cells are empty."""
    numbers = dict.fromkeys(COLUMNS[2:], math.nan)
    for name in (name for pair in PAIRS if any(row.get(each) for each in pair) for name in pair):
        unit = full_scale_a if name.startswith("offset") else 1.0
        low, high = LEAST_SD * unit if "sd" in name else -LARGEST * unit, LARGEST * unit
        with suppress(ValueError):
            numbers[name] = float(row.get(name, ""))
        if not low <= numbers[name] <= high:
            expected = f"a number from {low:g} to {high:g}: {MEANING[name]}"
            raise FleetError(f"{place}: {name} is {row.get(name, '')!r}; expected {expected}")
    if all(map(math.isnan, numbers.values())):
        raise FleetError(f"{place}: nothing was read; give drift and drift_sd, or offset_a and offset_sd_a")
    return BenchReading(**numbers)


def merge_readings(
    vehicles: Sequence[VehicleSummary], bench: BenchTable, branches: Sequence[str], *, windows: bool = True
) -> tuple[Array, list[str]]:
    """Return weighted means of what sensors showed on a bench and in zero-current windows.

    Parameters
    ----------
    vehicles : sequence of VehicleSummary
        N vehicles.
    bench : mapping
        Bench readings.
    branches : sequence of str
        Names of the K branches.
    windows : bool
        Whether zero-current windows are used.

    Returns
    -------
    readings : ndarray of shape (2, 2, N, K)
        Weighted means of bench and window readings, see :func:`bench_readings`; NaN where they contradict each other.
    notices : list of str
        Sensors whose readings contradict each other, and readings that could not be used.
    """
    names = [vehicle.vehicle for vehicle in vehicles]
    read, shown = bench_readings(bench, names, branches), window_readings(vehicles)
    if not windows:
        shown[:] = np.nan
    merged = np.array(weighted_mean((shown[0], shown[1]), (read[0], read[1])))
    (offset_a, sd_a), (read_a, read_sd_a) = shown[:, 1], read[:, 1]
    apart = np.abs(offset_a - read_a) > CONTRADICTION * np.hypot(sd_a, read_sd_a)
    merged[:, 1, apart] = np.nan
    notices = [
        f"vehicle {names[j]}: its {branches[k]} sensor was read as {read_a[j, k]:+.1f} A on the bench, and "
        f"showed {offset_a[j, k]:+.1f} A with open contactors: neither is used; check it again"
        for j, k in np.argwhere(apart).tolist()
    ]
    if unused := sorted({vehicle for vehicle, _ in bench} - set(names)):
        notices.append(f"bench readings of vehicles that are left out are not used: {', '.join(unused)}")
    return merged, notices


def untrusted_vehicles(
    rows: EvidenceRows,
    trusted: Mask,
    branches: Sequence[str],
    *,
    full_scale_a: float,
    load: UnmeasuredLoad | None = None,
) -> dict[int, str]:
    """Find trusted vehicles whose measured currents break the junction law, so that some sensor must be faulty.

    Trusted vehicles are judged alone: compared with a fleet of which most share an offset, they would stand out.

    Parameters
    ----------
    rows : EvidenceRows
        Evidence of N vehicles, without readings.
    trusted : ndarray of bool of shape (N,)
        Which are trusted.
    branches : sequence of str
        Names of the K branches in the order of the rows.
    full_scale_a : float
        Full scale of the junction. [A]
    load : UnmeasuredLoad or None
        Load that no branch measures; None: anything up to :data:`MOST_LOAD`, so that offsets of this size pass.

    Returns
    -------
    dict of int to str
        How each such vehicle breaks the law, by its position.
    """
    K, at = rows.branches, rows.places
    sd = np.sqrt(np.diagonal(rows.covariance, axis1=1, axis2=2))
    ratio, sum_a = rows.values[:, at.ratios], rows.values[:, at.junction] * full_scale_a
    accuracy = np.sqrt(2.0 * TRUSTED_DRIFT_SD**2 + LEAST_GAIN**2)
    off = np.where(np.abs(ratio) > CONTRADICTION * np.hypot(sd[:, at.ratios], accuracy), np.abs(ratio), 0.0)
    low_a, high_a, spread_a, why = 0.0, MOST_LOAD * full_scale_a, 0.0, "no load without a sensor explains"
    if load is not None:
        low_a, high_a, spread_a = load.mean_a, load.mean_a, load.sd_a
        why = f"the declared load of {load.mean_a:g} A does not explain"
    accuracy_a = np.hypot(np.sqrt(K * TRUSTED_OFFSET_SD**2 + LEAST_OFFSET**2) * full_scale_a, spread_a)
    away_a = np.maximum(low_a - sum_a, sum_a - high_a)
    sum_off = away_a > CONTRADICTION * np.hypot(sd[:, at.junction] * full_scale_a, accuracy_a)
    found = {}
    for j in np.flatnonzero(trusted & (off.any(axis=1) | sum_off)).tolist():
        k = int(np.argmax(off[j]))
        found[j] = f"its currents sum to {sum_a[j]:+.1f} A on average, which {why}"
        if off[j, k]:
            found[j] = f"the gains of its sensors {branches[k + 1]} and {branches[0]} differ by {ratio[j, k]:+z.1%}"
    return found
