"""Read one log or table, with the signals that the layout names, as one drive.

The current of a branch is one of three: sign * signal; sign * power / voltage, where the voltage is that of the latest
good frame at or before the power's frame and not older than the branch's time-out; or sign * formula, evaluated at the
instants of its most frequent channel, to which the others are interpolated. Every branch keeps the instants of its own
frames or rows. Currents are positive into the junction.
"""

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from cantools.database.can import Message
from numpy.typing import NDArray

from calibrator.drive import Array, Channel, Drive, Mask
from calibrator.drives.align import at_instants, evaluate_formula
from calibrator.errors import LogError
from calibrator.recordings.decode import decode_signal, message_is_sound, signal_range
from calibrator.recordings.frame_arrays import (
    CLOCK_GAP_S,
    EXTENDED_BIT,
    LONGEST_PAUSE_S,
    Frames,
    frame_key,
    repaired_time,
)
from calibrator.recordings.log_formats import is_table, read_frames
from calibrator.recordings.tables import Table, read_table
from calibrator.terminal.text import Notice
from ecu_node.core.signals import AMPERE, VOLT, WATT, factor_of, usual_unit
from ecu_node.database import VehicleDatabase, codes_of_no_value
from ecu_node.formulas import formula_names, parse_formula
from ecu_node.layout import Branch, split_signal

__all__ = [
    "FrameSource",
    "Recording",
    "RecordingReport",
    "SignalSource",
    "TableSource",
    "open_recording",
    "other_address",
    "read_recording",
]

_NOTHING = Channel(time_s=np.zeros(0), value=np.zeros(0), good=np.zeros(0, np.bool_))
_MOST_LISTED = 12
"""Identifiers listed in a message: enough to recognise the bus, short enough for one line."""
MOST_STRAY = 0.05
"""Largest share of a message's frames on other buses that is ignored: gateways and loggers leak a few frames. [1]"""


@dataclass(frozen=True, kw_only=True)
class RecordingReport:
    """Contents of a log or table, and the parts of it that could not be used.

    Attributes
    ----------
    channels : collection of (str, Channel)
        All branches and inputs of the layout by name, in its order.
    frames, error_frames, damaged : int
        Numbers of data frames, of error frames, and of damaged lines or frames in the whole log; rows in a table.
    disordered, clock_steps : int
        Frames whose time is before that of a frame logged earlier; jumps of the clock, or pauses, that became gaps.
    ignored : mapping of str to int
        Number of frames left out because they come from a bus that is not the layout's, by channel.
    found : str
        What was detected about a table, ``found`` of :class:`.Table`; empty for logs.
    unfit : tuple of str
        Two texts: that the log lacks the channel of a ``[[bus]]``, and what to do about it. Empty if it does not.
    """

    channels: Collection[tuple[str, Channel]]
    frames: int
    error_frames: int = 0
    damaged: int = 0
    disordered: int = 0
    clock_steps: int = 0
    ignored: Mapping[str, int] = field(default_factory=dict)
    found: str = ""
    unfit: tuple[str, ...] = ()

    def notices(self) -> list[Notice]:
        """Return what a user should know of the recording; empty for a log in which nothing is missing or wrong."""
        absent = ", ".join(name for name, channel in self.channels if not channel.time_s.size)
        spoilt = {name: (int(np.sum(~channel.good)), len(channel.good)) for name, channel in self.channels}
        return [
            *([Notice(text=f"no frames of {absent}")] if absent else []),
            *(
                Notice(text=f"{n}: {{}} of {{}} frames not usable", counts=counts)
                for n, counts in spoilt.items()
                if counts[0]
            ),
            *self.log_notices(),
        ]

    def log_notices(self) -> list[Notice]:
        """Return the notices that concern the log as a whole, not single channels."""
        found, unfit = (text.replace("{", "{{").replace("}", "}}") for text in (self.found, "; ".join(self.unfit)))
        texts = {
            f"{{}} rows, {found}": self.frames if found else 0,
            "{} damaged lines or frames left out": self.damaged,
            "{} error frames": self.error_frames,
            "{} frames out of order, sorted": self.disordered,
            f"jumps of the clock, or pauses of more than {LONGEST_PAUSE_S / 60.0:g} min, which became gaps of "
            f"{CLOCK_GAP_S:g} s: {{}}": self.clock_steps,
            f"{{}} frames of other buses ignored ({', '.join(self.ignored)})": sum(self.ignored.values()),
        }
        told = [Notice(text=text, counts=(count,)) for text, count in texts.items() if count]
        return [*told, Notice(text=unfit)] if unfit else told


