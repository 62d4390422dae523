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

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import combinations, product
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.ndimage import maximum_filter1d, minimum_filter1d
from scipy.stats import norm, qmc

from calibrator.drive import Array, Drive, DriveFile, Equipment, FleetSource, Mask
from calibrator.drives.align import Samples, align, at_pace
from calibrator.drives.charge import GAP_PERIODS
from calibrator.drives.delays import MAX_DELAY_S, estimate_delays, without_delays
from calibrator.errors import DriveError, FleetError
from calibrator.estimator.checks import CAUSES, UsualMisfits, find_misfits
from calibrator.estimator.decision import FleetEstimate, Points, decided, harm_probability, recovery_probability
from calibrator.estimator.evidence import junction_regression, stack_summaries
from calibrator.estimator.fleet_estimate import SUSPECTED
from calibrator.estimator.parameter_files import RunIdentity
from calibrator.estimator.readings import (
    CONTRADICTION,
    TRUSTED_DRIFT_SD,
    TRUSTED_OFFSET_SD,
    BenchTable,
    bench_readings,
    check_bench_table,
    read_bench_table,
    window_readings,
)
from calibrator.estimator.results import encode_chunk
from calibrator.estimator.settings import CalibrationSettings
from calibrator.estimator.vehicle_report import parameters_of, sensor_texts
from calibrator.processes.run_many import Workers
from calibrator.sources.fleet_source import load_drive, probe_equipment, read_vehicles
from calibrator.summaries.moments import BLOCK_S, DriveSummary
from calibrator.summaries.summariser import summarise_samples
from calibrator.summaries.vehicle_summary import (
    VehicleSummary,
    most_moving_first,
    require_possible,
    zero_current_offsets,
)
from calibrator.terminal.progress import shown
from ecu_node.database import VehicleDatabase
from ecu_node.errors import UserError
from ecu_node.layout import Layout, UnmeasuredLoad
from ecu_node.parameters import Explanation, SensorFinding, VehicleParameters

__all__ = ["calibrate_junctions", "read_junction", "summarise_junction"]

_Made = TypeVar("_Made")

LEAST_DURATION_S, SHORTEST_BLOCK_S, BLOCKS, FEWEST_BLOCKS = 5.0, 0.5, 16, 5
"""Least valid data, shortest block, number of blocks of a short recording, and least number beyond that of branches:
enough to tell how sure all is."""
FULL_BLOCK = 10
"""Samples that a block has where there are enough."""
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
SEEN = 3.0
"""Standard deviations from which on a fault is clear. [1]"""
MOST_SHOWN = 5
"""Vehicles whose gain ratios are shown one by one."""
MOST_READ_HERE = 5
"""Vehicles that are read in this process: others would take longer to start."""


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
    layout = at_pace(database.layout, drives)
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
    longest_s = max(BLOCK_S, FULL_BLOCK * layout.period_s)
    block_s = max(min(longest_s, duration_s / BLOCKS), SHORTEST_BLOCK_S, layout.period_s)
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
    """Rows of the junction law (M8) of one vehicle: log(-g) of the K - 1 other branches, c over full scale. [1]"""

    order: list[int]
    """Branches, the one that moves most first."""
    value: Array
    covariance: Array
    constant_a: tuple[float, float]
    """c with its standard deviation. [A]"""


