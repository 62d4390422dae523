"""One junction by itself: what its own recordings, and what is known of some of its sensors, say of the others.

No fleet is needed. Every vehicle gives K - 1 gain ratios and one constant of the junction law (M8),

    log(-g_k) = lambda_1 - lambda_k,    c = o_1 - sum over k > 1 of g_k o_k + (1 + d_1) l,    lambda = log(1 + d),

with the offsets o and the load l that no branch measures. They are linear in the unknowns (lambda, o, l), so recordings
of one car with different meters are one system of equations. Ratios have no scale: that comes from sensors that are
known; offsets come from known ones, zero-current windows, a declared load, or a charge balance. As no fleet tells what
is usual, the gain of a sensor that is not known is open: its prior is a wide Gaussian. Its offset is absent (a narrow
Gaussian: no zero is exact) or present, of any size; each choice is one explanation. What they leave open is reported
with its standard deviation, and is not corrected.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations, product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.ndimage import maximum_filter1d, minimum_filter1d
from scipy.stats import norm, qmc

from calibrator.drive import Array, Drive, DriveFile, Mask
from calibrator.drives.align import Samples, align
from calibrator.drives.charge import GAP_PERIODS
from calibrator.drives.delays import MAX_DELAY_S, estimate_delays, without_delays
from calibrator.errors import DriveError, FleetError
from calibrator.estimator.checks import CAUSES, UsualMisfits, find_misfits
from calibrator.estimator.decision import Points, harm_probability, recovery_probability
from calibrator.estimator.evidence import junction_regression, stack_summaries
from calibrator.estimator.fleet_estimate import SUSPECTED, FleetEstimate
from calibrator.estimator.readings import (
    CONTRADICTION,
    TRUSTED_DRIFT_SD,
    TRUSTED_OFFSET_SD,
    BenchTable,
    check_bench_table,
    read_bench_table,
)
from calibrator.estimator.results import encode_chunk
from calibrator.estimator.settings import CalibrationSettings
from calibrator.estimator.vehicle_report import parameters_of, sensor_text
from calibrator.files.parameter_files import RunIdentity
from calibrator.processes.run_many import Workers
from calibrator.sources.fleet_source import Equipment, FleetSource, load_drive, read_vehicles
from calibrator.summaries.moments import BLOCK_S, DriveSummary
from calibrator.summaries.summariser import summarise_samples
from calibrator.summaries.vehicle_summary import VehicleSummary, most_moving_first, require_possible
from calibrator.summaries.zero_current import weighted_mean, zero_current_offsets
from ecu_node.database import VehicleDatabase
from ecu_node.layout import Layout, UnmeasuredLoad
from ecu_node.parameters import Explanation, SensorFinding, VehicleParameters

__all__ = [
    "JunctionEstimate",
    "JunctionKnowledge",
    "Reading",
    "calibrate_junctions",
    "estimate_junction",
    "read_junction",
]

LEAST_DURATION_S, SHORTEST_BLOCK_S, BLOCKS, FEWEST_BLOCKS = 5.0, 0.5, 16, 5
"""Least valid data, shortest block, number of blocks of a short recording, and least number beyond that of branches:
enough to tell how sure all is."""
MOST_MISSING = 0.05
"""Share of a recording without samples of a branch up to which its charge is integrated. [1]"""
LAW_GAIN_SD, LAW_OFFSET_SD = 0.002, 0.0005
"""What delays, noise and curvature of sensors leave in a gain ratio, and in the constant over full scale. [1]"""
JUMP = 0.02
"""Change of a current within its largest possible delay, over full scale, that counts as a jump. [1]"""
MOST_RATIO, SURE_SD = 3.0, 0.1
"""Gain ratio that no two sensors have, and the standard deviation with which it counts as one. [1]"""
OPEN_GAIN_SD, OPEN_OFFSET_SD, OPEN_LOAD_SD = 0.3, 0.2, 0.04
"""Standard deviations before anything is known: of lambda, and over full scale of an offset and of a load. [1]"""
FAULT_SHARE = 0.2
"""Probability of a gain error, and of an offset, before anything is known. [1]"""
LEAST_FAULT = 0.02
"""Size that "recovered" counts a fault with at least: gain error, and offset over full scale. [1]"""
KNOWN_GAIN_SD, KNOWN_OFFSET_SD = 0.03, 0.005
"""Standard deviations up to which a gain, and an offset over full scale, count as known. [1]"""
OFFSET_SIZES = (0.0015, 0.005, 0.02, 0.2)
"""Standard deviations of an offset that is present, over full scale: each is as probable as the others. [1]"""
MOST_OFFSETS, MARGIN = 3, 12.0
"""Most offsets of one explanation, and the logarithm of the weight below the best from which on it is left out."""
DRAWS, FEWEST_DRAWS = 8192, 64
"""Draws in all, by weight of the explanations, and of each at least: the harm limit is some of them."""
USUAL_MISFIT, USUAL_RESIDUAL, USUAL_SPREAD = 0.0002, 0.002, 0.5
"""What curvature of good sensors, and noise and switched loads, leave in the sum, over full scale, and by how much the
logarithm of the latter's square differs between cars. [1]"""
STILL = 0.003
"""Standard deviation of all currents, over full scale, up to which the car stands still. [1]"""
SOUND_GAIN_SD, SOUND_OFFSET_SD = 0.01, 0.0025
"""Standard deviations up to which a sensor without a fault is called right: gain, and offset over full scale. [1]"""
UNCLEAR = (0.1, 0.9)
"""Probabilities of an offset between which it may be another sensor's. [1]"""
SEEN = 3.0
"""Standard deviations from which on a fault is clear. [1]"""
MOST_SHOWN = 5
"""Vehicles whose gain ratios are shown one by one."""


