"""What the user knows of single sensors, trusted vehicles and bench readings, and where the drives contradict it."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace

import numpy as np

from calibrator.calibration_settings import CalibrationSettings
from calibrator.drive import Mask
from calibrator.errors import FleetError
from calibrator.evidence.readings import TRUSTED_DRIFT_SD, TRUSTED_OFFSET_SD, Readings, no_readings
from calibrator.posterior.bench_table import BenchReadings, read_bench_readings, readings_of
from calibrator.posterior.estimate import FleetPosterior
from calibrator.posterior.health import ReferenceHealth
from calibrator.posterior.spread_starts import FEWEST_TRUSTED
from calibrator.summaries.vehicle_summary import VehicleSummary

__all__ = [
    "contradicted_readings",
    "merge_readings",
    "read_bench",
    "trust_notices",
    "window_notices",
]

LEAST_PROBABILITY = 1e-4
"""Of the explanations near a bench reading: below, the drives contradict it. [1]"""
CONTRADICTION = 4.0
"""Standard deviations from which on two readings of one sensor contradict each other. [1]"""


def read_bench(
    settings: CalibrationSettings,
    vehicles: Collection[str],
    branches: Collection[str],
    *,
    left_out: Mapping[str, str],
    full_scale_a: float,
) -> BenchReadings:
    """Read the table of bench readings, if there is one.

    Parameters
    ----------
    settings : CalibrationSettings
        Names the table, and the trusted vehicles.
    vehicles, branches, left_out, full_scale_a
        As for :func:`~calibrator.posterior.bench_table.read_bench_readings`.

    Returns
    -------
    mapping
        The readings by vehicle and branch.

    Raises
    ------
    FleetError
        Also if it contradicts the trust in a vehicle.
    """
    if settings.readings is None:
        return {}
    bench = read_bench_readings(settings.readings, vehicles, branches, left_out=left_out, full_scale_a=full_scale_a)
    for (vehicle, branch), (drift, drift_sd, offset_a, offset_sd_a) in bench.items():
        if vehicle in settings.trusted and (
            abs(drift) > CONTRADICTION * np.hypot(drift_sd, TRUSTED_DRIFT_SD)
            or abs(offset_a) > CONTRADICTION * np.hypot(offset_sd_a, TRUSTED_OFFSET_SD * full_scale_a)
        ):
            raise FleetError(
                f"{settings.readings}: the {branch} sensor of {vehicle} was read as faulty, and {vehicle} is trusted; "
                f"a trusted vehicle is one whose sensors were all found faultless"
            )
    return bench


def merge_readings(
    vehicles: Sequence[VehicleSummary], bench: BenchReadings, branches: Sequence[str]
) -> tuple[Readings, list[str]]:
    """What the sensors showed on a bench, and in zero-current windows.

    Parameters
    ----------
    vehicles : sequence of VehicleSummary
        N vehicles.
    bench : mapping
        Bench readings.
    branches : sequence of str
        Names of the K branches.

    Returns
    -------
    readings : Readings
        Both together; neither where they contradict each other.
    notices : list of str
        Where they do, and readings that could not be used.
    """
    names = [vehicle.vehicle for vehicle in vehicles]
    nothing = no_readings(len(vehicles), len(branches))
    offset_a = np.stack([vehicle.zero_current.offset_a for vehicle in vehicles])
    sd_a = np.stack([vehicle.zero_current.sd_a for vehicle in vehicles])
    read = readings_of(bench, names, branches)
    apart = np.abs(offset_a - read.offset_a) > CONTRADICTION * np.hypot(sd_a, read.offset_sd_a)
    notices = [
        f"vehicle {names[j]}: its {branches[k]} sensor was read as {read.offset_a[j, k]:+.1f} A on the bench, and "
        f"showed {offset_a[j, k]:+.1f} A with open contactors: neither is used; check it again"
        for j, k in np.argwhere(apart).tolist()
    ]
    unused = sorted({vehicle for vehicle, _ in bench} - set(names))
    if unused:
        notices.append(f"bench readings of vehicles that are left out are not used: {', '.join(unused)}")
    windows = replace(nothing, offset_a=np.where(apart, np.nan, offset_a), offset_sd_a=np.where(apart, np.nan, sd_a))
    kept = replace(
        read,
        offset_a=np.where(apart, np.nan, read.offset_a),
        offset_sd_a=np.where(apart, np.nan, read.offset_sd_a),
    )
    return windows.merged(kept), notices


def contradicted_readings(
    posterior: FleetPosterior, bench: BenchReadings, names: Sequence[str], branches: Sequence[str], full_scale_a: float
) -> dict[tuple[str, str], str]:
    """Find bench readings that a vehicle's drives contradict: another vehicle's, or a slip.

    Parameters
    ----------
    posterior : FleetPosterior
        Of N vehicles, without these readings.
    bench : mapping
        The readings.
    names, branches : sequence of str
        Names of the N vehicles and K branches.
    full_scale_a : float
        Full scale of the junction. [A]

    Returns
    -------
    dict of (str, str) to str
        What to say of each such sensor; none where the reference is in doubt, as drives contradict nothing then.
    """
    if posterior.health is not None and posterior.health.doubtful:
        return {}
    states, found = posterior.states, {}
    for (vehicle, branch), (drift, drift_sd, offset_a, offset_sd_a) in bench.items():
        if vehicle not in names:
            continue
        j, k = names.index(vehicle), posterior.order.index(branches.index(branch))
        near = np.ones(states.weight.shape[1], bool)
        for value, sd, told, told_sd in (
            (drift, drift_sd, states.drift[j, :, k], states.relative_sd[j, :, 1 + k]),
            (
                offset_a / full_scale_a,
                offset_sd_a / full_scale_a,
                states.offset[j, :, k],
                states.constant_sd[j, :, states.branches - 1 + k],
            ),
        ):
            if np.isfinite(value):
                near &= np.abs(value - told) <= CONTRADICTION * np.hypot(sd, told_sd)
        if states.weight[j] @ near < LEAST_PROBABILITY:
            found[vehicle, branch] = (
                f"vehicle {vehicle}: the bench reading of its {branch} sensor is not what its drives show, and is not "
                f"used; check it again, and whether it is of this vehicle"
            )
    return found


def trust_notices(names: Sequence[str], trusted: Mask, health: ReferenceHealth) -> list[str]:
    """Trusted vehicles that contradict the trust in them, or are too few to carry the reference."""
    carriers = int(np.count_nonzero(trusted)) - len(health.distrusted) - len(health.differing)
    too_few = (
        f"only {carriers} of the trusted vehicles can carry the reference, {FEWEST_TRUSTED} are needed: "
        f"it is the fleet's"
    )
    return [
        *([too_few] if trusted.any() and carriers < FEWEST_TRUSTED else []),
        *(f"vehicle {names[j]} is not trusted: {why}; check it again" for j, why in health.distrusted.items()),
        *(
            f"trusted vehicle {names[j]} does not carry the reference: it differs from the other trusted ones as by a "
            f"hardware fault"
            for j in health.differing
        ),
    ]


def window_notices(
    vehicles: Sequence[VehicleSummary], trusted: Mask, branches: Sequence[str], full_scale_a: float
) -> list[str]:
    """Trusted sensors that showed an offset while the contactors were open."""
    texts = []
    for vehicle in (vehicle for vehicle, is_trusted in zip(vehicles, trusted, strict=True) if is_trusted):
        shown, sd_a = vehicle.zero_current.offset_a, vehicle.zero_current.sd_a
        surprising = np.abs(shown) > CONTRADICTION * np.hypot(sd_a, TRUSTED_OFFSET_SD * full_scale_a)
        texts += [
            f"trusted vehicle {vehicle.vehicle}: its {branches[k]} sensor showed {shown[k]:+.1f} A with open "
            f"contactors; it was taken for faultless: check it again, or do not trust it"
            for k in np.flatnonzero(surprising).tolist()
        ]
    return texts
