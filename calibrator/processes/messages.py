"""What becomes of a source that a worker process reads, in messages to its parent and in words."""

import signal
from dataclasses import dataclass

__all__ = ["REMEDY", "Begun", "Raised", "Unread", "died", "too_long"]

REMEDY = "remove the file if it is damaged, cut it if it is long"
"""What to do about a file that could not be read."""


@dataclass(frozen=True, kw_only=True)
class Unread:
    """A file that could not be read to its end.

    Attributes
    ----------
    reason : str
        What happened, and what to do; without the file's name.
    """

    reason: str


@dataclass(frozen=True, kw_only=True)
class Begun:
    """A worker has begun to read: from now on its time counts."""


@dataclass(frozen=True, kw_only=True)
class Raised:
    """What a reader raised."""

    error: BaseException


def too_long(limit_s: float) -> str:
    """What to say of a source that took longer. [s]"""
    return f"reading took more than {limit_s:g} s and was ended; {REMEDY}, or allow more with --time-limit"


def died(code: int | None) -> str:
    """What to say of a worker that died, by its exit code."""
    how = f"ended with code {code}"
    if code is not None and code < 0:
        how = f"was killed by {signal.Signals(-code).name}"
    return f"the process that read it {how}; {REMEDY}, or use fewer --workers if memory ran out"
