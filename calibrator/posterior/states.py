"""States: the explanations of each vehicle's evidence, with their weights.

A state is a support, and a node where the support has pivots. The joint evidence is that of the relative rows times that
of the constant rows given what the relative rows left as residual.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from calibrator.drive import Array
from calibrator.evidence.rows import FleetRows, constant_design, relative_design
from calibrator.posterior.fault_prior import FaultPrior, ModelSpread
from calibrator.posterior.gaussian_block import BlockFit, Noise, integrate_constant, integrate_relative
from calibrator.posterior.supports import Support, constant_supports, relative_supports

__all__ = ["States", "enumerate_states"]

MOST_STATES = 128
"""States kept per vehicle, the most probable ones. [1]"""
CHUNK = 64
"""Vehicles worked on at a time: bounds the memory. [1]"""
NEGLIGIBLE = 40.0
"""Relative supports so far below the best (logarithm) cannot matter for any constant support. [1]"""


@dataclass(frozen=True)
class States:
    """Weighted explanations of N vehicles, S each, in order of falling weight.

    Attributes
    ----------
    weight : ndarray of shape (N, S)
        Posterior probability; each row sums to 1.
    log_evidence : ndarray of shape (N,)
        Logarithm of the probability of the vehicle's rows, all states together.
    relative, relative_sd : ndarray of shape (N, S, K + 1)
        d_h, d_1 .. d_K, and standard deviations. [1]
    constant, constant_sd : ndarray of shape (N, S, 2K - 1)
        o_h,1 .. o_h,K-1, o_1 .. o_K in fractions of full scale, and standard deviations. [1]
    """

    weight: Array
    log_evidence: Array
    relative: Array
    relative_sd: Array
    constant: Array
    constant_sd: Array

    def __len__(self) -> int:
        return len(self.weight)

    @property
    def branches(self) -> int:
        """Number of branches K."""
        return int(self.relative.shape[2]) - 1

    @property
    def drift(self) -> Array:
        """Drift of each sensor, shape (N, S, K). [1]"""
        return self.relative[:, :, 1:]

    @property
    def offset(self) -> Array:
        """Offset of each sensor in fractions of full scale, shape (N, S, K). [1]"""
        return self.constant[:, :, self.branches - 1 :]

    @property
    def hardware(self) -> NDArray[np.bool_]:
        """Whether a state has a hardware fault, shape (N, S)."""
        return np.asarray((self.relative[:, :, 0] != 0.0) | np.any(self.constant[:, :, : self.branches - 1], axis=2))

    @property
    def count(self) -> NDArray[np.int64]:
        """Number of nonzero parameters of each state, shape (N, S)."""
        return np.asarray(np.count_nonzero(self.relative, axis=2) + np.count_nonzero(self.constant, axis=2))


def enumerate_states(rows: FleetRows, prior: FaultPrior, spread: ModelSpread) -> States:
    """Find the explanations of each vehicle's rows.

    Parameters
    ----------
    rows : FleetRows
        Evidence of N vehicles.
    prior : FaultPrior
        Of the faults.
    spread : ModelSpread
        Of vehicles without fault.

    Returns
    -------
    States
        The most probable ones of each vehicle.
    """
    parts = [_enumerate(rows.take(slice(start, start + CHUNK)), prior, spread) for start in range(0, len(rows), CHUNK)]
    return States(*(np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(States)))


def _enumerate(rows: FleetRows, prior: FaultPrior, spread: ModelSpread) -> States:
    problem = _Problem.of(rows, prior, spread)
    relative = [(support, problem.relative_fit(support)) for support in relative_supports(rows.branches)]
    supports = constant_supports(rows.branches)
    best = np.max([fit.log_evidence.max(axis=(1, 2)) for _, fit in relative], axis=0)
    found = _Found.nothing(len(rows), rows.branches)
    for support, fit in relative:
        if np.any(fit.log_evidence.max(axis=(1, 2)) >= best - NEGLIGIBLE):
            found.add(*problem.with_constants(support, fit, supports))
    return found.states()


@dataclass(frozen=True)
class _Problem:
    """Rows of N vehicles, ready for both blocks."""

    rows: FleetRows
    prior: FaultPrior
    mean: Array
    first: Noise
    second: Noise
    carry: Array
    """How the constant rows follow the residuals of the relative ones, (N, 2K + 1, 3K - 1)."""
    log_prior: Array

    @classmethod
    def of(cls, rows: FleetRows, prior: FaultPrior, spread: ModelSpread) -> "_Problem":
        r = rows.relative.shape[1]
        R = rows.covariance + spread.covariance
        first = Noise.of(R[:, :r, :r])
        carry = R[:, r:, :r] @ first.precision
        second = Noise.of(R[:, r:, r:] - carry @ R[:, :r, r:])
        return cls(rows, prior, spread.mean, first, second, carry, prior.log_supports())

    def relative_fit(self, support: Support) -> BlockFit:
        """Evidence of one relative support, constant rows apart."""
        r = self.rows.relative.shape[1]
        centred = (self.rows.relative - self.mean[:r])[:, None, :]
        return integrate_relative(
            centred, relative_design(self.rows.branches), support, self.first, self.prior.relative
        )

    def with_constants(self, support: Support, fit: BlockFit, supports: Sequence[Support]) -> tuple[Array, list[Array]]:
        """Log weight of each state of one relative support (N, .), and its four arrays of parameters."""
        N, K = len(self.rows), self.rows.branches
        relative, relative_sd, residual = fit.parameters[:, 0], fit.sd[:, 0], fit.residual[:, 0]
        factor = 1.0 + relative[:, :, 1:]
        y = self.rows.constant[:, None, :] / np.concatenate([factor, factor[..., :1], factor], axis=2)
        y -= self.mean[-y.shape[2] :] + np.matmul(residual, np.swapaxes(self.carry, 1, 2))
        scale = np.concatenate([np.ones((*factor.shape[:2], K - 1)), factor], axis=2)
        log_factor = np.log(factor)
        log_density = fit.log_evidence[:, 0] - log_factor.sum(axis=2) - log_factor[:, :, 0]
        weights: list[Array] = []
        arrays: list[list[Array]] = [[], [], [], []]
        for constant in supports:
            hardware = int(support.hardware or constant.hardware)
            log_share = self.log_prior[hardware, len(support.active) + len(constant.active)]
            if np.isneginf(log_share):
                continue
            other = integrate_constant(y, constant_design(K), constant, self.second, self.prior.constant, scale)
            shape = other.log_evidence.shape
            weights.append((log_density[:, :, None] + other.log_evidence + log_share).reshape(N, -1))
            parts = (relative[:, :, None], relative_sd[:, :, None], other.parameters, other.sd)
            for store, part in zip(arrays, parts, strict=True):
                store.append(np.broadcast_to(part, (*shape, part.shape[-1])).reshape(N, -1, part.shape[-1]))
        if not weights:
            return np.full((N, 0), -np.inf), [np.zeros((N, 0, width)) for width in (K + 1, K + 1, 2 * K - 1, 2 * K - 1)]
        return np.concatenate(weights, axis=1), [np.concatenate(store, axis=1) for store in arrays]


@dataclass
class _Found:
    """The most probable states so far."""

    log_weight: Array
    log_total: Array
    arrays: list[Array]

    @classmethod
    def nothing(cls, vehicles: int, branches: int) -> "_Found":
        widths = (branches + 1, branches + 1, 2 * branches - 1, 2 * branches - 1)
        return cls(
            np.full((vehicles, 0), -np.inf), np.full(vehicles, -np.inf), [np.zeros((vehicles, 0, w)) for w in widths]
        )

    def add(self, log_weight: Array, arrays: Sequence[Array]) -> None:
        """Take up more states, and drop the least probable beyond MOST_STATES."""
        merged = np.concatenate([self.log_weight, log_weight], axis=1)
        self.log_total = np.asarray(logsumexp(np.column_stack([self.log_total, log_weight]), axis=1))
        self.log_weight, keep = _largest(merged, MOST_STATES)
        self.arrays = [
            np.take_along_axis(np.concatenate([old, new], axis=1), keep[:, :, None], axis=1)
            for old, new in zip(self.arrays, arrays, strict=True)
        ]

    def states(self) -> States:
        """What was found, in order of falling weight."""
        log_weight, order = _largest(self.log_weight, self.log_weight.shape[1])
        weight = np.exp(log_weight - logsumexp(log_weight, axis=1, keepdims=True))
        return States(weight, self.log_total, *(np.take_along_axis(a, order[:, :, None], axis=1) for a in self.arrays))


def _largest(values: Array, most: int) -> tuple[Array, NDArray[np.int64]]:
    """The largest values of each row in falling order, and where they are."""
    order = np.argsort(-values, axis=1, kind="stable")[:, :most]
    return np.take_along_axis(values, order, axis=1), order
