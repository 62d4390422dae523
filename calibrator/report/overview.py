"""What a result says of a fleet as a whole: its numbers, what to do next, and the workshop list."""

import math
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from calibrator.drive import Array
from calibrator.estimator.vehicle_report import REASONS
from calibrator.report.fleet_table import FleetTable, ParameterDetails
from calibrator.terminal.text import few

__all__ = [
    "FLEET_CAUSES",
    "Overview",
    "WorkshopRow",
    "amperes",
    "next_steps",
    "overview_of",
    "percent",
    "probability",
    "workshop_list",
]

MOST_REASONS = 20
"""Reasons of vehicles left out that are given one by one."""
_NOT_KNOWN = "not known"
WOULD_DECIDE = " would decide"
"""Ends what a reason asks for; what it would show stands behind."""
FLEET_CAUSES = ("load", "batch", "variant")
"""Findings that many vehicles share and a workshop cannot mend: they come last in its list."""


@dataclass(frozen=True, kw_only=True)
class Spread:
    """Median, and the values between which the middle 90 % lie; NaN if nothing is known."""

    median: float
    p05: float
    p95: float


@dataclass(frozen=True, kw_only=True)
class BranchHealth:
    """What is known of one branch of the fleet's reference.

    Attributes
    ----------
    agreeing_share : float or None
        Share of the vehicles whose sensors agree. [1]
    model_spread : float or None
        Standard deviation of the slopes of vehicles without a fault. [1]
    """

    agreeing_share: float | None
    model_spread: float | None


@dataclass(frozen=True, kw_only=True)
class Overview:
    """Numbers of a fleet.

    Attributes
    ----------
    vehicles, left_out : int
        Vehicles with parameters, and without.
    verdicts : mapping of str to int
        Vehicles per verdict.
    corrected : int
        Vehicles of which a branch is corrected.
    hardware_suspected : int or None
        Vehicles in which a hardware fault is suspected; None if the method cannot see one.
    faulty_sensors, applied_sensors : int
        Sensors in which a fault was found; those of them that are corrected.
    held_back : mapping of str to int
        Faults that are not corrected, by reason.
    junction_measured_a, junction_deployed_a : Spread
        Root mean square of the Kirchhoff sum per vehicle, before and after correction with what is applied. [A]
    unmeasured_a : float or None
        Mean load that no branch measures: the sum that right sensors show. [A]
    duration_h : Spread
        Length of the drives of a vehicle. [h]
    delay_ms : mapping of str to Spread
        How much later than the largest branch each is seen, where it is known. [ms]
    reference : mapping of str to BranchHealth
        By branch; empty if the method has no reference.
    left_out_reasons : mapping of str to int
        Vehicles left out, by reason; the most frequent ones.
    moved_sensors : int
        Sensors that have changed since the earlier result of ``calibrate --since``.
    """

    vehicles: int
    left_out: int
    verdicts: Mapping[str, int]
    corrected: int
    hardware_suspected: int | None
    faulty_sensors: int
    applied_sensors: int
    held_back: Mapping[str, int]
    junction_measured_a: Spread
    junction_deployed_a: Spread
    unmeasured_a: float | None
    duration_h: Spread
    delay_ms: Mapping[str, Spread]
    reference: Mapping[str, BranchHealth]
    left_out_reasons: Mapping[str, int]
    moved_sensors: int


def overview_of(table: FleetTable) -> Overview:
    """Count and summarise a result."""
    reference = table.run.details.get("reference", {})
    spread = table.run.details.get("hyperparameters", {}).get("model_spread", {})
    agreeing = reference.get("agreeing_share", {})
    held_back, faulty, suspected = table["held_back"], table.faulty, table.of_vehicles("hardware_fault")
    seen = suspected.any() or np.isfinite(table.of_vehicles("hardware_probability")).any()
    return Overview(
        vehicles=len(table),
        left_out=len(table.left_out),
        verdicts=dict(Counter(table.of_vehicles("verdict").tolist()).most_common()),
        corrected=int(table.corrected.sum()),
        hardware_suspected=int(suspected.sum()) if seen else None,
        faulty_sensors=int(faulty.sum()),
        applied_sensors=int((faulty & table["applied"]).sum()),
        held_back=dict(Counter(held_back[held_back.astype(bool)].tolist()).most_common()),
        junction_measured_a=_spread(table.of_vehicles("junction_rms_measured_a")),
        junction_deployed_a=_spread(table.deployed_a),
        unmeasured_a=reference.get("unmeasured_a"),
        duration_h=_spread(table.of_vehicles("duration_s") / 3600.0),
        delay_ms={
            name: _spread(1e3 * delay_s)
            for name, delay_s in zip(table.branches, table["delay_s"].T, strict=True)
            if np.isfinite(delay_s).any()
        },
        reference={  # a share of exactly 0 stands for a branch that no vehicle shows
            name: BranchHealth(agreeing_share=agreeing.get(name) or None, model_spread=spread.get(name))
            for name in (table.branches if reference and spread else ())
        },
        left_out_reasons=dict(Counter(table.left_out.values()).most_common(MOST_REASONS)),
        moved_sensors=int(table["moved"].astype(bool).sum()),
    )


def _spread(values: Array) -> Spread:
    known = values[np.isfinite(values)]
    low, middle, high = np.quantile(known, [0.05, 0.5, 0.95]).tolist() if len(known) else (np.nan,) * 3
    return Spread(median=middle, p05=low, p95=high)


