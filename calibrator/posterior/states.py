"""States: the explanations of each vehicle's evidence, with their weights.

A state is a support, and a node where the rows leave directions of it open. Up to :data:`EXACT_BRANCHES` branches all
supports are looked at. With more branches the sum over supports is approximate. All relative supports are looked at,
and of their states the best go on (:data:`calibrator.posterior.joint_evidence.MOST_RELATIVE`). With each of these go
the constant supports without hardware offsets, and those of at most
:data:`calibrator.posterior.supports.MOST_CONSTANT` parameters. Where one of the latter size is a likely explanation,
the best ones of its size (:data:`BEAM`) are grown by one parameter, and so on.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from itertools import chain, islice

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from calibrator.drive import Array
from calibrator.evidence.rows import FleetRows
from calibrator.faults import Index
from calibrator.posterior.fault_prior import OUTLIER_VARIANCE, FaultPrior, ModelSpread
from calibrator.posterior.joint_evidence import JointEvidence, StateArrays
from calibrator.posterior.supports import EXACT_BRANCHES, MOST_CONSTANT, Support, constant_supports, grown_supports

__all__ = ["States", "enumerate_states", "mean_states"]

MOST_STATES, MOST_AVERAGED = 128, 512
"""States kept per vehicle, the most probable ones, under one set of hyper-parameters and under several. [1]"""
BEAM = 8
"""Constant supports of one size that are grown, the best ones. [1]"""
GROWING = 3.0
"""None are if the best of them lies farther below the vehicle's best state (logarithm). [1]"""
NEGLIGIBLE_SHARE = 1e-3
"""Share of outliers below which none are looked for. [1]"""
MOST_WAITING = 1024
"""States that are collected before the most probable ones are picked: picking costs more than fitting. [1]"""
CHUNK, GROWN_CHUNK = 64, 16
"""Vehicles worked on at a time: bounds the memory; where supports are grown, what one wants is fitted to all. [1]"""


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
    chunk = CHUNK if rows.branches <= EXACT_BRANCHES else GROWN_CHUNK
    usual, wide = (replace(spread, covariance=scale * spread.covariance) for scale in (1.0, OUTLIER_VARIANCE))
    parts = []
    for start in range(0, len(rows), chunk):
        some = rows.take(slice(start, start + chunk))
        part = _enumerate(some, prior, usual)
        if spread.outlier_share > NEGLIGIBLE_SHARE:
            part = _merged(part, _enumerate(some, prior, wide), spread.outlier_share)
        parts.append(part)
    return _joined(parts)


def _joined(parts: Sequence[States]) -> States:
    """States of several lots of vehicles, one after the other."""
    return States(*(np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(States)))


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
    parts = JointEvidence.of(rows, prior, spread).by_size()
    found = _joined([_with_constants(evidence, rows.branches) for _, evidence in parts])
    return found.take(np.argsort(np.concatenate([which for which, _ in parts])))


def _with_constants(evidence: JointEvidence, branches: int) -> States:
    """All relative states with all constant supports."""
    found = _Found(len(evidence), branches)
    most = None if branches <= EXACT_BRANCHES else MOST_CONSTANT
    for support in constant_supports(branches, most=most):
        found.add(*evidence.with_constant(support))
    if most is not None:
        _grow(found, evidence, branches, most)
    return found.states()


def _grow(found: "_Found", evidence: JointEvidence, branches: int, size: int) -> None:
    """Add constant supports with one parameter more than the largest so far that are likely, while there are any.

    A vehicle gets its own ones only, so that it does not matter with which others it is worked on.
    """
    while wanted := _wanted(found, branches, size):
        for support, vehicles in wanted.items():
            log_weight, arrays = evidence.with_constant(support)
            others = np.ones(len(log_weight), bool)
            others[list(vehicles)] = False
            found.add(np.where(others[:, None], -np.inf, log_weight), arrays)
        size += 1


def _wanted(found: "_Found", branches: int, size: int) -> dict[Support, set[int]]:
    """Supports grown from those of this size, and for which vehicles."""
    wanted: dict[Support, set[int]] = {}
    for vehicle, beam in enumerate(found.beams(size)):
        for support in chain.from_iterable(grown_supports(branches, active) for active in beam):
            wanted.setdefault(support, set()).add(vehicle)
    return wanted


class _Found:
    """The most probable states so far, and those that wait to be compared with them."""

    def __init__(self, vehicles: int, branches: int) -> None:
        widths = (branches + 1, branches + 1, 2 * branches - 1, 2 * branches - 1)
        self._log_weight: Array = np.full((vehicles, MOST_STATES), -np.inf)
        self._log_total: Array = np.full(vehicles, -np.inf)
        self._arrays: list[Array] = [np.zeros((vehicles, MOST_STATES, width)) for width in widths]
        self._waiting: list[tuple[Array, StateArrays]] = []

    def add(self, log_weight: Array, arrays: StateArrays) -> None:
        """Take up more states."""
        self._waiting.append((log_weight, arrays))
        if sum(weights.shape[1] for weights, _ in self._waiting) > MOST_WAITING:
            self._merge()

    def beams(self, size: int) -> list[list[tuple[int, ...]]]:
        """Of each vehicle the best constant supports of this size, if one of them is likely."""
        self._merge()
        present = self._arrays[2] != 0.0
        live = (present.sum(axis=2) == size) & np.isfinite(self._log_weight)
        likely = (live & (self._log_weight >= self._log_weight[:, :1] - GROWING)).any(axis=1)
        found = [map(tuple, present[j, live[j]]) if likely[j] else () for j in range(len(live))]
        return [[tuple(np.flatnonzero(mask)) for mask in islice(dict.fromkeys(masks), BEAM)] for masks in found]

    def states(self) -> States:
        """What was found, in order of falling weight."""
        self._merge()
        weight = np.exp(self._log_weight - self._log_total[:, None])
        relative, relative_sd, constant, constant_sd = self._arrays
        outlier = np.zeros(weight.shape, bool)
        return States(weight, self._log_total, relative, relative_sd, constant, constant_sd, outlier)

    def _merge(self) -> None:
        """Keep the :data:`MOST_STATES` most probable ones."""
        if not self._waiting:
            return
        log_weights, arrays = zip(*self._waiting, strict=True)
        self._waiting = []
        self._log_total = np.asarray(logsumexp(np.column_stack([self._log_total, *log_weights]), axis=1))
        self._log_weight, keep = _largest(np.concatenate([self._log_weight, *log_weights], axis=1), MOST_STATES)
        self._arrays = [
            np.take_along_axis(np.concatenate([old, *new], axis=1), keep[:, :, None], axis=1)
            for old, new in zip(self._arrays, zip(*arrays, strict=True), strict=True)
        ]


def _largest(values: Array, most: int) -> tuple[Array, NDArray[np.int64]]:
    """The largest values of each row in falling order, and where they are."""
    order = np.argsort(-values, axis=1, kind="stable")[:, :most]
    return np.take_along_axis(values, order, axis=1), order
