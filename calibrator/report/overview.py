"""What a result says of a fleet as a whole: its numbers, what to do next, workshop list, the battery's margin."""

import hashlib
import math
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from calibrator.drive import Array
from calibrator.estimator.vehicle_report import REASONS
from calibrator.report.fleet_table import FleetTable, ParameterDetails
from calibrator.terminal.text import few
from ecu_node.parameters import HeldBack

__all__ = ["FLEET_CAUSES", "SIGMAS", "BatteryMargin", "Overview", "WorkshopRow", "amperes", "battery_margin"]
__all__ += ["overview_of", "percent", "probability", "steps_to_take", "workshop_list"]

MOST_REASONS = 20
"""Reasons of vehicles left out that are given one by one."""
_NOT_KNOWN = "not known"
NO_DBC = hashlib.sha256(b"").hexdigest()
"""Digest of the databases of a layout of a table."""
IN_WORKSHOP = ("beyond the limits", "does not fit")
"""Why a fault is not corrected, where the workshop list has it."""
UNDECIDED = ("cannot tell", "not enough data")
"""Verdicts that leave a question."""
NO_REASON = "more recordings, a reading at zero current or a bench check would decide"
MOST_QUESTIONS = 3
"""Questions of one kind that are asked one by one."""
SIGMAS = 3.0
"""Standard deviations that a margin covers; 1 in 370 is beyond if errors are Gaussian. [1]"""
QUANTILE = 0.999
"""Share of the fleet that one margin for all must cover; of fewer than a thousand vehicles all of them. [1]"""
MOST_LARGE = 5
FLEET_CAUSES = ("load", "batch", "variant")
"""Findings that many vehicles share and a workshop cannot mend: they come last in its list."""


class Quantiles(NamedTuple):
    """Median, and the values between which the middle 90 % lie; NaN if nothing is known."""

    median: float
    p05: float
    p95: float


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
    junction_measured_a, junction_deployed_a : Quantiles
        Root mean square of the Kirchhoff sum per vehicle, before and after correction with what is applied. [A]
    unmeasured_a : float or None
        Mean load that no branch measures: the sum that right sensors show. [A]
    duration_h : Quantiles
        Length of the drives of a vehicle. [h]
    delay_ms : mapping of str to Quantiles
        How much later than the largest branch each is seen, where it is known. [ms]
    reference : mapping of str to mapping of str to float or None
        By branch ``agreeing_share``, of the vehicles whose sensors agree, and ``model_spread``, standard deviation of
        the slopes of vehicles without a fault; empty if the method has no reference. [1]
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
    junction_measured_a: Quantiles
    junction_deployed_a: Quantiles
    unmeasured_a: float | None
    duration_h: Quantiles
    delay_ms: Mapping[str, Quantiles]
    reference: Mapping[str, Mapping[str, float | None]]
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
            name: {"agreeing_share": agreeing.get(name) or None, "model_spread": spread.get(name)}
            for name in (table.branches if reference and spread else ())
        },
        left_out_reasons=dict(Counter(table.left_out.values()).most_common(MOST_REASONS)),
        moved_sensors=int(table["moved"].astype(bool).sum()),
    )


def _spread(values: Array) -> Quantiles:
    known = values[np.isfinite(values)]
    low, middle, high = np.quantile(known, [0.05, 0.5, 0.95]).tolist() if len(known) else (np.nan,) * 3
    return Quantiles(median=middle, p05=low, p95=high)


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


