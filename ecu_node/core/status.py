"""What the node tells of itself: codes, which are those of the DBC's value tables, and counts."""

from dataclasses import asdict, dataclass
from enum import IntEnum

from ecu_node.errors import ParameterError

__all__ = ["Counters", "Quality", "Reason", "State", "TrustError", "UnfitError"]


class State(IntEnum):
    """What the node does with the branch currents."""

    STARTING = 0
    CORRECTING = 1
    PASSING_THROUGH = 2
    SHADOW = 3
    ASLEEP = 4
    PARTLY_CORRECTING = 5
    """Corrects, but not every branch; the reason says why."""


class Reason(IntEnum):
    """Why the node does not correct, or not everything."""

    NONE = 0
    NO_PARAMETERS = 1
    MALFORMED_PARAMETERS = 2
    WRONG_VEHICLE = 3
    WRONG_LAYOUT = 4
    WRONG_DBC = 5
    IMPLAUSIBLE_PARAMETERS = 6
    BRANCH_STALE = 7
    CORRECTION_WORSE = 8
    BRANCH_STUCK = 9
    INPUT_MISSING = 10
    NOT_SIGNED = 11
    NOT_VALID_NOW = 12
    REPLAYED = 13
    REVOKED = 14
    ON_TRIAL = 15
    SUM_IMPLAUSIBLE = 16
    """In a signal of 4 bits CORRECTION_WORSE stands for it."""
    FOREIGN_FRAMES = 17
    """Nothing is held back for it; in a signal of 4 bits NONE stands for it."""
    E2E_INVALID = 18
    """So many frames of a message fail their end-to-end check that it is not used. In 4 bits: INPUT_MISSING."""


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
    """Parameter files that took the place of the one before."""
    reload_failures: int = 0
    """Parameter files that did not fit; the ones before stayed in force."""

    def text(self) -> str:
        """One line for the log: what is not 0."""
        counted = ", ".join(f"{name.replace('_', ' ')} {value}" for name, value in asdict(self).items() if value)
        return counted or "no frames"
