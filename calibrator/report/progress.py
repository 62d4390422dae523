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
from rich.progress import Progress, ProgressColumn, Task
from rich.text import Text

__all__ = ["bar_line", "numbered_passes", "progress_bar", "rate_text", "shown"]

LINE_EVERY_S = 10.0
LEAST_BAR = 6
"""A bar that is shorter than this many characters tells nothing, and is left out. [1]"""
_Item = TypeVar("_Item")
_number: ContextVar[Callable[[], str]] = ContextVar("number", default=str)
"""What stands before the label of the next pass; nothing outside of numbered passes."""


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
def progress_bar(label: str, total: int | None, unit: str = "") -> Iterator[Callable[[float], None]]:
    """Show how far a long step is.

    Parameters
    ----------
    label : str
        What is being done.
    total : int or None
        How many units there are; None for a step of which nobody knows how long it is.
    unit : str
        What is counted, in the plural.

    Yields
    ------
    callable
        To be called with the number of units done.
    """
    label, console = f"{_number.get()()}{label}", Console(stderr=True)
    if console.is_terminal and not console.is_dumb_terminal:
        with Progress(_Line(unit, console), console=console, redirect_stdout=False) as bar:
            task = bar.add_task(label, total=total)
            yield lambda done: bar.update(task, completed=done)
    elif total is None:
        print(label, file=sys.stderr, flush=True)
        yield lambda done: None  # noqa: ARG005
    else:
        yield _Lines(label, total, unit)


def shown(items: Iterable[_Item], label: str, total: int, unit: str) -> Iterator[_Item]:
    """Items as they come, with a bar that counts those that were taken and dealt with; see :func:`progress_bar`."""
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


def bar_line(
    label: str,
    done: float,
    total: float | None,
    unit: str,
    *,
    per_s: float | None,
    elapsed_s: float,
    width: int,
    strokes: str = "━╌",
) -> str:
    """One line of progress that fits a terminal.

    Parameters
    ----------
    label, unit : str
        What is done, and what is counted.
    done, total : float
        How far it is; a total of None is not known.
    per_s : float or None
        Rate, if it is known yet. [1/s]
    elapsed_s : float
        Time since the beginning. [s]
    width : int
        Columns of the terminal; what has no room is left out, the bar first, and the unit.
    strokes : str
        Characters of what is done and of what is to come.

    Returns
    -------
    str
        At most `width` characters.
    """
    elapsed = _clock(elapsed_s)
    if total is None:
        return f"{label}, {elapsed}"[:width]
    counted = f"{done:.0f}/{total:.0f}"
    rate = "" if not per_s else f", {rate_text(per_s)}"
    left = ", -:-- left" if not per_s else f", {_clock((total - done) / per_s)} left"
    shortest = f"{label} {counted}{left}"
    forms = [f"{counted} {unit}{rate}, {elapsed}{left}", f"{counted}{rate}, {elapsed}{left}", f"{counted}{rate}{left}"]
    figures = next((form for form in forms if len(label) + 1 + len(form) <= width), None)
    if figures is None:
        return shortest[:width]
    room = width - len(label) - len(figures) - 2
    if room < LEAST_BAR:
        return f"{label} {figures}"
    full = round(room * min(done / total, 1.0)) if total else room
    return f"{label} {strokes[0] * full}{strokes[1] * (room - full)} {figures}"


class _Line(ProgressColumn):
    """The whole line of a bar."""

    def __init__(self, unit: str, console: Console) -> None:
        super().__init__()
        self._unit, self._console = unit, console
        self._strokes = "━╌" if console.encoding.startswith("utf") else "#."

    def render(self, task: Task) -> Text:
        """Draw the line as long as the terminal is wide."""
        text = bar_line(
            task.description,
            task.completed,
            task.total,
            self._unit,
            per_s=task.finished_speed or task.speed,
            elapsed_s=(task.finished_time if task.finished else task.elapsed) or 0.0,
            width=self._console.width - 1,
            strokes=self._strokes,
        )
        line = Text(text, no_wrap=True)
        line.highlight_regex(f"[{self._strokes[0]}]+", "green" if task.finished else "cyan")
        return line


class _Lines:
    """A line now and then, for a log."""

    def __init__(self, label: str, total: int, unit: str) -> None:
        self._label, self._total, self._unit = label, total, unit
        self._started_s = self._printed_s = time.monotonic()

    def __call__(self, done: float) -> None:
        now_s = time.monotonic()
        finished = done >= self._total
        if self._printed_s == math.inf or not (finished or now_s - self._printed_s >= LINE_EVERY_S):
            return
        self._printed_s = math.inf if finished else now_s
        elapsed_s = max(now_s - self._started_s, 1e-3)  # a millisecond: no step is shorter
        left_s = elapsed_s / max(done, 1) * (self._total - done)
        print(
            f"{self._label}: {done:.0f} of {self._total} {self._unit}, {rate_text(done / elapsed_s)}, "
            f"{elapsed_s:.0f} s, {left_s:.0f} s left",
            file=sys.stderr,
            flush=True,
        )


def _clock(seconds: float) -> str:
    """Minutes and seconds, with hours where there are some."""
    minutes, s = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{s:02}" if hours else f"{minutes}:{s:02}"
