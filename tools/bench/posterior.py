"""How long the explanations of one vehicle take: the posterior beside basis pursuit, the convex problem of the paper.

Fleets are simulated with the paper's faults (5 to 25 % of full scale, balanced fleets) and the errors of good drives.
The peer solves the quadratic basis pursuit of the same vehicles: built once, with parameters. The posterior is that of
known hyper-parameters, estimated from the same fleet before: explanations, estimate and probability of harm. All is
measured in seconds of processor time on one thread, the best of some runs.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from time import process_time

import numpy as np
from threadpoolctl import threadpool_limits

from bench.row import Row
from calibrator.artificial.random_fleet import draw_faults
from calibrator.drive import Array
from calibrator.estimator.decision import estimate_rows
from calibrator.estimator.evidence import UNKNOWN_VARIANCE, EvidenceRows, RowPlaces, row_design
from calibrator.estimator.learning import FaultModel, learn_fault_models
from calibrator.published.recovery import BasisPursuit

__all__ = ["rows"]

VEHICLES = {2: 300, 3: 300, 4: 150, 5: 32, 6: 16, 8: 8}
"""Vehicles of a fleet by number of branches."""
QUICK_VEHICLES = 4
SOLVED, QUICK_SOLVED = 40, 2
"""Vehicles that the peer solves."""
FLEET, QUICK_FLEET = 1000, 20
"""Vehicles of the fleet that is estimated as a whole."""
WITH_PEER, ALONE = (2, 4), (3, 5, 6, 8)
"""Numbers of branches that are measured beside the peer, and those that are not."""
SPARSITIES = (80.0, 60.0)
"""Typical, and worst. [%]"""
MAGNITUDE = (0.05, 0.25)
SLOPE_SD, RATIO_SD, INTERCEPT_SD, JUNCTION_SD = 0.002, 0.0005, 0.001, 0.0005
"""Of the simulated rows; those of good drives. [1]"""
MEAN, MEAN_SQUARE = 0.05, 0.02
"""Moments of the currents, in fractions of full scale and their squares. [1]"""
RESIDUAL = 0.25
"""Share of the expected squared residual that basis pursuit is allowed: it then finds most. [1]"""
RUNS = 3


def rows(*, quick: bool) -> list[Row]:
    """Measure.

    Parameters
    ----------
    quick : bool
        Few vehicles: shows that all works, not how long it takes.

    Returns
    -------
    list of Row
        Time per vehicle.
    """
    with threadpool_limits(1):
        return list(_rows(quick=quick))


def _rows(*, quick: bool) -> Iterator[Row]:
    for branches in WITH_PEER:
        for sparsity in SPARSITIES:
            fleet = _simulated(branches, QUICK_VEHICLES if quick else VEHICLES[branches], sparsity)
            peer_s = _basis_pursuit_s(fleet, QUICK_SOLVED if quick else SOLVED)
            yield _row("posterior", fleet, _posterior_s(fleet), peer_s)
    for branches in ALONE:
        for sparsity in SPARSITIES:
            fleet = _simulated(branches, QUICK_VEHICLES if quick else VEHICLES[branches], sparsity)
            yield _row("posterior", fleet, _posterior_s(fleet))
    fleet = _simulated(2, QUICK_FLEET if quick else FLEET, SPARSITIES[0])
    yield Row(
        name=f"fleet of {len(fleet.rows)} vehicles, hyper-parameters too, K = 2, S = {fleet.sparsity:.0f} %",
        value=_fleet_s(fleet),
        unit="s",
    )


@dataclass(frozen=True)
class _Fleet:
    rows: EvidenceRows
    sparsity: float


def _row(name: str, fleet: _Fleet, seconds: float, peer_s: float | None = None) -> Row:
    peer = None if peer_s is None else f"basis pursuit, cvxpy (DPP) and Clarabel: {1e3 * peer_s:.2f} ms"
    return Row(
        name=f"{name}, K = {fleet.rows.branches}, S = {fleet.sparsity:.0f} %",
        value=1e3 * seconds,
        unit="ms per vehicle",
        peer=peer,
        ratio=None if peer_s is None else peer_s / seconds,
    )


def _best_s(run: Callable[[], object]) -> float:
    """Processor time of the best of some runs; the first one, which may compile, does not count. [s]"""
    run()
    times = []
    for _ in range(RUNS):
        start = process_time()
        run()
        times.append(process_time() - start)
    return min(times)


def _basis_pursuit_s(fleet: _Fleet, vehicles: int) -> float:
    """Time per vehicle. [s]"""
    K = fleet.rows.branches
    slopes, intercepts = _slopes_and_intercepts(fleet)
    epsilon = RESIDUAL * K * (SLOPE_SD**2 + INTERCEPT_SD**2)
    problem = BasisPursuit(K)

    def solve() -> None:
        for a, b in zip(slopes[:vehicles], intercepts[:vehicles], strict=True):
            problem.solve(a, b, epsilon=epsilon)

    return _best_s(solve) / len(slopes[:vehicles])


def _slopes_and_intercepts(fleet: _Fleet) -> tuple[Array, Array]:
    K = fleet.rows.branches
    return np.exp(fleet.rows.relative[:, :K]), fleet.rows.constant[:, :K]


def _posterior_s(fleet: _Fleet) -> float:
    """Time per vehicle, once the fault models of the fleet are known. [s]"""
    models = learn_fault_models(fleet.rows, feed=0)
    return _best_s(lambda: _estimate(fleet.rows, models)) / len(fleet.rows)


def _estimate(rows: EvidenceRows, models: Sequence[FaultModel]) -> None:
    mean, square = np.full((len(rows), rows.branches), MEAN), np.full((len(rows), rows.branches), MEAN_SQUARE)
    estimate_rows(rows, models, feed=0, mean=mean, mean_square=square, usual=np.stack([mean[0], square[0]]))


def _fleet_s(fleet: _Fleet) -> float:
    """Time of the whole fleet. [s]"""
    return _best_s(lambda: _estimate(fleet.rows, learn_fault_models(fleet.rows, feed=0)))


def _simulated(branches: int, vehicles: int, sparsity: float) -> _Fleet:
    """Rows of vehicles with random faults and errors, the same in each run."""
    K, rng = branches, np.random.default_rng(branches)
    faults = draw_faults(
        rng, vehicles=vehicles, branches=K, sparsity=sparsity, magnitude=MAGNITUDE, full_scale_a=1.0, balanced=True
    )
    relative = np.column_stack([faults.hardware_drift, faults.drift])
    factor = 1.0 + faults.drift
    seen = np.concatenate([faults.hardware_offset_a[:, :-1], faults.offset_a / factor], axis=1)
    unknown = [np.sqrt(UNKNOWN_VARIANCE)] * K
    sd = np.array([SLOPE_SD] * K + [RATIO_SD] * (K - 1) + unknown + [INTERCEPT_SD] * K + [JUNCTION_SD] + unknown)
    error = np.where(sd < 1.0, sd, 0.0) * rng.normal(size=(vehicles, 5 * K))
    at = RowPlaces(K)
    made = np.column_stack([np.log1p(relative), seen, np.zeros(vehicles)]) @ row_design(K, feed=0).T + error
    made[:, at.gain_reads] = made[:, at.offset_reads] = 0.0
    first, second = made[:, at.relative], made[:, at.constant]
    second *= np.concatenate([factor, factor[:, :1], factor], axis=1)
    covariance = np.tile(np.diag(sd**2), (vehicles, 1, 1))
    rows = EvidenceRows(relative=first, constant=second, covariance=covariance, means=np.zeros((vehicles, 2, K)))
    return _Fleet(rows, sparsity)


def main() -> None:
    """Print the rows."""
    for row in rows(quick=False):
        ratio = "" if row.ratio is None else f"  {row.ratio:7.1f} times faster than {row.peer}"
        print(f"{row.name:62s} {row.value:9.4f} {row.unit}{ratio}")


if __name__ == "__main__":
    main()