class Reading(NamedTuple):
    """A value with its standard deviation."""

    mean: float
    sd: float


class Charge(NamedTuple):
    """Mean current of a branch over the whole of its recordings: as measured, and by a known charge. [A]"""

    measured_a: float
    true_a: float
    sd_a: float


@dataclass(frozen=True, kw_only=True)
class JunctionKnowledge:
    """What is known of a junction beside its recordings.

    Attributes
    ----------
    trusted : mapping of str to (float, float)
        Branches whose sensor is right: standard deviations of its gain error [1] and offset [A].
    bench : mapping
        Readings of single sensors by vehicle and branch.
    load : UnmeasuredLoad or None
        What flows out of the junction where no branch measures it; None: not known.
    charge : mapping of str to Charge
        Charge that went through a branch.
    """

    trusted: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    bench: BenchTable = field(default_factory=dict)
    load: UnmeasuredLoad | None = None
    charge: Mapping[str, Charge] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class JunctionEstimate:
    """Estimate of N vehicles that share their sensors, but for one, and what to say of them.

    Attributes
    ----------
    estimate : FleetEstimate
        As of a fleet; drifts and offsets are the means of the posterior, also where no fault is suspected.
    ratios : sequence of N mappings of str to Reading
        Gain of a branch over that of another, by their names: "battery / motor". [1]
    constant_a : sequence of N Reading
        Sum of the measured currents at zero current: offsets and loads without a sensor together. [A]
    deciding : sequence of N str
        What would decide the rest; empty if all is known.
    contradictions : tuple of str
        Where what is known contradicts itself.
    """

    estimate: FleetEstimate
    ratios: Sequence[Mapping[str, Reading]]
    constant_a: Sequence[Reading]
    deciding: Sequence[str]
    contradictions: tuple[str, ...]


def read_junction(entries: Sequence[DriveFile], equipment: Equipment, database: VehicleDatabase) -> VehicleSummary:
    """Read the drives of one vehicle, see :func:`summarise_junction`."""
    return summarise_junction([load_drive(entry, database) for entry in entries], equipment.branches, database)


def summarise_junction(drives: Sequence[Drive], branches: Sequence[str], database: VehicleDatabase) -> VehicleSummary:
    """Summarise the currents of one vehicle, in short blocks if its drives are short.

    Parameters
    ----------
    drives : sequence of Drive
        Of one vehicle.
    branches : sequence of str
        Names of the K branches.
    database : VehicleDatabase
        DBC and layout.

    Returns
    -------
    VehicleSummary
        Without inputs.

    Raises
    ------
    DriveError
        If a branch is missing, or there is too little valid data.
    """
    layout = database.layout
    for drive in drives:
        require_possible(drive, layout)
    delays = estimate_delays(drives, most_moving_first(drives, branches))
    samples = [align(without_delays(drive, delays.by_branch()), layout, branches, inputs=()) for drive in drives]
    samples = _without_jumps(samples, [delays.branches[k] for k in np.flatnonzero(~delays.known)], layout)
    duration_s = layout.period_s * sum(int(part.valid.sum()) for part in samples)
    if duration_s < LEAST_DURATION_S:
        raise DriveError(
            f"{duration_s:.1f} s in which all branches have usable samples; at least {LEAST_DURATION_S:g} s are "
            f"needed; rows farther apart than the timeout_s of their branch are stale"
        )
    block_s = max(min(BLOCK_S, duration_s / BLOCKS), SHORTEST_BLOCK_S, layout.period_s)
    summary = summarise_samples(samples, period_s=layout.period_s, block_s=block_s)
    if len(summary.moments) < len(branches) + FEWEST_BLOCKS:
        raise DriveError(
            f"{duration_s:.1f} s of usable samples on a time base of {layout.period_s:g} s tell too little: at least "
            f"{(len(branches) + FEWEST_BLOCKS) * block_s:.0f} s are needed"
        )
    return VehicleSummary(
        vehicle=drives[0].vehicle,
        drives=tuple(drive.name for drive in drives),
        summary=summary,
        delays=delays,
        zero_current=zero_current_offsets(drives, branches, database),
    )


def _without_jumps(drives: Sequence[Samples], unknown: Sequence[str], layout: Layout) -> list[Samples]:
    """Leave out samples near a jump of a branch whose delay is not known: it would be the junction's sum.

    Where that would leave less than half, as on a drive that is all jumps, they stay.
    """
    kept = []
    width = 2 * round(MAX_DELAY_S / layout.period_s) + 1
    for drive in drives:
        jump = np.zeros(len(drive.valid), bool)
        for name in unknown:
            current_a = drive.currents_a[:, drive.branch_names.index(name)]
            low_a = minimum_filter1d(np.where(drive.valid, current_a, np.inf), width)
            high_a = maximum_filter1d(np.where(drive.valid, current_a, -np.inf), width)
            jump |= high_a - low_a > JUMP * layout.full_scale_a
        kept.append(replace(drive, valid=drive.valid & ~jump))
    before, after = (sum(int(drive.valid.sum()) for drive in each) for each in (drives, kept))
    return kept if 2 * after > before else list(drives)