@dataclass(frozen=True, kw_only=True)
class WorkshopRow:
    """What a workshop should look at: which vehicle and branch (empty: the vehicle), cause, probability [1], why."""

    vehicle: str
    branch: str
    cause: str
    probability: float | None
    text: str


def workshop_list(table: FleetTable, files: Mapping[int, ParameterDetails]) -> list[WorkshopRow]:
    """List what parameters do not mend, by falling probability: hardware, sensors, what many vehicles share.

    Parameters
    ----------
    table : FleetTable
        The result.
    files : mapping of int to ParameterDetails
        What the parameter files add, by the vehicle's place in the table.
    """

    def row(j: int, branch: str | None, cause: str, text: str, value: float) -> WorkshopRow:
        known = value if math.isfinite(value) else None
        return WorkshopRow(
            vehicle=str(table.vehicle[j]), branch=branch or "", cause=cause, probability=known, text=text
        )

    hardware = table.of_vehicles("hardware_probability").tolist()
    rows = [
        row(j, None, "hardware", f"its currents differ from the fleet's{_changes(table, j)}", hardware[j])
        for j in np.flatnonzero(table.of_vehicles("hardware_fault")).tolist()
    ]
    for j, k in np.argwhere(table["held_back"] == "beyond the limits").tolist():
        fault = f"gain error {percent(table['drift'][j, k], 1, sign=True)}, offset {amperes(table['offset_a'][j, k])}"
        text = f"{fault}: {REASONS['beyond the limits']}"
        rows.append(row(j, table.branches[k], "beyond the limits", text, float(table["fault_probability"][j, k])))
    unfit = (table["held_back"] == "does not fit").any(axis=1)
    for j, file in files.items():
        rows += [row(j, each.branch, each.cause, each.text, each.probability) for each in file.findings]
        if unfit[j] and not file.findings:
            rows.append(row(j, None, "does not fit", f"a sensor to check: {REASONS['does not fit']}", math.nan))
    rows.sort(key=lambda row: (row.cause in FLEET_CAUSES, row.cause != "hardware", -(row.probability or 0.0)))
    return rows


def _changes(table: FleetTable, j: int) -> str:
    """By how much a hardware fault changes the currents of a vehicle."""
    drift = table.of_vehicles("hardware_drift")[j]
    parts = [f"all {percent(drift, 2, sign=True)}"] if abs(drift) >= 5e-5 else []
    offset_a = zip(table.branches, table["hardware_offset_a"][j].tolist(), strict=True)
    parts += [f"{name} {amperes(value, sign=True)}" for name, value in offset_a if abs(value) >= 0.005]
    return f": {', '.join(parts)}" if parts else ""


def next_steps(table: FleetTable, workshop: Sequence[WorkshopRow]) -> list[str]:
    """Say what to do with a result, one sentence each, the first step first."""
    corrected = table.vehicle[table.corrected].tolist()
    steps = []
    if corrected:
        steps.append(
            f"Install the parameters of {few(corrected)} on their nodes: params/VEHICLE.json of the result, or "
            f"'calibrator params RESULT VEHICLE'."
        )
    # What the workshop list has already is no question of evidence.
    mended = np.isin(table["held_back"].astype(str), ("beyond the limits", "does not fit")).any(axis=1)
    deciding: dict[str, dict[str, str]] = defaultdict(dict)
    for vehicle, reason in zip(table.vehicle[~mended], table.of_vehicles("reason")[~mended], strict=True):
        if reason:
            what, would, more = reason.partition(WOULD_DECIDE)
            deciding[what + would][vehicle] = more
    for what, vehicles in sorted(deciding.items(), key=lambda item: -len(item[1])):
        names, more = few(list(vehicles)), next(iter(vehicles.values())) if len(vehicles) == 1 else ""
        plain = f"{names}: {what}."
        steps.append(f"{what[:1].upper()}{what[1:]} about {names}{more}." if what.endswith(WOULD_DECIDE) else plain)
    hardware = [row.vehicle for row in workshop if row.cause == "hardware"]
    if hardware:
        steps.append(f"Look at the hardware of {few(hardware)}: their currents differ from the fleet's.")
    sensors = [row for row in workshop if row.cause not in {"hardware", *FLEET_CAUSES}]
    if sensors:
        named = dict.fromkeys(f"{row.vehicle} ({row.branch})" if row.branch else row.vehicle for row in sensors)
        steps.append(f"Check the sensors of {few(list(named))}: see the workshop list.")
    if table.left_out:
        reason = Counter(table.left_out.values()).most_common(1)[0][0]
        steps.append(f"Find out why {few(list(table.left_out))} could not be used; most often: {reason}.")
    return steps or ["Nothing: no fault was found, and no question is open."]


def amperes(value: float | None, *, digits: int = 2, sign: bool = False) -> str:
    """A current [A] with its unit."""
    return _number(value, digits, sign=sign, unit=" A")


def percent(value: float | None, digits: int, *, sign: bool = False) -> str:
    """A share or a relative change [1] in percent."""
    return _number(None if value is None else 100.0 * value, digits, sign=sign, unit=" %")


def probability(value: float | None) -> str:
    """A probability [1] in percent, never as certainty."""
    if value is None or not math.isfinite(value):
        return _NOT_KNOWN
    return "> 99.9 %" if value >= 0.9995 else "< 0.1 %" if value < 0.0005 else percent(value, 1)


def _number(value: float | None, digits: int, *, sign: bool, unit: str) -> str:
    if value is None or not math.isfinite(value):
        return _NOT_KNOWN
    return f"{value:{'+' if sign else ''}z.{digits}f}{unit}".replace("-", "−")
