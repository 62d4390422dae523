"""What the node reports about itself: codes (those of the DBC's value tables), counters, and latency."""

import time
from dataclasses import asdict, dataclass
from enum import IntEnum
from itertools import accumulate
from typing import Self

from ecu_node.errors import ParameterError

__all__ = ["Counters", "Latency", "Quality", "Reason", "State", "TrustError", "UnfitError"]


class _WithWords(IntEnum):
    """Enumeration of codes, each with a description in words."""

    words: str
    """What the code means, worded so that it fits into a sentence."""

    def __new__(cls, code: int, words: str = "") -> Self:
        member = int.__new__(cls, code)
        member._value_, member.words = code, words
        return member


class State(_WithWords):
    """What the node does with the branch currents."""

    STARTING = 0, "starting: waiting for the first frames of all branches"
    CORRECTING = 1, "correcting"
    PASSING_THROUGH = 2, "passing measured values through"
    SHADOW = 3, "shadow mode: computing, but passing measured values through"
    ASLEEP = 4, "asleep: no branch sends"
    PARTLY_CORRECTING = 5, "partly correcting: something of it cannot be corrected now"
    """The reason says why."""


class Reason(_WithWords):
    """Why the node does not correct, or not everything."""

    NONE = 0, "nothing keeps it from correcting"
    NO_PARAMETERS = 1, "there is no parameter file"
    MALFORMED_PARAMETERS = 2, "the parameter file cannot be read"
    WRONG_VEHICLE = 3, "the parameters are of another vehicle"
    WRONG_LAYOUT = 4, "the parameters are for another layout"
    WRONG_DBC = 5, "the parameters are for another DBC"
    IMPLAUSIBLE_PARAMETERS = 6, "the parameters are beyond the limits of the layout"
    BRANCH_STALE = 7, "a branch has sent nothing that can be used for longer than its timeout"
    CORRECTION_WORSE = 8, "the corrected Kirchhoff sum is worse than the measured one"
    BRANCH_STUCK = 9, "a branch never changes while the others do"
    INPUT_MISSING = (
        10,
        "a voltage, a branch's value or the state of the watch is missing; not everything is corrected, or judged",
    )
    NOT_SIGNED = 11, "the parameters are not what trusted signers have signed"
    NOT_VALID_NOW = 12, "the parameters have expired, or do not hold yet"
    REPLAYED = 13, "the parameters are older than what was accepted before"
    REVOKED = 14, "the parameters were revoked"
    ON_TRIAL = 15, "the parameters are on trial"
    SUM_IMPLAUSIBLE = 16, "the corrected Kirchhoff sum is not what it may be: a sensor is wrong"
    FOREIGN_FRAMES = 17, "another node sends frames that only this gateway may send; they are dropped"
    """This is only reported: the node goes on correcting."""
    E2E_INVALID = 18, "so many frames of a message fail their end-to-end check that it is not used"


class UnfitError(ParameterError):
    """Parameters that must not be applied here, with the reason as the node publishes it."""

    def __init__(self, reason: Reason, text: str) -> None:
        super().__init__(text)
        self.reason = reason

    def __reduce__(self) -> tuple[type["UnfitError"], tuple[Reason, str]]:
        """Let the error be pickled, so that it can be raised in another process."""
        return type(self), (self.reason, str(self))


class TrustError(UnfitError):
    """Parameters that cannot be trusted, because of their signature, expiry, order (a replay) or form."""


class Quality(IntEnum):
    """What kind of value stands in a corrected signal."""

    NOT_AVAILABLE = 0
    PASSED_THROUGH = 1
    CORRECTED = 2
    INVALID = 3
    IMPLAUSIBLE = 4
    """A measured value that is wrong by the Kirchhoff sum; a quality signal of only 2 bits shows INVALID instead."""


