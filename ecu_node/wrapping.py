"""Long lines on a terminal are broken at words; into files and pipes every line goes as it is, for grep."""

import os
import textwrap
from typing import TextIO

__all__ = ["fitted", "wrapped"]

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
