"""Normal form of linear rows y = X theta + e, e ~ N(0, R), and room to work on it, as compiled functions take them.

A = X^T R^-1 X, b = X^T R^-1 y, c = y^T R^-1 y.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from calibrator.drive import Array

__all__ = ["TINY", "Normal", "Places", "Scratch", "scratch_of"]

Places = NDArray[np.int64]
"""Numbers of parameters, rows or columns."""
TINY = 1e-9
"""Information on a parameter that no row tells. [1]"""


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


def scratch_of(size: int) -> Scratch:
    """Room for supports of up to so many parameters, or matrices of so many rows."""
    places, vectors, matrices = np.zeros((2, size), np.int64), np.zeros((5, size)), np.zeros((4, size, size))
    return Scratch(*places, *vectors, *matrices)
