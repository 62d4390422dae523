"""Compile numerical loops with numba: functions written in plain Python run as machine code.

A compiled function may use only numbers, arrays, tuples and other compiled functions.

Compiling the estimator takes about half a minute on first use. Numba keeps the result in the user's cache folder, in
one folder per version of the source; within it numba itself keeps versions of Python and numba, and processors, apart.
"""

import hashlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

import numba as _numba

__all__ = ["compiled", "inlined", "inner", "is_compiled"]

numba: Any = _numba  # its type hints leave out options

_Function = TypeVar("_Function", bound=Callable[..., object])
CACHE_VARIABLE = "CALIBRATOR_CACHE"
"""Environment variable that names a folder to use instead of the user's cache folder."""
SOURCES = (
    "calibrator/compiled.py",
    "calibrator/drives/align.py",
    "calibrator/drives/charge.py",
    "calibrator/drives/delays.py",
    "calibrator/estimator/posterior.py",
    "calibrator/estimator/prior.py",
    "calibrator/recordings/blf.py",
    "calibrator/recordings/decode.py",
    "calibrator/recordings/frame_arrays.py",
    "calibrator/recordings/text_logs.py",
    "calibrator/summaries/filter_bank.py",
    "calibrator/summaries/summariser.py",
    "ecu_node/summary.py",
)
"""Files whose functions or constants are compiled; a change in any of them starts a new cache folder, as numba itself
notices only changes in the file of the compiled function, not in files that it imports."""


def _cache_folder() -> Path | None:
    """Return the cache folder of this version of the source, made if missing; None if it cannot be made or written."""
    digest = hashlib.sha256()
    try:
        for source in SOURCES:
            digest.update((Path(__file__).parents[1] / source).read_bytes())
        usual = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "calibrator"
        folder = Path(os.environ.get(CACHE_VARIABLE) or usual) / f"compiled-{digest.hexdigest()[:16]}"
        folder.mkdir(parents=True, exist_ok=True)
    except (OSError, RuntimeError):  # no home folder, or none that can be written
        return None
    return folder if os.access(folder, os.W_OK) else None


_FOLDER = _cache_folder()


def compiled(function: _Function) -> _Function:
    """Compile a function that Python calls, at its first call; division by zero gives infinity, as in NumPy arrays."""
    if _FOLDER is None:
        return cast("_Function", _dispatcher(function))
    before, numba.config.CACHE_DIR = numba.config.CACHE_DIR, str(_FOLDER)  # only while this function is compiled
    try:
        return cast("_Function", _dispatcher(function, cache=True))
    finally:
        numba.config.CACHE_DIR = before


def inner(function: _Function) -> _Function:
    """Compile a function that only other compiled functions call."""
    return cast("_Function", _dispatcher(function, no_cpython_wrapper=True))


def inlined(function: _Function) -> _Function:
    """Compile a small function into its callers, as a call would take time to count references to its arrays."""
    return cast("_Function", _dispatcher(function, inline="always"))


def is_compiled(module: str) -> bool:
    """Check whether the cache has compiled functions of a module, given by the last part of its name: "posterior"."""
    return _FOLDER is not None and any(_FOLDER.rglob(f"{module}.*.nbi"))


def _dispatcher(function: Callable[..., object], **options: Any) -> Any:
    return numba.njit(error_model="numpy", no_cfunc_wrapper=True, **options)(function)