class _Law(NamedTuple):
    """Junction law (M8) of one vehicle, branches in an order that begins with the one that moves most."""

    order: list[int]
    ratio: Array
    """-g of the K - 1 other branches. [1]"""
    constant_a: float
    mean_a: Array
    """Of the other branches. [A]"""
    covariance: Array
    """Of (ratio, constant), shape (K, K)."""


def _law(summary: DriveSummary, branches: Sequence[str], where: str, scale_a: float) -> _Law:
    order = np.argsort(-summary.variance_a2, kind="stable").tolist()
    fit = junction_regression(stack_summaries([summary], order))
    covariance = fit.influence.T @ fit.influence + fit.prior_covariance[0]
    sign = np.append(-np.ones(len(order) - 1), 1.0)
    if summary.variance_a2.max() < (STILL * scale_a) ** 2:  # the ratios are open, and the sum tells the constant
        open_ratio = np.diag(np.append(np.ones(len(order) - 1), covariance[-1, -1]))
        mean_a = summary.mean_a
        return _Law(order, np.ones(len(order) - 1), float(mean_a.sum()), mean_a[order[1:]], open_ratio)
    *ratio, constant_a = fit.estimate[0] * sign
    for k, value, sd in zip(order[1:], ratio, np.sqrt(np.diagonal(covariance)), strict=False):
        if not 1.0 / MOST_RATIO < value < MOST_RATIO and sd < SURE_SD:
            first = branches[order[0]]
            raise FleetError(
                f"{where}: the currents do not balance: 1 A in branch {branches[k]} goes with {-value:+.2g} A in "
                f"branch {first}, expected -1 A; check sign and unit of branch {branches[k]} or {first}"
            )
    possible = np.clip(ratio, 1.0 / MOST_RATIO, MOST_RATIO)
    return _Law(order, possible, float(constant_a), summary.mean_a[order[1:]], covariance * np.outer(sign, sign))


class _System(NamedTuple):
    """Rows y = design x + error of N vehicles, over x = (lambda of S sensors, their offsets, N loads).

    Offsets and loads are in fractions of full scale.
    """

    y: Array
    covariance: Array
    design: Array
    mean: Array
    sd: Array
    """Prior of x: as read, or open."""
    read: Mask
    """Which of x were read."""
    sensors: int


def _places(vehicles: int, branches: Sequence[str], meter: str | None) -> NDArray[np.int64]:
    """Number of the sensor of each vehicle and branch, shape (N, K): they share all but the meter."""
    places = np.tile(np.arange(len(branches)), (vehicles, 1))
    if meter is not None:
        places[1:, branches.index(meter)] = len(branches) + np.arange(vehicles - 1)
    return places


def _system(
    vehicles: Sequence[VehicleSummary],
    places: NDArray[np.int64],
    branches: Sequence[str],
    known: JunctionKnowledge,
    *,
    laws: Sequence[_Law],
    full_scale_a: float,
) -> _System:
    """All that is measured and known, of sensors at places (N, K)."""
    (N, K), S = places.shape, int(places.max()) + 1
    y, covariance, design = np.zeros(N * K), np.zeros((N * K, N * K)), np.zeros((N * K, 2 * S + N))
    load = known.load or UnmeasuredLoad(mean_a=0.0, sd_a=OPEN_LOAD_SD * full_scale_a)
    for j, law in enumerate(laws):
        first, *others = places[j][law.order].tolist()
        rows, ratios, constant = slice(j * K, (j + 1) * K), range(j * K, (j + 1) * K - 1), (j + 1) * K - 1
        unit = np.append(1.0 / law.ratio, 1.0 / full_scale_a)
        y[rows] = np.append(np.log(law.ratio), law.constant_a / full_scale_a)
        covariance[rows, rows] = law.covariance * np.outer(unit, unit)
        # an error of a ratio turns the line about the mean current, and so moves the constant
        turn = np.vstack([np.eye(K - 1), law.ratio * law.mean_a / full_scale_a]) * LAW_GAIN_SD
        covariance[rows, rows] += turn @ turn.T
        covariance[constant, constant] += LAW_OFFSET_SD**2
        design[ratios, first], design[ratios, others] = 1.0, -1.0
        design[constant, [S + first, *(S + s for s in others)]] = np.append(1.0, law.ratio)
        design[constant, 2 * S + j] = 1.0
        design[constant, first] = load.mean_a / full_scale_a  # (1 + d_1) l
    mean, sd = np.full(2 * S + N, np.nan), np.full(2 * S + N, np.nan)
    mean[2 * S :], sd[2 * S :] = load.mean_a / full_scale_a, load.sd_a / full_scale_a
    for s in range(S):
        of = [(vehicles[j], k) for j, k in np.argwhere(places == s).tolist()]
        value, spread = weighted_mean(*_readings(of, branches, known))
        mean[s], sd[s] = np.log1p(value[0]), spread[0] / (1.0 + value[0])
        mean[S + s], sd[S + s] = value[1] / full_scale_a, spread[1] / full_scale_a
    read = np.isfinite(mean)
    wide = np.repeat([OPEN_GAIN_SD, OPEN_OFFSET_SD, OPEN_LOAD_SD], [S, S, N])
    for name, charge in known.charge.items():  # mean measured current = (1 + d) true + o
        row = np.zeros(2 * S + N)
        row[[branches.index(name), S + branches.index(name)]] = charge.true_a / full_scale_a, 1.0
        y = np.append(y, (charge.measured_a - charge.true_a) / full_scale_a)
        design = np.vstack([design, row])
        covariance = block_diag(covariance, [[(charge.sd_a / full_scale_a) ** 2 + LAW_OFFSET_SD**2]])
    return _System(y, covariance, design, np.where(read, mean, 0.0), np.where(read, sd, wide), read, S)


