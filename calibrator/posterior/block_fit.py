"""Evidence of one support: Gaussian likelihood of linear rows, integrated over slabs; compiled.

With y = X theta + e, e ~ N(0, R), and the slab's density on theta, the integral is

    N(y - X theta_hat; 0, R) sqrt(det(2 pi C)) prod_i mass_i,   C = (X^T R^-1 X)^-1,

mass_i being that of N(theta_hat_i, C_ii) under the slab. That is exact where all of the likelihood lies inside the
slab; at its edges the correlation between parameters is left out. All of it is computed from the rows' *normal form*,
with the pivots of open directions set to nodes of the slab.
"""

import math

import numpy as np

from calibrator.compiled import inlined, inner
from calibrator.drive import Array
from calibrator.posterior.normal import TINY, Normal, Places, Scratch
from calibrator.posterior.slab_nodes import SlabNodes
from calibrator.posterior.small_matrices import LOG_2PI, cholesky, inverse, log_mass, quadratic, solution, variances

__all__ = ["fit_node", "weigh_nodes"]


@inlined
def _split(active: Places, count: int, pivots: int, room: Scratch) -> tuple[int, int]:
    """Numbers of fitted parameters and of pivots; which they are is written into the room."""
    fitted, held = 0, 0
    for i in range(count):
        if (pivots >> i) & 1:
            room.pivots[held] = active[i]
            held += 1
        else:
            room.fitted[fitted] = active[i]
            fitted += 1
    return fitted, held


@inlined
def _follow_pivots(rows: Normal, fitted: int, held: int, room: Scratch) -> float:
    """How misfit and estimates change with the values v of the pivots; the misfit at v = 0.

    The misfit is that plus v^T (2 node + C v), the estimates are x - lever v.
    """
    for i in range(fitted):
        room.right[i] = rows.b[room.fitted[i]]
    squared = quadratic(room.L, room.right, fitted, room.z)
    solution(room.L, room.z, fitted, room.x)
    for p in range(held):
        for i in range(fitted):
            room.right[i] = rows.A[room.fitted[i], room.pivots[p]]
        quadratic(room.L, room.right, fitted, room.work[p])
        solution(room.L, room.work[p], fitted, room.right)
        for i in range(fitted):
            room.lever[i, p] = room.right[i]
    for p in range(held):
        room.node[p] = -rows.b[room.pivots[p]]
        for i in range(fitted):
            room.node[p] += room.work[p, i] * room.z[i]
        for r in range(held):
            total = rows.A[room.pivots[p], room.pivots[r]]
            for i in range(fitted):
                total -= room.work[p, i] * room.work[r, i]
            room.C[p, r] = total
    return float(rows.level[0]) - squared


@inlined
def _more_misfit(values: Array, held: int, room: Scratch) -> float:
    """What the misfit grows by if the pivots take these values."""
    more = 0.0
    for i in range(held):
        across = 2.0 * room.node[i]
        for j in range(held):
            across += room.C[i, j] * values[j]
        more += values[i] * across
    return more


@inlined
def _least_misfit(rows: Normal, active: Places, count: int, room: Scratch) -> float:
    """Misfit of the rows if all active parameters, pivots too, take whatever value suits them: none is smaller."""
    for i in range(count):
        for j in range(count):
            room.C[i, j] = rows.A[active[i], active[j]]
        room.C[i, i] *= 1.0 + TINY
        room.C[i, i] += TINY
        room.right[i] = rows.b[active[i]]
        room.pivots[i] = i
    cholesky(room.C, room.pivots, count, room.L)
    return float(rows.level[0]) - quadratic(room.L, room.right, count, room.z)


@inner
def weigh_nodes(
    rows: Normal,
    active: Places,
    count: int,
    pivots: int,
    nodes: SlabNodes,
    unit: Array,
    floor: float,
    room: Scratch,
    out: Array,
) -> int:
    """Logarithm of the integral at each node of one support, each node with its share.

    Parameters
    ----------
    rows : Normal
        Rows over all parameters.
    active, count : ndarray of int, int
        Parameters that are not zero.
    pivots : int
        Bits of those that are set to nodes.
    nodes : SlabNodes
        Of their slab.
    unit : ndarray
        Factor between what the rows are linear in and the parameter itself, where the nodes are not logarithmic.
    floor : float
        What is certainly below is not worked out.
    room : Scratch
        Room.
    out : ndarray
        Becomes the logarithms; minus infinity below the floor.

    Returns
    -------
    int
        Number of nodes.
    """
    if pivots and rows.level[1] - 0.5 * _least_misfit(rows, active, count, room) < floor:
        return 0
    fitted, held = _split(active, count, pivots, room)
    number = nodes.counts[held]
    start = rows.level[1] + 0.5 * (fitted * LOG_2PI - cholesky(rows.A, room.fitted, fitted, room.L)) - math.log(number)
    least = _follow_pivots(rows, fitted, held, room)
    if not nodes.logarithmic:
        for i in range(fitted):
            start += math.log(unit[room.fitted[i]])
    has_variances = False
    for q in range(number):
        value = start - 0.5 * (least + _more_misfit(nodes.values[held, q], held, room))
        for i in range(fitted):
            room.right[i] = room.x[i]
            for j in range(held):
                room.right[i] -= room.lever[i, j] * nodes.values[held, q, j]
            if nodes.logarithmic:
                value += room.right[i]
        if not value + fitted * nodes.log_density >= floor:
            out[q] = -np.inf
            continue
        if not has_variances:
            variances(room.L, fitted, room.work, room.variance)
            has_variances = True
        for i in range(fitted):
            scale = math.exp(room.right[i]) if nodes.logarithmic else unit[room.fitted[i]]
            mean = scale - 1.0 if nodes.logarithmic else room.right[i] * scale
            smaller = nodes.smaller if room.fitted[i] >= nodes.hardware else 0.0
            value += log_mass(mean, math.sqrt(room.variance[i]) * scale, nodes.low, nodes.high, smaller)
        out[q] = value
    return int(number)


@inner
def fit_node(
    rows: Normal,
    active: Places,
    count: int,
    pivots: int,
    nodes: SlabNodes,
    q: int,
    room: Scratch,
    theta: Array,
    covariance: Array,
) -> None:
    """Estimates of all parameters at one node, zero where not active, and their covariance.

    Pivots deviate as far as their nodes lie apart, and the others with them.
    """
    theta[:] = 0.0
    covariance[:] = 0.0
    fitted, held = _split(active, count, pivots, room)
    cholesky(rows.A, room.fitted, fitted, room.L)
    _follow_pivots(rows, fitted, held, room)
    inverse(room.L, fitted, room.work, room.C)
    for i in range(fitted):
        theta[room.fitted[i]] = room.x[i]
        for p in range(held):
            theta[room.fitted[i]] -= room.lever[i, p] * nodes.values[held, q, p]
        for j in range(fitted):
            covariance[room.fitted[i], room.fitted[j]] = room.C[i, j]
    for p in range(held):
        theta[room.pivots[p]] = nodes.values[held, q, p]
    for p in range(held):
        variance = nodes.sd[held, q, p] ** 2
        for i in range(fitted):
            room.right[i] = -room.lever[i, p]
        for i in range(fitted):
            for j in range(fitted):
                covariance[room.fitted[i], room.fitted[j]] += variance * room.right[i] * room.right[j]
            covariance[room.fitted[i], room.pivots[p]] += variance * room.right[i]
            covariance[room.pivots[p], room.fitted[i]] += variance * room.right[i]
        covariance[room.pivots[p], room.pivots[p]] += variance
