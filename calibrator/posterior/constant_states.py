"""Constant supports of one vehicle, taken with each of its relative states; compiled.

Where a branch has a hardware offset and no sensor offset, its drift scales that as well: what a change of the relative
parameters makes of the constant rows depends on which branches these are, the *pattern*.

What cannot come near the best state is not worked out: no integral is larger than the likelihood at its best.
"""

import math

import numpy as np

from calibrator.compiled import inlined, inner
from calibrator.drive import Array
from calibrator.posterior.block_fit import weigh_nodes
from calibrator.posterior.normal import Normal, Places, Scratch
from calibrator.posterior.open_directions import open_directions
from calibrator.posterior.relative_states import take_relative
from calibrator.posterior.small_matrices import LOG_2PI, cholesky, inverse, normal_form, sort_falling
from calibrator.posterior.workspace import BEAM, Evidence, Law, Room

__all__ = ["bit_count", "bits_of", "grown", "pattern_of", "sharpest", "take_pattern", "take_turn", "weigh_constants"]

DROPPED = 15.0
"""States so far below the best (logarithm) are not worked out. [1]"""
GROWING = 3.0
"""No supports are grown if the best lies farther below the vehicle's best state (logarithm). [1]"""


@inlined
def bit_count(bits: int) -> int:
    """How many bits are set."""
    count = 0
    while bits:
        bits &= bits - 1
        count += 1
    return count


@inlined
def bits_of(bits: int, active: Places) -> int:
    """Write down which bits are set; their number."""
    count, place = 0, 0
    while bits:
        if bits & 1:
            active[count] = place
            count += 1
        bits >>= 1
        place += 1
    return count


@inlined
def pattern_of(bits: int, branches: int, drifting: int) -> int:
    """Branches whose drift scales a hardware offset: those that have one, no sensor offset, and a drift; as bits."""
    hardware = bits & ((1 << (branches - 1)) - 1)
    if hardware:
        hardware |= 1 << (branches - 1)
    return hardware & ~(bits >> (branches - 1)) & drifting


@inlined
def sharpest(law: Law, evidence: Evidence, j: int, room: Room) -> None:
    """Information of the constant rows if the relative parameters were known: it says which directions are open."""
    rows = law.constant_design.shape[0]
    log_determinant = _invert(evidence.constant_covariance[j], rows, room.scratch, room.precision[0])
    room.sharp.level[1] = -0.5 * (rows * LOG_2PI + log_determinant)
    normal_form(law.constant_design, room.precision[0], room.rows, room.product, room.sharp.A, room.sharp.b)


@inner
def _invert(whole: Array, rows: int, scratch: Scratch, precision: Array) -> float:
    """``precision`` becomes the inverse of a covariance; the logarithm of its determinant."""
    for r in range(rows):
        scratch.fitted[r] = r
    log_determinant = cholesky(whole, scratch.fitted, rows, scratch.L)
    inverse(scratch.L, rows, scratch.work, precision)
    return log_determinant


@inner
def take_turn(law: Law, evidence: Evidence, pattern: int, room: Room) -> None:
    """``room.turned`` becomes the derivative where the drifts of this pattern scale hardware offsets.

    ``room.spread`` becomes the same times the covariance of the relative parameters.
    """
    K, n = law.branches, law.branches + 1
    for r in range(len(room.rows)):
        for p in range(n):
            room.turned[r, p] = room.turn[r, p]
    for k in range(K):
        if (pattern >> k) & 1:
            room.turned[k, 1 + k] -= room.rows[k]
            if evidence.turning:
                room.turned[K, 1 + k] -= room.rows[k]
    for r in range(len(room.rows)):
        for p in range(n):
            total = 0.0
            for q in range(n):
                total += room.turned[r, q] * room.covariance[q, p]
            room.spread[r, p] = total


@inner
def take_pattern(law: Law, evidence: Evidence, j: int, pattern: int, room: Room) -> None:
    """Normal form of the constant rows under one pattern."""
    if room.pattern_known[pattern]:
        return
    take_turn(law, evidence, pattern, room)
    rows, whole = law.constant_design.shape[0], room.scratch.C
    for r in range(rows):
        for s in range(r + 1):
            total = evidence.constant_covariance[j, r, s]
            for p in range(law.branches + 1):
                total += room.spread[r, p] * room.turned[s, p]
            whole[r, s] = whole[s, r] = total
    log_determinant = _invert(whole, rows, room.scratch, room.precision[pattern])
    A, b = room.patterns[pattern], room.pattern_b[pattern]
    misfit = normal_form(law.constant_design, room.precision[pattern], room.rows, room.product, A, b)
    room.pattern_level[pattern, 0] = misfit
    room.pattern_level[pattern, 1] = -0.5 * (rows * LOG_2PI + log_determinant)
    room.pattern_known[pattern] = True


