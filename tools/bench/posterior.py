"""How long the explanations of one vehicle take: the posterior beside basis pursuit, the convex problem of the paper.

Fleets are simulated with the paper's faults (5 to 25 % of full scale, balanced fleets) and the errors of good drives.
The peer solves the quadratic basis pursuit of the same vehicles; its problem is built once, with the vehicle's values
as parameters. The posterior comprises explanations, estimate and probability of harm, by hyperparameters that were
learnt from the same fleet before. Measured is the processor time on one thread, the best of some runs.
"""

from collections.abc import Callable, Sequence
from functools import partial
from time import process_time

import numpy as np
from threadpoolctl import threadpool_limits

from bench.row import Row
from calibrator.artificial.random_fleet import FaultSettings
from calibrator.estimator.decision import estimate_rows
from calibrator.estimator.evidence import UNKNOWN_VARIANCE, EvidenceRows, RowPlaces, row_design
from calibrator.estimator.learning import learn_fault_models
from calibrator.estimator.posterior import FaultModel
from calibrator.published.recovery import BasisPursuit

__all__ = ["rows"]

VEHICLES, QUICK_VEHICLES = {2: 300, 3: 300, 4: 150, 6: 16, 8: 8}, 4
"""Number of vehicles of a fleet, by number of branches; and of any fleet in quick runs."""
SOLVED, QUICK_SOLVED = 40, 2
"""Number of vehicles that the peer solves; and in quick runs."""
SPARSITIES = (80.0, 60.0)
"""Typical and worst sparsity of faults. [%]"""
SLOPE_SD, RATIO_SD, INTERCEPT_SD, JUNCTION_SD = 0.002, 0.0005, 0.001, 0.0005
"""Standard deviations of the simulated rows; those of good drives. [1]"""
MEAN, MEAN_SQUARE = 0.05, 0.02
"""Mean of each current, in fractions of full scale, and mean of its square. [1]"""
RESIDUAL = 0.25
"""Squared residual that basis pursuit is allowed, as a share of what noise alone leaves. [1]"""
RUNS = 3


def rows(*, quick: bool) -> list[Row]:
    """Measure the time per vehicle; if ``quick``, with few vehicles, which only shows that it works."""
    found = []
    with threadpool_limits(1):
        for branches, vehicles in VEHICLES.items():
            for sparsity in SPARSITIES:
                fleet = _simulated(branches, QUICK_VEHICLES if quick else vehicles, sparsity)
                models = learn_fault_models(fleet, feed=0)
                seconds = _best_s(partial(_estimate, fleet, models)) / len(fleet)
                peer_s = _basis_pursuit_s(fleet, QUICK_SOLVED if quick else SOLVED)
                peer, ratio = f"basis pursuit, cvxpy (DPP) and Clarabel: {1e3 * peer_s:.2f} ms", peer_s / seconds
                name = f"posterior, K = {branches}, S = {sparsity:.0f} %"
                found.append(Row(name=name, value=1e3 * seconds, unit="ms per vehicle", peer=peer, ratio=ratio))
    return found


def _best_s(measured: Callable[[], object]) -> float:
    """Return the processor time of the best of some runs; the first one, which may compile, does not count. [s]"""
    times = []
    for _ in range(1 + RUNS):
        start = process_time()
        measured()
        times.append(process_time() - start)
    return min(times[1:])


def _basis_pursuit_s(fleet: EvidenceRows, vehicles: int) -> float:
    """Return the processor time that basis pursuit takes per vehicle. [s]"""
    K = fleet.branches
    slopes, intercepts = np.exp(fleet.values[:, fleet.places.slopes]), fleet.values[:, fleet.places.intercepts]
    lines = np.hstack([slopes, intercepts])[:vehicles]
    epsilon, problem = RESIDUAL * K * (SLOPE_SD**2 + INTERCEPT_SD**2), BasisPursuit(K)
    return _best_s(lambda: [problem.solve(y, epsilon=epsilon) for y in lines]) / len(lines)


def _estimate(fleet: EvidenceRows, models: Sequence[FaultModel]) -> None:
    """Do the work that is timed: explanations, estimate and probability of harm of each vehicle."""
    mean, square = (np.full((len(fleet), fleet.branches), value) for value in (MEAN, MEAN_SQUARE))
    estimate_rows(fleet, models, feed=0, mean=mean, mean_square=square, usual=np.stack([mean[0], square[0]]))


def _simulated(branches: int, vehicles: int, sparsity: float) -> EvidenceRows:
    """Make rows of vehicles with random faults and errors, the same in each run."""
    K, rng, at = branches, np.random.default_rng(branches), RowPlaces(branches)
    faults = FaultSettings(sparsity=sparsity, balanced=True).draw(rng, vehicles=vehicles, branches=K, full_scale_a=1.0)
    factor = 1.0 + faults.drift
    gains = np.log1p(np.column_stack([faults.hardware_drift, faults.drift]))
    parameters = np.column_stack(
        [gains, faults.hardware_offset_a[:, :-1], faults.offset_a / factor, np.zeros(vehicles)]
    )
    unknown = [np.sqrt(UNKNOWN_VARIANCE)] * K
    sd = np.array([SLOPE_SD] * K + [RATIO_SD] * (K - 1) + unknown + [INTERCEPT_SD] * K + [JUNCTION_SD] + unknown)
    made = parameters @ row_design(K, feed=0).T
    made += np.where(sd < 1.0, sd, 0.0) * rng.normal(size=(vehicles, 5 * K))
    made[:, at.gain_reads] = made[:, at.offset_reads] = 0.0
    made[:, at.constant] *= np.concatenate([factor, factor[:, :1], factor], axis=1)
    covariance = np.tile(np.diag(sd**2), (vehicles, 1, 1))
    return EvidenceRows(values=made, covariance=covariance, means=np.zeros((vehicles, 2, K)))
