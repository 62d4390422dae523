"""Compilation of numerical loops: what is written as plain Python runs as machine code.

A function so marked may use numbers, arrays, tuples and other such functions only. It is compiled when it is first
called, which takes some ten seconds for all; the result is kept in the user's cache folder, one folder per state of the
source: a compiled function holds those that it calls, wherever they stand.
"""

import hashlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

import numba

__all__ = ["compiled", "inlined", "inner"]

_Function = TypeVar("_Function", bound=Callable[..., object])
CACHE_VARIABLE = "CALIBRATOR_CACHE"
"""Environment variable that names another folder than the user's cache folder."""

COMPILED = ("posterior", "evidence", "identification")
"""Folders of this package with compiled functions."""


def compiled(function: _Function) -> _Function:
    """Compile a function; division by zero gives infinity, as in arrays."""
    return _compile(function, no_cfunc_wrapper=True)


def inner(function: _Function) -> _Function:
    """Compile a function that other compiled functions alone call."""
    return _compile(function, no_cfunc_wrapper=True, no_cpython_wrapper=True)


def inlined(function: _Function) -> _Function:
    """Compile a function into its callers: for those that are called so often that handing over arguments counts."""
    return _compile(function, no_cfunc_wrapper=True, no_cpython_wrapper=True, forceinline=True)


def _compile(function: _Function, **options: Any) -> _Function:
    config: Any = numba.config
    before = config.CACHE_DIR
    config.CACHE_DIR = _CACHE or before
    try:
        return cast("_Function", numba.njit(cache=bool(_CACHE), error_model="numpy", **options)(function))
    finally:
        config.CACHE_DIR = before


def _cache_folder() -> str:
    """Folder of compiled code of this source, made if missing; empty if it cannot be made."""
    package = Path(__file__).parent
    sources = [Path(__file__), *(path for name in COMPILED for path in sorted((package / name).glob("*.py")))]
    digest = hashlib.sha256(b"".join(source.read_bytes() for source in sources)).hexdigest()[:16]
    usual = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "calibrator"
    folder = Path(os.environ.get(CACHE_VARIABLE) or usual) / digest
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return ""
    return str(folder) if os.access(folder, os.W_OK) else ""


_CACHE = _cache_folder()