@dataclass(kw_only=True)
class Counters:
    """Counters of the core and of the loop around it."""

    frames_in: int = 0
    """Received frames that carry a branch, its voltage, or the input of [watch]."""
    answers: int = 0
    """Corrected messages that an overlay node made, including those with values passed through or not available."""
    rewritten: int = 0
    """Frames in which a gateway changed a measured current."""
    forwarded: int = 0
    """Frames that a gateway passed on, including those that it rewrote, but not those that the kernel carries."""
    returned: int = 0
    """Frames that a gateway passed on from the vehicle to the sensors' bus, but not those that the kernel carries."""
    not_returned: int = 0
    """Frames from the vehicle's bus that the sensors' bus did not take."""
    not_passed_on: int = 0
    """Frames of branches that failed their end-to-end check, so that a gateway stopped them."""
    corrupt: int = 0
    """Frames with a wrong CRC or an impossible counter."""
    repeated: int = 0
    """Frames with the same counter as the one before."""
    jumped: int = 0
    """Frames whose counter had advanced further than the layout allows."""
    gaps: int = 0
    """Times that the counter of a message showed that a few frames before were lost."""
    short: int = 0
    """Signals of branches for which their frame was too short: one frame may count for several branches."""
    late: int = 0
    """Frames of messages with branches that were too old when they were read; they were not used."""
    dropped: int = 0
    """Frames that the kernel dropped because they were not read in time."""
    saturated: int = 0
    """Corrected values beyond the ends of their signal; the end was sent instead."""
    foreign: int = 0
    """Frames that another node sent, though only this gateway may send them; they were dropped."""
    echoes: int = 0
    """Own frames that the node received again."""
    send_errors: int = 0
    """Frames that the bus did not take."""
    bus_errors: int = 0
    """Error frames of the bus."""
    bus_off: int = 0
    """Times that the controller went off the bus."""
    reopened: int = 0
    """Times that the bus was opened again."""
    clock_steps: int = 0
    """Times that the time of day jumped against the steady clock; time stamps of frames are ignored for a while."""
    telemetry_lost: int = 0
    """Lines of telemetry that could not be written, or not in time."""
    reloads: int = 0
    """Times that other parameters were put in force, or those in force ended."""

    def text(self) -> str:
        """Return one line for the log, with all counters that are not 0."""
        counted = ", ".join(f"{name.replace('_', ' ')} {value}" for name, value in asdict(self).items() if value)
        return counted or "no frames"


class Latency:
    """Histogram of the time from the arrival of a branch's frame until its answer was sent.

    All answers sent with one call count with the latency of the one that waited longest: that costs a fifth of what
    timing each of them would, and the latency counted is never too small.

    Attributes
    ----------
    counts : list of int
        Element n counts the frames whose latency in whole microseconds has n bits, so that it is below 2^n us.
    largest_s : float
        Largest latency. [s]
    came : callable
        Called with the time on the steady clock at which a frame came [s], before its answer is sent.
    """

    def __init__(self) -> None:
        self.counts = [0] * 48
        self.largest_s = 0.0
        self._waiting: list[float] = []
        self.came = self._waiting.append

    def sent(self, not_sent: int) -> None:
        """Count the frames that came since the last call, unless the bus did not take some of their answers."""
        waiting = self._waiting
        if waiting and not not_sent:
            self.add(time.monotonic() - waiting[0], len(waiting))
        waiting.clear()

    def add(self, latency_s: float, frames: int = 1) -> None:
        """Count frames of this latency. [s]"""
        self.counts[int(max(latency_s, 0.0) * 1e6).bit_length()] += frames
        self.largest_s = max(self.largest_s, latency_s)

    def at_most_s(self, share: float) -> float:
        """Return the latency that this share of the frames does not exceed; it may be up to twice the true one. [s]"""
        wanted = share * sum(self.counts)
        bits = next(n for n, below in enumerate(accumulate(self.counts)) if below >= wanted)
        return min(1e-6 * 2.0**bits, self.largest_s)

    def microseconds(self) -> dict[str, int]:
        """Return median, 99.9 % quantile and largest latency. [us]"""
        found_s = {"p50": self.at_most_s(0.5), "p99.9": self.at_most_s(0.999), "max": self.largest_s}
        return {name: round(1e6 * value_s) for name, value_s in found_s.items()}