def _readings(
    sensor: Sequence[tuple[VehicleSummary, int]], branches: Sequence[str], known: JunctionKnowledge
) -> list[tuple[Array, Array]]:
    """What is known of one sensor: (gain error, offset [A]) and standard deviations, NaN where not known."""
    found: list[tuple[Array, Array]] = []
    for vehicle, k in sensor:
        shown, branch = vehicle.zero_current, branches[k]
        found.append((np.array([np.nan, shown.offset_a[k]]), np.array([np.nan, shown.sd_a[k]])))
        if (vehicle.vehicle, branch) in known.bench:
            bench = known.bench[vehicle.vehicle, branch]
            found.append((np.array([bench.drift, bench.offset_a]), np.array([bench.drift_sd, bench.offset_sd_a])))
    branch = branches[sensor[0][1]]
    if branch in known.trusted:
        found.append((np.zeros(2), np.array(known.trusted[branch])))
    return found


def _condition(system: _System, sd: Array) -> tuple[Array, Array, float]:
    """Mean (P,), covariance (P, P) and log evidence of x under a prior with these standard deviations (P,)."""
    A, prior, away = system.design, np.diag(sd**2), system.y - system.design @ system.mean
    rows = A @ prior @ A.T + system.covariance
    gain = np.linalg.solve(rows, A @ prior).T
    log_evidence = -0.5 * (away @ np.linalg.solve(rows, away) + np.linalg.slogdet(2.0 * np.pi * rows)[1])
    return system.mean + gain @ away, prior - gain @ A @ prior, float(log_evidence)


class _Posterior(NamedTuple):
    """Weighted draws of x (n, P), and the number of the explanation that each is of, the most probable one first."""

    draws: Array
    weight: Array
    explanation: NDArray[np.int64]
    mean: Array
    sd: Array
    offset_probability: Array
    """That each of the S sensors has an offset. [1]"""


def _posterior(system: _System) -> _Posterior:
    """Posterior over the explanations: which sensors have an offset, and of which size."""
    S = system.sensors
    may = [s for s in range(S) if not system.read[S + s]]
    found = []
    for size in range(min(len(may), MOST_OFFSETS) + 1):
        for chosen in combinations(may, size):
            for sizes in product(OFFSET_SIZES, repeat=size):
                sd = system.sd.copy()
                sd[[S + s for s in may]] = TRUSTED_OFFSET_SD
                sd[[S + s for s in chosen]] = sizes
                mean, covariance, log_weight = _condition(system, sd)
                log_weight += size * np.log(FAULT_SHARE / len(OFFSET_SIZES))
                log_weight += (len(may) - size) * np.log(1.0 - FAULT_SHARE)
                found.append((log_weight, chosen, mean, covariance))
    found.sort(key=lambda each: -each[0])
    found = [each for each in found if each[0] > found[0][0] - MARGIN]
    weight = np.exp([each[0] - found[0][0] for each in found])
    weight /= weight.sum()
    centre = weight @ np.array([each[2] for each in found])
    square = [np.diagonal(covariance) + (mean - centre) ** 2 for _, _, mean, covariance in found]
    normal = norm.ppf(qmc.Sobol(len(centre), scramble=True, rng=1).random(DRAWS))
    number = np.maximum((DRAWS * weight).astype(np.int64), FEWEST_DRAWS)
    draws, with_offset = [], np.zeros(S)
    for (_, chosen, mean, covariance), n, share in zip(found, number, weight, strict=True):
        values, vectors = np.linalg.eigh(covariance)
        draws.append(mean + normal[:n] @ (vectors * np.sqrt(np.maximum(values, 0.0))).T)
        with_offset[list(chosen)] += share
    return _Posterior(
        np.concatenate(draws),
        np.repeat(weight / number, number),
        np.repeat(np.arange(len(found)), number),
        centre,
        np.sqrt(weight @ np.array(square)),
        with_offset,
    )


def _fault_probability(mean: Array, sd: Array, prior_sd: float, sound_sd: float) -> Array:
    """Probability of a fault: an open prior against that of a sensor without one, on what the data alone say.

    The data's likelihood is the posterior over the prior: Gaussian, of precision 1 / sd^2 - 1 / prior_sd^2.
    """
    precision = np.maximum(sd**-2.0 - prior_sd**-2.0, 1e-12)
    value, variance = mean / sd**2 / precision, 1.0 / precision
    open_, sound = variance + prior_sd**2, variance + sound_sd**2
    log_odds = 0.5 * (np.log(sound / open_) + value**2 * (1.0 / sound - 1.0 / open_))
    return np.asarray(1.0 / (1.0 + (1.0 - FAULT_SHARE) / FAULT_SHARE * np.exp(-np.minimum(log_odds, 700.0))))


