"""What a result says of a fleet as a whole: the numbers of the report, and of its ``--json``."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from calibrator.drive import Array, Mask
from calibrator.report.fleet_table import FleetTable
from calibrator.report.protection import Margins

__all__ = ["BranchHealth", "Overview", "Protection", "Spread", "overview_of", "protection_of", "spread_of"]

MOST_REASONS = 20
"""Reasons of vehicles left out that are told one by one."""


@dataclass(frozen=True, kw_only=True)
class Spread:
    """Median, and the values between which the middle 90 % lie."""

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
        What vehicles without any fault differ by. [1]
    """

    agreeing_share: float | None
    model_spread: float | None


@dataclass(frozen=True, kw_only=True)
class Protection:
    """Battery protection margin before and after correction.

    Attributes
    ----------
    branch : str
        The battery's.
    limit_a, voltage_v : float, float or None
        Current limit, and the voltage that makes A to kW. [A], [V]
    common_before_a, common_after_a : float
        One margin for all vehicles. [A]
    own_median_a : float
        Median of the margins that vehicles need of their own, after correction. [A]
    corrected : int
        Vehicles of which the branch is corrected.
    common_gain_a, own_gain_a : float, float or None
        What the correction gives back: with one margin for all; and with a margin per vehicle, the median of the
        vehicles that are corrected, None if there is none. [A]
    common_gain_kw, own_gain_kw : float or None
        The same at the voltage. [kW]
    """

    branch: str
    limit_a: float
    voltage_v: float | None
    common_before_a: float
    common_after_a: float
    own_median_a: float
    corrected: int
    common_gain_a: float
    own_gain_a: float | None
    common_gain_kw: float | None
    own_gain_kw: float | None


@dataclass(frozen=True, kw_only=True)
class Overview:
    """Numbers of a fleet.

    Attributes
    ----------
    vehicles, left_out : int
        Vehicles with parameters, and without.
    verdicts : mapping of str to int
        Vehicles per verdict.
    corrected, hardware_suspected : int
        Vehicles of which some branch is corrected; of which a hardware fault is suspected.
    faulty_sensors, applied_sensors : int
        Sensors in which a fault was found; those of them that are corrected.
    held_back : mapping of str to int
        Faults that are not applied, by reason.
    junction_measured_a, junction_deployed_a : Spread
        Root mean square of the Kirchhoff sum per vehicle, before and after correction with what is applied. [A]
    unmeasured_a : float or None
        Mean load that no branch measures: what the sum of right sensors is. [A]
    duration_h : Spread
        Length of the drives of a vehicle. [h]
    delay_ms : mapping of str to Spread
        How much later than the largest branch each is seen. [ms]
    reference : mapping of str to BranchHealth
        By branch.
    left_out_reasons : mapping of str to int
        Vehicles left out, by reason; the most frequent ones.
    moved_sensors : int
        Sensors that have moved since the earlier result.
    """

    vehicles: int
    left_out: int
    verdicts: Mapping[str, int]
    corrected: int
    hardware_suspected: int
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
    """Count and summarise a result.

    Parameters
    ----------
    table : FleetTable
        The result.

    Returns
    -------
    Overview
        Of all its vehicles.
    """
    details = table.run.details
    faulty = table.faulty
    reasons = Counter(str(reason or "no reason is stored") for reason in table.left_out_reason)
    return Overview(
        vehicles=len(table),
        left_out=len(table.left_out),
        verdicts=dict(table.counts.verdicts.most_common()),
        corrected=int(table.corrected.sum()),
        hardware_suspected=table.counts.hardware_suspected,
        faulty_sensors=int(faulty.sum()),
        applied_sensors=int((table.applied & faulty).sum()),
        held_back=dict(table.counts.held_back.most_common()),
        junction_measured_a=spread_of(table.measured_a),
        junction_deployed_a=spread_of(table.deployed_a),
        unmeasured_a=details.get("reference", {}).get("unmeasured_a"),
        duration_h=spread_of(table.duration_s / 3600.0),
        delay_ms={
            name: spread_of(1e3 * known)
            for k, name in enumerate(table.branches)
            if len(known := table.delay_s[np.isfinite(table.delay_s[:, k]), k])
        },
        reference=_reference(table.branches, details),
        left_out_reasons=dict(reasons.most_common(MOST_REASONS)),
        moved_sensors=table.counts.moved_sensors,
    )


def protection_of(found: Margins, corrected: Mask, *, branch: str, voltage_v: float | None) -> Protection:
    """Put the margins of a fleet into numbers.

    Parameters
    ----------
    found : Margins
        Of the battery's branch.
    corrected : ndarray of bool, shape (N,)
        Vehicles of which it is corrected.
    branch : str
        Its name.
    voltage_v : float or None
        Of the battery; None: not known, and no kW are told. [V]

    Returns
    -------
    Protection
        In A and kW.
    """
    common_a = found.common_before_a - found.common_after_a
    own_a = float(np.median(found.own_gain_a[corrected])) if corrected.any() else None
    return Protection(
        branch=branch,
        limit_a=found.limit_a,
        voltage_v=voltage_v,
        common_before_a=found.common_before_a,
        common_after_a=found.common_after_a,
        own_median_a=float(np.median(found.after_a)),
        corrected=int(corrected.sum()),
        common_gain_a=common_a,
        own_gain_a=own_a,
        common_gain_kw=None if voltage_v is None else common_a * voltage_v / 1e3,
        own_gain_kw=None if voltage_v is None or own_a is None else own_a * voltage_v / 1e3,
    )


def spread_of(values: Array) -> Spread:
    """Median and 5th and 95th percentile of the values that are known; NaN if none is."""
    known = values[np.isfinite(values)]
    low, middle, high = np.quantile(known, [0.05, 0.5, 0.95]).tolist() if len(known) else (np.nan,) * 3
    return Spread(median=middle, p05=low, p95=high)


def _reference(branches: Sequence[str], details: Mapping[str, object]) -> dict[str, BranchHealth]:
    """Health of the reference; empty if the method has none."""
    reference, learnt = details.get("reference"), details.get("hyperparameters")
    if not isinstance(reference, dict) or not isinstance(learnt, dict):
        return {}
    return {
        name: BranchHealth(
            agreeing_share=reference.get("agreeing_share", {}).get(name),
            model_spread=learnt.get("model_spread", {}).get(name),
        )
        for name in branches
    }
