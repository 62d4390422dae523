"""Summary of a result for the whole fleet: its numbers, what to do next, workshop list, the battery's margin."""

import hashlib
import math
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from calibrator.drive import Array
from calibrator.estimator.vehicle_report import REASONS
from calibrator.report.fleet_table import FleetTable, ParameterDetails
from calibrator.terminal.text import few
from ecu_node.parameters import HeldBack

__all__ = [
    "FLEET_CAUSES",
    "SIGMAS",
    "amperes",
    "battery_margin",
    "overview_of",
    "percent",
    "probability",
    "share",
    "steps_to_take",
    "workshop_list",
]

MOST_REASONS = 20
"""Most reasons for leaving out vehicles that are listed one by one."""
_NOT_KNOWN = "not known"
NO_DBC = hashlib.sha256(b"").hexdigest()
"""Digest of the databases of a layout for tables, which names none."""
IN_WORKSHOP = ("beyond the limits", "does not fit")
"""A fault that is not corrected for one of these reasons is on the workshop list."""
UNDECIDED = ("cannot tell", "not enough data")
"""Verdicts after which more data would decide."""
NO_REASON = "more recordings, a reading at zero current or a bench check would decide"
MOST_QUESTIONS = 3
"""Most different questions, of vehicles held back for the same reasons, that are listed one by one."""
SIGMAS = 3.0
"""Standard deviations that a margin covers; 1 in 370 is beyond if errors are Gaussian. [1]"""
QUANTILE = 0.999
"""Share of the fleet that one margin for all must cover; of fewer than a thousand vehicles it must cover all. [1]"""
MOST_LARGE = 5
FLEET_CAUSES = ("load", "batch", "variant", "sum", "window")
"""Causes of findings that many vehicles share and a workshop cannot mend; they come last in its list."""


def overview_of(table: FleetTable) -> dict[str, Any]:
    """Return the numbers that sum up a result.

    Returns
    -------
    dict
        Numbers of vehicles: with parameters (``vehicles``), without (``left_out``; by frequent reason in
        ``left_out_reasons``), by verdict (``verdicts``), ``corrected``, and ``hardware_suspected`` (None if the method
        cannot see hardware faults). Numbers of sensors: ``faulty_sensors``; ``applied_sensors``, faulty and corrected;
        ``held_back``, not corrected, by reason; ``moved_sensors``, changed since the result of ``calibrate --since``.
        ``median``, ``p05`` and ``p95`` over vehicles: of the root mean square Kirchhoff sum as measured and with what
        is applied (``junction_measured_a``, ``junction_deployed_a``) [A], of the length of the drives (``duration_h``)
        [h] and of each branch's delay (``delay_ms``) [ms]. Load that no branch measures [A]: as a fleet shows it
        (``unmeasured_a``), or as declared for vehicles calibrated by themselves (``declared_load_a``); sums are then
        about it. ``reference``: by branch the share of the vehicles that agree, and the spread of their slopes [1].
    """
    reference = table.run.details.get("reference", {})
    spread = table.run.details.get("hyperparameters", {}).get("model_spread", {})
    agreeing = reference.get("agreeing_share", {})
    held_back, faulty, suspected = table["held_back"], table["faulty"], table.of_vehicles("hardware_fault")
    seen = suspected.any() or np.isfinite(table.of_vehicles("hardware_probability")).any()
    return {
        "vehicles": len(table),
        "left_out": len(table.left_out),
        "verdicts": dict(Counter(table.of_vehicles("verdict").tolist()).most_common()),
        "corrected": int(table.corrected.sum()),
        "hardware_suspected": int(suspected.sum()) if seen else None,
        "faulty_sensors": int(faulty.sum()),
        "applied_sensors": int((faulty & table["applied"]).sum()),
        "held_back": dict(Counter(held_back[held_back.astype(bool)].tolist()).most_common()),
        "junction_measured_a": _spread(table.of_vehicles("junction_rms_measured_a")),
        "junction_deployed_a": _spread(table.deployed_a),
        "unmeasured_a": reference.get("unmeasured_a"),
        "declared_load_a": table.run.details.get("declared_load_a", 0.0),
        "duration_h": _spread(table.of_vehicles("duration_s") / 3600.0),
        "delay_ms": {
            name: _spread(1e3 * delay_s)
            for name, delay_s in zip(table.branches, table["delay_s"].T, strict=True)
            if np.isfinite(delay_s).any()
        },
        "reference": {  # a share of exactly 0 means that no vehicle shows the branch
            name: {"agreeing_share": agreeing.get(name) or None, "model_spread": spread.get(name)}
            for name in (table.branches if reference and spread else ())
        },
        "left_out_reasons": dict(Counter(table.left_out.values()).most_common(MOST_REASONS)),
        "moved_sensors": int(table["moved"].astype(bool).sum()),
    }


