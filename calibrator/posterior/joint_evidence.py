"""Joint evidence of relative and constant parameters: first the relative rows, then the constant rows given those.

The constant rows depend on the relative parameters in two ways: they are seen in measured currents, which the drifts
scale, and what the relative parameters leave of their rows tells of the constant rows' errors. A relative state (a
support, and a node where it has a pivot) fixes both.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibrator.drive import Array, Mask
from calibrator.evidence.rows import FleetRows, constant_design, relative_design
from calibrator.posterior.fault_prior import FaultPrior, ModelSpread
from calibrator.posterior.gaussian_block import Noise, integrate_constant, integrate_relative
from calibrator.posterior.supports import EXACT_BRANCHES, Support, relative_supports

__all__ = ["JointEvidence", "StateArrays"]

StateArrays = tuple[Array, Array, Array, Array]
"""Relative parameters, their deviations, constant ones and theirs, of shapes (N, S, K + 1) and (N, S, 2K - 1)."""
NEGLIGIBLE = 40.0
"""Relative states so far below the best (logarithm) cannot matter for any constant support. [1]"""
MOST_RELATIVE = 24
"""Relative states of a vehicle that are looked at with more branches than can be exact, the best ones. [1]"""


@dataclass(frozen=True)
class _Candidates:
    """Relative states of N vehicles, M each.

    Attributes
    ----------
    log_evidence : ndarray of shape (N, M)
        Of the relative rows, and of the change of scale of the constant ones; minus infinity where negligible.
    count : ndarray of int, shape (N, M)
        Number of nonzero parameters.
    hardware : ndarray of bool, shape (N, M)
        Whether d_h is among them.
    parameters, sd : ndarray of shape (N, M, K + 1)
        As in :class:`calibrator.posterior.gaussian_block.BlockFit`.
    constant_rows : ndarray of shape (N, M, 2K + 1)
        As seen in true currents, less what the relative rows tell of them.
    scale : ndarray of shape (N, M, 2K - 1)
        1 for o_h, 1 + d_k for o_k.
    """

    log_evidence: Array
    count: NDArray[np.int64]
    hardware: Mask
    parameters: Array
    sd: Array
    constant_rows: Array
    scale: Array


@dataclass(frozen=True)
class JointEvidence:
    """Rows and prior of N vehicles, with their relative states."""

    log_prior: Array
    prior: FaultPrior
    noise: Noise
    candidates: _Candidates
    design: Array

    @classmethod
    def of(cls, rows: FleetRows, prior: FaultPrior, spread: ModelSpread) -> "JointEvidence":
        """Work out the relative states."""
        r = rows.relative.shape[1]
        R = rows.covariance + spread.covariance
        first = Noise.of(R[:, :r, :r])
        carry = R[:, r:, :r] @ first.precision
        second = Noise.of(R[:, r:, r:] - carry @ R[:, :r, r:])
        log_prior = prior.log_supports()
        states = _RelativeStates.of(rows.relative - spread.mean[:r], first, prior, log_prior)
        exact = rows.branches <= EXACT_BRANCHES
        candidates = _candidates(rows.constant, spread.mean[r:], carry, states, exact=exact)
        return cls(log_prior, prior, second, candidates, constant_design(rows.branches))

    def with_constant(self, support: Support) -> tuple[Array, StateArrays]:
        """Log weights (N, S) of the states with one constant support, and their parameters; S = 0 if impossible."""
        found = self.candidates
        hardware = (found.hardware | support.hardware).astype(np.int64)
        log_weight = found.log_evidence + self.log_prior[hardware, found.count + len(support.active)]
        if np.isneginf(log_weight).all():
            nothing, none = found.parameters[:, :0], found.scale[:, :0]
            return log_weight[:, :0], (nothing, nothing, none, none)
        fit = integrate_constant(
            found.constant_rows, self.design, support, self.noise, self.prior.constant, scale=found.scale
        )
        N, M, Q = fit.log_evidence.shape
        relative, relative_sd = (np.repeat(values, Q, axis=1) for values in (found.parameters, found.sd))
        constant, constant_sd = (values.reshape(N, M * Q, -1) for values in (fit.parameters, fit.sd))
        total = (log_weight[:, :, None] + fit.log_evidence).reshape(N, M * Q)
        return total, (relative, relative_sd, constant, constant_sd)


@dataclass(frozen=True)
class _RelativeStates:
    """All relative states of N vehicles: log evidence (N, S), log share at best (S,), and the rest of the fits."""

    log_evidence: Array
    best_share: Array
    count: NDArray[np.int64]
    hardware: Mask
    arrays: tuple[Array, Array, Array]
    """Parameters, deviations, residuals, of shape (N, S, .)."""

    @classmethod
    def of(cls, rows: Array, noise: Noise, prior: FaultPrior, log_prior: Array) -> "_RelativeStates":
        """Fit all supports to the centred relative rows (N, 3K - 1)."""
        K = prior.branches
        design, supports = relative_design(K), relative_supports(K)
        fits = [integrate_relative(rows[:, None], design, support, noise, prior.relative) for support in supports]
        nodes = [fit.log_evidence.shape[2] for fit in fits]
        shares = [log_prior[int(s.hardware) :, len(s.active) : len(s.active) + 2 * K].max() for s in supports]
        return cls(
            np.concatenate([fit.log_evidence[:, 0] for fit in fits], axis=1),
            np.repeat(shares, nodes),
            np.repeat([len(support.active) for support in supports], nodes),
            np.repeat([support.hardware for support in supports], nodes),
            (
                np.concatenate([fit.parameters[:, 0] for fit in fits], axis=1),
                np.concatenate([fit.sd[:, 0] for fit in fits], axis=1),
                np.concatenate([fit.residual[:, 0] for fit in fits], axis=1),
            ),
        )

    def best(self, *, exact: bool) -> tuple[NDArray[np.int64], Array]:
        """Which states to go on with, the best of each vehicle first, and their log evidence; shape (N, M)."""
        bound = self.log_evidence + self.best_share
        kept = bound >= bound.max(axis=1, keepdims=True) - NEGLIGIBLE
        most = int(kept.sum(axis=1).max())
        order = np.argsort(-bound, axis=1, kind="stable")[:, : most if exact else min(most, MOST_RELATIVE)]
        return order, np.take_along_axis(np.where(kept, self.log_evidence, -np.inf), order, axis=1)


def _candidates(rows: Array, mean: Array, carry: Array, states: _RelativeStates, *, exact: bool) -> _Candidates:
    """What the relative states make of the constant rows (N, 2K + 1)."""
    K = states.arrays[0].shape[2] - 1
    order, log_evidence = states.best(exact=exact)
    parameters, sd, residual = (np.take_along_axis(values, order[:, :, None], axis=1) for values in states.arrays)
    factor = 1.0 + parameters[:, :, 1:]
    seen = rows[:, None, :] / np.concatenate([factor, factor[..., :1], factor], axis=2)
    log_change = np.log(factor).sum(axis=2) + np.log(factor[:, :, 0])
    return _Candidates(
        log_evidence=log_evidence - log_change,
        count=states.count[order],
        hardware=states.hardware[order],
        parameters=parameters,
        sd=sd,
        constant_rows=seen - mean - residual @ np.swapaxes(carry, 1, 2),
        scale=np.concatenate([np.ones((*factor.shape[:2], K - 1)), factor], axis=2),
    )
