"""Progress on stderr: a bar with count and time left on a terminal, a line now and then elsewhere.

Where a command makes several passes, each bar says of which pass it is. Nothing of this goes to standard output.
"""

import math
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager
from contextvars import ContextVar
from typing import TypeVar

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Column

__all__ = ["no_progress", "one_pass", "progress_bar", "shown"]

LINE_EVERY_S = 10.0
WORTH_A_LINE_S = 1.0
"""A shorter step gets no line in a log. [s]"""
NARROW = 70
"""A terminal of fewer columns gets no units. [1]"""
_Item = TypeVar("_Item")
_active: ContextVar[Progress | None] = ContextVar("active", default=None)
"""The bars on the terminal; a step within a step adds its own to them."""
_number: ContextVar[Callable[[], str]] = ContextVar("number", default=str)
"""Function that gives the text before the label of the next bar, such as ``2/3``; empty outside of numbered passes."""
_silent: ContextVar[bool] = ContextVar("silent", default=False)
"""Whether nothing is shown."""


@contextmanager
def _within(variable: ContextVar[_Item], value: _Item) -> Iterator[None]:
    """Give a variable a value within the block."""
    before = variable.set(value)
    try:
        yield
    finally:
        variable.reset(before)


def no_progress() -> AbstractContextManager[None]:
    """Within the block no progress is shown, as in a library."""
    return _within(_silent, True)


def one_pass(number: int, total: int) -> AbstractContextManager[None]:
    """Within the block every bar begins with the number of the pass, as ``2/3 calibrate``; not if total is 1."""
    return _within(_number, lambda: f"{number}/{total} " if total > 1 else "")


@contextmanager
def progress_bar(label: str, total: int | None, unit: str = "") -> Iterator[Callable[[float], None]]:
    """Show how much of a long step is done.

    Parameters
    ----------
    label : str
        What the step does, such as ``calibrate``.
    total : int or None
        Number of units; None for a step of unknown length.
    unit : str
        Name of the units, in the plural.

    Yields
    ------
    callable
        Function to be called with the number of units done so far.
    """
    if sys.stderr is None or _silent.get():  # None: closed by whoever started the program
        yield lambda _: None
        return
    label, console = f"{_number.get()()}{label}", Console(stderr=True)
    if console.is_terminal and not console.is_dumb_terminal:
        with _bars(console) as bars:
            yield _moving(bars, label, total, unit)
    elif total is None:
        print(label, file=sys.stderr, flush=True)
        yield lambda _: None
    else:
        yield _writing(label, total, unit)


@contextmanager
def _bars(console: Console) -> Iterator[Progress]:
    """Yield the group of bars that is on the terminal, or else a new one."""
    if (bars := _active.get()) is not None:
        yield bars
        return
    columns = (
        TextColumn("{task.description}"),
        BarColumn(bar_width=None),
        TextColumn("{task.fields[count]}", table_column=Column(no_wrap=True)),
        TimeRemainingColumn(compact=True, elapsed_when_finished=True, table_column=Column(no_wrap=True)),
    )
    with Progress(*columns, console=console, expand=True, redirect_stdout=False) as bars, _within(_active, bars):
        yield bars


def _moving(bars: Progress, label: str, total: int | None, unit: str) -> Callable[[float], None]:
    """Add a bar to the terminal, without units if that is narrow; return the function that moves it."""
    unit = "" if bars.console.width < NARROW else f" {unit}"
    task = bars.add_task(label, total=total, count="")

    def move(done: float) -> None:
        bars.update(task, completed=done, count="" if total is None else f"{done:.0f}/{total}{unit}")

    return move


def shown(items: Iterable[_Item], label: str, total: int, unit: str) -> Iterator[_Item]:
    """Yield items as they come, and show a bar that counts those that are done; no bar for a single item."""
    if total <= 1:
        yield from items
        return
    with progress_bar(label, total, unit) as progress:
        for done, item in enumerate(items, start=1):
            yield item
            progress(done)


def _writing(label: str, total: int, unit: str) -> Callable[[float], None]:
    """Return a function that prints a line now and then, for a log."""
    started_s = printed_s = time.monotonic()

    def write(done: float) -> None:
        nonlocal printed_s
        now_s, finished = time.monotonic(), done >= total
        since_s, due_s = (started_s, WORTH_A_LINE_S) if finished else (printed_s, LINE_EVERY_S)
        if now_s - since_s < due_s or printed_s == math.inf:  # nothing is said after the last line
            return
        printed_s = math.inf if finished else now_s
        elapsed_s = now_s - started_s
        left = f"{elapsed_s * (total - done) / done:.0f} s left" if done > 0 else "time left unknown"
        print(f"{label}: {done:.0f} of {total} {unit}, {elapsed_s:.0f} s, {left}", file=sys.stderr, flush=True)

    return write