def _law(summary: DriveSummary, branches: Sequence[str], where: str, scale_a: float) -> _Law:
    order = np.argsort(-summary.variance_a2, kind="stable").tolist()
    fit = junction_regression(stack_summaries([summary], order))
    K, others, mean_a = len(order), order[1:], summary.mean_a
    covariance = fit.influence.T @ fit.influence + fit.prior_covariance[0]
    if summary.variance_a2.max() < (STILL * scale_a) ** 2:  # the ratios are open, and the sum tells the constant
        ratio: Array = np.ones(K - 1)
        constant_a = float(mean_a.sum())
        covariance = np.diag(np.append(np.ones(K - 1), covariance[-1, -1]))
    else:
        ratio, constant_a = -fit.estimate[0, :-1], float(fit.estimate[0, -1])
        sign = np.append(-np.ones(K - 1), 1.0)
        covariance *= np.outer(sign, sign)
        sure = np.sqrt(np.diagonal(covariance)[:-1]) < SURE_SD
        for k, value in zip(np.array(others)[sure].tolist(), ratio[sure].tolist(), strict=True):
            if not 1.0 / MOST_RATIO < value < MOST_RATIO:
                raise FleetError(
                    f"{where}: the currents do not balance: 1 A in branch {branches[k]} goes with {-value:+.2g} A in "
                    f"branch {branches[order[0]]}, expected -1 A; check sign and unit of branch {branches[k]} or "
                    f"{branches[order[0]]}"
                )
        ratio = np.clip(ratio, 1.0 / MOST_RATIO, MOST_RATIO)
    constant_sd_a = float(np.hypot(np.sqrt(covariance[-1, -1]), LAW_OFFSET_SD * scale_a))
    unit = np.append(1.0 / ratio, 1.0 / scale_a)
    # an error of a ratio turns the line about the mean current, and so moves the constant
    turn = np.vstack([np.eye(K - 1), ratio * mean_a[others] / scale_a]) * LAW_GAIN_SD
    covariance = covariance * np.outer(unit, unit) + turn @ turn.T
    covariance[-1, -1] += LAW_OFFSET_SD**2
    return _Law(order, np.append(np.log(ratio), constant_a / scale_a), covariance, (constant_a, constant_sd_a))


class _Known(NamedTuple):
    """What is known beside the recordings of N vehicles with K branches."""

    read: Array
    """Values and standard deviations of drifts [1] and offsets [A] by zero-current windows, bench and trust, shape
    (3, 2, 2, N, K); NaN where there are none."""
    load: UnmeasuredLoad | None
    charge_a: Mapping[str, tuple[float, float, float]]
    meter: str | None


