"""How a program starts, prints, fails and ends, the same for the node and whoever builds on it.

Results go to standard output, which may be closed, full, or read no more; what happens goes to standard error, one line
each, which a terminal gets broken at words. Errors of a user say what to do. Any other exception is a fault of the
program itself: its line names the place, for a report.
"""

import argparse
import os
import signal
import sys
import textwrap
import traceback
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, NoReturn, TextIO

from ecu_node.errors import UserError, printable

if TYPE_CHECKING:
    from _typeshed import SupportsWrite

__all__ = [
    "DEBUG",
    "DEBUG_HELP",
    "DEBUG_HINT",
    "FAILED",
    "INTERNAL_ERROR",
    "INTERRUPTED",
    "CommandParser",
    "drop_output",
    "end_of",
    "ending_at_interrupt",
    "fitted",
    "flush_output",
    "ignoring_hangups",
    "load_python_can",
    "say_error",
    "split_debug",
    "wrapped",
    "write_output",
    "write_text",
]


_MORE_INDENT = 4
"""Columns by which what follows of a line stands farther right than its beginning."""
_NARROWEST = 20
"""Columns; a terminal that says it has fewer does not know, and breaks lines itself."""


def fitted(text: str, stream: TextIO | None) -> str:
    """A text as a stream is to get it.

    Parameters
    ----------
    text : str
        Lines.
    stream : file or None
        Where it goes.

    Returns
    -------
    str
        Broken at words where the stream is a terminal that is narrower; else as it is.
    """
    try:
        if stream is None or not stream.isatty():
            return text
        columns = int(os.environ.get("COLUMNS") or os.get_terminal_size(stream.fileno()).columns)
    except (OSError, ValueError):
        return text
    return wrapped(text, columns) if columns >= _NARROWEST else text


def wrapped(text: str, columns: int) -> str:
    """Lines of at most so many columns, broken at spaces; a word that is longer stays whole."""
    return "\n".join(_wrapped_line(line, columns) for line in text.split("\n"))


def _wrapped_line(line: str, columns: int) -> str:
    if len(line) <= columns:
        return line
    words = line.lstrip()
    indent = " " * (len(line) - len(words))
    return textwrap.fill(
        words,
        columns,
        initial_indent=indent,
        subsequent_indent=f"{indent}{' ' * _MORE_INDENT}",
        break_long_words=False,
        break_on_hyphens=False,
        expand_tabs=False,
        replace_whitespace=False,
    )


def write_text(text: str) -> None:
    """Print a text for people, which a terminal gets broken at words; errors as for :func:`write_output`."""
    write_output(fitted(text, sys.stdout))


def write_output(text: str) -> None:
    """Print a text with a line end as it is, and see that it is written.

    Parameters
    ----------
    text : str
        What to print; nothing happens where standard output is closed.

    Raises
    ------
    UserError
        If it cannot be written, as on a full disk; what is not written is dropped.
    BrokenPipeError
        If its reader has left.
    """
    _write(f"{text}\n")


def flush_output() -> None:
    """See that all that was printed is written; raises as :func:`write_output` does."""
    _write("")


def _write(text: str) -> None:
    if sys.stdout is None:
        return
    try:
        sys.stdout.write(text)
        sys.stdout.flush()
    except BrokenPipeError:
        raise
    except OSError as error:
        drop_output()
        raise UserError(
            f"standard output: cannot write the result: {error.strerror}; give it somewhere else to go"
        ) from None


def drop_output() -> None:
    """Forget what was printed and cannot be written, now and at the interpreter's end."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


FAILED = 1
INTERNAL_ERROR = 70
"""Exit code of a fault of the program itself, EX_SOFTWARE of sysexits.h."""
DEBUG = "--debug"
DEBUG_HELP = "show the traceback of an error; may stand anywhere"
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
    others = [argument for argument in arguments[:end] if argument != DEBUG]
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
            text = f"internal error: {_place(error, packages)}; run again with {DEBUG} and report it"
            code = INTERNAL_ERROR
    say_error(f"{program}: {text}")
    return code


def say_error(text: str) -> None:
    """Say something on standard error in one line, which a terminal gets broken at words."""
    if sys.stderr is not None:  # closed by who started the program
        print(fitted(printable(" ".join(text.splitlines())), sys.stderr), file=sys.stderr, flush=True)


def _place(error: Exception, packages: Sequence[str]) -> str:
    """Type and text of an error, and the last place in the program's own files."""
    own = tuple(f"{Path(__file__).resolve().parents[1] / name}{os.sep}" for name in packages)
    frames = [frame for frame in traceback.extract_tb(error.__traceback__) if frame.filename.startswith(own)]
    where = f" ({Path(frames[-1].filename).name}, line {frames[-1].lineno})" if frames else ""
    return f"{type(error).__name__}: {error}{where}"


class CommandParser(argparse.ArgumentParser):
    """Says wrong use in one line, and that help cannot be written, where argparse would end as if it were."""

    def error(self, message: str) -> NoReturn:
        """Say what is wrong, and where help is."""
        say_error(f"{self.prog}: {message}; see '{self.prog} --help'")
        self.exit(2)

    def _print_message(self, message: str, file: "SupportsWrite[str] | None" = None) -> None:
        if file is not None and file is sys.stdout:
            write_output(message.removesuffix("\n"))
        else:
            super()._print_message(message, file)


INTERRUPTED = 130
"""Exit code that shells give to a program ended by SIGINT."""


@contextmanager
def ending_at_interrupt(message: str) -> Iterator[None]:
    """Within the block SIGINT ends the process with one line and :data:`INTERRUPTED`, unless it is ignored."""

    def end(number: int, frame: FrameType | None) -> None:  # noqa: ARG001
        os.write(sys.stderr.fileno(), f"{message}\n".encode())
        os._exit(INTERRUPTED)

    before = signal.getsignal(signal.SIGINT)
    if before is signal.SIG_IGN:
        yield
        return
    signal.signal(signal.SIGINT, end)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


@contextmanager
def ignoring_hangups() -> Iterator[None]:
    """Within the block SIGHUP, which would end the process, does nothing until somebody else handles it."""
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGHUP, before)


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
