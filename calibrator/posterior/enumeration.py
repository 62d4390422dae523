"""Sum over the explanations of one vehicle after the other; compiled.

A relative state (a support of d_h and the drifts, and a node where it has a pivot) makes the constant rows what they
are in true currents, and what it leaves of the relative rows tells of the constant rows' errors. How uncertain the
state's own parameters are widens the noise of the constant rows; what these leave then moves the parameters. With theta
the relative ones, C their covariance, and G what a change of theta makes of the constant rows y (whose noise is S),

    y ~ N(X omega, S + G C G^T),    theta moves by -C G^T (S + G C G^T)^-1 (y - X omega).

Where a branch has a hardware offset and no sensor offset, its drift scales that as well: G depends on which those are.

What cannot come near the best state is not worked out: no integral is larger than the likelihood at its best.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from calibrator.compiled import compiled
from calibrator.drive import Array
from calibrator.posterior.block_fit import Normal, Scratch, SlabNodes, fit_node, open_directions, weigh_nodes
from calibrator.posterior.small_matrices import LOG_2PI, cholesky, inverse

__all__ = ["Evidence", "Found", "Law", "Room", "enumerate_vehicles"]

Places = NDArray[np.int64]
POSSIBLE_DRIFT = (-0.9, 9.0)
"""Beyond it the scale between measured and true currents vanishes or explodes. [1]"""
MOST_TURN = 3.0
"""Largest logarithm by which a ratio can be off."""
MOST_MOVED = 1.0
"""Largest logarithm by which constant rows can move a drift. [1]"""
NEGLIGIBLE = 25.0
"""Relative states so far below the best (logarithm) are dropped: constant rows hardly ever make that good. [1]"""
DROPPED = 18.0
"""States so far below the best (logarithm) are not worked out. [1]"""
BEAM = 8
"""Constant supports of one size that are grown, the best ones. [1]"""
GROWING = 3.0
"""None are if the best of them lies farther below the vehicle's best state (logarithm). [1]"""


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
    relative_raw: Array
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
    """States of N vehicles, S each at most, not in order; ``count`` of them, logarithmic weights, total, parameters."""

    count: Places
    log_weight: Array
    log_total: Array
    relative: Array
    relative_sd: Array
    constant: Array
    constant_sd: Array


class Room(NamedTuple):
    """Intermediate results of one vehicle; patterns are those of drifts that scale hardware offsets."""

    scratch: Scratch
    active: Places
    normal: Normal
    weights: Array
    relative_log: Array
    order: Places
    theta: Array
    covariance: Array
    parameters: Array
    scale: Array
    residual: Array
    rows: Array
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
    top: Places
    top_log: Array


@compiled
def _bit_count(bits: int) -> int:
    count = 0
    while bits:
        bits &= bits - 1
        count += 1
    return count


@compiled
def _bits_of(bits: int, active: Places) -> int:
    """Write down which bits are set; their number."""
    count, place = 0, 0
    while bits:
        if bits & 1:
            active[count] = place
            count += 1
        bits >>= 1
        place += 1
    return count


@compiled
def _normal_form(X: Array, R: Array, y: Array, A: Array, b: Array) -> float:
    """A becomes X^T R X and b becomes X^T R y, R the precision; y^T R y."""
    rows, P = X.shape
    c = 0.0
    b[:P] = 0.0
    A[:P, :P] = 0.0
    for r in range(rows):
        weighted = 0.0
        for s in range(rows):
            weighted += R[r, s] * y[s]
        c += y[r] * weighted
        for p in range(P):
            if X[r, p] != 0.0:
                b[p] += X[r, p] * weighted
                for s in range(rows):
                    if R[r, s] != 0.0:
                        for q in range(P):
                            A[p, q] += X[r, p] * R[r, s] * X[s, q]
    return c


