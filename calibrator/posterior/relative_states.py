"""Relative states of one vehicle: supports of (d_h, d_1 .. d_K), and what each makes of the constant rows; compiled."""

import math

import numpy as np

from calibrator.compiled import inlined, inner
from calibrator.evidence.rows import MOST_TURN
from calibrator.posterior.block_fit import fit_node, weigh_nodes
from calibrator.posterior.open_directions import open_directions
from calibrator.posterior.small_matrices import LOG_2PI, normal_form, sort_falling
from calibrator.posterior.workspace import Evidence, Law, Room

__all__ = ["take_relative", "weigh_relative"]

POSSIBLE_DRIFT = (-0.9, 9.0)
"""Beyond it the scale between measured and true currents vanishes or explodes. [1]"""
NEGLIGIBLE = 25.0
"""Relative states so far below the best (logarithm) are dropped: constant rows hardly ever make that good. [1]"""


@inlined
def weigh_relative(law: Law, evidence: Evidence, j: int, room: Room) -> int:
    """Write down the logarithms of all relative states and their order; how many go on."""
    Q = room.weights.shape[0]
    normal = room.normal
    rows = evidence.relative.shape[1]
    normal.level[0] = normal_form(
        law.relative_design, evidence.relative_precision[j], evidence.relative[j], room.product, normal.A, normal.b
    )
    normal.level[1] = -0.5 * (rows * LOG_2PI + evidence.relative_log_determinant[j])
    _told_turn(law, evidence, j, room)
    best = -np.inf
    room.relative_log[:] = -np.inf
    for s in range(len(law.relative_size)):
        active, count = law.relative_active[s], law.relative_size[s]
        pivots = open_directions(normal.A, active, count, law.relative.spacing, room.scratch)
        room.pivots[s] = pivots
        floor = best - NEGLIGIBLE - law.best_share[s]
        number = weigh_nodes(normal, active, count, pivots, law.relative, room.scale, floor, room.scratch, room.weights)
        for q in range(number):
            room.relative_log[s * Q + q] = room.weights[q] + law.best_share[s]
            best = max(best, room.relative_log[s * Q + q])
    kept = 0
    for state in range(len(room.relative_log)):
        if room.relative_log[state] >= best - NEGLIGIBLE:
            room.order[kept] = state
            kept += 1
    sort_falling(room.relative_log, room.order, kept, room.order_work)
    return min(kept, law.most_relative)


@inlined
def _told_turn(law: Law, evidence: Evidence, j: int, room: Room) -> None:
    """How the constant rows change with the relative parameters through what the relative rows tell of their errors."""
    K, rows_r, rows_c = law.branches, evidence.relative.shape[1], evidence.constant.shape[1]
    for r in range(rows_c):
        for p in range(K + 1):
            room.told_turn[r, p] = 0.0
            for i in range(rows_r):
                room.told_turn[r, p] += evidence.carry[j, r, i] * law.relative_design[i, p]
            if r <= K:
                for i in range(2 * K - 1):
                    room.told_turn[r, p] -= evidence.lever[j, r, i] * law.relative_design[i, p]


@inner
def take_relative(law: Law, evidence: Evidence, j: int, state: int, room: Room) -> float:
    """Work out one relative state and the constant rows under it; the logarithm of its integral, without its prior."""
    K, Q = law.branches, room.weights.shape[0]
    s, q = state // Q, state % Q
    active, count = law.relative_active[s], law.relative_size[s]
    fit_node(room.normal, active, count, room.pivots[s], law.relative, q, room.scratch, room.theta, room.covariance)
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
            room.turn[r, p] = room.told_turn[r, p]
    if evidence.turning:
        _turn(law, evidence, j, room)
    return float(room.relative_log[state] - law.best_share[s] - log_change)


@inlined
def _turn(law: Law, evidence: Evidence, j: int, room: Room) -> None:
    """What turning about the means adds to the constant rows and their derivative, as :class:`LineMeans` tells."""
    K = law.branches
    for r in range(K + 1):
        for i in range(2 * K - 1):
            lever = evidence.lever[j, r, i]
            if lever != 0.0:
                room.rows[r] += lever * room.residual[i]
    for k in range(K):
        true = (1.0 + room.parameters[0]) * evidence.model[j, k]
        room.rows[k] += true * math.expm1(min(room.residual[k], MOST_TURN))
        room.turn[k, 1 + k] -= true
        room.turn[k, 0] -= true
        room.turn[K, 1 + k] -= true
    for k in range(1, K):
        turned = math.expm1(min(room.residual[K + k - 1], MOST_TURN))
        room.rows[K] -= turned * evidence.measured[j, k] / (1.0 + room.parameters[1 + k])
