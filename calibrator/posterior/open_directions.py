"""Directions that the rows of a vehicle leave open; compiled.

If all relative parameters are there, a common factor can move from d_h to the drifts unseen, and if o_h,k and o_k are
there, an offset from one to the other, unless some reading tells one of them. Which directions are open depends on the
rows of the vehicle. One parameter of each, the pivot, is set to the nodes of the slab in turn, and the others follow.
"""

from calibrator.compiled import inner
from calibrator.drive import Array
from calibrator.posterior.normal import TINY, Places, Scratch
from calibrator.posterior.small_matrices import cholesky, variances

__all__ = ["open_directions"]


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
