"""Compilation of numerical loops: what is written as plain Python runs as machine code.

A function marked :func:`compiled` may use numbers, arrays, tuples and other such functions only. It is compiled when it
is first called, and the result is kept beside its source.
"""

from collections.abc import Callable
from typing import TypeVar, cast

import numba

__all__ = ["compiled"]

_Function = TypeVar("_Function", bound=Callable[..., object])


def compiled(function: _Function) -> _Function:
    """Compile a function; division by zero gives infinity, as in arrays."""
    return cast("_Function", numba.njit(cache=True, error_model="numpy")(function))
