"""Telling the node's own frames that come back, as some adapters return them, from those of another node."""

from collections import deque
from collections.abc import Iterable

__all__ = ["OwnFrames"]

_REMEMBERED = 256
"""Frames of one identifier that may be on their way back."""


class OwnFrames:
    """What was sent lately, by identifier.

    Parameters
    ----------
    keys : iterable of tuple
        Identifiers, each with whether it has 29 bits, that nobody but this node may send on a bus.
    """

    def __init__(self, keys: Iterable[tuple[int, bool]]) -> None:
        self._sent: dict[tuple[int, bool], deque[bytes | bytearray]] = {key: deque(maxlen=_REMEMBERED) for key in keys}

    def sent(self, key: tuple[int, bool], data: bytes | bytearray) -> None:
        """Remember a frame that is sent."""
        self._sent[key].append(data)

    def is_foreign(self, key: tuple[int, bool], data: bytes | bytearray) -> bool:
        """Whether another node must have sent this frame; one that was sent from here may come back once."""
        try:
            self._sent[key].remove(data)
        except ValueError:
            return True
        return False

    def __contains__(self, key: tuple[int, bool]) -> bool:
        return key in self._sent