def _disagreements(readings: Sequence[tuple[Array, Array]], name: str) -> list[str]:
    """What is known of one sensor twice, and not the same."""
    found = []
    for (a, a_sd), (b, b_sd) in combinations(readings, 2):
        apart = np.abs(a - b) > CONTRADICTION * np.hypot(a_sd, b_sd)
        if apart[0]:
            found.append(f"the gain error of {name} is known as {a[0]:+z.2%} and as {b[0]:+z.2%}")
        if apart[1]:
            found.append(f"the offset of {name} is known as {a[1]:+.2f} A and as {b[1]:+.2f} A")
    return found


def _contradictions(system: _System, names: Sequence[str], scale_a: float) -> list[str]:
    """Readings and loads that the rows and all other readings deny, whatever the sensors that are not known do."""
    S, found = system.sensors, []
    for p in np.flatnonzero(system.read).tolist():
        sd = system.sd.copy()
        sd[p] = OPEN_GAIN_SD if p < S else OPEN_OFFSET_SD if p < 2 * S else OPEN_LOAD_SD
        mean, covariance, _ = _condition(system, sd)
        if abs(mean[p] - system.mean[p]) > CONTRADICTION * np.hypot(np.sqrt(covariance[p, p]), system.sd[p]):
            text = f"gain error of {names[p % S]} is known as {np.expm1(system.mean[p]):+z.2%}, the rest makes it "
            text += f"{np.expm1(mean[p]):+z.2%}"
            if p >= S:
                known_a, rest_a = system.mean[p] * scale_a, mean[p] * scale_a
                what = f"offset of {names[p % S]}" if p < 2 * S else "load that no branch measures"
                text = f"{what} is known as {known_a:+.2f} A, the rest makes it {rest_a:+.2f} A"
            found.append(f"the {text}")
    return found


