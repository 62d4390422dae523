"""The recent past of a signal, in the last frames of its message. Times are those of one steady clock. [s]"""

from collections import deque
from collections.abc import Iterator

from ecu_node.bits import PlacedSignal

__all__ = ["REMEMBERED_FRAMES", "Frames", "Past"]

REMEMBERED_FRAMES = 1024
"""Frames of a message that are remembered: longer than branches lag each other."""

Frames = deque[tuple[float, bytearray]]
"""Times [s] and payloads of the last intact frames of a message."""


class Past:
    """A signal in the last frames of its message; read only when it is asked for.

    Parameters
    ----------
    signal : PlacedSignal, optional
        Where it stands.
    frames : deque
        Frames that the message's source goes on to add to.
    """

    def __init__(self, signal: PlacedSignal | None = None, frames: Frames | None = None) -> None:
        self._signal = signal
        self._frames: Frames = deque() if frames is None else frames

    def newest_first(self) -> Iterator[tuple[float, int]]:
        """Times and codes, back from the last frame that has the signal. [s]"""
        for time_s, payload in reversed(self._frames):
            code = self._signal.code(payload) if self._signal is not None else None
            if code is not None:
                yield time_s, code