def _spread(values: Array) -> dict[str, float]:
    """Return ``median``, ``p05`` and ``p95``, between which the middle 90 % lie; NaN if no value is known."""
    known = values[np.isfinite(values)]
    found = np.quantile(known, [0.5, 0.05, 0.95]).tolist() if len(known) else (np.nan,) * 3
    return dict(zip(("median", "p05", "p95"), found, strict=True))


def workshop_list(table: FleetTable, files: Mapping[int, ParameterDetails]) -> list[dict[str, Any]]:
    """Return what no parameters can correct: hardware first, what many vehicles share last; each by probability.

    Parameters
    ----------
    table : FleetTable
        The result.
    files : mapping of int to ParameterDetails
        Details from the parameter files, by the vehicle's place in the table.

    Returns
    -------
    list of dict
        What a workshop should look at: ``vehicle``, ``branch`` (empty: the vehicle), ``cause``, ``probability`` [1]
        (None if it is not known) and ``text``.
    """
    columns = ["vehicle", "branch", "cause", "probability", "text"]
    rows, hardware = list[tuple[Any, ...]](), table.of_vehicles("hardware_probability")
    for j in np.flatnonzero(table.of_vehicles("hardware_fault")).tolist():
        rows.append((j, None, "hardware", hardware[j], f"its currents differ from the fleet's{_changes(table, j)}"))
    for j, k in np.argwhere(table["held_back"] == "beyond the limits").tolist():
        fault = f"gain error {percent(table['drift'][j, k], 1, sign=True)}, offset {amperes(table['offset_a'][j, k])}"
        text = f"{fault}: {REASONS['beyond the limits']}"
        rows.append((j, table.branches[k], "beyond the limits", table["fault_probability"][j, k], text))
    unfit = (table["held_back"] == "does not fit").any(axis=1)
    for j, file in files.items():
        rows += [(j, each.branch, each.cause, each.probability, each.text) for each in file.findings]
        if unfit[j] and not file.findings:
            rows.append((j, None, "does not fit", None, f"a sensor to check: {REASONS['does not fit']}"))
    known = [
        (str(table.vehicle[j]), branch or "", cause, None if p is None or math.isnan(p) else float(p), text)
        for j, branch, cause, p, text in rows
    ]
    ranks = {"hardware": 0, **dict.fromkeys(FLEET_CAUSES, 2)}
    known.sort(key=lambda row: (ranks.get(row[2], 1), -(row[3] or 0.0)))
    return [dict(zip(columns, row, strict=True)) for row in known]


def _changes(table: FleetTable, j: int) -> str:
    """Say by how much its hardware fault changes the currents of vehicle j: ``: all +1.20 %, motor +0.50 A``."""
    drift = table.of_vehicles("hardware_drift")[j]
    parts = [f"all {percent(drift, 2, sign=True)}"] if abs(drift) >= 5e-5 else []
    offset_a = zip(table.branches, table["hardware_offset_a"][j].tolist(), strict=True)
    parts += [f"{name} {amperes(value, sign=True)}" for name, value in offset_a if abs(value) >= 0.005]
    return f": {', '.join(parts)}" if parts else ""


