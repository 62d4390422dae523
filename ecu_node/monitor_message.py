"""One message as ``ecu-node monitor`` hears it. Times are those of one steady clock. [s]"""

from collections import deque
from collections.abc import Sequence
from heapq import merge

from cantools.database.can import Message

from ecu_node.bits import PlacedSignal
from ecu_node.database import VehicleDatabase
from ecu_node.e2e import Check, Receiver
from ecu_node.e2e_profiles import protection_of
from ecu_node.monitor_view import FrameFaults
from ecu_node.past import REMEMBERED_FRAMES, Frames

__all__ = ["HeardMessage", "answers_when_asked"]

_RATE_WINDOW_S = 2.0
"""Frame rates are means over about this long. [s]"""


class HeardMessage:
    """Its frames, whether they are intact, and how many come.

    Parameters
    ----------
    database : VehicleDatabase
        Layout and DBC.
    message : Message
        A message of the DBC.
    start_s : float
        Now; the rate counts from here. [s]

    Attributes
    ----------
    rate_hz : float
        Of its frames, intact or not, as of the last :meth:`count_rate`. [1/s]
    frames : deque
        Times [s] and payloads of the last intact frames.

    Raises
    ------
    LayoutError
        If the message cannot carry its protection.
    """

    def __init__(self, database: VehicleDatabase, message: Message, start_s: float) -> None:
        protection = protection_of(database, message)
        self._check = Receiver(protection).check if protection is not None else None
        self._found = dict.fromkeys(Check, 0)
        self._count = 0
        self._counts: deque[tuple[float, int]] = deque([(start_s, 0)])
        self.rate_hz = 0.0
        self.frames: Frames = deque(maxlen=REMEMBERED_FRAMES)

    def take(self, payload: bytearray, time_s: float) -> None:
        """Take a frame; like the node, use it only if it is intact, new, and not after a jump of its counter."""
        self._count += 1
        if self._check is not None and (found := self._check(payload)) is not Check.OK:
            self._found[found] += 1
            if found is not Check.LOST:
                return
        self.frames.append((time_s, payload))

    def count_rate(self, now_s: float) -> None:
        """Work out the frame rate."""
        counts = self._counts
        while len(counts) > 1 and counts[1][0] <= now_s - _RATE_WINDOW_S:
            counts.popleft()
        since_s, before = counts[0]
        self.rate_hz = (self._count - before) / (now_s - since_s) if now_s > since_s else 0.0
        counts.append((now_s, self._count))

    @property
    def faults(self) -> FrameFaults:
        """Frames that failed their check."""
        found = self._found
        return FrameFaults(
            corrupt=found[Check.CORRUPT],
            repeated=found[Check.REPEATED],
            lost=found[Check.LOST] + found[Check.JUMPED],
        )


def answers_when_asked(asked: Frames, others: Sequence[Frames], signal: PlacedSignal, answers: Frames) -> Frames:
    """Answers of the node, at the times of the frames that they answer.

    Parameters
    ----------
    asked : deque
        Times [s] and payloads of a branch's frames.
    others : sequence of deque
        The same of other messages that the same corrected message answers.
    signal : PlacedSignal
        Its current in them.
    answers : deque
        Times [s] and payloads of its corrected messages.

    Returns
    -------
    deque
        Each answer at the time of the newest frame before it that no later answer has; a node that was held up answers
        several frames at once. Answers to frames without the current repeat what was said before, and are left out.
    """
    found: Frames = deque()
    own = ((time_s, payload) for time_s, payload in reversed(asked))
    sources = [own, *(((time_s, None) for time_s, _ in reversed(frames)) for frames in others)]
    newest_first = merge(*sources, key=lambda frame: -frame[0])
    for answer_s, answer in reversed(answers):
        frame = next((frame for frame in newest_first if frame[0] <= answer_s), None)
        if frame is None:
            break
        asked_s, payload = frame
        if payload is not None and signal.code(payload) is not None:
            found.appendleft((asked_s, answer))
    return found
