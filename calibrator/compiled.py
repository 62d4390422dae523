"""Compilation of numerical loops: what is written as plain Python runs as machine code.

A function so marked may use numbers, arrays, tuples and other such functions only.

Compilation of the estimator takes about half a minute. The result is kept in the user's cache folder, one folder per
state of source, Python, numba and processor. Of several processes that need it at once one compiles, and others wait.
"""

import fcntl
import hashlib
import multiprocessing
import os
import pickle
import platform
import shutil
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any, Generic, ParamSpec, TypeVar, cast

import llvmlite.binding
import numba as _numba

__all__ = ["compiled", "compiled_with_notice", "inlined", "inner"]

numba: Any = _numba  # its type hints leave out options and the compilation for given types

_Function = TypeVar("_Function", bound=Callable[..., object])
_Parameters = ParamSpec("_Parameters")
_Result = TypeVar("_Result")
CACHE_VARIABLE = "CALIBRATOR_CACHE"
"""Environment variable that names another folder than the user's cache folder."""
SOURCES = (
    "compiled.py",
    "drives/align.py",
    "drives/charge.py",
    "drives/delays.py",
    "estimator/posterior.py",
    "estimator/prior.py",
    "recordings/blf.py",
    "recordings/decode.py",
    "recordings/frame_arrays.py",
    "recordings/text_logs.py",
    "summaries/filter_bank.py",
    "summaries/summariser.py",
)
"""Files of this package whose functions or constants are compiled."""
KEPT = 4
"""Folders of compiled code that are kept, the last ones used: of other versions or installations."""
PREFIX = "compiled-"
"""Of the names of these folders: nothing else is removed."""


class compiled(Generic[_Parameters, _Result]):  # noqa: N801 (a decorator)
    """Compile a function that Python calls, when it is first called; division by zero gives infinity, as in arrays."""

    takes_long = False

    def __init__(self, function: Callable[_Parameters, _Result]) -> None:
        self._function = function
        self._ready: Callable[_Parameters, _Result] | None = None

    def __call__(self, *args: _Parameters.args, **kwargs: _Parameters.kwargs) -> _Result:
        """Call it."""
        if self._ready is None:
            self._ready = self._compile(tuple(numba.typeof(value) for value in args))
        return self._ready(*args, **kwargs)

    def _compile(self, types: tuple[Any, ...]) -> Callable[_Parameters, _Result]:
        """Machine code for arguments of these types, from the cache if it is there."""
        if numba.config.DISABLE_JIT:  # to debug what is compiled
            return self._function
        folder = _cache_folder()
        if folder is None:
            if self.takes_long:
                _say(f"in every run, as its cache cannot be written; {CACHE_VARIABLE} can name another folder")
            return _machine_code(self._function, types, None)
        with _alone(folder):
            os.utime(folder)
            if not any(folder.rglob(f"*.{self._function.__qualname__}-*.nbc")):
                _forget_others(folder)
                if self.takes_long:
                    _say("once")
            try:
                return _machine_code(self._function, types, folder)
            except (OSError, EOFError, pickle.UnpicklingError):  # the machine went down as it was written, say
                _clear(folder)
                return _machine_code(self._function, types, None)


class compiled_with_notice(compiled[_Parameters, _Result]):  # noqa: N801 (a decorator)
    """The same for the estimator, whose compilation takes so long that the user is told of it."""

    takes_long = True


def inner(function: _Function) -> _Function:
    """Compile a function that compiled functions alone call."""
    return cast("_Function", _dispatcher(function, no_cpython_wrapper=True))


def inlined(function: _Function) -> _Function:
    """Compile a function into its callers: for those with few callers, as each layer of calls is compiled anew."""
    return cast("_Function", _dispatcher(function, no_cpython_wrapper=True, inline="always"))


def _dispatcher(function: Callable[..., object], **options: Any) -> Any:
    return numba.njit(error_model="numpy", no_cfunc_wrapper=True, **options)(function)


def _machine_code(
    function: Callable[_Parameters, _Result], types: tuple[Any, ...], folder: Path | None
) -> Callable[_Parameters, _Result]:
    """A function as machine code: from the folder, or compiled and written there; None: only compiled."""
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
    if multiprocessing.current_process().name != "MainProcess":
        return
    print(f"calibrator: compiling the estimator (about half a minute, {when})", file=sys.stderr, flush=True)


@contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """While no other process does this with the same folder."""
    with (folder / "lock").open("w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX)
        except OSError:  # a file system without locks: each process compiles for itself
            yield
            return
        yield


def _clear(folder: Path) -> None:
    """Remove what is in a folder of compiled code, but for its lock."""
    for entry in folder.iterdir():
        if entry.is_dir():
            shutil.rmtree(entry, ignore_errors=True)


def _forget_others(folder: Path) -> None:
    """Remove the folders of compiled code that were not used for longest."""

    def last_use(other: Path) -> float:
        try:
            return other.stat().st_mtime
        except OSError:  # another process removed it
            return 0.0

    others = sorted(folder.parent.glob(f"{PREFIX}*"), key=last_use, reverse=True)
    for other in others[KEPT:]:
        shutil.rmtree(other, ignore_errors=True)


@cache
def _cache_folder() -> Path | None:
    """Folder of compiled code of this source, Python, numba and processor, made if missing; None if it cannot be."""
    try:
        usual = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "calibrator"
        folder = Path(os.environ.get(CACHE_VARIABLE) or usual) / f"{PREFIX}{_digest()}"
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "lock").touch()
    except (OSError, RuntimeError):  # no home folder, or none that can be written
        return None
    return folder if os.access(folder, os.W_OK) else None


def _digest() -> str:
    """What compiled code depends on, in 16 characters."""
    binding: Any = llvmlite.binding
    machine = (
        numba.config.CPU_NAME or binding.get_host_cpu_name(),
        numba.config.CPU_FEATURES or binding.get_host_cpu_features().flatten(),
    )
    versions = (platform.python_version(), numba.__version__, llvmlite.__version__)
    sources = sorted(path for pattern in SOURCES for path in Path(__file__).parent.glob(pattern))
    digest = hashlib.sha256("\n".join((*machine, *versions)).encode())
    for source in sources:
        digest.update(source.read_bytes())
    return digest.hexdigest()[:16]