class _System:
    """Rows y = design x + error of N recordings over x = (lambda of S sensors, their offsets, N loads).

    The first rows are the junction laws, and the charges; the last ones what is known of single x. Offsets and loads
    are in fractions of full scale. Before anything is known, all x are about 0 and open.

    Attributes
    ----------
    places : ndarray of int of shape (N, K)
        Number of the sensor of each vehicle and branch: vehicles share all but meters.
    names : list of S str
        Of the sensors.
    laws : list of N _Law
        The junction laws.
    known : list of (int, str)
        Place in x, and name, of what each of the last rows tells.
    """

    def __init__(
        self, vehicles: Sequence[VehicleSummary], branches: Sequence[str], known: _Known, scale_a: float
    ) -> None:
        N, K, self.scale_a = len(vehicles), len(branches), scale_a
        self.places = np.tile(np.arange(K), (N, 1))
        if known.meter is not None:
            self.places[1:, branches.index(known.meter)] = K + np.arange(N - 1)
        self.sensors = S = int(self.places.max()) + 1
        self.names = [branches[k] if k < K else f"{known.meter} ({vehicles[k - K + 1].vehicle})" for k in range(S)]
        self.laws = [_law(each.summary, branches, each.vehicle, scale_a) for each in vehicles]
        load = known.load or UnmeasuredLoad(mean_a=0.0, sd_a=0.0)
        given = [
            (int(self.places[j, k]) + what * S, *known.read[r, :, what, j, k].tolist())
            for r, what, j, k in np.argwhere(np.isfinite(known.read[:, 0])).tolist()
        ]
        given += [(2 * S + j, load.mean_a, load.sd_a) for j in range(N) if known.load is not None]
        self.known = [(p, self._called(p)) for p, _, _ in given]
        of_gain = np.array([p < S for p, _, _ in given], bool)
        value, sd = np.array([each[1:] for each in given]).reshape(-1, 2).T
        design = np.zeros((N * K + len(known.charge_a) + len(given), 2 * S + N))
        for j, law in enumerate(self.laws):
            first, *others = self.places[j][law.order].tolist()
            ratios, constant = range(j * K, (j + 1) * K - 1), (j + 1) * K - 1
            design[ratios, first], design[ratios, others] = 1.0, -1.0
            design[constant, [S + first, *(S + s for s in others)]] = np.append(1.0, np.exp(law.value[:-1]))
            design[constant, 2 * S + j] = 1.0
            design[constant, first] = load.mean_a / scale_a  # (1 + d_1) l
        charges = np.array([*known.charge_a.values()]).reshape(-1, 3) / scale_a  # mean measured = (1 + d) true + o
        for i, name in enumerate(known.charge_a, start=N * K):
            k = branches.index(name)
            design[i, [k, S + k]] = charges[i - N * K, 1], 1.0
        design[range(len(design) - len(given), len(design)), [p for p, _, _ in given]] = 1.0
        self.design = design
        self.y = np.concatenate(
            [
                *(law.value for law in self.laws),
                charges[:, 0] - charges[:, 1],
                np.where(of_gain, np.log1p(np.where(of_gain, value, 0.0)), value / scale_a),
            ]
        )
        self.covariance = block_diag(
            *(law.covariance for law in self.laws),
            np.diag(charges[:, 2] ** 2 + LAW_OFFSET_SD**2),
            np.diag(np.where(of_gain, sd / (1.0 + value), sd / scale_a) ** 2),
        )
        self.open_sd = np.repeat([OPEN_GAIN_SD, OPEN_OFFSET_SD, OPEN_LOAD_SD], [S, S, N])

    def _called(self, p: int) -> str:
        S = self.sensors
        what = ("gain error of", "offset of")[p // S] if p < 2 * S else ""
        return f"{what} {self.names[p % S]}" if what else "load that no branch measures"

    def is_known(self, p: int) -> bool:
        """Whether anything tells x_p by itself."""
        return any(place == p for place, _ in self.known)

    def condition(self, sd: Array, without: int | None = None) -> tuple[Array, Array, float]:
        """Mean (P,), covariance (P, P) and log evidence of x under a prior with these standard deviations (P,).

        ``without`` is a row that is left out.
        """
        used = np.arange(len(self.y)) != (len(self.y) if without is None else without)
        A, prior, y = self.design[used], np.diag(sd**2), self.y[used]
        rows = A @ prior @ A.T + self.covariance[used][:, used]
        gain = np.linalg.solve(rows, A @ prior).T
        log_evidence = -0.5 * (y @ np.linalg.solve(rows, y) + np.linalg.slogdet(2.0 * np.pi * rows)[1])
        return gain @ y, prior - gain @ A @ prior, float(log_evidence)

    def contradictions(self) -> list[str]:
        """What is known and all other rows deny, whatever the sensors that are not known do."""
        found = []
        for row, (p, name) in enumerate(self.known, start=len(self.y) - len(self.known)):
            mean, covariance, _ = self.condition(self.open_sd, without=row)
            if abs(mean[p] - self.y[row]) > CONTRADICTION * np.sqrt(covariance[p, p] + self.covariance[row, row]):
                known, rest = (
                    f"{np.expm1(value):+z.2%}" if p < self.sensors else f"{value * self.scale_a:+.2f} A"
                    for value in (self.y[row], mean[p])
                )
                found.append(f"the {name} is known as {known}, the rest makes it {rest}")
        return found


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
    may = [s for s in range(S) if not system.is_known(S + s)]
    found = []
    for size in range(min(len(may), MOST_OFFSETS) + 1):
        for chosen in combinations(may, size):
            for sizes in product(OFFSET_SIZES, repeat=size):
                sd = system.open_sd.copy()
                sd[[S + s for s in may]] = TRUSTED_OFFSET_SD
                sd[[S + s for s in chosen]] = sizes
                mean, covariance, log_weight = system.condition(sd)
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


def _estimate(
    vehicles: Sequence[VehicleSummary], branches: Sequence[str], known: _Known, *, layout: Layout, harm_limit: float
) -> tuple[FleetEstimate, list[_Law], list[str], list[str]]:
    """Estimate the sensors of one vehicle; or of one car in several recordings, each with its own meter.

    Parameters
    ----------
    vehicles : sequence of VehicleSummary
        N recordings of the same sensors in K branches, all but the meter; without a meter one.
    branches : sequence of str
        Names of the K branches.
    known : _Known
        What is known beside the recordings.
    layout : Layout
        Has the full scale and the limits of corrections.
    harm_limit : float
        Largest probability of harm with which a branch is corrected. [1]

    Returns
    -------
    estimate : FleetEstimate
        As of a fleet; drifts and offsets are the means of the posterior, also where no fault is suspected.
    laws : list of N _Law
        The junction laws.
    deciding : list of N str
        What would decide the rest; empty if all is known.
    contradictions : list of str
        Where what is known contradicts itself.

    Raises
    ------
    FleetError
        If currents do not balance as those of a junction: a sign or a unit is wrong.
    """
    N, K, scale_a = len(vehicles), len(branches), layout.full_scale_a
    system = _System(vehicles, branches, known, scale_a)
    S, places, contradictions = system.sensors, system.places, system.contradictions()
    scale_known, posterior = any(p < S for p, _ in system.known), _posterior(system)
    mean, sd, draws, weight = posterior.mean, posterior.sd, posterior.draws, posterior.weight
    gain_fault = _fault_probability(mean[:S], sd[:S], OPEN_GAIN_SD, TRUSTED_DRIFT_SD)
    offset_fault = _fault_probability(mean[S : 2 * S], sd[S : 2 * S], OPEN_OFFSET_SD, TRUSTED_OFFSET_SD)
    offset_read = [system.is_known(S + s) for s in range(S)]
    offset_fault = np.where(offset_read, offset_fault, posterior.offset_probability)
    fault = (1.0 - (1.0 - gain_fault) * (1.0 - offset_fault))[places]
    drift, offset, gain_sd, offset_sd = np.expm1(mean[places]), mean[S + places], sd[places], sd[S + places]
    harm, harm_of_gain, confidence, points = np.zeros((N, K)), np.zeros((N, K)), np.zeros(N), []
    kinds = np.arange(posterior.explanation[-1] + 1)
    for j, vehicle in enumerate(vehicles):
        faults = np.concatenate([np.expm1(draws[:, places[j]]), draws[:, S + places[j]]], axis=1)
        points.append(Points(faults, weight, posterior.explanation, np.zeros_like(kinds), kinds))
        own = (vehicle.summary.mean_a / scale_a - offset[j]) / (1.0 + drift[j])
        spread = vehicle.summary.variance_a2 / scale_a**2 / (1.0 + drift[j]) ** 2
        estimate, true = np.append(drift[j], offset[j]), (own[None], (own**2 + spread)[None])
        harm[j] = harm_probability(points[j], estimate, *true)
        harm_of_gain[j] = harm_probability(points[j], np.append(drift[j], np.zeros(K)), *true)
        confidence[j] = recovery_probability(points[j], estimate[None], (LEAST_FAULT, LEAST_FAULT))[0]
    # Where it is open whose an offset is, the gain alone may be corrected.
    gain_alone = (harm >= harm_limit) & (harm_of_gain < harm_limit) & (gain_fault[places] > SUSPECTED)
    harm, faulty = np.where(gain_alone, harm_of_gain, harm), fault > SUSPECTED
    findings = _misfits([each.summary for each in vehicles], branches, scale_a)
    unfit = np.array([[bool(mine)] for mine in findings])
    in_doubt = not scale_known or bool(contradictions) or bool(gain_sd.min() > KNOWN_GAIN_SD)
    well_known = (gain_sd <= SOUND_GAIN_SD) & (offset_sd <= SOUND_OFFSET_SD)
    held_back, corrected, verdicts = decided(
        faulty,
        unfit=unfit,
        in_doubt=np.array(in_doubt),
        still=gain_sd > KNOWN_GAIN_SD,
        harmful=~(harm < harm_limit),
        beyond=(np.abs(drift) > layout.limits.drift) | (np.abs(offset * scale_a) > layout.offset_limit_a),
        sound=(~faulty & well_known).all(axis=1) & ~unfit[:, 0] & scale_known & (not contradictions),
    )
    alone = gain_alone & corrected
    found = FleetEstimate(
        drift=drift,
        offset_a=np.where(alone, 0.0, offset) * scale_a,
        drift_sd=gain_sd * (1.0 + drift),
        offset_sd_a=np.where(alone, np.hypot(offset_sd, offset), offset_sd) * scale_a,
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
        verdicts=verdicts,
        explanations=[_explanations(each, branches, scale_a) for each in points],
        findings=findings,
        evidence=np.zeros((N, 3, 0)),
    )
    deciding = [
        "; ".join(
            [
                *(each.text for each in mine[:1]),
                *_deciding(branches, gain_sd[j], offset_sd[j], scale=scale_known, load=known.load is not None),
            ]
        )
        for j, mine in enumerate(findings)
    ]
    return found, system.laws, deciding, contradictions


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


def _named_ratios(law: _Law, branches: Sequence[str]) -> dict[str, tuple[float, float]]:
    """Gain ratios "a / b" with a before b in the layout, whichever branch moves most, and standard deviations. [1]"""
    first, *others = law.order
    ratios, sds = np.exp(law.value[:-1]).tolist(), np.sqrt(np.diagonal(law.covariance)[:-1]).tolist()
    found = {}
    for k, ratio, sd in sorted(zip(others, ratios, sds, strict=True)):
        above, below, value = (first, k, ratio) if first < k else (k, first, 1.0 / ratio)
        found[f"{branches[above]} / {branches[below]}"] = (value, value * sd)
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


def _deciding(branches: Sequence[str], gain_sd: Array, offset_sd: Array, *, scale: bool, load: bool) -> list[str]:
    """What is not known of the sensors, and what would tell; by what is known."""
    if not scale:
        return [
            f"only ratios of gains are known: name a sensor that you trust (--trusted {branches[0]}), or give bench "
            f"readings (--readings)"
        ]
    if gain_sd.min() > KNOWN_GAIN_SD:
        return [f"no gain is known better than to +-{gain_sd.min():.1%}: a better reference would decide"]
    texts = []
    if gains := [name for name, sd in zip(branches, gain_sd, strict=True) if sd > KNOWN_GAIN_SD]:
        texts.append(f"the gain of {', '.join(gains)} needs a drive in which that current varies more")
    if offsets := [name for name, sd in zip(branches, offset_sd, strict=True) if sd > KNOWN_OFFSET_SD]:
        more = "" if load else ", or the load that no branch measures (--load)"
        whose = ", ".join(offsets)
        texts.append(f"the offset of {whose} needs a zero-current window (contactors open), a bench reading{more}")
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
    fleet: FleetSource, identity: RunIdentity, settings: CalibrationSettings, *, workers: Workers
) -> tuple[Equipment, bytes, dict[str, object], list[str]]:
    """Calibrate each vehicle by itself; with a meter all together, as they are recordings of one car.

    Parameters
    ----------
    fleet : FleetSource
        The recordings.
    identity : RunIdentity
        For the parameter files.
    settings : CalibrationSettings
        How; its trusted names are branches.
    workers : Workers
        Where the drives are read, if they are many.

    Returns
    -------
    equipment : Equipment
        Has the K branches.
    part : bytes
        Of the result: parameters of every vehicle that could be used, and why the others could not.
    details : dict of str to JSON values
        Gain ratios and constants, for the record of the run.
    notices : list of str
        What the user should know.

    Raises
    ------
    UserError
        If no vehicle can be used, or something is said to be known that is not there.
    """
    layout = identity.database.layout
    equipment, vehicles, left_out, drives = _read(fleet, identity.database, settings, workers)
    branches, load = equipment.branches, settings.load or layout.unmeasured_load
    read = _known_readings(vehicles, branches, settings, layout, left_out)
    charge_a = _charges(drives, settings, fleet)
    groups = [range(len(vehicles))] if settings.meter is not None else [[j] for j in range(len(vehicles))]
    parameters, junctions, notices = [], dict[str, object](), list[str]()
    for group in groups:
        known = _Known(read[..., list(group), :], load, charge_a, settings.meter)
        try:
            found, laws, deciding, contradictions = _estimate(
                [vehicles[j] for j in group], branches, known, layout=layout, harm_limit=settings.harm_limit
            )
        except FleetError as error:
            if len(groups) == 1:
                raise
            left_out[vehicles[group[0]].vehicle] = str(error)
            continue
        if contradictions:
            why = "; ".join(contradictions)
            notices.append(f"what is known contradicts itself, so nothing is corrected: {why}")
        for i, j in enumerate(group):
            name, ratios, constant_a = vehicles[j].vehicle, _named_ratios(laws[i], branches), laws[i].constant_a
            k = int(np.argmax(found.drift[i]))
            if found.drift[i, k] >= 1.0:  # as in the schema of the parameter file
                left_out[name] = (
                    f"sensor {branches[k]} reads {1.0 + found.drift[i, k]:.1f} times the current; check its unit, or "
                    f"what is known of the other sensors"
                )
                continue
            expected_a = 0.0 if load is None else load.mean_a
            mine = parameters_of(
                vehicles[j],
                found,
                i,
                identity=identity,
                branches=branches,
                expected_a=expected_a,
                fleet_size=1,
                decisive=deciding[i],
            )
            parameters.append(mine)
            junctions[name] = {"gain_ratio": ratios, "constant_a": constant_a}
            if len(vehicles) <= MOST_SHOWN:
                said = ", ".join(f"{value:.4f} +- {sd:.4f} ({pair})" for pair, (value, sd) in ratios.items())
                texts = [f"{branch}: {text}" for branch, text in sensor_texts(mine).items()]
                texts.append(
                    f"gain ratios {said}; at zero current the sensors sum to {constant_a[0]:+.2f} +- "
                    f"{constant_a[1]:.2f} A: their offsets, and loads without a sensor"
                )
                notices += [f"{name}: {text}" for text in (*texts, *_same_error(mine, settings.trusted))]
    details = {"junction": junctions, "declared_load_a": 0.0 if load is None else load.mean_a}
    return equipment, encode_chunk(parameters, left_out), details, notices