def estimate_junction(
    vehicles: Sequence[VehicleSummary],
    branches: Sequence[str],
    known: JunctionKnowledge,
    *,
    full_scale_a: float,
    harm_limit: float,
    limits: tuple[float, float] = (np.inf, np.inf),
    meter: str | None = None,
) -> JunctionEstimate:
    """Estimate the sensors of one vehicle; or of one car in several recordings, each with its own meter.

    Parameters
    ----------
    vehicles : sequence of VehicleSummary
        N recordings of the same sensors in K branches, all but the meter; without a meter one.
    branches : sequence of str
        Names of the K branches.
    known : JunctionKnowledge
        What is known beside the recordings.
    full_scale_a : float
        Full scale of the junction. [A]
    harm_limit : float
        Largest probability of harm with which a branch is corrected. [1]
    limits : tuple of float
        Largest gain error [1] and offset [A] that are corrected.
    meter : str or None
        Branch that has another sensor in each recording.

    Returns
    -------
    JunctionEstimate
        In the order of the vehicles.

    Raises
    ------
    FleetError
        If currents do not balance as those of a junction: a sign or a unit is wrong.
    """
    N, K, scale_a = len(vehicles), len(branches), full_scale_a
    places = _places(N, branches, meter)
    laws = [_law(each.summary, branches, each.vehicle, scale_a) for each in vehicles]
    system = _system(vehicles, places, branches, known, laws=laws, full_scale_a=scale_a)
    names = [branches[k] if k < K else f"{meter} ({vehicles[k - K + 1].vehicle})" for k in range(system.sensors)]
    contradictions = _contradictions(system, names, scale_a)
    for s in range(system.sensors):
        of = [(vehicles[j], k) for j, k in np.argwhere(places == s).tolist()]
        contradictions += _disagreements(_readings(of, branches, known), names[s])
    S, scale_known = system.sensors, bool(system.read[: system.sensors].any())
    posterior = _posterior(system)
    mean, sd, draws, weight = posterior.mean, posterior.sd, posterior.draws, posterior.weight
    gain_fault = _fault_probability(mean[:S], sd[:S], OPEN_GAIN_SD, TRUSTED_DRIFT_SD)
    offset_fault = _fault_probability(mean[S : 2 * S], sd[S : 2 * S], OPEN_OFFSET_SD, TRUSTED_OFFSET_SD)
    offset_fault = np.where(system.read[S : 2 * S], offset_fault, posterior.offset_probability)
    fault = (1.0 - (1.0 - gain_fault) * (1.0 - offset_fault))[places]
    drift, offset, gain_sd, offset_sd = np.expm1(mean[places]), mean[S + places], sd[places], sd[S + places]
    harm, harm_of_gain, confidence, points = np.zeros((N, K)), np.zeros((N, K)), np.zeros(N), []
    for j, vehicle in enumerate(vehicles):
        faults = np.concatenate([np.expm1(draws[:, places[j]]), draws[:, S + places[j]]], axis=1)
        kinds = np.arange(posterior.explanation[-1] + 1)
        points.append(Points(faults, weight, posterior.explanation, np.zeros_like(kinds), kinds))
        own = (vehicle.summary.mean_a / scale_a - offset[j]) / (1.0 + drift[j])
        spread = vehicle.summary.variance_a2 / scale_a**2 / (1.0 + drift[j]) ** 2
        estimate = np.append(drift[j], offset[j])
        true = own[None], (own**2 + spread)[None]
        harm[j] = harm_probability(points[j], estimate, *true)
        harm_of_gain[j] = harm_probability(points[j], np.append(drift[j], np.zeros(K)), *true)
        confidence[j] = recovery_probability(points[j], estimate[None], (LEAST_FAULT, LEAST_FAULT))[0]
    vague = bool(gain_sd.min() > KNOWN_GAIN_SD)
    known_well = (gain_sd <= SOUND_GAIN_SD) & (offset_sd <= SOUND_OFFSET_SD)
    # Where it is open whose an offset is, the gain alone may be corrected.
    gain_alone = (harm >= harm_limit) & (harm_of_gain < harm_limit) & (gain_fault[places] > SUSPECTED)
    harm = np.where(gain_alone, harm_of_gain, harm)
    faulty = fault > SUSPECTED
    findings = _misfits([each.summary for each in vehicles], branches, scale_a)
    unfit = np.array([[bool(mine)] for mine in findings])
    reasons = {  # the first that applies is reported
        "": ~faulty,
        "does not fit": np.broadcast_to(unfit, (N, K)),
        "reference in doubt": np.full((N, K), not scale_known or bool(contradictions) or vague),
        "moved too little": gain_sd > KNOWN_GAIN_SD,
        "harm limit": ~(harm < harm_limit),
        "beyond the limits": (np.abs(drift) > limits[0]) | (np.abs(offset * scale_a) > limits[1]),
    }
    held_back = np.select(list(reasons.values()), list(reasons), "")
    corrected = faulty & (held_back == "")
    deciding = [
        "; ".join(
            [each.text for each in findings[j][:1]]
            + _deciding(
                branches,
                gain_sd[j],
                offset_sd[j],
                offset[j] * scale_a,
                offset_fault[places[j]],
                scale_known=scale_known,
                load_known=known.load is not None,
            )
        )
        for j in range(N)
    ]
    offset_sd = np.where(gain_alone & corrected, np.hypot(offset_sd, offset), offset_sd)
    offset = np.where(gain_alone & corrected, 0.0, offset)
    sound = (~faulty & known_well).all(axis=1) & ~unfit[:, 0] & scale_known & (not contradictions)
    verdicts = np.select([corrected.any(axis=1), sound], ["corrected", "no sensor fault"], "cannot tell")
    return JunctionEstimate(
        estimate=FleetEstimate(
            drift=drift,
            offset_a=offset * scale_a,
            drift_sd=gain_sd * (1.0 + drift),
            offset_sd_a=offset_sd * scale_a,
            hardware_drift=np.zeros(N),
            hardware_offset_a=np.zeros((N, K)),
            hardware_probability=np.full(N, np.nan),
            confidence=confidence,
            fault_probability=fault,
            harm_probability=harm,
            identifiable=gain_sd <= KNOWN_GAIN_SD,
            points=points,
            order=tuple(range(K)),
            full_scale_a=scale_a,
            corrected=corrected,
            held_back=held_back,
            verdicts=verdicts.tolist(),
            explanations=[_explanations(each, branches, scale_a) for each in points],
            findings=findings,
            evidence=[],
        ),
        ratios=[_named_ratios(law, branches) for law in laws],
        constant_a=[
            Reading(law.constant_a, float(np.hypot(np.sqrt(law.covariance[-1, -1]), LAW_OFFSET_SD * scale_a)))
            for law in laws
        ],
        deciding=deciding,
        contradictions=(f"what is known contradicts itself, so nothing is corrected: {'; '.join(contradictions)}",)
        if contradictions
        else (),
    )


def _misfits(summaries: Sequence[DriveSummary], branches: Sequence[str], scale_a: float) -> list[list[SensorFinding]]:
    """What linear sensors do not explain, by current, time or temperature; whose it is, only a fleet tells."""
    K = len(branches)
    usual = UsualMisfits(
        misfit_a=np.full(len(CAUSES), USUAL_MISFIT * scale_a),
        residual_a2=(USUAL_RESIDUAL * scale_a) ** 2,
        fast_a2=(USUAL_RESIDUAL * scale_a) ** 2,
        residual_spread=USUAL_SPREAD,
        slope_spread=np.ones(K),
        model_error_a=np.full(K, scale_a),
        spike_rate=1.0,
    )
    found = find_misfits(summaries, np.zeros((1, K)), usual, full_scale_a=scale_a, branches=branches)
    return [[each for each in mine if each.cause != "noise"] for mine in found]


def _named_ratios(law: _Law, branches: Sequence[str]) -> dict[str, Reading]:
    """Gain ratios "a / b" with a before b in the layout, whichever branch moves most."""
    first, *others = law.order
    relative_sd = np.hypot(np.sqrt(np.diagonal(law.covariance)[:-1]) / law.ratio, LAW_GAIN_SD)
    found = {}
    for k, ratio, sd in sorted(zip(others, law.ratio.tolist(), relative_sd.tolist(), strict=True)):
        above, below, value = (first, k, ratio) if first < k else (k, first, 1.0 / ratio)
        found[f"{branches[above]} / {branches[below]}"] = Reading(value, value * sd)
    return found


