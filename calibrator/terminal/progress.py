"""Progress on stderr: a bar with rate and time left on a terminal, a line now and then elsewhere.

A command of several passes says of each which one it is. Nothing of all this goes to standard output.
"""

import math
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from itertools import count
from typing import TypeVar

from rich.console import Console
from rich.progress import BarColumn, Progress, ProgressColumn, Task, TextColumn
from rich.text import Text

__all__ = ["no_progress", "numbered_passes", "one_pass", "progress_bar", "rate_text", "shown"]

LINE_EVERY_S = 10.0
DRAWN_EVERY_S = 0.1
"""A bar is moved no more often: a step may have millions of units. [s]"""
WORTH_A_LINE_S = 1.0
"""A step that is done sooner is not told in a log. [s]"""
NARROW = 70
"""A terminal of fewer columns gets shorter figures. [1]"""
_Item = TypeVar("_Item")
_active: ContextVar[Progress | None] = ContextVar("active", default=None)
"""The bars on the terminal; a step within a step adds its own to them."""
_number: ContextVar[Callable[[], str]] = ContextVar("number", default=str)
"""What stands before the label of the next pass; nothing outside of numbered passes."""
_silent: ContextVar[bool] = ContextVar("silent", default=False)
"""Whether nothing is shown."""


@contextmanager
def no_progress() -> Iterator[None]:
    """Within the block no progress is shown, as in a library."""
    before = _silent.set(True)
    try:
        yield
    finally:
        _silent.reset(before)


@contextmanager
def numbered_passes(total: int) -> Iterator[None]:
    """Within the block every bar says which of so many passes it is: ``2/3 calibrate``."""
    numbers = count(1)
    before = _number.set(lambda: f"{next(numbers)}/{total} ")
    try:
        yield
    finally:
        _number.reset(before)


@contextmanager
def one_pass(number: int, total: int) -> Iterator[None]:
    """Within the block every bar belongs to the same pass; a single one has no number."""
    before = _number.set(lambda: f"{number}/{total} " if total > 1 else "")
    try:
        yield
    finally:
        _number.reset(before)


@contextmanager
def progress_bar(label: str, total: int | None, unit: str = "", *, begun: int = 0) -> Iterator[Callable[[float], None]]:
    """Show how far a long step is.

    Parameters
    ----------
    label : str
        What is being done.
    total : int or None
        How many units there are; None for a step of which nobody knows how long it is.
    unit : str
        What is counted, in the plural.
    begun : int
        Units that were done before, by a run that was stopped.

    Yields
    ------
    callable
        To be called with the number of units done.
    """
    if sys.stderr is None or _silent.get():  # closed by who started the program
        yield lambda _: None
        return
    label, console = f"{_number.get()()}{label}", Console(stderr=True)
    if console.is_terminal and not console.is_dumb_terminal:
        with _bars(console) as bars:
            yield _Bar(bars, label, total, unit, begun)
    elif total is None:
        print(label, file=sys.stderr, flush=True)
        yield lambda _: None
    else:
        yield _Lines(label, total, unit, begun)


@contextmanager
def _bars(console: Console) -> Iterator[Progress]:
    """The bars that are on the terminal, or new ones."""
    if (bars := _active.get()) is not None:
        yield bars
        return
    columns = (TextColumn("{task.description}"), BarColumn(bar_width=None), _Figures(console.width))
    with Progress(*columns, console=console, expand=True, redirect_stdout=False) as bars:
        before = _active.set(bars)
        try:
            yield bars
        finally:
            _active.reset(before)


class _Bar:
    """A bar on the terminal."""

    def __init__(self, bars: Progress, label: str, total: float | None, unit: str, begun: int) -> None:
        self._bars, self._total, self._moved_s = bars, total, -math.inf
        self._task = bars.add_task(label, total=total, completed=begun, unit=unit, begun=begun)

    def __call__(self, done: float) -> None:
        now_s = time.monotonic()
        if now_s - self._moved_s >= DRAWN_EVERY_S or done == self._total:
            self._moved_s = now_s
            self._bars.update(self._task, completed=done)


def shown(items: Iterable[_Item], label: str, total: int, unit: str) -> Iterator[_Item]:
    """Items as they come, with a bar that counts those that were dealt with; a single one needs no bar."""
    if total <= 1:
        yield from items
        return
    with progress_bar(label, total, unit) as progress:
        for done, item in enumerate(items, start=1):
            yield item
            progress(done)


def rate_text(per_s: float) -> str:
    """How fast it goes, in two to three digits: per second, per minute or per hour."""
    for factor, name in ((1.0, "s"), (60.0, "min"), (3600.0, "h")):
        rate = per_s * factor
        if rate >= 1.0 or name == "h":
            break
    return f"{rate:.0f}/{name}" if rate >= 10.0 else f"{rate:.1f}/{name}"


class _Figures(ProgressColumn):
    """How far, how fast and how long it goes on, at the end of the line of a bar."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self._is_narrow = width < NARROW

    def render(self, task: Task) -> Text:
        """Say it; a narrow terminal gets no unit and no rate."""
        elapsed_s = (task.finished_time if task.finished else task.elapsed) or 0.0
        if task.total is None:
            return Text(_clock(elapsed_s), no_wrap=True)
        per_s = (task.completed - task.fields["begun"]) / elapsed_s if elapsed_s else 0.0
        left = f", {_clock((task.total - task.completed) / per_s)} left" if per_s else ""
        rate = f", {rate_text(per_s)}" if per_s and not self._is_narrow else ""
        unit = "" if self._is_narrow else f" {task.fields['unit']}"
        return Text(f"{task.completed:.0f}/{task.total:.0f}{unit}{rate}{left}", no_wrap=True)


class _Lines:
    """A line now and then, for a log."""

    def __init__(self, label: str, total: int, unit: str, begun: int) -> None:
        self._label, self._total, self._unit, self._begun = label, total, unit, begun
        self._started_s = self._printed_s = time.monotonic()

    def __call__(self, done: float) -> None:
        now_s = time.monotonic()
        finished = done >= self._total
        since_s, due_s = (self._started_s, WORTH_A_LINE_S) if finished else (self._printed_s, LINE_EVERY_S)
        if self._printed_s == math.inf or now_s - since_s < due_s:  # nothing is said after the last line
            return
        self._printed_s = math.inf if finished else now_s
        elapsed_s = max(now_s - self._started_s, 1e-3)  # a millisecond: no step is shorter
        per_s = (done - self._begun) / elapsed_s
        left = f"{(self._total - done) / per_s:.0f} s left" if per_s > 0.0 else "time left unknown"
        print(
            f"{self._label}: {done:.0f} of {self._total} {self._unit}, {rate_text(per_s)}, {elapsed_s:.0f} s, {left}",
            file=sys.stderr,
            flush=True,
        )


def _clock(seconds: float) -> str:
    """Minutes and seconds, with hours where there are some."""
    minutes, s = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{s:02}" if hours else f"{minutes}:{s:02}"
