"""How a program ends that failed: one line on standard error, an exit code, and with ``--debug`` the traceback before.

Errors of a user say what to do. Any other exception is a fault of the program itself: its line names the place, for a
report.
"""

import os
import sys
import traceback
from collections.abc import Sequence
from pathlib import Path

from ecu_node.errors import UserError, printable
from ecu_node.wrapping import fitted

__all__ = [
    "DEBUG",
    "DEBUG_HELP",
    "DEBUG_HINT",
    "FAILED",
    "INTERNAL_ERROR",
    "end_of",
    "one_line",
    "say_error",
    "split_debug",
]

FAILED = 1
INTERNAL_ERROR = 70
"""Exit code of a fault of the program itself, EX_SOFTWARE of sysexits.h."""
DEBUG = "--debug"
DEBUG_HELP = "show the traceback of an error; may stand anywhere"
DEBUG_HINT = "--debug shows the traceback of an error."
_OWN = tuple(f"{Path(__file__).resolve().parents[1] / name}{os.sep}" for name in ("calibrator", "ecu_node", "tools"))
_REMEDY = "see that it is there, may be used by you, and that its disk has room"


def split_debug(arguments: Sequence[str]) -> tuple[list[str], bool]:
    """Take ``--debug`` out of a command line.

    Parameters
    ----------
    arguments : sequence of str
        Without the program's name; what stands behind ``--`` is no option.

    Returns
    -------
    arguments : list of str
        The others.
    debug : bool
        Whether it was there.
    """
    end = arguments.index("--") if "--" in arguments else len(arguments)
    others = [argument for argument in arguments[:end] if argument != DEBUG]
    return [*others, *arguments[end:]], len(others) < end


def end_of(program: str, error: Exception, *, debug: bool) -> int:
    """Say on standard error why a program ends.

    Parameters
    ----------
    program : str
        Its name.
    error : Exception
        What ended it.
    debug : bool
        Whether the traceback is shown before the line.

    Returns
    -------
    int
        Exit code: :data:`FAILED`, or :data:`INTERNAL_ERROR` for a fault of the program itself.
    """
    if debug:
        traceback.print_exception(error)
    known = _known(error)
    text = f"internal error: {_place(error)}; run again with {DEBUG} and report it" if known is None else known
    say_error(f"{program}: {text}")
    return INTERNAL_ERROR if known is None else FAILED


def one_line(text: str) -> str:
    """A text without line ends."""
    return " ".join(text.splitlines())


def say_error(text: str) -> None:
    """Say something on standard error in one line, which a terminal gets broken at words."""
    if sys.stderr is not None:  # closed by who started the program
        print(fitted(printable(one_line(text)), sys.stderr), file=sys.stderr, flush=True)


def _known(error: Exception) -> str | None:
    """What to say of an error that is no fault of the program; else None."""
    match error:
        case UserError():
            return str(error)
        case MemoryError():
            return "there is not enough memory; give it less at a time, or fewer --workers where there are some"
        case OSError():
            return f"{error.filename or 'file or standard output'}: {error.strerror or error}; {_REMEDY}"
    return None


def _place(error: Exception) -> str:
    """Type and text of an error, and the last place in this program's own files."""
    frames = [frame for frame in traceback.extract_tb(error.__traceback__) if frame.filename.startswith(_OWN)]
    where = f" ({Path(frames[-1].filename).name}, line {frames[-1].lineno})" if frames else ""
    return f"{type(error).__name__}: {error}{where}"
