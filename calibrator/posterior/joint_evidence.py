"""Joint evidence of relative and constant parameters: first the relative rows, then the constant rows given those.

A relative state (a support, and a node where it has a pivot) makes the constant rows what they are in true currents,
and what it leaves of the relative rows tells of the constant rows' errors. How uncertain the state's own parameters are
widens the noise of the constant rows; what these leave then moves the parameters. With theta the relative ones, C their
covariance, and G what a change of theta makes of the constant rows y (whose noise is S),

    y ~ N(X omega, S + G C G^T),    theta moves by -C G^T (S + G C G^T)^-1 (y - X omega).
"""

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from calibrator.drive import Array
from calibrator.evidence.rows import FleetRows, constant_design, relative_design
from calibrator.posterior.fault_prior import FaultPrior, ModelSpread
from calibrator.posterior.gaussian_block import BlockFit, Noise, integrate_constant, integrate_relative
from calibrator.posterior.supports import EXACT_BRANCHES, Support, relative_supports

__all__ = ["JointEvidence", "StateArrays"]

StateArrays = tuple[Array, Array, Array, Array]
"""Relative parameters, their deviations, constant ones and theirs, of shapes (N, S, K + 1) and (N, S, 2K - 1)."""
NEGLIGIBLE = 25.0
"""Relative states so far below the best (logarithm) are dropped: constant rows hardly ever make that good. [1]"""
FEW_RELATIVE = 16
"""Relative states of a vehicle up to which it does not matter how many. [1]"""
MOST_MOVED = 1.0
"""Largest logarithm by which constant rows can move a drift. [1]"""
MOST_RELATIVE = 24
"""Relative states of a vehicle that are looked at with more branches than can be exact, the best ones. [1]"""


@dataclass(frozen=True)
class _Candidates:
    """Relative states of N vehicles, M each.

    Attributes
    ----------
    log_evidence : ndarray of shape (N, M)
        Of the relative rows, and of the change of scale of the constant ones; minus infinity where negligible.
    hardware, sensor : ndarray of int, shape (N, M)
        Numbers of nonzero hardware and sensor parameters.
    parameters : ndarray of shape (N, M, K + 1)
        d_h, d_1 .. d_K.
    covariance : ndarray of shape (N, M, K + 1, K + 1)
        Of their logarithms.
    constant_rows : ndarray of shape (N, M, 2K + 1)
        As seen in true currents, less what the relative rows tell of them.
    turn : ndarray of shape (N, M, 2K + 1, K + 1)
        Derivative of these by the logarithms, without hardware offsets.
    scale : ndarray of shape (N, M, 2K - 1)
        1 for o_h, 1 + d_k for o_k.
    """

    log_evidence: Array
    hardware: NDArray[np.int64]
    sensor: NDArray[np.int64]
    parameters: Array
    covariance: Array
    constant_rows: Array
    turn: Array
    scale: Array


