"""Evidence rows of fleets whose faults are known."""

from dataclasses import dataclass

import numpy as np

from calibrator.artificial.random_fleet import draw_faults
from calibrator.drive import Array
from calibrator.evidence.rows import UNKNOWN_VARIANCE, FleetRows, constant_design, relative_design
from calibrator.faults import Faults
from calibrator.posterior.fault_prior import FaultPrior, ModelSpread
from calibrator.posterior.slab import Slab

FULL_SCALE_A = 400.0


@dataclass(frozen=True, kw_only=True)
class Errors:
    """Standard deviations of slopes, gain ratios, intercepts and junction constant, offsets over full scale. [1]"""

    slope: float = 0.002
    ratio: float = 0.0005
    intercept: float = 0.001
    junction: float = 0.0005

    def covariance(self, branches: int) -> Array:
        """Of the rows of one vehicle, without bench readings, shape (5K, 5K)."""
        K = branches
        told = [self.slope] * K + [self.ratio] * (K - 1), [self.intercept] * K + [self.junction]
        unknown = np.full(K, UNKNOWN_VARIANCE)
        return np.diag(np.concatenate([np.square(told[0]), unknown, np.square(told[1]), unknown]))


def faults_of(relative: Array, constant: Array) -> Faults:
    """Fault parameters of (d_h, d_1 .. d_K) and (o_h,1 .. o_h,K-1, o_1 .. o_K), offsets over full scale."""
    K = relative.shape[1] - 1
    free = FULL_SCALE_A * constant[:, : K - 1]
    return Faults(
        hardware_drift=relative[:, 0],
        hardware_offset_a=np.column_stack([free, -free.sum(axis=1)]),
        drift=relative[:, 1:],
        offset_a=FULL_SCALE_A * constant[:, K - 1 :],
    )


def parameters_of(faults: Faults) -> tuple[Array, Array]:
    """The inverse of :func:`faults_of`."""
    free = faults.hardware_offset_a[:, :-1]
    relative = np.column_stack([faults.hardware_drift, faults.drift])
    return relative, np.concatenate([free, faults.offset_a], axis=1) / FULL_SCALE_A


def rows_of(faults: Faults, *, seed: int = 0, errors: Errors | None = None, noise: float = 1.0) -> FleetRows:
    """Rows of a fleet with N(0, noise^2 x stated covariance) errors; bench readings are unknown."""
    errors = errors or Errors()
    N, K = faults.drift.shape
    relative, constant = parameters_of(faults)
    R = errors.covariance(K)
    told = np.diag(R) < UNKNOWN_VARIANCE
    error = noise * np.random.default_rng(seed).normal(size=(N, 5 * K)) * np.sqrt(np.diag(R))
    factor = 1.0 + faults.drift
    seen = constant.copy()
    seen[:, K - 1 :] /= factor
    first = (np.log1p(relative) @ relative_design(K).T + error[:, : 3 * K - 1]) * told[: 3 * K - 1]
    second = (seen @ constant_design(K).T + error[:, 3 * K - 1 :]) * told[3 * K - 1 :]
    scale = np.concatenate([factor, factor[:, :1], factor], axis=1)
    return FleetRows(relative=first, constant=second * scale, covariance=np.repeat(R[None], N, axis=0))


def random_faults(seed: int, *, vehicles: int, branches: int, sparsity: float, low: float = 0.05) -> Faults:
    """Balanced fleet of the paper, not symmetric."""
    return draw_faults(
        np.random.default_rng(seed),
        vehicles=vehicles,
        branches=branches,
        sparsity=sparsity,
        magnitude=(low, 0.25),
        full_scale_a=FULL_SCALE_A,
        balanced=True,
    )


def prior_of(branches: int, *, decay: float = 0.7, hardware: float = 0.5, low: float = 0.05) -> FaultPrior:
    """Counts that fall by a factor with each fault; so many vehicles have hardware faults."""
    counts = np.exp(-decay * np.add.outer(np.arange(branches + 1.0), np.arange(2.0 * branches + 1.0)))
    counts[0] *= (1.0 - hardware) / counts[0].sum()
    counts[1:] *= hardware / counts[1:].sum()
    return FaultPrior(counts=counts, relative=Slab(low, 0.25), constant=Slab(low, 0.25))


def no_spread(branches: int) -> ModelSpread:
    """Vehicles without faults are all alike."""
    return ModelSpread(mean=np.zeros(5 * branches), covariance=np.zeros((5 * branches, 5 * branches)))
