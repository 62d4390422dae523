"""Sum over the explanations of one vehicle after the other; compiled.

A relative state (a support of d_h and the drifts, and a node where it has a pivot) makes the constant rows what they
are in true currents, and what it leaves of the relative rows tells of the constant rows' errors. How uncertain the
state's own parameters are widens the noise of the constant rows; what these leave then moves the parameters. With theta
the relative ones, C their covariance, and G what a change of theta makes of the constant rows y (whose noise is S),

    y ~ N(X omega, S + G C G^T),    theta moves by -C G^T (S + G C G^T)^-1 (y - X omega).
"""

import math

import numpy as np

from calibrator.compiled import in_place, inlined
from calibrator.drive import Array
from calibrator.posterior.block_fit import fit_node
from calibrator.posterior.constant_states import (
    bit_count,
    bits_of,
    grown,
    pattern_of,
    sharpest,
    take_pattern,
    take_turn,
    weigh_constants,
)
from calibrator.posterior.normal import Normal
from calibrator.posterior.relative_states import take_relative, weigh_relative
from calibrator.posterior.small_matrices import quadratic, sort_falling
from calibrator.posterior.workspace import Evidence, Found, Law, Room

__all__ = ["enumerate_vehicles"]

MOST_MOVED = 1.0
"""Largest logarithm by which constant rows can move a drift. [1]"""
UNTOLD = 1e-5
"""Weight that is left when the parameters of no more states are worked out. [1]"""


@in_place
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
        number = weigh_relative(law, evidence, j, room)
        sharpest(law, evidence, j, room)
        room.seen[:] = -1
        room.visited[:] = False
        room.kept[0], room.best[0], room.best[1] = 0, -np.inf, 0.0
        supports, size = law.constant_bits, law.grown
        while len(supports):
            weigh_constants(law, evidence, j, number, supports, room)
            wanted = grown(law, size, room) if size else 0
            supports = room.wanted[:wanted]
            size += 1
        found.log_total[j] = room.best[0] + math.log(room.best[1])
        found.number[j] = _write_states(law, evidence, j, room, found)


@inlined
def _write_states(law: Law, evidence: Evidence, j: int, room: Room, found: Found) -> int:
    """Work out the parameters of the best states until next to no weight is left; how many they are."""
    kept = room.kept[0]
    for i in range(kept):
        room.top_order[i] = i
    sort_falling(room.top_log, room.top_order, kept, room.order_work)
    left, written = 1.0, 0
    while written < kept and left > UNTOLD:
        left -= math.exp(room.top_log[room.top_order[written]] - found.log_total[j])
        found.log_weight[j, written] = room.top_log[room.top_order[written]]
        written += 1
    # One relative state after the other, as each is worked out anew.
    for i in range(written):
        m = room.top[room.top_order[i], 0]
        if m < 0:
            continue
        take_relative(law, evidence, j, room.order[m], room)
        room.pattern_known[:] = False
        for place in range(i, written):
            entry = room.top_order[place]
            if room.top[entry, 0] == m:
                _write_state(law, evidence, j, room, entry, found, place)
                room.top[entry, 0] = -1
    return written


@inlined
def _write_state(law: Law, evidence: Evidence, j: int, room: Room, entry: int, found: Found, place: int) -> None:
    """Parameters of one state: constant ones, and relative ones as these move them.

    The rows were divided by the 1 + d of the state, whatever moves it: the offsets stay.
    """
    K, P = law.branches, law.constant_design.shape[1]
    bits, q = room.top[entry, 1], room.top[entry, 2]
    drifting = 0
    for k in range(K):
        if room.theta[1 + k] != 0.0:
            drifting |= 1 << k
    pattern = pattern_of(bits, K, drifting)
    take_pattern(law, evidence, j, pattern, room)
    take_turn(law, evidence, pattern, room)
    normal = Normal(room.patterns[pattern], room.pattern_b[pattern], room.pattern_level[pattern])
    count, pivots = bits_of(bits, room.active), room.seen[bits]
    theta, C = room.constant_theta, room.constant_covariance
    fit_node(normal, room.active, count, pivots, law.constant, q, room.scratch, theta, C)
    for p in range(P):
        found.constant[j, place, p] = theta[p] * room.scale[p]
        found.constant_sd[j, place, p] = math.sqrt(C[p, p]) * room.scale[p]
    for r in range(len(room.left)):
        room.left[r] = room.rows[r]
        for p in range(P):
            room.left[r] -= law.constant_design[r, p] * theta[p]
    fitted = count - bit_count(pivots)
    for p in range(K + 1):
        moved, told = _told_by_constants(law, room, room.precision[pattern], p, fitted)
        factor = (1.0 + room.parameters[p]) * math.exp(min(max(moved, -MOST_MOVED), MOST_MOVED))
        found.relative[j, place, p] = factor - 1.0
        found.relative_sd[j, place, p] = math.sqrt(max(room.covariance[p, p] - told, 0.0)) * factor


@inlined
def _told_by_constants(law: Law, room: Room, precision: Array, p: int, fitted: int) -> tuple[float, float]:
    """By how much what is left of the constant rows moves a relative parameter, and the variance that it takes away."""
    moved, told, rows = 0.0, 0.0, len(room.left)
    for r in range(rows):
        total = 0.0
        for t in range(rows):
            total += precision[r, t] * room.spread[t, p]
        room.weighted[r] = total
        moved -= total * room.left[r]
        told += total * room.spread[r, p]
    for i in range(fitted):
        total = 0.0
        for r in range(rows):
            total += law.constant_design[r, room.scratch.fitted[i]] * room.weighted[r]
        room.projected[i] = total
    return moved, told - quadratic(room.scratch.L, room.projected, fitted, room.scratch.z)