def _explanations(points: Points, branches: Sequence[str], scale_a: float) -> list[Explanation]:
    """Explanations by falling probability: those of their mean faults that are clear; what looks the same is one."""
    K, found = len(branches), dict[bytes, tuple[float, Array, Mask]]()
    for number in range(len(points.fit)):
        own = points.explanation == number
        share, faults = float(points.weight[own].sum()), points.faults[own]
        mean = points.weight[own] @ faults / share
        clear = np.abs(mean) > SEEN * np.sqrt(points.weight[own] @ (faults - mean) ** 2 / share)
        before, kept, _ = found.get(clear.tobytes(), (0.0, mean, clear))
        found[clear.tobytes()] = (before + share, kept, clear)
    return [
        Explanation(
            probability=min(share, 1.0),
            drift={name: float(mean[k]) for k, name in enumerate(branches) if clear[k]},
            offset_a={name: float(mean[K + k] * scale_a) for k, name in enumerate(branches) if clear[K + k]},
        )
        for share, mean, clear in sorted(found.values(), key=lambda each: -each[0])
    ]


def _deciding(
    branches: Sequence[str],
    gain_sd: Array,
    offset_sd: Array,
    offset_a: Array,
    offset_probability: Array,
    *,
    scale_known: bool,
    load_known: bool,
) -> list[str]:
    """What is not known of the sensors, and what would tell."""
    if not scale_known:
        return [
            f"only ratios of gains are known: name a sensor that you trust (--trusted {branches[0]}), or give bench "
            f"readings (--readings)"
        ]
    if gain_sd.min() > KNOWN_GAIN_SD:
        return [f"no gain is known better than to +-{gain_sd.min():.1%}: a better reference would decide"]
    texts = []
    if gains := [name for name, sd in zip(branches, gain_sd, strict=True) if sd > KNOWN_GAIN_SD]:
        texts.append(f"the gain of {', '.join(gains)} needs a drive in which that current varies more")
    unclear = [k for k, p in enumerate(offset_probability) if load_known and UNCLEAR[0] < p < UNCLEAR[1]]
    if len(unclear) > 1:
        whose = " or ".join(branches[k] for k in unclear)
        texts.append(
            f"an offset of {offset_a[unclear].sum():+.1f} A is of {whose}: a zero-current window (contactors open), or "
            f"a bench reading of one of them, would decide"
        )
    elif offsets := [name for name, sd in zip(branches, offset_sd, strict=True) if sd > KNOWN_OFFSET_SD]:
        load = "" if load_known else ", or the load that no branch measures (--load)"
        texts.append(
            f"the offset of {', '.join(offsets)} needs a zero-current window (contactors open), a bench reading{load}"
        )
    return texts


def _same_error(parameters: VehicleParameters, trusted: Collection[str]) -> list[str]:
    """Say where all gains are wrong alike against one sensor that is trusted: then that one may be wrong."""
    others = [branch for name, branch in parameters.branches.items() if name not in trusted]
    drifts = np.array([branch.drift for branch in others])
    sds = np.array([branch.drift_sd for branch in others], dtype=float)
    if len(trusted) != 1 or len(others) < 2 or not (np.abs(drifts) > SEEN * sds).all():
        return []
    if np.ptp(drifts) > SEEN * np.hypot(*np.sort(sds)[-2:]):
        return []
    (reference,), error = trusted, drifts.mean()
    own = 1.0 / (1.0 + error) - 1.0
    return [f"all others read {error:+z.1%} against {reference}: a gain error of its own of {own:+z.1%} looks the same"]


def calibrate_junctions(
    drives: Mapping[str, Sequence[Drive]],
    fleet: FleetSource,
    equipment: Equipment,
    identity: RunIdentity,
    settings: CalibrationSettings,
    *,
    workers: Workers,
) -> tuple[bytes, dict[str, object], tuple[str, ...]]:
    """Calibrate each vehicle by itself; with a meter all together, as they are recordings of one car.

    Parameters
    ----------
    drives : mapping of str to sequence of Drive
        Those that were read already, by vehicle: all of a few vehicles, or none.
    fleet : FleetSource
        The recordings.
    equipment : Equipment
        Has the K branches.
    identity : RunIdentity
        For the parameter files.
    settings : CalibrationSettings
        How; its trusted names are branches.
    workers : Workers
        Where the drives are read.

    Returns
    -------
    part : bytes
        Of the result: parameters of every vehicle that could be used, and why the others could not.
    details : dict of str to JSON values
        Gain ratios and constants, for the record of the run.
    notices : tuple of str
        What the user should know.

    Raises
    ------
    UserError
        If no vehicle can be used, or something is said to be known that is not there.
    """
    layout, branches = identity.database.layout, equipment.branches
    vehicles, left_out = _summaries(fleet, drives, branches, identity.database, settings.time_limit_s, workers=workers)
    known = _known(settings, layout, branches, [each.vehicle for each in vehicles], left_out)
    if settings.charge_ah:
        if len(drives) != 1:
            raise FleetError(
                f"--charge is of the recordings of one vehicle, and there are {len(fleet.vehicles)}; give those of one"
            )
        (mine,) = drives.values()
        charges = {name: _charge(mine, name, *value) for name, value in settings.charge_ah.items()}
        known = replace(known, charge=charges)
    groups = [vehicles] if settings.meter is not None else [[each] for each in vehicles]
    parameters, junctions, notices = [], dict[str, object](), list[str]()
    for group in groups:
        try:
            found = estimate_junction(
                group,
                branches,
                known,
                full_scale_a=layout.full_scale_a,
                harm_limit=settings.harm_limit,
                limits=(layout.limits.drift, layout.offset_limit_a),
                meter=settings.meter,
            )
        except FleetError as error:
            if len(groups) == 1:
                raise
            left_out[group[0].vehicle] = str(error)
            continue
        notices += found.contradictions
        for j, vehicle in enumerate(group):
            parameters.append(
                parameters_of(
                    vehicle,
                    found.estimate,
                    j,
                    identity=identity,
                    branches=branches,
                    expected_a=0.0 if known.load is None else known.load.mean_a,
                    fleet_size=1,
                    decisive=found.deciding[j],
                )
            )
            junctions[vehicle.vehicle] = {
                "gain_ratio": found.ratios[j],
                "constant_a": found.constant_a[j],
            }
            if len(vehicles) <= MOST_SHOWN:
                sensors = parameters[-1].branches.items()
                notices += [f"{vehicle.vehicle}: {name}: {sensor_text(branch)}" for name, branch in sensors]
                notices.append(_shown(vehicle.vehicle, found.ratios[j], found.constant_a[j]))
                notices += [f"{vehicle.vehicle}: {text}" for text in _same_error(parameters[-1], settings.trusted)]
    return encode_chunk(parameters, left_out), {"junction": junctions}, tuple(notices)


