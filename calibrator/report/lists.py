"""Lists of the fleet report: largest faults, what the workshop should look at, who was left out, what has changed."""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibrator.drive import Array, Mask
from calibrator.report.fleet_table import FleetTable
from calibrator.report.overview import Overview
from calibrator.report.protection import Margins
from calibrator.report.words import amperes, with_sd
from calibrator.terminal.text import few

__all__ = [
    "HardwareRow",
    "HoldingUp",
    "LeftOutRow",
    "SensorRow",
    "Workshop",
    "changes_since",
    "comparison_rows",
    "holding_up",
    "largest_faults",
    "left_out_rows",
    "moved_texts",
    "workshop_list",
]

MOST_RANKED = 50
MOST_WORKSHOP = 500
MOST_MOVED = 200
MOST_HOLDING = 10
"""Rows of the lists; all of them stand in ``results.parquet``."""
TO_REPLACE = ("beyond the limits", "does not fit")
"""Why a fault is held back that no gain error and offset mend."""


@dataclass(frozen=True, kw_only=True)
class SensorRow:
    """One sensor: what it is off by at full scale [A], its drift and offset as text, and what is done about it."""

    vehicle: str
    branch: str
    error_a: float
    drift: str
    offset: str
    probability: float
    state: str


@dataclass(frozen=True, kw_only=True)
class HardwareRow:
    """One vehicle with a suspected hardware fault: probability, d_h [1] and o_h of each branch [A]."""

    vehicle: str
    probability: float
    drift: float
    offset_a: Sequence[float]


@dataclass(frozen=True, kw_only=True)
class Workshop:
    """What a workshop should look at."""

    hardware: Sequence[HardwareRow]
    hardware_caption: str
    sensors: Sequence[SensorRow]
    sensor_caption: str


@dataclass(frozen=True, kw_only=True)
class HoldingUp:
    """A vehicle that needs a large margin after correction [A], and what would decide about it."""

    vehicle: str
    margin_a: float
    verdict: str
    reason: str


@dataclass(frozen=True, kw_only=True)
class LeftOutRow:
    """Vehicles left out for one reason."""

    count: int
    reason: str
    names: str


def largest_faults(table: FleetTable) -> list[SensorRow]:
    """Faulty sensors by falling error at full scale, up to :data:`MOST_RANKED`."""
    return _sensors(table, table.faulty)[:MOST_RANKED]


def workshop_list(table: FleetTable) -> Workshop:
    """Suspected hardware faults by falling probability and size, and sensors that parameters do not mend.

    Parameters
    ----------
    table : FleetTable
        The result.

    Returns
    -------
    Workshop
        Up to :data:`MOST_WORKSHOP` of each, and how many there are.
    """
    size_a = np.abs(table.hardware_drift) * table.run.full_scale_a + np.abs(table.hardware_offset_a).max(axis=1)
    order = np.lexsort((-size_a, -np.round(np.nan_to_num(table.hardware_probability, nan=1.0), 3)))
    places = [j for j in order.tolist() if table.suspected[j]]
    beyond = np.isin(table.held_back.astype(str), TO_REPLACE)
    sensors = _sensors(table, beyond)
    return Workshop(
        hardware=[
            HardwareRow(
                vehicle=str(table.vehicle[j]),
                probability=float(table.hardware_probability[j]),
                drift=float(table.hardware_drift[j]),
                offset_a=table.hardware_offset_a[j].tolist(),
            )
            for j in places[:MOST_WORKSHOP]
        ],
        hardware_caption=_caption(len(places), "vehicles"),
        sensors=sensors[:MOST_WORKSHOP],
        sensor_caption=_caption(len(sensors), "sensors"),
    )


def holding_up(table: FleetTable, found: Margins | None) -> list[HoldingUp]:
    """Vehicles that need more than half of the margin that is one for all after correction, the largest first."""
    if found is None:
        return []
    holding = np.argsort(-found.after_a, kind="stable")[:MOST_HOLDING]
    holding = holding[found.after_a[holding] > found.common_after_a / 2.0]
    return [
        HoldingUp(
            vehicle=str(table.vehicle[j]),
            margin_a=float(found.after_a[j]),
            verdict=str(table.verdict[j]),
            reason=str(table.reason[j] or ""),
        )
        for j in holding.tolist()
    ]


