"""How a program starts, prints, fails and ends; shared by the node and the programs that build on it.

Results go to standard output, which may be closed, on a full disk, or without a reader; events go to standard error,
one line each. Errors of a user say what to do. Any other exception is a fault of the program itself: its line names the
place in the code, for a report.
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
    """Print a result, as JSON or as readable text; errors are those of :func:`write_output`."""
    if as_json:
        write_output(json.dumps(document, indent=2))
    else:
        write_output(text)


def write_output(text: str, end: str = "\n") -> bool:
    """Print a text, and make sure that it is written.

    Parameters
    ----------
    text : str
        Text to print; nothing happens if standard output is closed.
    end : str
        Text that is printed after it.

    Returns
    -------
    bool
        False if the reader of standard output has gone, as ``head`` does; all that is printed from then on is dropped.

    Raises
    ------
    UserError
        If it cannot be written, as on a full disk; the rest of it is dropped.
    """
    try:
        print(text, end=end, flush=True)
    except BrokenPipeError:
        drop_output()
        return False
    except OSError as error:
        drop_output()
        raise UserError(
            f"standard output: cannot write the result: {error.strerror}; give it somewhere else to go"
        ) from None
    return True


def flush_output() -> None:
    """Make sure that all printed text is written; errors are those of :func:`write_output`."""
    write_output("", end="")


def drop_output() -> None:
    """Discard printed text that cannot be written, so that the interpreter does not try again at its end."""
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
        Arguments without the program's name; what follows ``--`` is no option.

    Returns
    -------
    arguments : list of str
        The other arguments.
    debug : bool
        Whether ``--debug`` was among them.
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
        Error that ended it.
    debug : bool
        Whether the traceback is shown before the line.
    packages : sequence of str
        The program's own packages, in the folder that holds ``ecu_node``: a fault is reported with the last place in
        their code.

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
    with suppress(OSError):  # a full disk, or a reader that has gone
        if sys.stderr is not None:  # None if whoever started the program closed it
            print(printable(" ".join(text.splitlines())), file=sys.stderr, flush=True)


def _place(error: Exception, packages: Sequence[str]) -> str:
    """Return type and text of an error, and its last place in the program's own files."""
    own = tuple(f"{Path(__file__).resolve().parents[1] / name}{os.sep}" for name in packages)
    frames = [frame for frame in traceback.extract_tb(error.__traceback__) if frame.filename.startswith(own)]
    where = f" ({Path(frames[-1].filename).name}, line {frames[-1].lineno})" if frames else ""
    return f"{type(error).__name__}: {error}{where}"


class CommandParser(argparse.ArgumentParser):
    """Parser that reports wrong use in one line, and an error if its help cannot be written, unlike argparse.

    Parameters
    ----------
    done, failed : str
        What the exit codes 0 and 1 of the command mean; its help ends with them.
    **settings
        Other arguments of ``argparse.ArgumentParser``.
    """

    def __init__(self, *, done: str = "done", failed: str = "failed", **settings: Any) -> None:
        codes = f"Exit codes: 0 {done}, 1 {failed}, 2 wrong use, 70 internal error, 130 interrupted, 143 SIGTERM."
        super().__init__(epilog=f"{codes} {DEBUG_HINT}", **settings)

    def error(self, message: str) -> NoReturn:
        """Say what is wrong and where to find help, and end with exit code 2."""
        say_error(f"{self.prog}: {message}; see '{self.prog} --help'")
        self.exit(2)

    def _print_message(self, message: str, file: "SupportsWrite[str] | None" = None) -> None:  # noqa: ARG002  # standard output
        write_output(message.removesuffix("\n"))


def run_program(name: str, work: Callable[[list[str]], int], arguments: Sequence[str]) -> int:
    """Run a program; any error becomes one line on standard error; an output that nobody reads any more is none.

    Parameters
    ----------
    name : str
        Name of the program.
    work : callable
        Takes the arguments without ``--debug``, and returns the exit code; Ctrl-C in it ends the process with 130,
        unless it handles SIGINT itself.
    arguments : sequence of str
        Arguments without the program's name.

    Returns
    -------
    int
        Exit code: that of `work`, :data:`FAILED`, or :data:`INTERNAL_ERROR`.
    """
    others, debug = split_debug(arguments)
    if isinstance(sys.stdout, TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # file names may be no text, or not the terminal's
    try:
        with ending_at_interrupt(f"{name}: interrupted"):
            try:
                return work(others)
            finally:
                flush_output()
    except Exception as error:  # noqa: BLE001 (each is reported, and ends the program)
        return end_of(name, error, debug=debug)


INTERRUPTED = 130
"""Exit code that shells give to a program ended by SIGINT."""


@contextmanager
def ending_at_interrupt(message: str) -> Iterator[None]:
    """Within the block SIGINT ends the process with one line and :data:`INTERRUPTED`, unless it is ignored."""

    def end(number: int, frame: FrameType | None) -> None:  # noqa: ARG001
        with suppress(AttributeError, OSError):  # closed, or without a reader
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
    """Import python-can without letting it import asammdf; python-can then reads no MF4 files in this process.

    asammdf stays importable for others. Do nothing if either has been imported before.
    """
    if "can" in sys.modules or "asammdf" in sys.modules:
        return
    sys.modules["asammdf"] = None  # type: ignore[assignment]  # documented: makes its import fail
    try:
        import can  # noqa: F401, PLC0415
    finally:
        del sys.modules["asammdf"]
