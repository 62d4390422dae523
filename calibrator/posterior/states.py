"""States: the explanations of each vehicle's evidence, with their weights.

A state is a support, and a node where the rows leave directions of it open. Up to :data:`EXACT_BRANCHES` branches all
supports are looked at. With more branches the sum over supports is approximate. All relative supports are looked at,
and of their states the best go on (:data:`calibrator.posterior.workspace.MOST_RELATIVE`). With each of these go
the constant supports without hardware offsets, and those of at most
:data:`calibrator.posterior.supports.MOST_CONSTANT` parameters. Where one of the latter size is a likely explanation,
the best ones of its size (:data:`calibrator.posterior.workspace.BEAM`) are grown by one parameter, and so on.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from calibrator.drive import Array
from calibrator.evidence.rows import FleetRows
from calibrator.faults import Index
from calibrator.posterior.enumeration import enumerate_vehicles
from calibrator.posterior.fault_prior import OUTLIER_VARIANCE, FaultPrior, ModelSpread
from calibrator.posterior.workspace import MOST_STATES, evidence_of, found_of, law_of, room_of

__all__ = ["States", "enumerate_states", "mean_states"]

MOST_AVERAGED = 512
"""States kept per vehicle under several sets of hyper-parameters, the most probable ones. [1]"""
NEGLIGIBLE_SHARE = 1e-3
"""Share of outliers below which none are looked for. [1]"""
CHUNK = 256
"""Vehicles worked on at a time: bounds the memory. [1]"""


@dataclass(frozen=True)
class States:
    """Weighted explanations of N vehicles, S each, in order of falling weight.

    Attributes
    ----------
    weight : ndarray of shape (N, S)
        Posterior probability; each row sums to 1, less the states that were dropped.
    log_evidence : ndarray of shape (N,)
        Logarithm of the probability of the vehicle's rows, all states together.
    relative, relative_sd : ndarray of shape (N, S, K + 1)
        d_h, d_1 .. d_K, and standard deviations. [1]
    constant, constant_sd : ndarray of shape (N, S, 2K - 1)
        o_h,1 .. o_h,K-1, o_1 .. o_K in fractions of full scale, and standard deviations. [1]
    outlier : ndarray of bool of shape (N, S)
        Whether the vehicle differs from its fleet more than others do.
    """

    weight: Array
    log_evidence: Array
    relative: Array
    relative_sd: Array
    constant: Array
    constant_sd: Array
    outlier: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.weight)

    def take(self, index: Index) -> "States":
        """Return the states of some of the vehicles."""
        return States(*(getattr(self, f.name)[index] for f in fields(States)))

    def padded(self, most: int) -> "States":
        """Return the same with so many states per vehicle, further ones of no weight."""
        more = most - self.weight.shape[1]

        def wider(values: NDArray[np.generic]) -> NDArray[np.generic]:
            return np.pad(values, [(0, 0), (0, more if values.ndim > 1 else 0), (0, 0)][: values.ndim])

        return States(*(wider(getattr(self, f.name)) for f in fields(States)))  # type: ignore[arg-type]

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
        return self.hardware_count > 0

    @property
    def hardware_count(self) -> NDArray[np.int64]:
        """Number of nonzero hardware parameters of each state, shape (N, S)."""
        offsets = self.constant[:, :, : self.branches - 1]
        return np.asarray((self.relative[:, :, 0] != 0.0) + np.count_nonzero(offsets, axis=2))

    @property
    def sensor_count(self) -> NDArray[np.int64]:
        """Number of nonzero sensor parameters of each state, shape (N, S)."""
        return np.asarray(np.count_nonzero(self.drift, axis=2) + np.count_nonzero(self.offset, axis=2))


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
    usual, wide = (replace(spread, covariance=scale * spread.covariance) for scale in (1.0, OUTLIER_VARIANCE))
    parts = []
    for start in range(0, len(rows), CHUNK):
        some = rows.take(slice(start, start + CHUNK))
        part = _enumerate(some, prior, usual)
        if spread.outlier_share > NEGLIGIBLE_SHARE:
            part = _merged(part, _enumerate(some, prior, wide), spread.outlier_share)
        parts.append(part)
    return _joined(parts)


def _joined(parts: Sequence[States]) -> States:
    """States of several lots of vehicles, one after the other."""
    most = max(part.weight.shape[1] for part in parts)
    padded = [part.padded(most) for part in parts]
    return States(*(np.concatenate([getattr(part, f.name) for part in padded]) for f in fields(States)))


def _merged(usual: States, wide: States, share: float) -> States:
    """Both explanations of how far a vehicle may differ from its fleet, each as probable as its evidence says."""
    log_usual, log_wide = usual.log_evidence + np.log1p(-share), wide.log_evidence + np.log(share)
    total = np.logaddexp(log_usual, log_wide)
    weights = [usual.weight * np.exp(log_usual - total)[:, None], wide.weight * np.exp(log_wide - total)[:, None]]
    weight, order = _largest(np.concatenate(weights, axis=1), MOST_STATES)
    outlier = np.concatenate([np.zeros_like(usual.outlier), np.ones_like(wide.outlier)], axis=1)
    return States(
        weight,
        total,
        *_picked([usual, wide], order),
        np.take_along_axis(outlier, order, axis=1),
    )


def _picked(several: Sequence[States], order: NDArray[np.int64]) -> tuple[Array, Array, Array, Array]:
    """Parameters and deviations of chosen states out of several lists."""

    def picked(name: str) -> Array:
        every = np.concatenate([getattr(states, name) for states in several], axis=1)
        return np.take_along_axis(every, order[:, :, None], axis=1)

    return picked("relative"), picked("relative_sd"), picked("constant"), picked("constant_sd")


def mean_states(several: Sequence[States]) -> States:
    """Average the posteriors of the same vehicles under several hyper-parameters."""
    if len(several) == 1:
        return several[0]
    every = np.concatenate([states.weight for states in several], axis=1) / len(several)
    weight, order = _largest(np.asarray(every), MOST_AVERAGED)
    log_evidence = logsumexp([states.log_evidence for states in several], axis=0) - np.log(len(several))
    outlier = np.concatenate([states.outlier for states in several], axis=1)
    return States(
        weight,
        np.asarray(log_evidence),
        *_picked(several, order),
        np.take_along_axis(outlier, order, axis=1),
    )


def _enumerate(rows: FleetRows, prior: FaultPrior, spread: ModelSpread) -> States:
    law, found = law_of(prior), found_of(len(rows), rows.branches)
    enumerate_vehicles(law, evidence_of(rows, spread), room_of(law), found)
    most = int(found.number.max())
    weight = np.exp(found.log_weight[:, :most] - found.log_total[:, None])
    return States(
        weight,
        found.log_total,
        found.relative[:, :most],
        found.relative_sd[:, :most],
        found.constant[:, :most],
        found.constant_sd[:, :most],
        np.zeros(weight.shape, bool),
    )


def _largest(values: Array, most: int) -> tuple[Array, NDArray[np.int64]]:
    """The largest values of each row in falling order, and where they are."""
    order = np.argsort(-values, axis=1, kind="stable")[:, :most]
    return np.take_along_axis(values, order, axis=1), order
