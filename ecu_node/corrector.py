"""The node without its bus: frames and times go in, corrected frames and the status come out.

Overlay: a branch's frame is answered by its corrected message under an identifier of its own; nothing else is touched.
A frame that is corrupt or repeated is counted and answered by nothing. Times are those of one steady clock. [s]
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import NamedTuple

from ecu_node.bits import BitPlace
from ecu_node.branch import LiveBranch, VoltageSensor
from ecu_node.codes import Codes, as_written
from ecu_node.e2e import Check, Receiver, Sender
from ecu_node.status import Reason, State

__all__ = ["Corrector", "Counters", "Frame", "FrameKey", "Source", "StatusFields", "Target"]


class FrameKey(NamedTuple):
    """Identifier of a frame; one number with 11 and with 29 bits are two identifiers."""

    identifier: int
    extended: bool


class Frame(NamedTuple):
    """One data frame, in or out."""

    key: FrameKey
    data: bytes
    fd: bool = False
    bitrate_switch: bool = False


@dataclass(kw_only=True)
class Counters:
    """What happened since the start."""

    frames_in: int = 0
    """Frames of branches (and their voltages) received."""
    corrected: int = 0
    """Corrected messages made."""
    corrupt: int = 0
    """Frames with a wrong CRC or an impossible counter; nothing was made of them."""
    repeated: int = 0
    """Frames with the counter of the one before; nothing was made of them."""
    gaps: int = 0
    """Times that the counter showed lost frames."""
    send_errors: int = 0
    """Frames that the bus did not take."""
    saturated: int = 0
    """Corrected values beyond the ends of their signal; the end was sent instead."""

    def text(self) -> str:
        """One line for the log."""
        return ", ".join(f"{name.replace('_', ' ')} {value}" for name, value in asdict(self).items())


class Target:
    """One corrected message: its own payload, branches and protection.

    Parameters
    ----------
    key : FrameKey
        Its identifier.
    length : int
        Bytes of the message.
    fd : bool
        Whether the DBC sends it as CAN FD.
    branches : list of LiveBranch
        The branches written into it.
    sender : Sender or None
        End-to-end protection.
    """

    def __init__(
        self, *, key: FrameKey, length: int, fd: bool, branches: Sequence[LiveBranch], sender: Sender | None
    ) -> None:
        self.key = key
        self._fd = fd
        self._branches = branches
        self._sender = sender
        self._payload = bytearray(length)

    def frame(self, now_s: float, source: Frame, counters: Counters) -> Frame:
        """Make the message anew, and count it; CAN FD where the DBC says so or the source's frame was."""
        counters.corrected += 1
        for branch in self._branches:
            counters.saturated += branch.write(self._payload, now_s)
        if self._sender is not None:
            self._sender.protect(self._payload)
        return Frame(self.key, bytes(self._payload), self._fd or source.fd, source.bitrate_switch)


@dataclass(frozen=True, kw_only=True)
class Source:
    """One incoming message, what is read from it and which messages answer it."""

    receiver: Receiver | None
    voltages: Sequence[VoltageSensor]
    branches: Sequence[LiveBranch]
    targets: Sequence[Target]


@dataclass(frozen=True, kw_only=True)
class StatusFields:
    """The status message; fields that the layout leaves out are None."""

    key: FrameKey
    length: int
    fd: bool
    sender: Sender | None
    state: BitPlace
    reason: BitPlace
    parameter_set: BitPlace | None
    sum_measured: tuple[Codes, int] | None
    """Signal and its code for "no value"."""
    sum_corrected: tuple[Codes, int] | None


@dataclass(kw_only=True)
class Corrector:
    """The pure core of the node; built by :func:`ecu_node.wiring.wire`.

    Attributes
    ----------
    sources : mapping of FrameKey to Source
        What is received; no other frame is looked at.
    branches : sequence of LiveBranch
        All branches of the layout.
    status_fields : StatusFields or None
        Status message, if the layout has one.
    reason : Reason
        Why measured values are passed through; NONE where parameters are in force.
    parameter_set : int
        Number of the parameter set in force, modulo 256; 0 where none is.
    counters : Counters
        Counted so far.
    """

    sources: Mapping[FrameKey, Source]
    branches: Sequence[LiveBranch]
    status_fields: StatusFields | None
    reason: Reason
    parameter_set: int
    counters: Counters = field(default_factory=Counters)

    def receive(self, frame: Frame, now_s: float) -> list[Frame]:
        """Take one frame from the bus.

        Parameters
        ----------
        frame : Frame
            Any data frame.
        now_s : float
            When it came. [s]

        Returns
        -------
        list of Frame
            The corrected messages that answer it; none for foreign, corrupt and repeated frames.
        """
        source = self.sources.get(frame.key)
        if source is None:
            return []
        self.counters.frames_in += 1
        if source.receiver is not None and not self._is_intact(source.receiver.check(frame.data)):
            return []
        for voltage in source.voltages:
            voltage.update(frame.data, now_s)
        for branch in source.branches:
            branch.update(frame.data, now_s)
        return [target.frame(now_s, frame, self.counters) for target in source.targets]

    def state(self, now_s: float) -> tuple[State, Reason]:
        """What the node does at this instant, and why; it corrects while a branch to be corrected is not stale."""
        if self.reason is not Reason.NONE:
            return State.PASSING_THROUGH, self.reason
        reason = Reason.BRANCH_STALE if any(branch.is_stale(now_s) for branch in self.branches) else Reason.NONE
        if not any(branch.fault.applied and not branch.is_stale(now_s) for branch in self.branches):
            return State.PASSING_THROUGH, reason
        waiting = any(branch.is_fitted and not branch.seen for branch in self.branches)
        return State.STARTING if waiting and reason is Reason.NONE else State.CORRECTING, reason

    def junction_sums_a(self, now_s: float) -> tuple[float | None, float | None]:
        """Sum of the last branch currents, measured and corrected [A]; None while any fitted branch has none."""
        fitted = [branch for branch in self.branches if branch.is_fitted]
        return (
            _sum_or_none([branch.measured_a(now_s) for branch in fitted]),
            _sum_or_none([branch.corrected_a(now_s) for branch in fitted]),
        )

    def status(self, now_s: float) -> Frame | None:
        """Make the status message; None if the layout has none."""
        fields = self.status_fields
        if fields is None:
            return None
        payload = bytearray(fields.length)
        state, reason = self.state(now_s)
        fields.state.put(payload, state)
        fields.reason.put(payload, reason)
        if fields.parameter_set is not None:
            fields.parameter_set.put(payload, self.parameter_set)
        for signal, total in zip((fields.sum_measured, fields.sum_corrected), self.junction_sums_a(now_s), strict=True):
            if signal is not None:
                codes, missing = signal
                codes.place.put(payload, missing if total is None else codes.nearest(as_written(total)))
        if fields.sender is not None:
            fields.sender.protect(payload)
        return Frame(fields.key, bytes(payload), fields.fd)

    def _is_intact(self, check: Check) -> bool:
        self.counters.corrupt += check is Check.CORRUPT
        self.counters.repeated += check is Check.REPEATED
        self.counters.gaps += check is Check.LOST
        return check.usable


def _sum_or_none(currents: Sequence[float | None]) -> float | None:
    known = [current for current in currents if current is not None]
    return sum(known) if known and len(known) == len(currents) else None