@dataclass(frozen=True, kw_only=True)
class Recording:
    """A drive, the corrected currents found beside it in the log, and the report on the log.

    Attributes
    ----------
    drive : Drive
        Measured currents and inputs.
    corrected : mapping of str to Channel
        Corrected currents that a node published into the log, by branch name, positive into the junction. [A]
    report : RecordingReport
        Counts of the frames that were read and left out, and what the recording lacks.
    """

    drive: Drive
    corrected: Mapping[str, Channel]
    report: RecordingReport


def read_recording(path: Path, database: VehicleDatabase, *, vehicle: str, name: str) -> Recording:
    """Read a log or a table as a drive, with a report on what was read.

    Parameters
    ----------
    path : Path
        Log of any format of :mod:`calibrator.recordings.log_formats`, or table of :mod:`calibrator.recordings.tables`.
    database : VehicleDatabase
        DBC and layout.
    vehicle, name : str
        Identity of the vehicle and of the drive.

    Returns
    -------
    Recording
        The drive. Branches without frames and inputs without a good frame are absent from it and named in the report.

    Raises
    ------
    LogError
        If the file cannot be read, holds none of the branches, or has one message on several buses.
    DatabaseError
        If a signal of the layout cannot be decoded.
    """
    return open_recording(path, database).recording(vehicle, name)


def open_recording(path: Path, database: VehicleDatabase) -> "SignalSource":
    """Read a log or a table, and return its signals.

    LogError if the file cannot be read, or a column could be two signals. Missing branches, and a message on several
    buses, are found only when signals are read.
    """
    if is_table(path):
        return TableSource(read_table(path), database)
    return FrameSource(read_frames(path), database, str(path))


