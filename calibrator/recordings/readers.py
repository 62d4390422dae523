"""One log and the layout's signals make one drive.

Branch k is signal * sign, or sign * power / voltage with the voltage of the latest good frame at or before the power's,
not older than the branch's time-out. Every branch keeps the instants of its own frames. Currents are positive into the
junction.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from cantools.database.can import Message

from calibrator.drive import Array, Channel, Drive, Mask
from calibrator.errors import LogError
from calibrator.recordings.decode import codes_of_no_value, decode_signal
from calibrator.recordings.e2e_profile import message_is_sound
from calibrator.recordings.frame_arrays import EXTENDED_BIT, Frames, frame_key
from calibrator.recordings.frames import read_frames
from calibrator.recordings.log_time import CLOCK_GAP_S, repaired_time
from calibrator.terminal.notices import Notice
from ecu_node.database import VehicleDatabase
from ecu_node.layout import Branch
from ecu_node.units import AMPERE, VOLT, WATT, unit_factor

__all__ = ["ChannelReport", "Recording", "RecordingReport", "drive_from_frames", "read_drive", "read_recording"]

_MOST_LISTED = 12
"""Identifiers listed in a message: enough to recognise the bus, short enough for one line."""


@dataclass(frozen=True, kw_only=True)
class ChannelReport:
    """What a log holds of one branch or input.

    Attributes
    ----------
    name, signal : str
        Name in the layout; ``Message.Signal`` in the DBC.
    frames, not_good : int
        Frames that carry it, and how many of them are labelled as not good.
    first_s, last_s : float
        First and last instant since the start of the log; NaN without frames. [s]
    """

    name: str
    signal: str
    frames: int
    not_good: int
    first_s: float
    last_s: float


@dataclass(frozen=True, kw_only=True)
class RecordingReport:
    """What a log holds, and what of it could not be used.

    Attributes
    ----------
    channels : tuple of ChannelReport
        All branches and inputs of the layout, in its order.
    frames, error_frames, remote_frames, damaged : int
        Counts over the whole log.
    disordered, clock_steps : int
        Frames logged before an earlier one; steps of the clock that became gaps.
    """

    channels: tuple[ChannelReport, ...]
    frames: int
    error_frames: int
    remote_frames: int
    damaged: int
    disordered: int
    clock_steps: int

    def notices(self) -> list[str]:
        """Return what a user should know, one short text each; empty if the log is whole and sound."""
        return [str(notice) for notice in self.counted_notices()]

    def log_notices(self) -> list[str]:
        """Return those of the notices that concern the log as a whole, not single channels."""
        return [str(notice) for notice in self._counted_log_notices()]

    def counted_notices(self) -> list[Notice]:
        """Return the notices with their counts apart, so that those of many logs can be told together."""
        absent = [item.name for item in self.channels if not item.frames]
        spoilt = [item for item in self.channels if item.not_good]
        notices = [Notice(text=f"no frames of {', '.join(absent)}")] if absent else []
        notices += [
            Notice(text=f"{item.name}: {{}} of {{}} frames not usable", counts=(item.not_good, item.frames))
            for item in spoilt
        ]
        return notices + self._counted_log_notices()

    def _counted_log_notices(self) -> list[Notice]:
        texts = {
            "{} damaged lines or frames left out": self.damaged,
            "{} error frames": self.error_frames,
            "{} frames out of order, sorted": self.disordered,
            f"the clock was set {{}} times, each step became a gap of {CLOCK_GAP_S:g} s": self.clock_steps,
        }
        return [Notice(text=text, counts=(count,)) for text, count in texts.items() if count]


@dataclass(frozen=True, kw_only=True)
class Recording:
    """A drive, what was published as corrected beside it, and the account of the log.

    Attributes
    ----------
    drive : Drive
        Measured currents and inputs.
    corrected : mapping of str to Channel
        Corrected currents found in the log by branch name, positive into the junction. [A]
    report : RecordingReport
        What was found and what was left out.
    """

    drive: Drive
    corrected: Mapping[str, Channel]
    report: RecordingReport


def read_drive(path: Path, database: VehicleDatabase, *, vehicle: str, name: str) -> Drive:
    """Read a log as a drive; see :func:`read_recording`, which also tells what was left out."""
    return read_recording(path, database, vehicle=vehicle, name=name).drive


def read_recording(path: Path, database: VehicleDatabase, *, vehicle: str, name: str) -> Recording:
    """Read a log as a drive with its account.

    Parameters
    ----------
    path : Path
        Log file of any format of :mod:`calibrator.recordings.frames`.
    database : VehicleDatabase
        DBC and layout.
    vehicle, name : str
        Identity of the vehicle and of the drive.

    Returns
    -------
    Recording
        The drive; branches without frames and inputs without a good one are absent from it and named in the report.

    Raises
    ------
    LogError
        If the file cannot be read, holds none of the branches, or one signal on two buses.
    DatabaseError
        If a signal of the layout cannot be decoded.
    """
    return drive_from_frames(read_frames(path), database, vehicle=vehicle, name=name, where=str(path))


def drive_from_frames(frames: Frames, database: VehicleDatabase, *, vehicle: str, name: str, where: str) -> Recording:
    """Decode frames as a drive; as :func:`read_recording`, with `where` to name the source in messages."""
    source = _Source(frames, database, where)
    layout = database.layout
    branches = {branch.name: source.branch(branch, branch.source) for branch in layout.branch}
    if not any(channel.time_s.size for channel in branches.values()):
        raise LogError(f"{where}: no branch of {layout.path} in this log; {source.found_and_expected()}")
    inputs = {item.name: source.channel(item.signal) for item in layout.input}
    corrected = {branch.name: source.branch(branch, branch.corrected) for branch in layout.branch if branch.corrected}
    signals = {branch.name: branch.source for branch in layout.branch} | {i.name: i.signal for i in layout.input}
    report = RecordingReport(
        channels=tuple(_channel_report(key, signals[key], c) for key, c in (branches | inputs).items()),
        frames=len(frames),
        error_frames=frames.error_frames,
        remote_frames=frames.remote_frames,
        damaged=frames.damaged,
        disordered=source.time.disordered,
        clock_steps=source.time.clock_steps,
    )
    available = {key: channel for key, channel in inputs.items() if channel.good.any()}
    drive = Drive(vehicle=vehicle, name=name, branches=_present(branches), inputs=available)
    return Recording(drive=drive, corrected=_present(corrected), report=report)


class _Source:
    """Frames in the order of time, with the look-ups that turn them into channels."""

    def __init__(self, frames: Frames, database: VehicleDatabase, where: str) -> None:
        self.time = repaired_time(frames.time_ns)
        self._frames = frames.take(self.time.order) if self.time.disordered or self.time.clock_steps else frames
        self._database = database
        self._where = where
        self._messages: dict[str, tuple[Frames, Array, Mask]] = {}

    def channel(self, signal_name: str) -> Channel:
        """One signal in the unit of the DBC, at the frames that carry it."""
        message, signal = self._database.signal(signal_name)
        frames, time_s, unspoilt = self._of_message(message)
        no_value = codes_of_no_value(self._database, signal_name)
        decoded = decode_signal(message, signal, frames.data, frames.length, no_value)
        kept = decoded.present
        return Channel(time_s=time_s[kept], value=decoded.value[kept], good=(decoded.good & unspoilt)[kept])

    def scaled(self, signal_name: str, units: Mapping[str, float], branch: Branch) -> Channel:
        """One signal in A, V or W."""
        _, signal = self._database.signal(signal_name)
        factor = unit_factor(signal, units, f"{self._database.layout.path}: branch {branch.name}")
        channel = self.channel(signal_name)
        return Channel(time_s=channel.time_s, value=channel.value * factor, good=channel.good)

    def branch(self, branch: Branch, signal_name: str) -> Channel:
        """One branch, measured or corrected, as a current positive into the junction.

        The signal is a current, or a power if the branch is one.
        """
        if branch.power is None or branch.voltage is None:
            current = self.scaled(signal_name, AMPERE, branch)
            return Channel(time_s=current.time_s, value=branch.sign * current.value, good=current.good)
        power = self.scaled(signal_name, WATT, branch)
        voltage = self.scaled(branch.voltage, VOLT, branch)
        held_v, fresh = _held(voltage, power.time_s, branch.timeout_s)
        good = power.good & fresh & (held_v != 0.0)
        value = np.divide(branch.sign * power.value, held_v, out=np.full(len(held_v), np.nan), where=good)
        return Channel(time_s=power.time_s, value=value, good=good & np.isfinite(value))

    def found_and_expected(self) -> str:
        """Identifiers of the log and of the branches, for a message."""
        expected = [self._database.signal(branch.source)[0] for branch in self._database.layout.branch]
        texts = [f"{message.name} ({_hex(_key(message))})" for message in expected]
        keys = np.unique(self._frames.key).tolist()
        more = f" and {len(keys) - _MOST_LISTED} more" if len(keys) > _MOST_LISTED else ""
        return (
            f"it has the identifiers {', '.join(map(_hex, keys[:_MOST_LISTED]))}{more}; expected "
            f"{', '.join(dict.fromkeys(texts))}; check that layout and log belong to the same vehicle and bus"
        )

    def _of_message(self, message: Message) -> tuple[Frames, Array, Mask]:
        """Frames of a message, their times, and whether their end-to-end protection is right."""
        if message.name not in self._messages:
            index = np.flatnonzero(self._frames.key == np.uint32(_key(message)))
            frames = self._frames.take(index)
            buses = np.unique(frames.channel)
            if len(buses) > 1:
                names = ", ".join(frames.channels[bus] for bus in buses)
                raise LogError(
                    f"{self._where}: {message.name} comes on {len(buses)} buses ({names}); "
                    f"leave one bus in the log, else two sensors are mixed"
                )
            unspoilt = message_is_sound(self._database, message, frames.data, frames.length)
            self._messages[message.name] = (frames, self.time.time_s[index], unspoilt)
        return self._messages[message.name]


def _held(channel: Channel, time_s: Array, max_age_s: float) -> tuple[Array, Mask]:
    """Latest good value at or before each instant, and whether there is one that is not too old."""
    known_s, known = channel.time_s[channel.good], channel.value[channel.good]
    latest = np.searchsorted(known_s, time_s, side="right") - 1
    if not known_s.size:
        return np.zeros(len(time_s)), np.zeros(len(time_s), np.bool_)
    found = np.maximum(latest, 0)
    return known[found], (latest >= 0) & (time_s - known_s[found] <= max_age_s)


def _key(message: Message) -> int:
    return frame_key(message.frame_id, extended=message.is_extended_frame)


def _hex(key: int) -> str:
    return f"0x{key & ~EXTENDED_BIT:08X}" if key & EXTENDED_BIT else f"0x{key:03X}"


def _present(channels: Mapping[str, Channel]) -> dict[str, Channel]:
    return {name: channel for name, channel in channels.items() if channel.time_s.size}


def _channel_report(name: str, signal: str, channel: Channel) -> ChannelReport:
    time_s = channel.time_s
    return ChannelReport(
        name=name,
        signal=signal,
        frames=len(time_s),
        not_good=int(np.sum(~channel.good)),
        first_s=float(time_s[0]) if time_s.size else float("nan"),
        last_s=float(time_s[-1]) if time_s.size else float("nan"),
    )