@dataclass(frozen=True)
class JointEvidence:
    """Rows and prior of N vehicles, with their relative states.

    ``constant_covariance`` (N, 2K + 1, 2K + 1) is S; ``turning`` says whether constants turn with the ratios.
    """

    log_prior: Array
    prior: FaultPrior
    constant_covariance: Array
    candidates: _Candidates
    design: Array
    turning: bool
    _noises: dict[tuple[int, ...], tuple[Array, Noise]] = field(default_factory=dict)

    @classmethod
    def of(cls, rows: FleetRows, prior: FaultPrior, spread: ModelSpread) -> "JointEvidence":
        """Work out the relative states."""
        r, K = rows.relative.shape[1], rows.branches
        R = rows.dispersed(spread.dispersion)[0] + spread.covariance
        first = Noise.of(R[:, :r, :r])
        carry = R[:, r:, :r] @ first.precision[:, 0]
        second = R[:, r:, r:] - carry @ R[:, :r, r:]
        log_prior = prior.log_supports()
        states = _RelativeStates.of(rows.relative - spread.mean[:r], first, prior, log_prior)
        of_spread = np.diag(spread.covariance)[r : r + K + 1]
        share = np.minimum(of_spread / np.diagonal(second, axis1=1, axis2=2)[:, : K + 1], 1.0)
        candidates = _candidates(rows, spread.mean[r:], carry, states, share)
        return cls(log_prior, prior, second, candidates, constant_design(K), turning=rows.means is not None)

    def __len__(self) -> int:
        return len(self.candidates.log_evidence)

    def by_size(self) -> list[tuple[NDArray[np.int64], "JointEvidence"]]:
        """The same evidence in parts of vehicles with about as many relative states each, and which vehicles they are.

        All vehicles of a part are given as many states as the one that has most.
        """
        found = self.candidates
        count = np.isfinite(found.log_evidence).sum(axis=1)
        size = np.maximum(np.ceil(np.log2(count / FEW_RELATIVE)), 0.0)
        return [
            (which, self._take(which, most=int(count[which].max())))
            for which in (np.flatnonzero(size == each) for each in np.unique(size))
        ]

    def _take(self, which: NDArray[np.int64], *, most: int) -> "JointEvidence":
        states = {name: values[which, :most] for name, values in vars(self.candidates).items()}
        return replace(
            self,
            constant_covariance=self.constant_covariance[which],
            candidates=_Candidates(**states),
            _noises={},
        )

    def with_constant(self, support: Support) -> tuple[Array, StateArrays]:
        """Log weights (N, S) of the states with one constant support, and their parameters; S = 0 if impossible."""
        found = self.candidates
        in_hardware = sum(i < self.prior.branches - 1 for i in support.active)
        sensors = found.sensor + len(support.active) - in_hardware
        log_weight = found.log_evidence + self.log_prior[found.hardware + in_hardware, sensors]
        if np.isneginf(log_weight).all():
            nothing, none = found.parameters[:, :0], found.scale[:, :0]
            return log_weight[:, :0], (nothing, nothing, none, none)
        turn, noise = self._noise(support)
        fit = integrate_constant(
            found.constant_rows, self.design, support, noise, self.prior.constant, scale=found.scale
        )
        N, M, Q = fit.log_evidence.shape
        moved, relative_sd = _moved(found.covariance, turn, noise, fit)
        factor = (1.0 + found.parameters[:, :, None]) * np.exp(moved)
        # The rows were divided by the 1 + d of the state, whatever moves it: the offsets stay.
        offset_sd = np.sqrt(np.diagonal(fit.covariance, axis1=3, axis2=4)) * found.scale[:, :, None]
        arrays = (factor - 1.0, relative_sd * factor, fit.parameters, offset_sd)
        relative, relative_sd, constant, constant_sd = (values.reshape(N, M * Q, -1) for values in arrays)
        total = (log_weight[:, :, None] + fit.log_evidence).reshape(N, M * Q)
        return total, (relative, relative_sd, constant, constant_sd)

    def _noise(self, support: Support) -> tuple[Array, Noise]:
        """Derivative of the constant rows by the relative logarithms, and their noise; the same for many supports.

        Where a branch has a hardware offset and no sensor offset, its drift scales that as well.
        """
        K, found = self.prior.branches, self.candidates
        hardware = [k for k in range(K - 1) if k in support.active]
        scaled = tuple(k for k in [*hardware, *([K - 1] if hardware else [])] if K - 1 + k not in support.active)
        if scaled not in self._noises:
            turn = found.turn.copy()
            for k in scaled:
                turn[:, :, k, 1 + k] -= found.constant_rows[:, :, k]
                turn[:, :, K, 1 + k] -= self.turning * found.constant_rows[:, :, k]
            added = turn @ found.covariance @ np.swapaxes(turn, 2, 3)
            self._noises[scaled] = turn, Noise.of(self.constant_covariance[:, None] + added)
        return self._noises[scaled]