class SignalSource(ABC):
    """A recording, sorted by time, that returns signals and branches as channels.

    Attributes
    ----------
    database : VehicleDatabase
        DBC and layout.
    where : str
        The file, for messages.
    time_s : ndarray of shape (n,)
        Time of all frames or rows since the first one, not decreasing. [s]
    """

    def __init__(self, database: VehicleDatabase, where: str, time_s: Array) -> None:
        self.database = database
        self.where = where
        self.time_s = time_s

    @abstractmethod
    def samples(self, signal_name: str) -> tuple[Channel, Mapping[str, Mask]]:
        """Return one signal in the unit of the DBC, at the frames or rows that carry it, and which samples are bad.

        The second result maps each reason to the samples that it makes unusable; all other samples are good.
        """

    @abstractmethod
    def unit(self, signal_name: str) -> str:
        """Return the unit of a signal; empty if none is stated. DatabaseError if the DBC lacks the signal.

        The unit of the DBC comes first (without a DBC, that of the branch in the layout), then that of the column.
        """

    @abstractmethod
    def found_and_expected(self) -> str:
        """Return which identifiers or columns the recording has, and which the branches need, as part of a message."""

    @abstractmethod
    def report(self, channels: Collection[tuple[str, Channel]]) -> RecordingReport:
        """Return the report on the recording, given its channels by name."""

    def recording(self, vehicle: str, name: str) -> Recording:
        """Return the drive under these names, with its report; LogError if it has no branch or one on several buses."""
        layout = self.database.layout
        branches = {branch.name: self.branch(branch, branch.source) for branch in layout.branch}
        if not any(channel.time_s.size for channel in branches.values()):
            what = f"{self.where}: no branch of {layout.path} in it; {self.found_and_expected()}"
            raise LogError(what, "check that layout and log belong to the same vehicle and bus")
        inputs = {item.name: self.samples(item.signal)[0] for item in layout.input}
        corrected = {branch.name: self.branch(branch, branch.corrected) for branch in layout.branch if branch.corrected}
        drive = Drive(
            vehicle=vehicle,
            name=name,
            branches={key: channel for key, channel in branches.items() if channel.time_s.size},
            inputs={key: channel for key, channel in inputs.items() if channel.good.any()},
        )
        corrected = {key: channel for key, channel in corrected.items() if channel.time_s.size}
        return Recording(drive=drive, corrected=corrected, report=self.report(tuple((branches | inputs).items())))

    def branch(self, branch: Branch, signal_name: str) -> Channel:
        """Return one branch, measured or corrected, as a current that is positive into the junction. [A]

        `signal_name` names a current, or a power if the branch is given by power and voltage. A branch with a formula
        is computed, and `signal_name` is not used.
        """
        if branch.formula is not None:
            return self._computed(branch, branch.formula)
        if branch.power is None or branch.voltage is None:
            current = self._scaled(signal_name, AMPERE, branch)
            return Channel(time_s=current.time_s, value=branch.sign * current.value, good=current.good)
        power = self._scaled(signal_name, WATT, branch)
        voltage = self._scaled(branch.voltage, VOLT, branch)
        held_v, fresh = _held(voltage, power.time_s, branch.timeout_s)
        good = power.good & fresh & (held_v != 0.0)
        value = np.divide(branch.sign * power.value, held_v, out=np.full(len(held_v), np.nan), where=good)
        return Channel(time_s=power.time_s, value=value, good=good & np.isfinite(value))

    def _scaled(self, signal_name: str, units: Mapping[str, float], branch: Branch) -> Channel:
        """Return one signal converted to A, V or W, whichever `units` is for."""
        channel = self.samples(signal_name)[0]
        where = f"{self.database.layout.path}: branch {branch.name}"
        factor = factor_of(self.unit(signal_name), units, f"{where}: {signal_name}")
        return Channel(time_s=channel.time_s, value=channel.value * factor, good=channel.good)

    def _computed(self, branch: Branch, formula: str) -> Channel:
        """Compute a branch from its formula, at the instants of the most frequent channel in the formula.

        There are no samples if a channel has no good one.
        """
        layout, names = self.database.layout, formula_names(parse_formula(formula))
        signals = {item.name: item.signal for item in layout.input}
        channels = {name: self.samples(signals.get(name, name))[0] for name in layout.base_inputs(names)}
        if not channels or not all(channel.good.any() for channel in channels.values()):
            return _NOTHING
        time_s = max(channels.values(), key=lambda channel: len(channel.time_s)).time_s
        values, good = {}, np.ones(len(time_s), np.bool_)
        for name, channel in channels.items():
            values[name], known = at_instants(channel, time_s, branch.timeout_s)
            good &= known
        for item in layout.derived:
            if layout.base_inputs([item.name]) <= values.keys():
                values[item.name] = evaluate_formula(item.formula, values)
        value = branch.sign * evaluate_formula(formula, values)
        return Channel(time_s=time_s, value=value, good=good & np.isfinite(value))