@compiled
def _weigh_relative(law: Law, evidence: Evidence, j: int, room: Room) -> int:
    """Write down the logarithms of all relative states and their order; how many go on."""
    K, Q = law.branches, room.weights.shape[0]
    normal = room.normal
    rows = evidence.relative.shape[1]
    normal.level[0] = _normal_form(
        law.relative_design, evidence.relative_precision[j], evidence.relative[j], normal.A, normal.b
    )
    normal.level[1] = -0.5 * (rows * LOG_2PI + evidence.relative_log_determinant[j])
    best = -np.inf
    room.relative_log[:] = -np.inf
    for s in range(len(law.relative_size)):
        active, count = law.relative_active[s], law.relative_size[s]
        pivots = open_directions(normal.A, active, count, law.relative.spacing, room.scratch)
        room.pivots[s] = pivots
        floor = best - NEGLIGIBLE - law.best_share[s]
        number = weigh_nodes(
            normal, active, count, pivots, law.relative, room.scale, floor, room.scratch, room.weights
        )
        for q in range(number):
            room.relative_log[s * Q + q] = room.weights[q] + law.best_share[s]
            best = max(best, room.relative_log[s * Q + q])
    kept = 0
    for state in range(len(room.relative_log)):
        if room.relative_log[state] >= best - NEGLIGIBLE:
            room.order[kept] = state
            kept += 1
    by_weight = np.argsort(-room.relative_log[room.order[:kept]], kind="mergesort")
    chosen = room.order[:kept][by_weight]
    kept = min(kept, law.most_relative)
    room.order[:kept] = chosen[:kept]
    return kept


@compiled
def _take_relative(law: Law, evidence: Evidence, j: int, state: int, room: Room) -> float:
    """Work out one relative state and the constant rows under it; the logarithm of its integral, without its prior."""
    K, Q = law.branches, room.weights.shape[0]
    s, q = state // Q, state % Q
    active, count = law.relative_active[s], law.relative_size[s]
    fit_node(
        room.normal, active, count, room.pivots[s], law.relative, q, room.scratch, room.theta, room.covariance
    )
    rows_r, rows_c = evidence.relative.shape[1], evidence.constant.shape[1]
    for r in range(rows_r):
        total = evidence.relative[j, r]
        for p in range(K + 1):
            total -= law.relative_design[r, p] * room.theta[p]
        room.residual[r] = total
    log_change = 0.0
    for p in range(K + 1):
        room.parameters[p] = min(max(math.expm1(room.theta[p]), POSSIBLE_DRIFT[0]), POSSIBLE_DRIFT[1])
    for k in range(K):
        room.scale[k] = 1.0  # of o_h, but for the last, which is overwritten
    for k in range(K):
        room.scale[K - 1 + k] = 1.0 + room.parameters[1 + k]
        log_change += math.log(room.scale[K - 1 + k]) * evidence.share[j, k]
    log_change += math.log(1.0 + room.parameters[1]) * evidence.share[j, K]
    for r in range(rows_c):
        branch = r if r < K else (0 if r == K else r - K - 1)
        total = evidence.constant[j, r] / (1.0 + room.parameters[1 + branch]) - evidence.constant_mean[r]
        for i in range(rows_r):
            total -= evidence.carry[j, r, i] * room.residual[i]
        room.rows[r] = total
        for p in range(K + 1):
            room.turn[r, p] = 0.0
            for i in range(rows_r):
                room.turn[r, p] += evidence.carry[j, r, i] * law.relative_design[i, p]
    if evidence.turning:
        _turn(law, evidence, j, room)
    return room.relative_log[state] - law.best_share[s] - log_change


@compiled
def _turn(law: Law, evidence: Evidence, j: int, room: Room) -> None:
    """What turning about the means adds to the constant rows and their derivative, as :class:`LineMeans` tells."""
    K = law.branches
    for r in range(K + 1):
        for i in range(2 * K - 1):
            lever = evidence.lever[j, r, i]
            if lever != 0.0:
                room.rows[r] += lever * room.residual[i]
                for p in range(K + 1):
                    room.turn[r, p] -= lever * law.relative_design[i, p]
    for k in range(K):
        true = (1.0 + room.parameters[0]) * evidence.model[j, k]
        room.rows[k] += true * math.expm1(min(room.residual[k], MOST_TURN))
        room.turn[k, 1 + k] -= true
        room.turn[k, 0] -= true
        room.turn[K, 1 + k] -= true
    for k in range(1, K):
        turned = math.expm1(min(room.residual[K + k - 1], MOST_TURN))
        room.rows[K] -= turned * evidence.measured[j, k] / (1.0 + room.parameters[1 + k])