def steps_to_take(table: FleetTable, workshop: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return what to do with a result, a sentence or two per step; ``workshop`` is from :func:`workshop_list`."""
    steps = []
    if corrected := table.vehicle[table.corrected].tolist():
        steps.append(
            f"Correct the tables of {few(corrected)}: 'calibrator kirchhoff TABLE --layout LAYOUT --parameters "
            f"params/VEHICLE.json --table corrected.csv'. A node needs a layout with the signals of a DBC."
            if table.run.dbc_sha256 == NO_DBC
            else f"Install the parameters of {few(corrected)} on their nodes: params/VEHICLE.json of the result, or "
            f"'calibrator params RESULT VEHICLE'."
        )
    # A fault that is on the workshop list needs no more evidence.
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
    if hardware := [row["vehicle"] for row in workshop if row["cause"] == "hardware"]:
        steps.append(f"Look at the hardware of {few(hardware)}: their currents differ from the fleet's.")
    sensors = [row for row in workshop if row["cause"] not in {"hardware", *FLEET_CAUSES}]
    if named := dict.fromkeys(f"{row['vehicle']} ({row['branch']})".removesuffix(" ()") for row in sensors):
        steps.append(f"Check the sensors of {few(list(named))}: see the workshop list.")
    if table.left_out:
        most = Counter(table.left_out.values()).most_common(1)[0][0]
        steps.append(f"Find out why {few(list(table.left_out))} could not be used; most often: {most}.")
    return steps or ["Nothing: no fault was found, and no question is open."]


def battery_margin(
    table: FleetTable, branch: str, *, limit_a: float | None = None, voltage_v: float | None = None
) -> dict[str, Any] | None:
    """Return how far a controller must stay below the battery's limit, as the sensor can be wrong (paper, figure 1).

    docs/report.md derives it.

    Parameters
    ----------
    table : FleetTable
        The result.
    branch : str
        Branch of the battery.
    limit_a, voltage_v : float or None
        Current limit, None: full scale [A]; voltage, which is only passed on, to show margins in kW [V].

    Returns
    -------
    dict or None
        The arguments; number of ``vehicles`` whose sensor has a known gain and offset, how many of these are
        ``corrected``, and number of the other vehicles (``not_known``), for which no margin is made. Margins [A]: one
        for all vehicles as measured (``common_before_a``) and after correction (``common_after_a``), and the
        difference (``common_gain_a``); what correction saves if each vehicle has its own margin, in the median of
        those corrected (``own_gain_a``, None without any). ``largest``: names and margins of up to 5 vehicles, not
        corrected, that need the largest margins, more than half of ``common_after_a``. None if the sensor is known in
        no vehicle.
    """
    k, limit_a = table.branches.index(branch), limit_a or table.run.full_scale_a
    known = np.flatnonzero(~(table["open_gain"] | table["open_offset"])[:, k])
    if not len(known):
        return None
    error_a = np.abs(table["drift"][known, k]) * limit_a + np.abs(table["offset_a"][known, k])
    unsure_a = SIGMAS * np.hypot(limit_a * table["drift_sd"][known, k], table["offset_sd_a"][known, k])
    applied = table["applied"][known, k]
    after_a = unsure_a + np.where(applied, 0.0, error_a)
    before, after = (float(np.quantile(each, QUANTILE, method="higher")) for each in (error_a + unsure_a, after_a))
    order = [i for i in np.argsort(-after_a, kind="stable") if not applied[i] and after_a[i] > after / 2.0]
    return {
        "branch": branch,
        "limit_a": limit_a,
        "voltage_v": voltage_v,
        "vehicles": len(known),
        "not_known": len(table) - len(known),
        "corrected": int(applied.sum()),
        "common_before_a": before,
        "common_after_a": after,
        "common_gain_a": before - after,
        "own_gain_a": float(np.median(error_a[applied])) if applied.any() else None,
        "largest": [(str(table.vehicle[known[i]]), float(after_a[i])) for i in order[:MOST_LARGE]],
    }


def amperes(value: float | None, *, digits: int = 2, sign: bool = False) -> str:
    """Return a current [A] as text: ``1.25 A``; ``not known`` for None and NaN."""
    return _number(value, digits, sign=sign, unit=" A")


def percent(value: float | None, digits: int, *, sign: bool = False) -> str:
    """Return a share or relative change [1] as text in percent: ``12.5 %``; ``not known`` for None and NaN."""
    return _number(None if value is None else 100.0 * value, digits, sign=sign, unit=" %")


def share(part: int, whole: int) -> str:
    """Return a share as text in whole percent; ``< 1 %`` and ``> 99 %`` where 0 % or 100 % would not be exact."""
    percents = 100.0 * part / whole
    return "< 1 %" if 0.0 < percents < 0.5 else "> 99 %" if 99.5 <= percents < 100.0 else f"{percents:.0f} %"


def probability(value: float | None) -> str:
    """Return a probability [1] as text in percent, never as certainty: ``97.3 %``, ``> 99.9 %``, ``not known``."""
    if value is None or not math.isfinite(value):
        return _NOT_KNOWN
    return "> 99.9 %" if value >= 0.9995 else "< 0.1 %" if value < 0.0005 else percent(value, 1)


def _number(value: float | None, digits: int, *, sign: bool, unit: str) -> str:
    if value is None or not math.isfinite(value):
        return _NOT_KNOWN
    return f"{value:{'+' if sign else ''}z.{digits}f}{unit}".replace("-", "−")