class FrameSource(SignalSource):
    """A CAN log as a source of signals.

    Attributes
    ----------
    frames : Frames
        The frames in the order of time.
    time : LogTime
        Their times, and what was repaired in them.
    ignored : dict of str to int
        Number of frames left out so far because they come from another bus, by channel.
    """

    def __init__(self, frames: Frames, database: VehicleDatabase, where: str) -> None:
        self.time = repaired_time(frames.time_ns)
        super().__init__(database, where, self.time.time_s)
        self.frames = frames.take(self.time.order) if self.time.disordered or self.time.clock_steps else frames
        self._messages: dict[str, tuple[NDArray[np.uint8], NDArray[np.uint8], Array, Mask]] = {}
        self.ignored: Counter[str] = Counter()
        self._named = [bus.channel for bus in database.layout.bus]
        if self._named:
            self._ignore(frames.channel, self._named)

    def samples(self, signal_name: str) -> tuple[Channel, Mapping[str, Mask]]:  # noqa: D102 (as above)
        message, signal = self.database.signal(signal_name)
        data, length, time_s, unspoilt = self._of_message(signal_name)
        codes = codes_of_no_value(self.database, signal_name)
        decoded = decode_signal(message, signal, data, length, codes)
        kept = slice(None) if decoded.present.all() else decoded.present
        channel = Channel(time_s=time_s[kept], value=decoded.value[kept], good=(decoded.good & unspoilt)[kept])
        return channel, {reason: bad[kept] for reason, bad in {"E2E check failed": ~unspoilt, **decoded.bad}.items()}

    def unit(self, signal_name: str) -> str:  # noqa: D102 (as above)
        return self.database.signal(signal_name)[1].unit or ""

    def found_and_expected(self) -> str:  # noqa: D102 (as above)
        names = [branch.source for branch in self.database.layout.branch if not branch.computed]
        messages = [self.database.signal(name)[0] for name in names]
        expected = ", ".join(dict.fromkeys(f"{message.name} ({_hex(_key(message))})" for message in messages))
        here, wanted = (
            f" on {', '.join(names)}" if self._named else "" for names in (self.frames.channels, self._named)
        )
        keys = np.unique(self.frames.key).tolist()
        more = f" and {len(keys) - _MOST_LISTED} more" if len(keys) > _MOST_LISTED else ""
        return (
            f"it has the identifiers {', '.join(map(_hex, keys[:_MOST_LISTED]))}{more}{here}; expected "
            f"{expected or 'signals of the inputs'}{wanted}"
        )

    def report(self, channels: Collection[tuple[str, Channel]]) -> RecordingReport:  # noqa: D102 (as above)
        here = self.frames.channels
        lacking = ", ".join(channel for channel in self._named if channel not in here)
        unfit = (
            f"no channel {lacking} in it, which has {', '.join(here)}",
            "correct channel in [[bus]], or record that bus",
        )
        return RecordingReport(
            channels=channels,
            frames=len(self.frames),
            error_frames=self.frames.error_frames,
            damaged=self.frames.damaged,
            disordered=self.time.disordered,
            clock_steps=self.time.clock_steps,
            ignored=dict(self.ignored),
            unfit=unfit if lacking else (),
        )

    def _of_message(self, signal_name: str) -> tuple[NDArray[np.uint8], NDArray[np.uint8], Array, Mask]:
        """Return payloads, lengths and times of a signal's message, and which frames pass the end-to-end check."""
        name = split_signal(signal_name)[0]
        if name not in self._messages:
            message = self.database.message(name)
            index = np.flatnonzero(self.frames.key == np.uint32(_key(message)))
            index = index[self._is_of_bus(name, self.frames.channel[index])]
            data, length = self.frames.data.take(index, axis=0), self.frames.length.take(index)
            unspoilt = message_is_sound(self.database, message, data, length)
            self._messages[name] = (data, length, self.time_s.take(index), unspoilt)
        return self._messages[name]

    def _is_of_bus(self, name: str, channel: NDArray[np.uint32]) -> Mask:
        """Return which frames of a message come from its bus: the layout's, else the bus that carries nearly all.

        LogError if no bus does.
        """
        channels, wanted = self.frames.channels, self.database.channel_of(name)
        if wanted is not None:
            return np.asarray(channel == (channels.index(wanted) if wanted in channels else len(channels)))
        counts = np.bincount(channel, minlength=len(channels))
        main = int(np.argmax(counts))
        if counts.sum() - counts[main] > MOST_STRAY * counts.sum():
            names = ", ".join(f"{bus} {count}" for bus, count in zip(channels, counts, strict=True) if count)
            raise LogError(
                f"{self.where}: {name} comes on several buses (frames: {names}), as if from two sensors; in the layout "
                f'write [[bus]] with name = "hv", channel = "{channels[main]}", dbc = "{self.database.layout.dbc}" in '
                f"place of dbc"
            )
        self._ignore(channel, [channels[main]])
        return np.asarray(channel == main)

    def _ignore(self, channel: NDArray[np.uint32], known: Sequence[str]) -> None:
        """Add to :attr:`ignored` how many of the frames are on channels other than the `known` ones."""
        counts = zip(self.frames.channels, np.bincount(channel, minlength=len(self.frames.channels)), strict=True)
        self.ignored.update({bus: int(count) for bus, count in counts if count and bus not in known})


