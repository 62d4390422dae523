"""Compilation of numerical loops: what is written as plain Python runs as machine code.

A function so marked may use numbers, arrays, tuples and other such functions only.

Compilation of the estimator takes about half a minute. Numba keeps the result in the user's cache folder, one folder
per state of source, Python, numba and processor. Of several processes that need it at once one compiles, and others
wait.
"""

import fcntl
import hashlib
import multiprocessing
import os
import pickle
import shutil
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache, wraps
from pathlib import Path
from typing import Any, ParamSpec, TypeVar, cast

import numba as _numba
from numba.core.registry import cpu_target

__all__ = ["compiled", "compiled_with_notice", "inner"]

numba: Any = _numba  # its type hints leave out options and the compilation for given types

_Function = TypeVar("_Function", bound=Callable[..., object])
_Parameters = ParamSpec("_Parameters")
_Result = TypeVar("_Result")
CACHE_VARIABLE = "CALIBRATOR_CACHE"
"""Environment variable that names another folder than the user's cache folder."""
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
"""Files whose functions or constants are compiled."""
KEPT = 4
"""Folders of compiled code that are kept, the last ones used: of other versions or installations."""
PREFIX = "compiled-"
"""Of the names of these folders: nothing else is removed."""


def compiled(function: Callable[_Parameters, _Result]) -> Callable[_Parameters, _Result]:
    """Compile a function that Python calls, when it is first called; division by zero gives infinity, as in arrays."""
    return _compiled_at_first_call(function, takes_long=False)


def compiled_with_notice(function: Callable[_Parameters, _Result]) -> Callable[_Parameters, _Result]:
    """The same for the estimator, whose compilation takes so long that the user is told of it."""
    return _compiled_at_first_call(function, takes_long=True)


def inner(function: _Function) -> _Function:
    """Compile a function that compiled functions alone call."""
    return cast("_Function", _dispatcher(function, no_cpython_wrapper=True))


def _dispatcher(function: Callable[..., object], **options: Any) -> Any:
    return numba.njit(error_model="numpy", no_cfunc_wrapper=True, **options)(function)


def _compiled_at_first_call(
    function: Callable[_Parameters, _Result], *, takes_long: bool
) -> Callable[_Parameters, _Result]:
    ready: Callable[_Parameters, _Result] | None = None

    @wraps(function)
    def call(*args: _Parameters.args, **kwargs: _Parameters.kwargs) -> _Result:
        nonlocal ready
        if ready is None:
            types = tuple(numba.typeof(value) for value in args)
            # to debug what is compiled, numba can be told to leave it as it is
            ready = function if numba.config.DISABLE_JIT else _machine_code(function, types, takes_long=takes_long)
        return ready(*args, **kwargs)

    return call


def _machine_code(
    function: Callable[_Parameters, _Result], types: tuple[Any, ...], *, takes_long: bool
) -> Callable[_Parameters, _Result]:
    """Machine code for arguments of these types, from the cache if it is there."""
    folder = _cache_folder()
    if folder is None:
        if takes_long:
            _say(f"in every run, as its cache cannot be written; {CACHE_VARIABLE} can name another folder")
        return _compile(function, types, None)
    with _alone(folder):
        os.utime(folder)
        if not any(folder.rglob(f"*.{function.__qualname__}-*.nbc")):
            _forget_others(folder)
            if takes_long:
                _say("once")
        try:
            return _compile(function, types, folder)
        except (OSError, EOFError, pickle.UnpicklingError):  # the machine went down as it was written, say
            for file in folder.rglob("*.nb[ci]"):
                file.unlink(missing_ok=True)
            return _compile(function, types, None)


@contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """While no other process does this with the same folder."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        with suppress(OSError):  # a file system without locks: each process compiles for itself
            fcntl.flock(handle, fcntl.LOCK_EX)
        yield
    finally:
        os.close(handle)


def _compile(
    function: Callable[_Parameters, _Result], types: tuple[Any, ...], folder: Path | None
) -> Callable[_Parameters, _Result]:
    """Load a function from the folder, or compile it and write it there; None: only compile it."""
    before, numba.config.CACHE_DIR = numba.config.CACHE_DIR, str(folder or "")
    try:
        dispatcher = _dispatcher(function, cache=folder is not None)
    finally:
        numba.config.CACHE_DIR = before
    dispatcher.compile(types)
    return cast("Callable[_Parameters, _Result]", dispatcher)


@cache
def _say(when: str) -> None:
    """Tell the user what takes time; once, and workers say nothing, which would tear the bar of who started them."""
    if multiprocessing.current_process().name == "MainProcess":
        print(f"calibrator: compiling the estimator (about half a minute, {when})", file=sys.stderr, flush=True)


def _forget_others(folder: Path) -> None:
    """Remove the folders of compiled code that were not used for longest."""
    with suppress(FileNotFoundError):  # another process removed one
        for old in sorted(folder.parent.glob(f"{PREFIX}*"), key=os.path.getmtime)[:-KEPT]:
            shutil.rmtree(old, ignore_errors=True)


@cache
def _cache_folder() -> Path | None:
    """Folder of compiled code of this source, Python, numba and processor, made if missing; None if it cannot be."""
    digest = hashlib.sha256(f"{sys.version} {numba.__version__}".encode())
    digest.update(str(cpu_target.target_context.codegen().magic_tuple()).encode())
    try:
        for source in SOURCES:
            digest.update((Path(__file__).parents[1] / source).read_bytes())
        usual = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "calibrator"
        folder = Path(os.environ.get(CACHE_VARIABLE) or usual) / f"{PREFIX}{digest.hexdigest()[:16]}"
        folder.mkdir(parents=True, exist_ok=True)
    except (OSError, RuntimeError):  # no home folder, or none that can be written
        return None
    return folder if os.access(folder, os.W_OK) else None
