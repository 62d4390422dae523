"""Print how long the posterior takes per vehicle, by number of branches and sparsity, and how often it finds the truth.

Rows are simulated with the paper's faults (5 to 25 % of full scale, balanced fleets), 64 vehicles, one thread.
"""

from time import perf_counter

import numpy as np
from threadpoolctl import threadpool_limits

from calibrator.artificial.random_fleet import draw_faults
from calibrator.drive import Array
from calibrator.evidence.rows import UNKNOWN_VARIANCE, FleetRows, constant_design, relative_design
from calibrator.posterior.fault_prior import FaultPrior, ModelSpread
from calibrator.posterior.slab import Slab
from calibrator.posterior.states import enumerate_states

VEHICLES = 64
MAGNITUDE = (0.05, 0.25)
DECAY = 0.7
"""Logarithm by which each further fault is less likely. [1]"""
SLOPE_SD, RATIO_SD, INTERCEPT_SD, JUNCTION_SD = 0.002, 0.0005, 0.001, 0.0005
"""Of the simulated rows; those of good drives. [1]"""


def main() -> None:
    """Print one line per case."""
    print("branches  sparsity %  ms per vehicle  right support")
    with threadpool_limits(1):
        for branches in (2, 3, 4, 5, 6, 8):
            for sparsity in (80.0, 60.0):
                milliseconds, right = _measure(branches, sparsity)
                print(f"{branches:8d}  {sparsity:10.0f}  {milliseconds:14.1f}  {right:13.2f}")


def _measure(branches: int, sparsity: float) -> tuple[float, float]:
    K, rng = branches, np.random.default_rng(branches)
    faults = draw_faults(
        rng, vehicles=VEHICLES, branches=K, sparsity=sparsity, magnitude=MAGNITUDE, full_scale_a=1.0, balanced=True
    )
    relative = np.column_stack([faults.hardware_drift, faults.drift])
    constant = np.concatenate([faults.hardware_offset_a[:, :-1], faults.offset_a], axis=1)
    rows = _rows(rng, relative, constant)
    spread = ModelSpread(mean=np.zeros(5 * K), covariance=np.zeros((5 * K, 5 * K)))
    start = perf_counter()
    states = enumerate_states(rows, _prior(K), spread)
    milliseconds = 1e3 * (perf_counter() - start) / VEHICLES
    same = np.all((states.relative[:, 0] != 0.0) == (relative != 0.0), axis=1)
    same &= np.all((states.constant[:, 0] != 0.0) == (constant != 0.0), axis=1)
    return milliseconds, float(same.mean())


def _rows(rng: np.random.Generator, relative: Array, constant: Array) -> FleetRows:
    K = relative.shape[1] - 1
    unknown = [np.sqrt(UNKNOWN_VARIANCE)] * K
    sd = np.array([SLOPE_SD] * K + [RATIO_SD] * (K - 1) + unknown + [INTERCEPT_SD] * K + [JUNCTION_SD] + unknown)
    error = np.where(sd < 1.0, sd, 0.0) * rng.normal(size=(VEHICLES, 5 * K))
    factor = 1.0 + relative[:, 1:]
    seen = np.concatenate([constant[:, : K - 1], constant[:, K - 1 :] / factor], axis=1)
    first = np.log1p(relative) @ relative_design(K).T + error[:, : 3 * K - 1]
    second = seen @ constant_design(K).T + error[:, 3 * K - 1 :]
    first[:, 2 * K - 1 :], second[:, K + 1 :] = 0.0, 0.0
    second *= np.concatenate([factor, factor[:, :1], factor], axis=1)
    return FleetRows(relative=first, constant=second, covariance=np.tile(np.diag(sd**2), (VEHICLES, 1, 1)))


def _prior(branches: int) -> FaultPrior:
    counts = np.exp(-DECAY * np.add.outer(np.arange(branches + 1.0), np.arange(2.0 * branches + 1.0)))
    return FaultPrior(counts=counts / counts.sum(), relative=Slab(*MAGNITUDE), constant=Slab(*MAGNITUDE))


if __name__ == "__main__":
    main()
