"""Evidence of one support: Gaussian likelihood of linear rows, integrated over slabs; compiled.

With y = X theta + e, e ~ N(0, R), and the slab's density on theta, the integral is

    N(y - X theta_hat; 0, R) sqrt(det(2 pi C)) prod_i mass_i,   C = (X^T R^-1 X)^-1,

mass_i being that of N(theta_hat_i, C_ii) under the slab. That is exact where all of the likelihood lies inside the
slab; at its edges the correlation between parameters is left out. All of it is computed from the rows' *normal form*:
A = X^T R^-1 X, b = X^T R^-1 y, c = y^T R^-1 y.

Rows can leave directions open: if all relative parameters are there, a common factor can move from d_h to the drifts
unseen, and if o_h,k and o_k are there, an offset from one to the other, unless some reading tells one of them. Which
directions are open depends on the rows of the vehicle. One parameter of each, the pivot, is set to the nodes of the
slab in turn, and the others follow.
"""

import math
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from calibrator.compiled import inlined, inner
from calibrator.drive import Array
from calibrator.posterior.slab import Slab
from calibrator.posterior.small_matrices import (
    LOG_2PI,
    cholesky,
    inverse,
    log_mass,
    quadratic,
    solution,
    variances,
)

__all__ = ["Normal", "Scratch", "SlabNodes", "fit_node", "open_directions", "scratch_of", "slab_nodes", "weigh_nodes"]

Places = NDArray[np.int64]
TINY = 1e-9
"""Information on a parameter that no row tells. [1]"""


class SlabNodes(NamedTuple):
    """A slab, and its nodes for 0 .. D open directions; both logarithms and values where they stand for drifts.

    ``values`` (D + 1, Q, D), of which ``counts[d]`` are used; ``sd`` (D + 1, Q, D) what each stands for; ``spacing``
    (D + 1,) how far they lie apart if there is one direction more.
    """

    low: float
    high: float
    logarithmic: bool
    counts: Places
    values: Array
    sd: Array
    spacing: Array


class Normal(NamedTuple):
    """Normal form of rows: A (P, P), b (P,), and (c, logarithm of the density at a misfit of zero) as an array."""

    A: Array
    b: Array
    level: Array


class Scratch(NamedTuple):
    """Room for intermediate results."""

    fitted: Places
    pivots: Places
    node: Array
    right: Array
    z: Array
    x: Array
    variance: Array
    L: Array
    work: Array
    C: Array
    lever: Array


def slab_nodes(slab: Slab, directions: int, *, logarithmic: bool) -> SlabNodes:
    """Nodes of a slab for up to so many open directions.

    Parameters
    ----------
    slab : Slab
        Of drifts or offsets.
    directions : int
        Most directions that can be open.
    logarithmic : bool
        Whether the rows are linear in the logarithm of 1 + parameter.

    Returns
    -------
    SlabNodes
        For compiled functions.
    """
    units = [_unit_nodes(d) for d in range(directions + 1)]
    most = max(len(unit) for unit in units)
    values, sd = np.zeros((directions + 1, most, directions)), np.zeros((directions + 1, most, directions))
    for d, unit in enumerate(units):
        nodes = slab.at(unit)
        values[d, : len(unit), :d] = np.log1p(nodes) if logarithmic else nodes
        sd[d, : len(unit), :d] = slab.cell_sd(d) / (1.0 + nodes if logarithmic else 1.0)
    return SlabNodes(
        low=slab.low,
        high=slab.high,
        logarithmic=logarithmic,
        counts=np.array([len(unit) for unit in units]),
        values=values,
        sd=sd,
        spacing=np.array([slab.spacing(d + 1) for d in range(directions + 1)]),
    )


@cache
def _unit_nodes(directions: int) -> Array:
    return Slab.unit_nodes(directions)


def scratch_of(size: int) -> Scratch:
    """Room for supports of up to so many parameters, or matrices of so many rows."""
    places, vectors, matrices = np.zeros((2, size), np.int64), np.zeros((5, size)), np.zeros((4, size, size))
    return Scratch(*places, *vectors, *matrices)


@inner
def open_directions(A: Array, active: Places, count: int, spacing: Array, room: Scratch) -> int:
    """Which of the active parameters are pivots, as bits: the first that is open, until none is.

    A direction is open where its parameters' deviations are wider than nodes would lie apart with one pivot more.
    """
    pivots, found = 0, 0
    while found < count:
        kept = 0
        for i in range(count):
            if not (pivots >> i) & 1:
                room.fitted[kept] = i
                kept += 1
        for i in range(kept):
            for j in range(kept):
                room.C[i, j] = A[active[room.fitted[i]], active[room.fitted[j]]]
            room.C[i, i] += TINY
            room.pivots[i] = i
        cholesky(room.C, room.pivots, kept, room.L)
        variances(room.L, kept, room.work, room.variance)
        first = -1
        for i in range(kept):
            if room.variance[i] > spacing[found] ** 2:
                first = room.fitted[i]
                break
        if first < 0:
            break
        pivots |= 1 << first
        found += 1
    return pivots


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
    log_density = -math.log(2.0 * (nodes.high - nodes.low))
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
        if not value + fitted * log_density >= floor:
            out[q] = -np.inf
            continue
        if not has_variances:
            variances(room.L, fitted, room.work, room.variance)
            has_variances = True
        for i in range(fitted):
            scale = math.exp(room.right[i]) if nodes.logarithmic else unit[room.fitted[i]]
            mean = scale - 1.0 if nodes.logarithmic else room.right[i] * scale
            value += log_mass(mean, math.sqrt(room.variance[i]) * scale, nodes.low, nodes.high)
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
