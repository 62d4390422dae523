"""What the node tells of itself: codes, which are those of the DBC's value tables, counts, and latency."""

import time
from dataclasses import asdict, dataclass
from enum import IntEnum
from itertools import accumulate
from typing import Self

from ecu_node.errors import ParameterError

__all__ = ["Counters", "Latency", "Quality", "Reason", "State", "TrustError", "UnfitError"]


class _WithWords(IntEnum):
    """Codes, each with words for people."""

    words: str
    """What it means, within a sentence."""

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
    """Nothing is held back for it."""
    E2E_INVALID = 18, "so many frames of a message fail their end-to-end check that it is not used"


class UnfitError(ParameterError):
    """Parameters that must not be applied here, with the reason as the node publishes it."""

    def __init__(self, reason: Reason, text: str) -> None:
        super().__init__(text)
        self.reason = reason

    def __reduce__(self) -> tuple[type["UnfitError"], tuple[Reason, str]]:
        """Let it travel between processes."""
        return type(self), (self.reason, str(self))


class TrustError(UnfitError):
    """Parameters that nobody may vouch for: signature, time, order, or form."""


class Quality(IntEnum):
    """What stands in one corrected signal."""

    NOT_AVAILABLE = 0
    PASSED_THROUGH = 1
    CORRECTED = 2
    INVALID = 3
    IMPLAUSIBLE = 4
    """A measured value that the Kirchhoff sum says is wrong; in a signal of 2 bits INVALID stands for it."""


@dataclass(kw_only=True)
class Counters:
    """Counted by the core and by the loop around it."""

    frames_in: int = 0
    """Frames of branches, their voltages and the state of [watch] received."""
    answers: int = 0
    """Corrected messages that an overlay node made, those with values passed through or not available included."""
    rewritten: int = 0
    """Frames in which a gateway wrote another current than was measured."""
    forwarded: int = 0
    """Frames passed on by a gateway, those that it rewrote included, those that the kernel carries not."""
    returned: int = 0
    """The same from the vehicle to the sensors' bus."""
    not_returned: int = 0
    """Frames of the vehicle that the sensors' bus did not take."""
    held_back: int = 0
    """Frames that failed their check and that a gateway did not pass on."""
    corrupt: int = 0
    """Frames with a wrong CRC or an impossible counter."""
    repeated: int = 0
    """Frames with the counter of the one before."""
    jumped: int = 0
    """Frames whose counter was further on than the layout allows."""
    gaps: int = 0
    """Times that the counter showed a few lost frames."""
    short: int = 0
    """Frames too short for a signal that the layout reads from them."""
    late: int = 0
    """Frames of branches that were too old when they were read; nothing was made of them."""
    dropped: int = 0
    """Frames that the kernel dropped because they were not read in time."""
    saturated: int = 0
    """Corrected values beyond the ends of their signal; the end was sent instead."""
    foreign: int = 0
    """Frames that only this gateway may send and another node sent; they were dropped."""
    echoes: int = 0
    """Own frames that came back."""
    send_errors: int = 0
    """Frames that the bus did not take."""
    bus_errors: int = 0
    """Error frames of the bus."""
    bus_off: int = 0
    """Times that the controller went off the bus."""
    reopened: int = 0
    """Times that the bus was opened again."""
    clock_steps: int = 0
    """Times that the time of day jumped against the steady clock; the times of reading are taken for a while then."""
    telemetry_lost: int = 0
    """Lines of telemetry that could not be written in time."""
    reloads: int = 0
    """Times that other parameters came in force, or those in force ended."""

    def text(self) -> str:
        """One line for the log: what is not 0."""
        counted = ", ".join(f"{name.replace('_', ' ')} {value}" for name, value in asdict(self).items() if value)
        return counted or "no frames"


class Latency:
    """Histogram of the time from when a branch's frame came until its answer was sent.

    Answers that are sent with one call count as the one that waited longest: a fifth of the cost, and never too little.

    Attributes
    ----------
    counts : list of int
        Frames whose latency in whole microseconds has so many bits: number n counts those below 2^n us.
    largest_s : float
        Largest one. [s]
    came : callable
        Takes when a frame came, on the steady clock [s]; its answer is sent next.
    """

    def __init__(self) -> None:
        self.counts = [0] * 48
        self.largest_s = 0.0
        self._waiting: list[float] = []
        self.came = self._waiting.append

    def sent(self, not_sent: int) -> None:
        """Count the frames that came since the last time, unless the bus did not take some of their answers."""
        waiting = self._waiting
        if waiting and not not_sent:
            self.add(time.monotonic() - waiting[0], len(waiting))
        waiting.clear()

    def add(self, latency_s: float, frames: int = 1) -> None:
        """Count frames of this latency. [s]"""
        self.counts[int(max(latency_s, 0.0) * 1e6).bit_length()] += frames
        self.largest_s = max(self.largest_s, latency_s)

    def at_most_s(self, share: float) -> float:
        """Latency that this share of the frames does not exceed, up to a factor of 2 more than it is. [s]"""
        wanted = share * sum(self.counts)
        bits = next(n for n, below in enumerate(accumulate(self.counts)) if below >= wanted)
        return min(1e-6 * 2.0**bits, self.largest_s)

    def microseconds(self) -> dict[str, int]:
        """Median, 99.9 % and largest. [us]"""
        found_s = {"p50": self.at_most_s(0.5), "p99.9": self.at_most_s(0.999), "max": self.largest_s}
        return {name: round(1e6 * value_s) for name, value_s in found_s.items()}
