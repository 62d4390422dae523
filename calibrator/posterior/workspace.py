"""What the enumeration works on, as compiled code takes it: prior and supports, evidence, results, and room."""

from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from calibrator.drive import Array
from calibrator.evidence.rows import FleetRows, constant_design, relative_design
from calibrator.posterior.fault_prior import FaultPrior, ModelSpread
from calibrator.posterior.normal import Normal, Places, Scratch, scratch_of
from calibrator.posterior.slab_nodes import SlabNodes, slab_nodes
from calibrator.posterior.supports import EXACT_BRANCHES, MOST_CONSTANT, constant_supports, relative_supports

__all__ = ["Evidence", "Found", "Law", "Room", "evidence_of", "found_of", "law_of", "room_of"]

MOST_STATES = 128
"""States kept per vehicle, the most probable ones. [1]"""
MOST_RELATIVE = 24
"""Relative states of a vehicle that are looked at with more branches than can be exact, the best ones. [1]"""
BEAM = 8
"""Constant supports of one size that are grown, the best ones. [1]"""


class Law(NamedTuple):
    """Prior of the faults, and supports; P = K + 1 relative and 2K - 1 constant parameters.

    ``active`` of supports (., P) with ``size``; ``constant_bits`` the constant ones as bits; ``best_share`` the largest
    logarithmic prior that a relative support can come to with constants; ``most_relative`` how many relative states go
    on; ``grown`` the size of constant supports from which on the best are grown, 0 for none.
    """

    branches: int
    log_prior: Array
    relative_design: Array
    constant_design: Array
    relative: SlabNodes
    constant: SlabNodes
    relative_active: Places
    relative_size: Places
    best_share: Array
    constant_bits: Places
    most_relative: int
    grown: int


class Evidence(NamedTuple):
    """Rows of N vehicles, centred, with r_r = 3K - 1 relative and r_c = 2K + 1 constant ones.

    ``relative`` (N, r_r) with ``relative_precision`` (N, r_r, r_r) and the determinant's logarithm; ``constant``
    (N, r_c) as measured, ``constant_mean`` (r_c,), ``constant_covariance`` (N, r_c, r_c) given the relative rows,
    ``carry`` (N, r_c, r_r) what these tell of them; ``lever`` (N, K + 1, 2K - 1), ``model`` and ``measured`` (N, K) of
    the means about which constants turn, if ``turning``; ``share`` (N, K + 1) of the spread in the constant rows'
    variance.
    """

    relative: Array
    relative_precision: Array
    relative_log_determinant: Array
    constant: Array
    constant_mean: Array
    constant_covariance: Array
    carry: Array
    lever: Array
    model: Array
    measured: Array
    turning: bool
    share: Array


class Found(NamedTuple):
    """States of N vehicles, S each at most, by falling weight.

    ``number`` of them, logarithms of their weights and of the total, parameters and their deviations.
    """

    number: Places
    log_weight: Array
    log_total: Array
    relative: Array
    relative_sd: Array
    constant: Array
    constant_sd: Array


class Room(NamedTuple):
    """Intermediate results of one vehicle; patterns are those of drifts that scale hardware offsets.

    ``told_turn`` is the derivative of the constant rows by the relative parameters as far as it is that of all states.
    ``kept`` (1,) counts the states on the list ``top``; ``best`` is the largest logarithm so far, and the sum of all
    states over the best one.
    """

    scratch: Scratch
    active: Places
    normal: Normal
    weights: Array
    relative_log: Array
    order: Places
    order_work: Places
    theta: Array
    covariance: Array
    parameters: Array
    scale: Array
    residual: Array
    product: Array
    rows: Array
    told_turn: Array
    turn: Array
    turned: Array
    spread: Array
    precision: Array
    patterns: Array
    pattern_b: Array
    pattern_level: Array
    pattern_known: NDArray[np.bool_]
    pivots: Places
    seen: Places
    visited: NDArray[np.bool_]
    wanted: Places
    sharp: Normal
    constant_theta: Array
    constant_covariance: Array
    left: Array
    weighted: Array
    projected: Array
    kept: Places
    best: Array
    top: Places
    top_log: Array
    top_order: Places


def law_of(prior: FaultPrior) -> Law:
    """The prior as compiled code takes it."""
    K = prior.branches
    log_prior = prior.log_supports()
    exact = K <= EXACT_BRANCHES
    active, size, constant_bits = _supports(K, None if exact else MOST_CONSTANT)
    hardware = (active == 0).any(axis=1, where=np.arange(K + 1) < size[:, None]).astype(np.int64)
    sensors = size - hardware
    share = [log_prior[h : h + K, n : n + K + 1].max() for h, n in zip(hardware, sensors, strict=True)]
    return Law(
        branches=K,
        log_prior=log_prior,
        relative_design=relative_design(K),
        constant_design=constant_design(K),
        relative=slab_nodes(prior.relative, K + 1, logarithmic=True, hardware=1),
        constant=slab_nodes(prior.constant, 2 * K - 1, logarithmic=False, hardware=K - 1),
        relative_active=active,
        relative_size=size,
        best_share=np.array(share),
        constant_bits=constant_bits,
        most_relative=np.iinfo(np.int64).max if exact else MOST_RELATIVE,
        grown=0 if exact else MOST_CONSTANT,
    )


