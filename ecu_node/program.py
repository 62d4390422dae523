"""How a program starts, prints, fails and ends, the same for the node and whoever builds on it.

Results go to standard output, which may be closed, full, or read no more; what happens goes to standard error, one line
each. Errors of a user say what to do. Any other exception is a fault of the
program itself: its line names the place, for a report.
"""

import argparse
import json
import os
import signal
import sys
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from io import TextIOWrapper
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any, NoReturn

from ecu_node.errors import UserError, printable

if TYPE_CHECKING:
    from _typeshed import SupportsWrite


def write_result(document: Any, text: str, *, as_json: bool) -> None:
    """Print what was found: as JSON, or as a text for people; errors as for :func:`write_output`."""
    if as_json:
        write_output(json.dumps(document, indent=2))
    else:
        write_output(text)


def write_output(text: str, end: str = "\n") -> None:
    """Print a text as it is, and see that it is written.

    Parameters
    ----------
    text : str
        What to print; nothing happens where standard output is closed.
    end : str
        What stands behind it.

    Raises
    ------
    UserError
        If it cannot be written, as on a full disk; what is not written is dropped.
    BrokenPipeError
        If its reader has left.
    """
    try:
        print(text, end=end, flush=True)
    except BrokenPipeError:
        raise
    except OSError as error:
        drop_output()
        raise UserError(
            f"standard output: cannot write the result: {error.strerror}; give it somewhere else to go"
        ) from None


def flush_output() -> None:
    """See that all that was printed is written; raises as :func:`write_output` does."""
    write_output("", end="")


def drop_output() -> None:
    """Forget what was printed and cannot be written, now and at the interpreter's end."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


FAILED = 1
INTERNAL_ERROR = 70
"""Exit code of a fault of the program itself, EX_SOFTWARE of sysexits.h."""
_DEBUG = "--debug"
DEBUG_HINT = "--debug shows the traceback of an error."
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
    others = [argument for argument in arguments[:end] if argument != _DEBUG]
    return [*others, *arguments[end:]], len(others) < end


def end_of(program: str, error: Exception, *, debug: bool, packages: Sequence[str] = ("ecu_node",)) -> int:
    """Say on standard error why a program ends.

    Parameters
    ----------
    program : str
        Its name.
    error : Exception
        What ended it.
    debug : bool
        Whether the traceback is shown before the line.
    packages : sequence of str
        The program's own, side by side with this one: a fault is reported with the last place in them.

    Returns
    -------
    int
        Exit code: :data:`FAILED`, or :data:`INTERNAL_ERROR` for a fault of the program itself.
    """
    if debug:
        traceback.print_exception(error)
    match error:
        case UserError():
            text, code = str(error), FAILED
        case MemoryError():
            text, code = "there is not enough memory; give it less at a time", FAILED
        case OSError():
            where = error.filename or "file or standard output"
            text, code = f"{where}: {error.strerror or error}; {_REMEDY}", FAILED
        case _:
            text = f"internal error: {_place(error, packages)}; run again with {_DEBUG} and report it"
            code = INTERNAL_ERROR
    say_error(f"{program}: {text}")
    return code


def say_error(text: str) -> None:
    """Say something on standard error in one line."""
    with suppress(OSError):  # a disk that is full, or a reader that has left
        if sys.stderr is not None:  # closed by who started the program
            print(printable(" ".join(text.splitlines())), file=sys.stderr, flush=True)


def _place(error: Exception, packages: Sequence[str]) -> str:
    """Type and text of an error, and the last place in the program's own files."""
    own = tuple(f"{Path(__file__).resolve().parents[1] / name}{os.sep}" for name in packages)
    frames = [frame for frame in traceback.extract_tb(error.__traceback__) if frame.filename.startswith(own)]
    where = f" ({Path(frames[-1].filename).name}, line {frames[-1].lineno})" if frames else ""
    return f"{type(error).__name__}: {error}{where}"


class CommandParser(argparse.ArgumentParser):
    """Says wrong use in one line, and that help cannot be written, where argparse would end as if it were.

    Parameters
    ----------
    done, failed : str
        What the exit codes 0 and 1 of the command mean; its help ends with them.
    **settings
        Of ``argparse.ArgumentParser``.
    """

    def __init__(self, *, done: str = "done", failed: str = "failed", **settings: Any) -> None:
        codes = f"Exit codes: 0 {done}, 1 {failed}, 2 wrong use, 70 internal error, 130 interrupted."
        super().__init__(epilog=f"{codes} {DEBUG_HINT}", **settings)

    def error(self, message: str) -> NoReturn:
        """Say what is wrong, and where help is."""
        say_error(f"{self.prog}: {message}; see '{self.prog} --help'")
        self.exit(2)

    def _print_message(self, message: str, file: "SupportsWrite[str] | None" = None) -> None:  # noqa: ARG002  # standard output
        write_output(message.removesuffix("\n"))


def run_program(name: str, work: Callable[[list[str]], int], arguments: Sequence[str]) -> int:
    """Run a program; any error is one line on standard error, but a closed output pipe, which is silent.

    Parameters
    ----------
    name : str
        Of the program.
    work : callable
        Takes the arguments less ``--debug``, and returns the exit code; Ctrl-C in it ends the process with 130, until
        it handles SIGINT itself.
    arguments : sequence of str
        Without the program's name.

    Returns
    -------
    int
        Exit code: that of `work`, :data:`FAILED`, or :data:`INTERNAL_ERROR`.
    """
    others, debug = split_debug(arguments)
    if isinstance(sys.stdout, TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # names of files may be no text, or not that of the terminal
    try:
        with ending_at_interrupt(f"{name}: interrupted"):
            try:
                return work(others)
            finally:
                flush_output()
    except BrokenPipeError:
        drop_output()
        return FAILED
    except Exception as error:  # noqa: BLE001 (each is told, and ends the program)
        return end_of(name, error, debug=debug)


INTERRUPTED = 130
"""Exit code that shells give to a program ended by SIGINT."""


@contextmanager
def ending_at_interrupt(message: str) -> Iterator[None]:
    """Within the block SIGINT ends the process with one line and :data:`INTERRUPTED`, unless it is ignored."""

    def end(number: int, frame: FrameType | None) -> None:  # noqa: ARG001
        with suppress(AttributeError, OSError):  # closed, or taken by nobody
            os.write(sys.stderr.fileno(), f"{message}\n".encode())
        os._exit(INTERRUPTED)

    before = signal.getsignal(signal.SIGINT)
    if before is not signal.SIG_IGN:
        signal.signal(signal.SIGINT, end)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def load_python_can() -> None:
    """Import python-can without asammdf, which stays importable; for programs, as python-can then reads no MF4.

    Does nothing where one of both has been imported before.
    """
    if "can" in sys.modules or "asammdf" in sys.modules:
        return
    sys.modules["asammdf"] = None  # type: ignore[assignment]  # documented: makes its import fail
    try:
        import can  # noqa: F401, PLC0415
    finally:
        del sys.modules["asammdf"]