@compiled
def _take_turn(law: Law, evidence: Evidence, pattern: int, room: Room) -> None:
    """``room.turned`` becomes the derivative where the drifts of this pattern scale hardware offsets."""
    K = law.branches
    room.turned[:] = room.turn
    for k in range(K):
        if (pattern >> k) & 1:
            room.turned[k, 1 + k] -= room.rows[k]
            if evidence.turning:
                room.turned[K, 1 + k] -= room.rows[k]


@compiled
def _take_pattern(law: Law, evidence: Evidence, j: int, pattern: int, room: Room) -> None:
    """Normal form of the constant rows under one pattern."""
    if room.pattern_known[pattern]:
        return
    rows, P = law.constant_design.shape
    n = law.branches + 1
    _take_turn(law, evidence, pattern, room)
    for r in range(rows):
        for p in range(n):
            total = 0.0
            for q in range(n):
                total += room.turned[r, q] * room.covariance[q, p]
            room.spread[r, p] = total
    whole = room.scratch.C
    for r in range(rows):
        for s in range(r + 1):
            total = evidence.constant_covariance[j, r, s]
            for p in range(n):
                total += room.spread[r, p] * room.turned[s, p]
            whole[r, s] = whole[s, r] = total
        room.scratch.fitted[r] = r
    log_determinant = cholesky(whole, room.scratch.fitted, rows, room.scratch.L)
    inverse(room.scratch.L, rows, room.scratch.work, room.precision[pattern])
    room.pattern_level[pattern, 0] = _normal_form(
        law.constant_design, room.precision[pattern], room.rows, room.patterns[pattern], room.pattern_b[pattern]
    )
    room.pattern_level[pattern, 1] = -0.5 * (rows * LOG_2PI + log_determinant)
    room.pattern_known[pattern] = True


@compiled
def _pattern_of(bits: int, branches: int, drifting: int) -> int:
    """Branches whose drift scales a hardware offset: those that have one, no sensor offset, and a drift; as bits."""
    hardware = bits & ((1 << (branches - 1)) - 1)
    if hardware:
        hardware |= 1 << (branches - 1)
    return hardware & ~(bits >> (branches - 1)) & drifting


@compiled
def enumerate_vehicles(law: Law, evidence: Evidence, room: Room, found: Found) -> None:
    """Find the states of all vehicles.

    Parameters
    ----------
    law, evidence : Law, Evidence
        Prior and rows.
    room : Room
        Room.
    found : Found
        Becomes the result.
    """
    for j in range(len(evidence.relative)):
        _enumerate_vehicle(law, evidence, j, room, found)


@compiled
def _enumerate_vehicle(law: Law, evidence: Evidence, j: int, room: Room, found: Found) -> None:
    K = law.branches
    room.seen[:] = -1
    number = _weigh_relative(law, evidence, j, room)
    kept, best, total = 0, -np.inf, 0.0
    Q = room.weights.shape[0]
    for m in range(number):
        s = room.order[m] // Q
        log_relative = _take_relative(law, evidence, j, room.order[m], room)
        room.pattern_known[:] = False
        _take_pattern(law, evidence, j, 0, room)
        at_best = log_relative + room.pattern_level[0, 1]
        if law.best_share[s] == -np.inf or at_best + law.best_share[s] < best - DROPPED:
            continue
        hardware_r, size_r, drifting = 0, law.relative_size[s], 0
        for i in range(size_r):
            if law.relative_active[s, i] == 0:
                hardware_r = 1
            else:
                drifting |= 1 << (law.relative_active[s, i] - 1)
        for bits in law.constant_bits:
            hardware_c = _bit_count(bits & ((1 << (K - 1)) - 1))
            size = _bit_count(bits)
            log_prior = law.log_prior[hardware_r + hardware_c, size_r - hardware_r + size - hardware_c]
            if log_prior == -np.inf or at_best + log_prior < best - DROPPED:
                continue
            pattern = _pattern_of(bits, K, drifting)
            _take_pattern(law, evidence, j, pattern, room)
            count = _bits_of(bits, room.active)
            normal = Normal(room.patterns[pattern], room.pattern_b[pattern], room.pattern_level[pattern])
            if room.seen[bits] < 0:
                room.seen[bits] = open_directions(normal.A, room.active, count, law.constant.spacing, room.scratch)
            base = log_relative + log_prior
            nodes = weigh_nodes(
                normal,
                room.active,
                count,
                room.seen[bits],
                law.constant,
                room.scale,
                best - DROPPED - base,
                room.scratch,
                room.weights,
            )
            for q in range(nodes):
                value = base + room.weights[q]
                if value > best:
                    total *= math.exp(best - value)
                    best = value
                if value >= best - DROPPED:
                    total += math.exp(value - best)
                    kept = _keep(room, kept, value, m, bits, q)
    found.log_total[j] = best + math.log(total)
    found.count[j] = _write_states(law, evidence, j, room, kept, best, found)