def _read(
    fleet: FleetSource, database: VehicleDatabase, settings: CalibrationSettings, workers: Workers
) -> tuple[Equipment, list[VehicleSummary], dict[str, str], list[Sequence[Drive]]]:
    """Branches; summaries of the vehicles that can be used, why the others cannot; drives of each, if they are few."""
    branches, limit_s = settings.branches, settings.time_limit_s
    if len(fleet.vehicles) > MOST_READ_HERE:
        equipment = probe_equipment(fleet, database, branches, limit_s=limit_s, modelled=False)
        found = read_vehicles(read_junction, fleet, equipment, database, workers=workers, limit_s=limit_s)
        return equipment, *found, []
    left_out = dict(fleet.left_out)

    def usable(make: Callable[[Any], _Made], items: Iterable[tuple[str, Any]]) -> dict[str, _Made]:
        """What can be made of some vehicles; why it cannot of the others goes to those left out."""
        found = dict[str, _Made]()
        for vehicle, item in items:
            try:
                found[vehicle] = make(item)
            except UserError as problem:
                left_out[vehicle] = str(problem)
        if not found:
            raise FleetError(list(left_out.values())[-1])
        return found

    entries = shown(fleet.vehicles.items(), "read drives", len(fleet.vehicles), "vehicles")
    drives = usable(lambda mine: [load_drive(entry, database) for entry in mine], entries)
    first = [mine[0] for mine in drives.values()]
    equipment = probe_equipment(fleet, database, branches, limit_s=limit_s, modelled=False, drives=first)
    vehicles = usable(lambda mine: summarise_junction(mine, equipment.branches, database), drives.items())
    return equipment, list(vehicles.values()), left_out, list(drives.values())