def _moved(covariance: Array, turn: Array, noise: Noise, fit: BlockFit) -> tuple[Array, Array]:
    """How far the constant rows move the relative logarithms, and the deviations then; both (N, M, Q, K + 1)."""
    gain = covariance @ np.swapaxes(turn, 2, 3)
    moved = -np.matmul(fit.residual, np.swapaxes(gain @ noise.precision, 2, 3))
    variance = np.diagonal(covariance, axis1=2, axis2=3) - np.einsum(
        "nmar,nmrs,nmas->nma", gain, fit.information, gain, optimize=True
    )
    sd = np.sqrt(np.maximum(variance, 0.0))
    return np.clip(moved, -MOST_MOVED, MOST_MOVED), np.broadcast_to(sd[:, :, None], moved.shape)


@dataclass(frozen=True)
class _RelativeStates:
    """All relative states of N vehicles: log evidence (N, S), log share at best (S,), and the rest of the fits."""

    log_evidence: Array
    best_share: Array
    hardware: NDArray[np.int64]
    sensor: NDArray[np.int64]
    parameters: Array
    covariance: Array
    residual: Array

    @classmethod
    def of(cls, rows: Array, noise: Noise, prior: FaultPrior, log_prior: Array) -> "_RelativeStates":
        """Fit all supports to the centred relative rows (N, 3K - 1)."""
        K = prior.branches
        design, supports = relative_design(K), relative_supports(K)
        fits = [integrate_relative(rows[:, None], design, support, noise, prior.relative) for support in supports]
        nodes = [fit.log_evidence.shape[2] for fit in fits]
        hardware = [int(support.hardware) for support in supports]
        sensor = [len(support.active) - h for support, h in zip(supports, hardware, strict=True)]
        shares = [log_prior[h : h + K, n : n + K + 1].max() for h, n in zip(hardware, sensor, strict=True)]
        return cls(
            np.concatenate([fit.log_evidence[:, 0] for fit in fits], axis=1),
            np.repeat(shares, nodes),
            np.repeat(hardware, nodes),
            np.repeat(sensor, nodes),
            np.concatenate([fit.parameters[:, 0] for fit in fits], axis=1),
            np.concatenate([fit.covariance[:, 0] for fit in fits], axis=1),
            np.concatenate([fit.residual[:, 0] for fit in fits], axis=1),
        )

    def best(self, *, exact: bool) -> tuple[NDArray[np.int64], Array]:
        """Which states to go on with, the best of each vehicle first, and their log evidence; shape (N, M)."""
        bound = self.log_evidence + self.best_share
        kept = bound >= bound.max(axis=1, keepdims=True) - NEGLIGIBLE
        most = int(kept.sum(axis=1).max())
        order = np.argsort(-bound, axis=1, kind="stable")[:, : most if exact else min(most, MOST_RELATIVE)]
        return order, np.take_along_axis(np.where(kept, self.log_evidence, -np.inf), order, axis=1)


def _candidates(rows: FleetRows, mean: Array, carry: Array, states: _RelativeStates, share: Array) -> _Candidates:
    """What the relative states make of the constant rows.

    Where the model spread, which is one of true currents, is most of a row's variance (``share``, (N, K + 1)), the
    density changes with the scale between measured and true currents; sampling errors are those of the measured ones.
    """
    K = rows.branches
    order, log_evidence = states.best(exact=K <= EXACT_BRANCHES)
    vehicles = np.arange(len(rows))[:, None]
    parameters, residual = states.parameters[vehicles, order], states.residual[vehicles, order]
    factor = 1.0 + parameters[:, :, 1:]
    seen = rows.constant_seen(parameters, residual)
    log_change = np.einsum("nmk,nk->nm", np.log(factor), share[:, :K]) + np.log(factor[:, :, 0]) * share[:, K:]
    return _Candidates(
        log_evidence=log_evidence - log_change,
        hardware=states.hardware[order],
        sensor=states.sensor[order],
        parameters=parameters,
        covariance=states.covariance[vehicles, order],
        constant_rows=seen - mean - residual @ np.swapaxes(carry, 1, 2),
        turn=rows.constant_turn(parameters) + (carry @ relative_design(K))[:, None],
        scale=np.concatenate([np.ones((*factor.shape[:2], K - 1)), factor], axis=2),
    )