def left_out_rows(table: FleetTable, overview: Overview) -> list[LeftOutRow]:
    """Vehicles without parameters by reason, the most frequent reasons first."""
    names: dict[str, list[str]] = defaultdict(list)
    for vehicle, reason in zip(table.left_out, table.left_out_reason, strict=True):
        names[str(reason or "no reason is stored")].append(str(vehicle))
    return [
        LeftOutRow(count=count, reason=reason, names=few(names[reason]))
        for reason, count in overview.left_out_reasons.items()
    ]


def moved_texts(table: FleetTable) -> list[str]:
    """Sensors that have moved since an earlier result, in words."""
    rows, branches = np.nonzero(table.moved.astype(bool))
    found = zip(rows.tolist(), branches.tolist(), strict=True)
    return [f"{table.vehicle[j]}, {table.branches[k]}: {table.moved[j, k]}" for j, k in found][:MOST_MOVED]


def changes_since(table: FleetTable, earlier: FleetTable | None) -> dict[str, Array]:
    """By how much what sensors show at full scale has changed since an earlier result.

    Parameters
    ----------
    table, earlier : FleetTable, FleetTable or None
        Results of the same fleet, with the same branches.

    Returns
    -------
    dict of str to ndarray of shape (n,)
        By branch, of the sensors whose parameters differ: change of drift times full scale plus offset. [A]
    """
    if earlier is None:
        return {}
    place = earlier.places(table.vehicle.tolist())
    both = place >= 0
    found: dict[str, Array] = {}
    for k, name in enumerate(table.branches):
        drift = table.drift[both, k] - earlier.drift[place[both], k]
        offset_a = table.offset_a[both, k] - earlier.offset_a[place[both], k]
        changed = (drift != 0.0) | (offset_a != 0.0)
        found[name] = (drift * table.run.full_scale_a + offset_a)[changed]
    return found if any(map(len, found.values())) else {}


def comparison_rows(table: FleetTable, other: FleetTable) -> list[tuple[str, str, str]]:
    """What two methods found, side by side."""

    def told(each: FleetTable) -> dict[str, str]:
        return {
            "vehicles calibrated": f"{len(each):,}",
            "corrected": f"{int(each.corrected.sum()):,}",
            "cannot tell": f"{each.counts.verdicts['cannot tell']:,}",
            "hardware fault suspected": f"{each.counts.hardware_suspected:,}",
            "Kirchhoff sum as measured, median RMS": amperes(float(np.median(each.measured_a))),
            "after correction, median": amperes(float(np.median(each.deployed_a))),
            "after correction, 95 % of the vehicles below": amperes(float(np.quantile(each.deployed_a, 0.95))),
        }

    mine, its = told(table), told(other)
    return [(label, mine[label], its[label]) for label in mine]


def _sensors(table: FleetTable, chosen: Mask) -> list[SensorRow]:
    """Some sensors by falling error at full scale."""
    error_a = table.error_a
    rows, branches = np.nonzero(chosen)
    order: NDArray[np.int64] = np.argsort(-error_a[rows, branches], kind="stable")[: max(MOST_RANKED, MOST_WORKSHOP)]
    return [_sensor(table, int(rows[n]), int(branches[n]), float(error_a[rows[n], branches[n]])) for n in order]


def _sensor(table: FleetTable, j: int, k: int, error_a: float) -> SensorRow:
    return SensorRow(
        vehicle=str(table.vehicle[j]),
        branch=table.branches[k],
        error_a=error_a,
        drift=with_sd(table.drift[j, k], table.drift_sd[j, k], factor=100.0, unit=" %"),
        offset=with_sd(table.offset_a[j, k], table.offset_sd_a[j, k], factor=1.0, unit=" A"),
        probability=float(table.fault_probability[j, k]),
        state="corrected" if table.applied[j, k] else str(table.held_back[j, k] or "not applied"),
    )


def _caption(count: int, what: str) -> str:
    return f"{count:,} {what}{f', the first {MOST_WORKSHOP}' if count > MOST_WORKSHOP else ''}."
