"""Standard output that may be closed, full, or read no more: what a program prints is written, or it says so.

What the interpreter still holds at its end it would try to write with a traceback, and without an exit code of its own.
"""

import os
import sys

from ecu_node.errors import UserError
from ecu_node.wrapping import fitted

__all__ = ["drop_output", "flush_output", "write_output", "write_text"]


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
    if sys.stdout is None:
        return
    try:
        sys.stdout.write(f"{text}\n")
    except BrokenPipeError:
        raise
    except OSError as error:
        raise _cannot_write(error) from None
    flush_output()


def flush_output() -> None:
    """See that all that was printed is written; raises as :func:`write_output` does."""
    if sys.stdout is None:
        return
    try:
        sys.stdout.flush()
    except BrokenPipeError:
        raise
    except OSError as error:
        raise _cannot_write(error) from None


def drop_output() -> None:
    """Forget what was printed and cannot be written, now and at the interpreter's end."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _cannot_write(error: OSError) -> UserError:
    drop_output()
    return UserError(f"standard output: cannot write the result: {error.strerror}; give it somewhere else to go")