def _summaries(
    fleet: FleetSource,
    drives: Mapping[str, Sequence[Drive]],
    branches: tuple[str, ...],
    database: VehicleDatabase,
    limit_s: float,
    *,
    workers: Workers,
) -> tuple[list[VehicleSummary], dict[str, str]]:
    """Summaries of the vehicles that can be used, and why the others cannot."""
    if not drives:
        equipment = Equipment(branches=branches, inputs=(), fleet_inputs=(), notices=())
        return read_vehicles(read_junction, fleet, equipment, database, workers=workers, limit_s=limit_s)
    found, left_out = list[VehicleSummary](), dict(fleet.left_out)
    for name, mine in drives.items():
        try:
            found.append(summarise_junction(mine, branches, database))
        except DriveError as error:
            left_out[name] = last = str(error)
    if not found:
        raise DriveError(last)
    return found, left_out


def _shown(vehicle: str, ratios: Mapping[str, Reading], constant_a: Reading) -> str:
    """Gain ratios and constant of a vehicle in words."""
    said = ", ".join(f"{value.mean:.4f} +- {value.sd:.4f} ({pair})" for pair, value in ratios.items())
    return (
        f"{vehicle}: gain ratios {said}; at zero current the sensors sum to {constant_a.mean:+.2f} +- "
        f"{constant_a.sd:.2f} A: their offsets, and loads without a sensor"
    )


def _charge(drives: Sequence[Drive], branch: str, charge_ah: float, sd_ah: float) -> Charge:
    """Mean currents of a branch over the whole of some drives; FleetError if too much of it is missing."""
    measured_as = span_s = missing_s = 0.0
    for drive in drives:
        channel = drive.branches[branch]
        time_s, value_a = channel.time_s[channel.good], channel.value[channel.good]
        step_s = np.diff(time_s)
        measured_as += float(np.trapezoid(value_a, time_s))
        span_s += float(time_s[-1] - time_s[0])
        missing_s += float(step_s[step_s > GAP_PERIODS * np.median(step_s)].sum())
    if missing_s > MOST_MISSING * span_s:
        raise FleetError(
            f"--charge {branch}: {missing_s:.0f} s of {span_s:.0f} s have no samples of it, so its charge is not "
            f"known; leave the option out"
        )
    hours = span_s / 3600.0
    return Charge(measured_as / span_s, charge_ah / hours, sd_ah / hours)


def _known(
    settings: CalibrationSettings,
    layout: Layout,
    branches: Sequence[str],
    vehicles: Sequence[str],
    left_out: Mapping[str, str],
) -> JunctionKnowledge:
    """What the user knows; FleetError if it is of something that is not there."""
    scale_a, meter = layout.full_scale_a, [settings.meter] if settings.meter else []
    for option, names in {"--trusted": settings.trusted, "--charge": settings.charge_ah, "--meter": meter}.items():
        for name in names:
            if name not in branches:
                raise FleetError(f"{option} {name}: no such branch was recorded; there are {', '.join(branches)}")
    if settings.meter is not None and len(vehicles) < 2:
        raise FleetError(f"--meter {settings.meter}: one folder of recordings; give one for each of its sensors")
    bench: BenchTable = {}
    if settings.readings is not None:
        bench = read_bench_table(settings.readings, branches, full_scale_a=scale_a)
        check_bench_table(bench, vehicles, left_out=left_out, trusted=(), full_scale_a=scale_a)
    return JunctionKnowledge(
        trusted={
            name: (max(TRUSTED_DRIFT_SD, layout.find_branch(name).uncertainty), TRUSTED_OFFSET_SD * scale_a)
            for name in settings.trusted
        },
        bench=bench,
        load=settings.load or layout.unmeasured_load,
    )