@cache
def _supports(branches: int, most: int | None) -> tuple[Places, Places, Places]:
    """Relative supports, their sizes, and constant supports of at most so many parameters as bits."""
    supports = relative_supports(branches)
    active = np.zeros((len(supports), branches + 1), np.int64)
    for place, support in enumerate(supports):
        active[place, : len(support.active)] = support.active
    size = np.array([len(support.active) for support in supports])
    constant = constant_supports(branches, most=most)
    return active, size, np.array([sum(1 << place for place in support.active) for support in constant])


def evidence_of(rows: FleetRows, spread: ModelSpread) -> Evidence:
    """Rows and model spread as compiled code takes them."""
    r, K, N = rows.relative.shape[1], rows.branches, len(rows)
    R = rows.dispersed(spread.dispersion)[0] + spread.covariance
    precision = np.linalg.inv(R[:, :r, :r])
    carry = R[:, r:, :r] @ precision
    second = R[:, r:, r:] - carry @ R[:, :r, r:]
    of_spread = np.diag(spread.covariance)[r : r + K + 1]
    means = rows.means
    nothing = np.zeros((N, K))
    return Evidence(
        relative=rows.relative - spread.mean[:r],
        relative_precision=precision,
        relative_log_determinant=np.linalg.slogdet(R[:, :r, :r])[1],
        constant=rows.constant,
        constant_mean=spread.mean[r:],
        constant_covariance=second,
        carry=carry,
        lever=np.zeros((N, K + 1, 2 * K - 1)) if means is None else means.lever(rows.relative),
        model=nothing if means is None else means.model,
        measured=nothing if means is None else means.measured,
        turning=means is not None,
        share=np.minimum(of_spread / np.diagonal(second, axis1=1, axis2=2)[:, : K + 1], 1.0),
    )


def found_of(vehicles: int, branches: int) -> Found:
    """Room for the states of so many vehicles; weights of none."""
    shape = (vehicles, MOST_STATES)
    return Found(
        number=np.zeros(vehicles, np.int64),
        log_weight=np.full(shape, -np.inf),
        log_total=np.zeros(vehicles),
        relative=np.zeros((*shape, branches + 1)),
        relative_sd=np.zeros((*shape, branches + 1)),
        constant=np.zeros((*shape, 2 * branches - 1)),
        constant_sd=np.zeros((*shape, 2 * branches - 1)),
    )


def room_of(law: Law) -> Room:
    """Room for the enumeration under a prior."""
    K, S = law.branches, len(law.relative_size)
    n, P, rows = K + 1, 2 * K - 1, 2 * K + 1
    Q = max(law.relative.values.shape[1], law.constant.values.shape[1])
    patterns, supports = 1 << K, 1 << P
    return Room(
        scratch=scratch_of(rows),
        active=np.zeros(rows, np.int64),
        normal=Normal(np.zeros((rows, rows)), np.zeros(rows), np.zeros(2)),
        weights=np.zeros(Q),
        relative_log=np.zeros(S * Q),
        order=np.zeros(S * Q, np.int64),
        order_work=np.zeros(max(S * Q, MOST_STATES), np.int64),
        theta=np.zeros(n),
        covariance=np.zeros((n, n)),
        parameters=np.zeros(n),
        scale=np.zeros(P),
        residual=np.zeros(3 * K - 1),
        product=np.zeros((max(3 * K - 1, rows), max(n, P))),
        rows=np.zeros(rows),
        told_turn=np.zeros((rows, n)),
        turn=np.zeros((rows, n)),
        turned=np.zeros((rows, n)),
        spread=np.zeros((rows, n)),
        precision=np.zeros((patterns, rows, rows)),
        patterns=np.zeros((patterns, P, P)),
        pattern_b=np.zeros((patterns, P)),
        pattern_level=np.zeros((patterns, 2)),
        pattern_known=np.zeros(patterns, bool),
        pivots=np.zeros(S, np.int64),
        seen=np.zeros(supports, np.int64),
        visited=np.zeros(supports, bool),
        wanted=np.zeros(BEAM * P, np.int64),
        sharp=Normal(np.zeros((P, P)), np.zeros(P), np.zeros(2)),
        constant_theta=np.zeros(P),
        constant_covariance=np.zeros((P, P)),
        left=np.zeros(rows),
        weighted=np.zeros(rows),
        projected=np.zeros(rows),
        kept=np.zeros(1, np.int64),
        best=np.zeros(2),
        top=np.zeros((MOST_STATES, 3), np.int64),
        top_log=np.zeros(MOST_STATES),
        top_order=np.zeros(MOST_STATES, np.int64),
    )
