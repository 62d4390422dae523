"""Time of a log: increasing, and without the jumps of a clock that was set while recording.

Frames of several buses may be logged slightly out of order: they are sorted. A larger step back, or a step forward
longer than any pause within a drive, is the clock's: the recording goes on after a gap of fixed length, so that nothing
is interpolated across it and a wrong date cannot make a drive of years.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibrator.drive import Array

__all__ = ["CLOCK_GAP_S", "LogTime", "repaired_time"]

LARGEST_DISORDER_S = 1.0
"""Buffers of loggers are emptied more often than this. [s]"""
LONGEST_PAUSE_S = 600.0
"""A bus that is silent for longer has been asleep; what follows counts as after a gap. [s]"""
CLOCK_GAP_S = 60.0
"""Length of the gap that replaces a clock step; longer than all time-outs of usual layouts. [s]"""


@dataclass(frozen=True, kw_only=True)
class LogTime:
    """Time of the frames of one log.

    Attributes
    ----------
    order : ndarray of int64, shape (n,)
        Order in which the frames are to be taken.
    time_s : ndarray of shape (n,)
        Time since the first frame, in that order, not decreasing. [s]
    disordered : int
        Frames that were logged before an earlier one.
    clock_steps : int
        Steps of the clock that were replaced by a gap of :data:`CLOCK_GAP_S`.
    """

    order: NDArray[np.int64]
    time_s: Array
    disordered: int
    clock_steps: int


def repaired_time(time_ns: NDArray[np.int64]) -> LogTime:
    """Put time stamps into order.

    Parameters
    ----------
    time_ns : ndarray of int64, shape (n,)
        Time stamps in the order of the file, n > 0. [ns]

    Returns
    -------
    LogTime
        Order, time since the first frame, and what was repaired.
    """
    elapsed = (time_ns - time_ns[0]) * 1e-9
    step = np.diff(elapsed)
    jump = (step < -LARGEST_DISORDER_S) | (step > LONGEST_PAUSE_S)
    if jump.any():
        shift = np.concatenate([[0.0], np.cumsum(np.where(jump, CLOCK_GAP_S - step, 0.0))])
        elapsed = elapsed + shift
    order = np.argsort(elapsed, kind="stable")
    ordered = elapsed[order]
    return LogTime(
        order=order,
        time_s=ordered - ordered[0],
        disordered=int(np.sum(elapsed < np.maximum.accumulate(elapsed))),
        clock_steps=int(jump.sum()),
    )