@inlined
def weigh_constants(law: Law, evidence: Evidence, j: int, number: int, supports: Places, room: Room) -> None:
    """Take all relative states with these constant supports, on top of what was found so far."""
    K, Q = law.branches, room.weights.shape[0]
    best, total = room.best[0], room.best[1]
    hardware_bits = (1 << (K - 1)) - 1
    for bits in supports:
        room.visited[bits] = True
    for m in range(number):
        s = room.order[m] // Q
        if law.best_share[s] == -np.inf:
            continue
        log_relative = take_relative(law, evidence, j, room.order[m], room)
        room.pattern_known[:] = False
        if log_relative + room.sharp.level[1] + law.best_share[s] < best - DROPPED:
            continue
        hardware, sensors, drifting = _counts(law, s)
        for bits in supports:
            in_hardware = bit_count(bits & hardware_bits)
            log_prior = law.log_prior[hardware + in_hardware, sensors + bit_count(bits) - in_hardware]
            base = log_relative + log_prior
            if base == -np.inf or base + room.sharp.level[1] < best - DROPPED:
                continue
            pattern = pattern_of(bits, K, drifting)
            if not room.pattern_known[pattern]:
                take_pattern(law, evidence, j, pattern, room)
            if base + room.pattern_level[pattern, 1] < best - DROPPED:
                continue
            nodes = _weigh_support(law, room, bits, pattern, best - DROPPED - base)
            for q in range(nodes):
                value = base + room.weights[q]
                if value > best:
                    total *= math.exp(best - value)
                    best = value
                if value >= best - DROPPED:
                    total += math.exp(value - best)
                    _keep(room, value, m, bits, q)
    room.best[0], room.best[1] = best, total


@inlined
def _counts(law: Law, support: int) -> tuple[int, int, int]:
    """Numbers of hardware and sensor parameters of a relative support, and the branches that drift as bits."""
    hardware, drifting = 0, 0
    for i in range(law.relative_size[support]):
        if law.relative_active[support, i] == 0:
            hardware = 1
        else:
            drifting |= 1 << (law.relative_active[support, i] - 1)
    return hardware, law.relative_size[support] - hardware, drifting


@inlined
def _weigh_support(law: Law, room: Room, bits: int, pattern: int, floor: float) -> int:
    """Write down the logarithms of the integral at each node of one constant support; how many nodes."""
    count = bits_of(bits, room.active)
    if room.seen[bits] < 0:
        room.seen[bits] = open_directions(room.sharp.A, room.active, count, law.constant.spacing, room.scratch)
    normal = Normal(room.patterns[pattern], room.pattern_b[pattern], room.pattern_level[pattern])
    pivots = room.seen[bits]
    return weigh_nodes(normal, room.active, count, pivots, law.constant, room.scale, floor, room.scratch, room.weights)


@inlined
def grown(law: Law, size: int, room: Room) -> int:
    """Write down constant supports with one parameter more than the best ones of this size; how many they are."""
    kept, best = room.kept[0], room.best[0]
    for i in range(kept):
        room.top_order[i] = i
    sort_falling(room.top_log, room.top_order, kept, room.order_work)
    beam, wanted, last = 0, 0, -1
    for i in range(kept):
        place = room.top_order[i]
        bits = room.top[place, 1]
        if bit_count(bits) != size or bits == last:
            continue
        if beam == 0 and room.top_log[place] < best - GROWING:
            return 0
        last = bits
        beam += 1
        for p in range(2 * law.branches - 1):
            more = bits | (1 << p)
            if not room.visited[more]:
                room.visited[more] = True
                room.wanted[wanted] = more
                wanted += 1
        if beam == BEAM:
            break
    return wanted


@inlined
def _keep(room: Room, value: float, m: int, bits: int, q: int) -> None:
    """Put a state on the list of the best ones."""
    place = room.kept[0]
    if place < len(room.top_log):
        room.kept[0] += 1
    else:
        place = 0
        for i in range(1, len(room.top_log)):
            if room.top_log[i] < room.top_log[place]:
                place = i
        if room.top_log[place] >= value:
            return
    room.top_log[place] = value
    room.top[place, 0], room.top[place, 1], room.top[place, 2] = m, bits, q