def _known_readings(
    vehicles: Sequence[VehicleSummary],
    branches: Sequence[str],
    settings: CalibrationSettings,
    layout: Layout,
    left_out: Mapping[str, str],
) -> Array:
    """What is known of the sensors, see :class:`_Known`; FleetError if it is of something that is not there."""
    scale_a, names = layout.full_scale_a, [each.vehicle for each in vehicles]
    meter = [settings.meter] if settings.meter else []
    for option, given in {"--trusted": settings.trusted, "--charge": settings.charge_ah, "--meter": meter}.items():
        for name in given:
            if name not in branches:
                raise FleetError(f"{option} {name}: no such branch was recorded; there are {', '.join(branches)}")
    if meter and len(vehicles) < 2:
        raise FleetError(f"--meter {settings.meter}: one folder of recordings; give one for each of its sensors")
    bench: BenchTable = {}
    if settings.readings is not None:
        bench = read_bench_table(settings.readings, branches, full_scale_a=scale_a)
        check_bench_table(bench, names, left_out=left_out, trusted=(), full_scale_a=scale_a)
    trusted = np.full((2, 2, len(names), len(branches)), np.nan)
    for k, name in enumerate(branches):
        if name in settings.trusted:
            of = slice(None) if name == settings.meter or not meter else slice(1)  # once of each sensor
            trusted[0, :, of, k] = 0.0
            trusted[1, 0, of, k] = max(TRUSTED_DRIFT_SD, layout.find_branch(name).uncertainty)
            trusted[1, 1, of, k] = TRUSTED_OFFSET_SD * scale_a
    return np.stack([window_readings(vehicles), bench_readings(bench, names, branches), trusted])