def steps_to_take(table: FleetTable, workshop: Sequence[WorkshopRow]) -> list[str]:
    """Say what to do with a result, one sentence each, the first step first."""
    steps = []
    if corrected := table.vehicle[table.corrected].tolist():
        steps.append(
            f"Correct the tables of {few(corrected)}: 'calibrator kirchhoff TABLE --layout LAYOUT --parameters "
            f"params/VEHICLE.json --table corrected.csv'. A node needs a layout with the signals of a DBC."
            if table.run.dbc_sha256 == NO_DBC
            else f"Install the parameters of {few(corrected)} on their nodes: params/VEHICLE.json of the result, or "
            f"'calibrator params RESULT VEHICLE'."
        )
    # What the workshop list has already is no question of evidence.
    held, reason = table["held_back"], table.of_vehicles("reason")
    undecided = (held != "").any(axis=1) | (reason != "") | np.isin(table.of_vehicles("verdict"), UNDECIDED)
    mended = np.isin(held, IN_WORKSHOP).any(axis=1)
    questions: dict[tuple[HeldBack, ...], dict[str, list[str]]] = defaultdict(lambda: defaultdict(list))
    for j in np.flatnonzero(undecided & ~mended).tolist():
        questions[tuple(sorted({*held[j]} - {""}))][reason[j] or NO_REASON].append(table.vehicle[j])
    for kinds, asked in questions.items():
        if len(asked) <= MOST_QUESTIONS:
            steps += [f"{few(names)}: {text}." for text, names in asked.items()]
            continue
        why = f", not corrected because {' and '.join(REASONS[each] for each in kinds)}" if kinds else ""
        text, (first, *_) = next(iter(asked.items()))
        every = few([name for names in asked.values() for name in names])
        steps.append(f"{every}{why}: what would decide stands with each. Of {first}: {text}.")
    if hardware := [row.vehicle for row in workshop if row.cause == "hardware"]:
        steps.append(f"Look at the hardware of {few(hardware)}: their currents differ from the fleet's.")
    if sensors := [row for row in workshop if row.cause not in {"hardware", *FLEET_CAUSES}]:
        named = dict.fromkeys(f"{row.vehicle} ({row.branch})" if row.branch else row.vehicle for row in sensors)
        steps.append(f"Check the sensors of {few(list(named))}: see the workshop list.")
    if table.left_out:
        most = Counter(table.left_out.values()).most_common(1)[0][0]
        steps.append(f"Find out why {few(list(table.left_out))} could not be used; most often: {most}.")
    return steps or ["Nothing: no fault was found, and no question is open."]


@dataclass(frozen=True, kw_only=True)
class BatteryMargin:
    """What a controller must stay below the battery's limit by, as its sensor can be wrong: figure 1 of the paper.

    Attributes
    ----------
    branch : str
        The battery's.
    limit_a, voltage_v : float, float or None
        Current limit, and the voltage that makes kW of A. [A], [V]
    vehicles, not_known, corrected : int
        Vehicles of which the sensor is known; others, which are not counted; and of the first those that are corrected.
    common_before_a, common_after_a, common_gain_a : float
        One margin for all vehicles, as measured and after correction, and the difference. [A]
    own_gain_a : float or None
        What a margin per vehicle gives back: the median of those that are corrected, None if there is none. [A]
    largest : list of (str, float)
        Vehicles that keep the common margin large, as they are not corrected, and the margin that each needs. [A]
    """

    branch: str
    limit_a: float
    voltage_v: float | None
    vehicles: int
    not_known: int
    corrected: int
    common_before_a: float
    common_after_a: float
    common_gain_a: float
    own_gain_a: float | None
    largest: list[tuple[str, float]]

    def power_kw(self, current_a: float | None) -> float | None:
        """A current at the voltage; None if one of both is not known. [kW]"""
        return None if current_a is None or self.voltage_v is None else current_a * self.voltage_v / 1e3


def battery_margin(
    table: FleetTable, branch: str, *, limit_a: float | None = None, voltage_v: float | None = None
) -> BatteryMargin | None:
    """Find the battery's protection margin; docs/report.md derives it.

    Parameters
    ----------
    table : FleetTable
        The result.
    branch : str
        The battery's.
    limit_a, voltage_v : float or None
        As in :class:`BatteryMargin`; without a limit full scale is taken. [A], [V]

    Returns
    -------
    BatteryMargin or None
        None if the sensor of no vehicle is known.
    """
    k, limit_a = table.branches.index(branch), limit_a or table.run.full_scale_a
    known = np.flatnonzero(~(table.open_gain | table.open_offset)[:, k])
    if not len(known):
        return None
    error_a = np.abs(table["drift"][known, k]) * limit_a + np.abs(table["offset_a"][known, k])
    unsure_a = SIGMAS * np.hypot(limit_a * table["drift_sd"][known, k], table["offset_sd_a"][known, k])
    applied = table["applied"][known, k]
    after_a = unsure_a + np.where(applied, 0.0, error_a)
    before, after = (float(np.quantile(each, QUANTILE, method="higher")) for each in (error_a + unsure_a, after_a))
    order = [i for i in np.argsort(-after_a, kind="stable") if not applied[i] and after_a[i] > after / 2.0]
    return BatteryMargin(
        branch=branch,
        limit_a=limit_a,
        voltage_v=voltage_v,
        vehicles=len(known),
        not_known=len(table) - len(known),
        corrected=int(applied.sum()),
        common_before_a=before,
        common_after_a=after,
        common_gain_a=before - after,
        own_gain_a=float(np.median(error_a[applied])) if applied.any() else None,
        largest=[(str(table.vehicle[known[i]]), float(after_a[i])) for i in order[:MOST_LARGE]],
    )


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