@compiled
def _keep(room: Room, kept: int, value: float, m: int, bits: int, q: int) -> int:
    """Put a state on the list of the best ones; the length of the list."""
    if kept < len(room.top_log):
        place = kept
        kept += 1
    else:
        place = int(np.argmin(room.top_log))
        if room.top_log[place] >= value:
            return kept
    room.top_log[place] = value
    room.top[place, 0], room.top[place, 1], room.top[place, 2] = m, bits, q
    return kept


@compiled
def _write_states(law: Law, evidence: Evidence, j: int, room: Room, kept: int, best: float, found: Found) -> int:
    """Work out the parameters of the states on the list; how many they are."""
    order = np.argsort(room.top[:kept, 0], kind="mergesort")
    written, last = 0, -1
    for place in order:
        if room.top_log[place] < best - DROPPED:
            continue
        m, bits, q = room.top[place, 0], room.top[place, 1], room.top[place, 2]
        if m != last:
            _take_relative(law, evidence, j, room.order[m], room)
            room.pattern_known[:] = False
            last = m
        _write_state(law, evidence, j, room, bits, q, found, written)
        found.log_weight[j, written] = room.top_log[place]
        written += 1
    return written


@compiled
def _write_state(
    law: Law, evidence: Evidence, j: int, room: Room, bits: int, q: int, found: Found, place: int
) -> None:
    """Parameters of one state: constant ones, and relative ones as these move them."""
    K, n = law.branches, law.branches + 1
    rows, P = law.constant_design.shape
    drifting = 0
    for k in range(K):
        if room.theta[1 + k] != 0.0:
            drifting |= 1 << k
    pattern = _pattern_of(bits, K, drifting)
    _take_pattern(law, evidence, j, pattern, room)
    _take_turn(law, evidence, pattern, room)
    normal = Normal(room.patterns[pattern], room.pattern_b[pattern], room.pattern_level[pattern])
    count = _bits_of(bits, room.active)
    theta, C = np.zeros(P), np.zeros((P, P))
    fit_node(normal, room.active, count, room.seen[bits], law.constant, q, room.scratch, theta, C)
    left = np.zeros(rows)
    for r in range(rows):
        left[r] = room.rows[r]
        for p in range(P):
            left[r] -= law.constant_design[r, p] * theta[p]
    gain = room.covariance @ room.turned.T
    precision = room.precision[pattern]
    moved = -gain @ (precision @ left)
    fitted, held = _fitted_of(room.active, count, room.seen[bits])
    information = precision.copy()
    if fitted.size:
        X = np.zeros((rows, fitted.size))
        for i in range(fitted.size):
            X[:, i] = law.constant_design[:, fitted[i]]
        weighted = precision @ X
        information -= weighted @ np.linalg.solve(X.T @ weighted, weighted.T)
    for p in range(n):
        moved[p] = min(max(moved[p], -MOST_MOVED), MOST_MOVED)
        factor = (1.0 + room.parameters[p]) * math.exp(moved[p])
        variance = room.covariance[p, p] - gain[p] @ information @ gain[p]
        found.relative[j, place, p] = factor - 1.0
        found.relative_sd[j, place, p] = math.sqrt(max(variance, 0.0)) * factor
    for p in range(P):
        stretch = 1.0 if p < K - 1 else math.exp(moved[p - K + 2])
        found.constant[j, place, p] = theta[p] * room.scale[p] * stretch
        found.constant_sd[j, place, p] = math.sqrt(C[p, p]) * room.scale[p] * stretch


@compiled
def _fitted_of(active: Places, count: int, pivots: int) -> tuple[Places, int]:
    fitted = np.zeros(count, np.int64)
    number = 0
    for i in range(count):
        if not (pivots >> i) & 1:
            fitted[number] = active[i]
            number += 1
    return fitted[:number], count - number