class TableSource(SignalSource):
    """A table as a source of signals; with a DBC its columns may be called ``Message.Signal`` or ``Signal``."""

    def __init__(self, table: Table, database: VehicleDatabase) -> None:
        super().__init__(database, str(table.path), table.time_s)
        self.table = table
        layout = database.layout
        owners: dict[str, str] = {}
        for name in sorted({*self.branch_columns(), *(item.signal for item in layout.input)}):
            header = table.header(name)
            if header is not None and owners.setdefault(header, name) != name:
                raise LogError(
                    f"{table.path}: column {header!r} could be {owners[header]} and {name}; call columns after message "
                    f"and signal"
                )

    def unit(self, signal_name: str) -> str:  # noqa: D102 (as above)
        unit = self.database.signal(signal_name)[1].unit
        return unit or self.table.units.get(self.table.header(signal_name) or "", "")

    def found_and_expected(self) -> str:  # noqa: D102 (as above)
        expected = ", ".join(repr(branch.source) for branch in self.database.layout.branch)
        return f"{self.table.known(self.database.layout.branch[0].source)}; expected {expected}"

    def recording(self, vehicle: str, name: str) -> Recording:  # noqa: D102 (as above)
        for column in self.branch_columns():
            if complaint := self.table.no_numbers(column, or_words=False):
                raise LogError(f"{self.where}: {complaint[0]}", complaint[1])
        return super().recording(vehicle, name)

    def branch_columns(self) -> list[str]:
        """Return the names of the columns that the branches are read from; formulas name their own."""
        sources = ((item.signal, item.power, item.voltage) for item in self.database.layout.branch)
        return [name for names in sources for name in names if name is not None]

    def report(self, channels: Collection[tuple[str, Channel]]) -> RecordingReport:  # noqa: D102 (as above)
        return RecordingReport(
            channels=channels,
            frames=len(self.table.time_s),
            damaged=self.table.without_time,
            disordered=self.table.disordered,
            clock_steps=self.table.clock_steps,
            found=self.table.found,
        )

    def samples(self, signal_name: str) -> tuple[Channel, Mapping[str, Mask]]:
        """Return a column as :meth:`SignalSource.samples` does, converted to the DBC's unit if both are known."""
        header = self.table.header(signal_name)
        if header is None:
            return _NOTHING, {}
        signal = self.database.signal(signal_name)[1]
        value = self.table.columns[header] * _ratio(self.table.units.get(header, ""), signal.unit or "")
        text = self.table.bad.get(header, np.zeros(len(value), np.bool_))
        kept = np.isfinite(value) | text
        reasons = {"no number": text[kept], "out of range": (~text & ~signal_range(signal).holds(value))[kept]}
        good = ~np.logical_or.reduce(list(reasons.values()))
        return Channel(time_s=self.table.time_s[kept], value=value[kept], good=good), reasons


def _ratio(unit: str, wanted: str) -> float:
    """Return the factor from one unit to another of the same quantity; 1 if either unit is unknown."""
    for known in (AMPERE, VOLT, WATT):
        if unit in known and usual_unit(wanted) in known:
            return known[unit] / known[usual_unit(wanted)]
    return 1.0


def _held(channel: Channel, time_s: Array, max_age_s: float) -> tuple[Array, Mask]:
    """Return the latest good value at or before each instant, and whether it exists and is not too old."""
    known_s, known = channel.time_s[channel.good], channel.value[channel.good]
    latest = np.searchsorted(known_s, time_s, side="right") - 1
    if not known_s.size:
        return np.zeros(len(time_s)), np.zeros(len(time_s), np.bool_)
    found = np.maximum(latest, 0)
    return known[found], (latest >= 0) & (time_s - known_s[found] <= max_age_s)


def other_address(frames: Frames, message: Message, database: VehicleDatabase) -> str:
    """Say which identifiers differ from that of a message in the last byte alone, which is J1939's source address.

    Empty if the message itself is there, if its identifier has 11 bits, or if the DBC knows all such identifiers.
    """
    key, known = _key(message), {_key(each) for bus in database.databases.values() for each in bus.messages}
    alike = set(np.unique(frames.key[frames.key >> 8 == key >> 8]).tolist())
    if not alike - known or key in alike or not message.is_extended_frame:
        return ""
    others = ", ".join(map(_hex, sorted(alike - known)))
    what = f"the log has {others}: if that is {message.name} ({_hex(key)}) from another source address (J1939)"
    return f"{what}, change the identifier in the DBC"


def _key(message: Message) -> int:
    return frame_key(message.frame_id, extended=message.is_extended_frame)


def _hex(key: int) -> str:
    return f"0x{key & ~EXTENDED_BIT:08X}" if key & EXTENDED_BIT else f"0x{key:03X}"
