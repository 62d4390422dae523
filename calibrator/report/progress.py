"""Progress on stderr: a bar with rate and time left on a terminal, a line now and then elsewhere."""

import math
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

__all__ = ["progress_bar"]

LINE_EVERY_S = 10.0


@contextmanager
def progress_bar(label: str, total: int, unit: str) -> Iterator[Callable[[int], None]]:
    """Show how far a long step is.

    Parameters
    ----------
    label : str
        What is being done.
    total : int
        How many units there are.
    unit : str
        What is counted, in the plural.

    Yields
    ------
    callable
        To be called with the number of units done.
    """
    console = Console(stderr=True)
    if console.is_terminal:
        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TextColumn(unit))
        with Progress(*columns, TimeElapsedColumn(), TimeRemainingColumn(), console=console) as bar:
            task = bar.add_task(label, total=total)
            yield lambda done: bar.update(task, completed=done)
        return
    started = time.monotonic()
    printed = started

    def report(done: int) -> None:
        nonlocal printed
        now = time.monotonic()
        finished = done >= total
        if printed < math.inf and (finished or now - printed >= LINE_EVERY_S):
            printed = math.inf if finished else now
            left_s = (now - started) / max(done, 1) * (total - done)
            print(f"{label}: {done} of {total} {unit}, {now - started:.0f} s, {left_s:.0f} s left", file=sys.stderr)

    yield report