def _charges(
    drives: Sequence[Sequence[Drive]], settings: CalibrationSettings, fleet: FleetSource
) -> dict[str, tuple[float, float, float]]:
    """Mean current of branches over all drives of one vehicle: as measured, by their charge, its deviation. [A]"""
    if not settings.charge_ah:
        return {}
    if len(drives) != 1:
        raise FleetError(
            f"--charge is of the recordings of one vehicle, and there are {len(fleet.vehicles)}; give those of one"
        )
    found, duration_s = {}, sum(drive.duration_s for drive in drives[0])
    for branch, (charge_ah, sd_ah) in settings.charge_ah.items():
        measured_as = span_s = missing_s = 0.0
        for drive in drives[0]:
            channel = drive.branches[branch]
            time_s, value_a = channel.time_s[channel.good], channel.value[channel.good]
            step_s = np.diff(time_s)
            usual = step_s <= GAP_PERIODS * np.median(step_s) if step_s.size else step_s > 0.0
            measured_as += float(np.trapezoid(value_a, time_s))
            span_s += float(step_s.sum())
            missing_s += drive.duration_s - float(step_s[usual].sum())
        if missing_s > MOST_MISSING * duration_s:
            raise FleetError(
                f"--charge {branch}: {missing_s:.0f} s of {duration_s:.0f} s have no samples of it, so its charge is "
                f"not known; leave the option out"
            )
        found[branch] = measured_as / span_s, charge_ah * 3600.0 / span_s, sd_ah * 3600.0 / span_s
    return found
