"""``ecu-node run --summary``: the node sums up its drives as ``calibrator summarise`` does, in plain Python.

What is summed stands in :mod:`ecu_node.summary`. The blocks of a batch are added: a record has one entry per batch
(150 s at 10 Hz), which is what a power cut can lose. A record is a file ``FOLDER/VEHICLE/TIME.summary`` of at most
:data:`MOST_BATCHES`, replaced as a whole with each batch. Delays are those of the parameter file. Frames are read from
the bus as a logger would, beside the node; the work of a batch is done in steps of about a millisecond between frames.
"""

import argparse
import math
import time
from bisect import bisect_right
from collections import deque
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import partial
from itertools import pairwise
from operator import mul
from pathlib import Path
from typing import Any

from can.typechecking import CanFilter
from cantools.database.can import Message, Signal

from ecu_node.bus.adapters import connect
from ecu_node.bus.steady_bus import SteadyBus
from ecu_node.core.e2e import protection_of
from ecu_node.core.signals import AMPERE, VOLT, WATT, FrameKey, placed_signal, unit_factor
from ecu_node.core.status import Counters
from ecu_node.database import VehicleDatabase
from ecu_node.documents import write_atomically
from ecu_node.errors import LayoutError, UserError
from ecu_node.formulas import base_inputs, formula_value, parse_formula
from ecu_node.layout import SignalName
from ecu_node.parameters import VehicleParameters
from ecu_node.summary import (
    BATCH_SAMPLES,
    BLOCK_S,
    DIFFERENCE_GAIN,
    FEWEST_FOR_GAINS,
    FEWEST_ZERO_SAMPLES,
    LEAST_EDGE,
    LEAST_SHARE,
    LEAST_SPIKE_A,
    LEVELS_A,
    MAD_TO_SD,
    MEDIAN_EXCESS,
    NORMAL_MEDIAN,
    OTHERS_MOVE,
    RANGE_SLACK,
    SCHEMA_VERSION,
    SPIKE_SDS,
    SPIKE_WINDOW,
    STEP_OF_SPIKE,
    SUFFIX,
    TIME_RESOLUTION_S,
    ZERO_PIECE_S,
    ZERO_RESOLUTION_A,
    ZERO_SETTLING_S,
    SummaryFile,
    codes_of_no_value,
    encode_summary,
    packed,
)

MOST_BATCHES = 48
"""Of a file: two hours at 10 Hz, so that no file that is written again and again grows large."""
MOST_AT_ONCE = 64
"""Frames taken in one look, so that a flood of them delays no correction; what the bus cannot keep is a gap."""
DRIVE_GAP_S = 60.0
"""Nothing on the bus for so long ends a drive. [s]"""
_MOST_ZERO = 20_000
"""Samples of a branch that are kept of one window with open contactors."""
_PROBED_S = 30.0
"""From the start of a drive: branches and inputs without a good value until then count as not fitted. [s]"""

_Column = list[float]


class _Reader:
    """A signal as the frames of its message carry it, and who takes its values."""

    def __init__(self, message: Message, signal: Signal, no_value: frozenset[int]) -> None:
        self._placed = placed_signal(message, signal)
        self._ones = (1 << signal.length) - 1
        self._no_value = frozenset(code & self._ones for code in no_value)
        self._scale, self._offset = float(signal.scale), float(signal.offset)
        low, high = (signal.minimum, signal.maximum) if signal.minimum or signal.maximum else (None, None)
        slack = abs(self._scale) * RANGE_SLACK
        self._low = -math.inf if low is None else float(low) - slack
        self._high = math.inf if high is None else float(high) + slack
        self.takers: list[Callable[[float, float], None]] = []

    def take(self, payload: bytes | bytearray, time_s: float, *, is_sound: bool) -> None:
        """Hand on the value of one frame, NaN where it may not be used; a frame without the signal has none."""
        code = self._placed.code(payload)
        value = math.nan
        if code is None:
            if len(payload) >= self._placed.end:
                return
        elif is_sound and code & self._ones not in self._no_value:
            value = code * self._scale + self._offset
            if not self._low <= value <= self._high:
                value = math.nan
        for taker in self.takers:
            taker(time_s, value)


class _Channel:
    """Good samples of a branch or input around the next instant of the time base."""

    def __init__(self, limit_s: float, factor: float = 1.0, delay_s: float = 0.0) -> None:
        self.limit_s, self._factor, self._delay_s = limit_s + TIME_RESOLUTION_S, factor, delay_s
        self.samples: deque[tuple[float, float]] = deque()
        self.seen: Callable[[float, float], None] = lambda _time_s, _value: None
        """Takes every good sample, at the instant at which it was seen."""

    def put(self, time_s: float, value: float) -> None:
        """Take a sample. [s], [unit of the signal]"""
        if math.isnan(value):
            return
        self.seen(time_s, self._factor * value)
        sample, samples = (time_s - self._delay_s, self._factor * value), self.samples
        if samples and samples[-1][0] >= sample[0]:
            if samples[-1][0] > sample[0]:
                return  # it was overtaken
            samples.pop()  # of several at one instant the last counts
        samples.append(sample)

    def at(self, instant_s: float, now_s: float) -> float | None:
        """Value at an instant after all before; NaN if there is none, None if the next sample is to be waited for.

        At the end of a drive, now being infinite, the last sample stands for what is just after it.
        """
        samples = self.samples
        while len(samples) > 1 and samples[1][0] <= instant_s:
            samples.popleft()
        before_s, before = samples[0]
        if (before_s >= instant_s and len(samples) > 1) or (now_s == math.inf and len(samples) == 1):
            return before
        if len(samples) == 1:
            return math.nan if now_s - self._delay_s - before_s > self.limit_s and before_s < instant_s else None
        after_s, after = samples[1]
        gap_s = after_s - before_s
        if gap_s > self.limit_s:
            return math.nan
        share = (instant_s - before_s) / gap_s
        return (1.0 - share) * before + share * after


class _Power:
    """A branch that is a power over a voltage: the latest good one, not older than the branch's time-out."""

    def __init__(self, channel: _Channel, limit_s: float, volt: float) -> None:
        self._channel, self._limit_s, self._unit = channel, limit_s, volt
        self._volt = (-math.inf, 0.0)

    def put_voltage(self, time_s: float, value: float) -> None:
        if not math.isnan(value):
            self._volt = time_s, self._unit * value

    def put(self, time_s: float, value: float) -> None:
        volt_s, volt = self._volt
        if volt and time_s - volt_s <= self._limit_s:
            self._channel.put(time_s, value / volt)


class _ZeroCurrent:
    """What K sensors show while the contactors are open."""

    def __init__(self, branches: int, is_open: Sequence[float], max_age_s: float) -> None:
        self._open, self._max_age_s = is_open, max_age_s
        self._window: list[list[tuple[float, float]]] | None = None
        self._first_s = self._last_s = 0.0
        self._medians: list[_Column] = [[] for _ in range(branches)]
        self._pieces: list[_Column] = [[] for _ in range(branches)]
        self._noise: list[_Column] = [[0.0, 0.0, 0.0] for _ in range(branches)]
        """Number, sum and sum of squares of the distances from the medians."""

    def state(self, time_s: float, value: float) -> None:
        """Take a state of the contactors."""
        is_open = any(math.isclose(value, other, rel_tol=1e-9, abs_tol=1e-9) for other in self._open)
        if self._window is not None and (not is_open or time_s - self._last_s > self._max_age_s):
            self.end_window()
        if is_open:
            if self._window is None:
                self._window, self._first_s = [[] for _ in self._medians], time_s
            self._last_s = time_s

    def current(self, branch: int, time_s: float, value_a: float) -> None:
        """Take a good sample of a branch."""
        if self._window is not None and len(self._window[branch]) < _MOST_ZERO:
            self._window[branch].append((time_s, value_a))

    def end_window(self) -> None:
        """Take the median of each branch well inside the window, and those of its pieces."""
        window, self._window = self._window, None
        for k, samples in enumerate(window or ()):
            first_s, last_s = self._first_s + ZERO_SETTLING_S, self._last_s - ZERO_SETTLING_S
            inside = [sample for sample in samples if first_s <= sample[0] <= last_s]
            if inside:
                middle = _median([value for _, value in inside])
                pieces: dict[int, _Column] = {}
                for time_s, value in inside:
                    pieces.setdefault(int((time_s - inside[0][0]) / ZERO_PIECE_S), []).append(value)
                far = [value - middle for _, value in inside]
                self._medians[k].append(middle)
                self._pieces[k] += map(_median, pieces.values())
                for place, part in enumerate((len(far), sum(far), sum(map(mul, far, far)))):
                    self._noise[k][place] += part

    def reading(self, branch: int, step_a: float) -> tuple[float, float] | None:
        """Offset of a branch and its standard deviation [A]; None if the windows are too short."""
        count, total, squares = self._noise[branch]
        if count < FEWEST_ZERO_SAMPLES:
            return None
        medians, pieces = self._medians[branch], self._pieces[branch]
        white = math.sqrt(math.pi / 2.0 * max(squares / count - (total / count) ** 2, 0.0) / count)
        middle = sum(pieces) / len(pieces)
        wander = 0.0
        if len(pieces) > 1:
            variance = sum((piece - middle) ** 2 for piece in pieces) / (len(pieces) - 1)
            wander = math.sqrt(variance / len(medians))
        sd = math.sqrt(ZERO_RESOLUTION_A**2 + step_a**2 / 12.0 + max(white, wander) ** 2)
        return sum(medians) / len(medians), sd


@dataclass(kw_only=True)
class _Batches:
    """What a file has so far; see :class:`SummaryFile`."""

    recorded: tuple[str, ...]
    inputs: tuple[str, ...]
    branches: tuple[str, ...]
    levels: list[dict[int, _Column]]
    zero: _ZeroCurrent
    starts: list[bool] = field(default_factory=list)
    count: list[int] = field(default_factory=list)
    mean: _Column = field(default_factory=list)
    covariance: _Column = field(default_factory=list)
    noise_a2: _Column = field(default_factory=list)
    fast_a2: _Column = field(default_factory=list)
    spikes: _Column = field(default_factory=list)
    temperature_c: _Column = field(default_factory=list)
    path: Path | None = None


class OnBoardSummary:
    """Makes the summary of one vehicle from its frames.

    Parameters
    ----------
    folder : Path
        Where records are written, in a folder named as the vehicle.
    vehicle : str
        Its name.
    database : VehicleDatabase
        Layout and DBC.
    delays : mapping of str to (float, float or None)
        Delay of each branch and its standard deviation, None: not known; branches that are not named have none. [s]
    say : callable
        Takes one line for the log.

    Raises
    ------
    UserError
        If the layout has a branch that is computed by a formula, or the folder cannot be made.
    """

    def __init__(
        self,
        folder: Path,
        vehicle: str,
        database: VehicleDatabase,
        *,
        delays: Mapping[str, tuple[float, float | None]],
        say: Callable[[str], None],
    ) -> None:
        layout, self._period_s = database.layout, database.layout.period_s
        if computed := [branch.name for branch in layout.branch if branch.computed]:
            raise LayoutError(
                f"{layout.path}: branch {computed[0]} is computed by a formula, which --summary does not; leave it out "
                f"of the layout, or record logs"
            )
        self._folder, self._vehicle, self._database, self._say = folder, vehicle, database, say
        self._bus: SteadyBus | None = None
        self._delays = {branch.name: delays.get(branch.name, (0.0, None)) for branch in layout.branch}
        try:
            (folder / vehicle).mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise UserError(f"--summary {folder}: cannot be used: {error.strerror}; name another folder") from None
        self._length = max(round(BLOCK_S / layout.period_s), 1)
        self._batch = self._length * max(BATCH_SAMPLES // self._length, 1)
        self.messages: dict[FrameKey, tuple[Callable[[bytes | bytearray], bool], list[_Reader]]] = {}
        """What is read, by identifier."""
        self._readers: dict[str, _Reader] = {}
        wanted = base_inputs(layout, layout.fleet_inputs or layout.model_inputs)
        self._inputs = self._wire_inputs([item.name for item in layout.input if item.name in wanted])
        self._branches = self._wire_branches()
        self._temperature = math.nan
        self._writer = ThreadPoolExecutor(1, "summary")
        self._written: Future[None] | None = None
        self._has_failed = False
        self._steps: Iterator[None] = iter(())
        self._zero = self._new_zero()
        self._file: _Batches | None = None
        self._zero_s: float | None = None
        self._next: int | None = None
        self._last_s = self._heard_s = 0.0
        self._restart()

    # ---- frames

    def listen(self, bus: SteadyBus) -> None:
        """Take frames from a bus from now on, at each :meth:`look`; it is closed with the summary."""
        self._bus = bus

    def look(self, now_s: float) -> None:
        """Take the frames that have come, and do a little of what is to be done; on the steady clock. [s]"""
        for _ in range(MOST_AT_ONCE):
            if self._bus is None or (message := self._bus.receive(0.0)) is None:
                break
            if not message.is_remote_frame:
                key = FrameKey(message.arbitration_id, message.is_extended_id)
                self.take(key, message.data, message.timestamp or time.time())
                self._heard_s = now_s
        next(self._steps, None)
        if self._zero_s is not None and now_s - self._heard_s > DRIVE_GAP_S:
            self.end_drive()

    def take(self, key: FrameKey, payload: bytes | bytearray, stamp_s: float) -> None:
        """Take a frame.

        Parameters
        ----------
        key : FrameKey
            Identifier.
        payload : bytes
            Data.
        stamp_s : float
            Time of day. A step of it, forwards or backwards, begins another drive. [s]
        """
        if self._zero_s is not None and abs(stamp_s - self._zero_s - self._last_s) > DRIVE_GAP_S:
            self.end_drive()
        if self._zero_s is None:
            self._zero_s = stamp_s
        time_s = self._last_s = stamp_s - self._zero_s
        if (found := self.messages.get(key)) is None:
            return
        is_sound, readers = found
        sound = is_sound(payload)
        for reader in readers:
            reader.take(payload, time_s, is_sound=sound)
        self._hand_on(time_s)

    def end_drive(self) -> None:
        """End a drive: its last block is closed, short as it may be, and written."""
        if self._next is None and self._zero_s is not None:
            self._start()
        if self._next is not None:
            end_s = min(channel.samples[-1][0] for channel in self._channels) + TIME_RESOLUTION_S * self._period_s
            for instant in range(self._next, math.floor(end_s / self._period_s) + 1):
                row = [channel.at(instant * self._period_s, math.inf) for channel in self._channels]
                self._take_row([math.nan if value is None else value for value in row])
        self._zero.end_window()
        self._close_batch()
        for _ in self._steps:
            pass
        self._restart()

    def close(self) -> None:
        """End the drive, and see that it is on the disk."""
        if self._bus is not None:
            self._bus.close()
        self.end_drive()
        self._writer.shutdown()
        self._look_at_writer()

    def _wire_inputs(self, names: Sequence[str]) -> dict[str, _Channel]:
        """Read recorded inputs, the temperature of the sensors and the state of the contactors."""
        layout = self._database.layout
        channels = {name: _Channel(layout.max_age_s) for name in names}
        for name, channel in channels.items():
            self._take_signal(self._signal_of(name), channel.put)
        if layout.temperature is not None:
            self._take_signal(self._signal_of(layout.temperature), self._put_temperature)
        if layout.contactor is not None:
            self._take_signal(self._signal_of(layout.contactor.input), self._put_state)
        return channels

    def _wire_branches(self) -> dict[str, _Channel]:
        """Read the branches."""
        layout, channels = self._database.layout, {}
        for k, branch in enumerate(layout.branch):
            where, units = f"{layout.path}: branch {branch.name}", AMPERE if branch.power is None else WATT
            factor = branch.sign * unit_factor(self._database.signal(branch.source)[1], units, where)
            channel = _Channel(branch.timeout_s, factor, self._delays[branch.name][0])
            channel.seen = partial(self._put_seen, k)
            put = channel.put
            if branch.voltage is not None:
                volt = unit_factor(self._database.signal(branch.voltage)[1], VOLT, where)
                power = _Power(channel, branch.timeout_s, volt)
                self._take_signal(branch.voltage, power.put_voltage)
                put = power.put
            self._take_signal(branch.source, put)
            channels[branch.name] = channel
        return channels

    def _new_zero(self) -> _ZeroCurrent:
        layout = self._database.layout
        is_open = [] if layout.contactor is None else layout.contactor.open
        return _ZeroCurrent(len(layout.branch), is_open, layout.max_age_s)

    def _signal_of(self, name: str) -> SignalName:
        return next(item.signal for item in self._database.layout.input if item.name == name)

    def _take_signal(self, name: SignalName, taker: Callable[[float, float], None]) -> None:
        """Give the values of a signal to somebody."""
        if name not in self._readers:
            message, signal = self._database.signal(name)
            self._readers[name] = _Reader(message, signal, codes_of_no_value(self._database, name))
            key = FrameKey(message.frame_id, message.is_extended_frame)
            if key not in self.messages:
                self.messages[key] = (self._check_of(message), [])
            self.messages[key][1].append(self._readers[name])
        self._readers[name].takers.append(taker)

    def _check_of(self, message: Message) -> Callable[[bytes | bytearray], bool]:
        """Whether a payload of a message is sound, by its end-to-end protection."""
        protection = protection_of(self._database, message)
        if protection is None:
            return lambda _: True

        def is_sound(payload: bytes | bytearray) -> bool:
            return (
                len(payload) >= protection.least_bytes
                and protection.counter_of(payload) < protection.modulus
                and protection.is_sound(bytearray(payload))
            )

        return is_sound

    def _put_state(self, time_s: float, value: float) -> None:
        self._zero.state(time_s, value)

    def _put_seen(self, branch: int, time_s: float, value_a: float) -> None:
        self._zero.current(branch, time_s, value_a)

    def _put_temperature(self, _: float, value: float) -> None:
        if not math.isnan(value):
            self._temperature = value

    # ---- rows

    def _restart(self) -> None:
        """Begin a drive, with the next frame."""
        self._zero_s = self._next = None
        self._drive_starts = True
        self._temperature = math.nan
        for channel in (*self._inputs.values(), *self._branches.values()):
            channel.samples.clear()
        self._columns: list[_Column] = []
        self._warm_c: _Column = []

    def _start(self) -> None:
        """Let the time base of the drive begin, with the branches and inputs that there are."""
        layout = self._database.layout
        inputs = {name: channel for name, channel in self._inputs.items() if channel.samples}
        branches = {name: channel for name, channel in self._branches.items() if channel.samples}
        self._channels = [*inputs.values(), *branches.values()]
        if len(branches) < 2:
            for channel in self._channels:
                channel.samples.popleft()
            return
        start_s = max(channel.samples[0][0] for channel in self._channels)
        self._next = math.ceil((start_s - TIME_RESOLUTION_S * self._period_s) / self._period_s)
        names = layout.fleet_inputs or layout.model_inputs
        chosen = tuple(name for name in names if base_inputs(layout, [name]) <= inputs.keys())
        wanted = (tuple(inputs), chosen, tuple(branches))
        if self._file is None or wanted != (self._file.recorded, self._file.inputs, self._file.branches):
            self._file = self._new_file(*wanted)
            absent = [name for name in (*self._inputs, *self._branches) if name not in {*inputs, *branches}]
            if absent:
                self._say(f"--summary: no good value of {', '.join(absent)}: left out")
        derived = [item for item in layout.derived if base_inputs(layout, [item.name]) <= inputs.keys()]
        self._derived = [(item.name, parse_formula(item.formula)) for item in derived]
        self._new_batch(len(chosen) + len(branches))

    def _new_batch(self, columns: int) -> None:
        self._columns = [[] for _ in range(columns)]
        self._warm_c = []

    def _hand_on(self, now_s: float) -> None:
        """Take the instants at which all channels have a value."""
        if self._next is None:
            if now_s < _PROBED_S and not all(c.samples for c in (*self._inputs.values(), *self._branches.values())):
                return
            self._start()
        while self._next is not None and (instant_s := self._next * self._period_s) <= now_s:
            row = []
            for channel in self._channels:
                value = channel.at(instant_s, now_s)
                if value is None:
                    return
                row.append(value)
            self._next += 1
            self._take_row(row)

    def _take_row(self, row: _Column) -> None:
        assert self._file is not None
        recorded = self._file.recorded
        values = dict(zip(recorded, row, strict=False))
        for name, formula in self._derived:
            values[name] = formula_value(formula, values)
        row = [*(values[name] for name in self._file.inputs), *row[len(recorded) :]]
        if not all(map(math.isfinite, row)):
            row = [math.nan] * len(row)
        for column, value in zip(self._columns, row, strict=True):
            column.append(value)
        self._warm_c.append(self._temperature)
        if len(self._warm_c) == self._batch:
            self._close_batch()

    # ---- batches

    def _close_batch(self) -> None:
        """Sum a batch, in steps of about a millisecond; one that is still being summed is finished first."""
        for _ in self._steps:
            pass
        columns, warm_c = self._columns, self._warm_c
        if warm_c:
            padding = [math.nan] * (-len(warm_c) % self._length)
            for column in (*columns, warm_c):
                column.extend(padding)
            assert self._file is not None
            self._steps = self._sum(self._file, columns, warm_c)
            self._new_batch(len(columns))

    def _sum(self, file: _Batches, columns: list[_Column], warm_c: _Column) -> Iterator[None]:
        """Add the blocks of a batch to the file, and write it."""
        K, length = len(file.branches), self._length
        M = len(columns) - K
        blocks = [slice(first, first + length) for first in range(0, len(warm_c), length)]
        noise = []
        for block in blocks:
            noise.append([_white_noise_a2(column[block]) for column in columns[M:]])
            yield
        used = [not math.isnan(value) for value in columns[M]]
        currents = [[value if there else 0.0 for value, there in zip(c, used, strict=True)] for c in columns[M:]]
        found = yield from _find_spikes(currents, used)
        for t in found:
            used[t] = False
        kept = [block for block in blocks if sum(used[block]) >= LEAST_SHARE * length]
        if not kept:
            return
        yield
        parts = []
        for column in columns:
            parts.append([value for block in kept for value, ok in zip(column[block], used[block], strict=True) if ok])
            yield
        count = len(parts[0])
        means = [math.fsum(part) / count for part in parts]
        file.mean += means
        centred = [[value - mean for value in part] for part, mean in zip(parts, means, strict=True)]
        for i, one in enumerate(centred):
            file.covariance += [math.fsum(map(mul, one, other)) / count for other in centred[: i + 1]]
            yield
        for k in range(K):
            _add_levels(parts, M + k, file.levels[k])
            yield
        fast = [
            _second_differences([columns[M + k][block] for block in kept], [used[b] for b in kept]) for k in range(K)
        ]
        yield
        file.fast_a2 += [math.fsum(map(mul, fast[i], fast[j])) for i in range(K) for j in range(i + 1)]
        samples = [sum(used[block]) for block in kept]
        pairs = [(noise[blocks.index(block)], n) for block, n in zip(kept, samples, strict=True)]
        file.noise_a2 += [sum(part[k] * n for part, n in pairs) / count for k in range(K)]
        inside = [signs for t, signs in found.items() if any(block.start <= t < block.stop for block in kept)]
        file.spikes += [sum(sign[k] == way for sign in inside) for k in range(K) for way in (1, -1)]
        warm = [_mean_known(warm_c[block], used[block]) for block in kept]
        file.temperature_c.append(sum(mean * n for mean, n in zip(warm, samples, strict=True)) / count)
        file.starts.append(self._drive_starts)
        self._drive_starts = False
        file.count.append(count)
        yield
        self._write(file)
        if len(file.count) == MOST_BATCHES:
            self._zero = self._new_zero()
            self._file = self._new_file(file.recorded, file.inputs, file.branches)

    # ---- files

    def _new_file(self, recorded: tuple[str, ...], inputs: tuple[str, ...], branches: tuple[str, ...]) -> _Batches:
        levels: list[dict[int, _Column]] = [{} for _ in branches]
        return _Batches(recorded=recorded, inputs=inputs, branches=branches, levels=levels, zero=self._zero)

    def _write(self, file: _Batches) -> None:
        """Have a file replaced as a whole; one that could not be written is tried again with the next batch."""
        if file.path is None:
            stem = f"{datetime.now(UTC):%Y-%m-%dT%H%M%S}"
            names = (f"{stem}{more}{SUFFIX}" for more in ("", *(f"-{n}" for n in range(2, 1000))))
            file.path = next(path for name in names if not (path := self._folder / self._vehicle / name).exists())
        self._look_at_writer()
        content = encode_summary(self._record(file))
        self._written = self._writer.submit(write_atomically, file.path, content)

    def _look_at_writer(self) -> None:
        """Say when writing fails, and when it does no more."""
        if self._written is None:
            return
        try:
            self._written.result()
            failed, news = False, "records are written again"
        except OSError as error:
            failed, news = True, f"{error.strerror}; records are lost until that has changed"
        if failed != self._has_failed:
            self._has_failed = failed
            self._say(f"--summary: {news}")

    def _record(self, file: _Batches) -> SummaryFile:
        layout, database = self._database.layout, self._database
        places = {branch.name: k for k, branch in enumerate(layout.branch)}
        readings = [file.zero.reading(places[name], database.current_step_a(name)) for name in file.branches]
        levels = [sorted(sums) for sums in file.levels]
        return SummaryFile(
            schema_version=SCHEMA_VERSION,
            vehicle=self._vehicle,
            layout_sha256=layout.digest,
            dbc_sha256=database.digest,
            branches=list(file.branches),
            inputs=list(file.inputs),
            recorded=list(file.recorded),
            period_s=layout.period_s,
            block_s=BLOCK_S,
            delay_s=[self._delays[name][0] for name in file.branches],
            delay_sd_s=[self._delays[name][1] for name in file.branches],
            zero_offset_a=[None if reading is None else reading[0] for reading in readings],
            zero_sd_a=[None if reading is None else reading[1] for reading in readings],
            starts=file.starts,
            count=file.count,
            mean=packed(file.mean),
            covariance=packed(file.covariance),
            noise_a2=packed(file.noise_a2),
            fast_a2=packed(file.fast_a2),
            spikes=packed(file.spikes),
            temperature_c=packed(file.temperature_c),
            levels=levels,
            level_sums=packed(
                [x for k, chosen in enumerate(levels) for level in chosen for x in file.levels[k][level]]
            ),
        )


def on_board_summary(
    options: argparse.Namespace,
    bus: Mapping[str, Any],
    database: VehicleDatabase,
    parameters: VehicleParameters | None,
    say: Callable[[str], None],
) -> OnBoardSummary:
    """Summary of a run of the node, which listens to the bus of the sensors by itself, as a logger does.

    Parameters
    ----------
    options : argparse.Namespace
        Those of ``ecu-node run``.
    bus : mapping
        Bus of the sensors, as the arguments of :func:`ecu_node.bus.adapters.bus_config`.
    database, parameters : VehicleDatabase, VehicleParameters or None
        Of the vehicle; delays are those of the parameters.
    say : callable
        Takes one line for the log.

    Raises
    ------
    UserError
        If it is not known which vehicle it is, or the bus cannot be opened a second time.
    """
    vehicle = options.vehicle or (parameters.vehicle if parameters is not None else None)
    if vehicle is None:
        raise UserError("--summary: it is not known which vehicle this is; give --vehicle or $ECU_NODE_VEHICLE")
    if "/" in vehicle or vehicle.startswith("."):
        raise UserError(f"--summary: vehicle {vehicle!r} cannot name a folder; rename it")
    delays = (
        {}
        if parameters is None
        else {name: (branch.delay_s or 0.0, branch.delay_sd_s) for name, branch in parameters.branches.items()}
    )
    summary = OnBoardSummary(options.summary, vehicle, database, delays=delays, say=say)
    filters: list[CanFilter] = [
        {"can_id": key, "can_mask": 0x1FFFFFFF if extended else 0x7FF, "extended": extended}
        for key, extended in summary.messages
    ]
    summary.listen(SteadyBus(partial(connect, filters=filters, **bus), Counters(), listen_only=True))
    return summary


# ---- sums of a batch


def _median(values: Sequence[float]) -> float:
    ordered, middle = sorted(values), len(values) // 2
    return ordered[middle] if len(ordered) % 2 else 0.5 * (ordered[middle - 1] + ordered[middle])


def _mean_known(values: Sequence[float], used: Sequence[bool]) -> float:
    known = [value for value, there in zip(values, used, strict=True) if there and not math.isnan(value)]
    return sum(known) / len(known) if known else math.nan


def _white_noise_a2(current_a: Sequence[float]) -> float:
    """Variance of white noise in a block, from the median third difference; gaps (NaN) take no part. [A^2]"""
    x = current_a
    third = [abs(late - early - 3.0 * (c - b)) for early, b, c, late in zip(x, x[1:], x[2:], x[3:], strict=False)]
    known = [value for value in third if not math.isnan(value)]
    if not known:
        return 0.0
    return (_median(known) / NORMAL_MEDIAN) ** 2 / DIFFERENCE_GAIN / (1.0 + MEDIAN_EXCESS / len(known))


def _add_levels(columns: Sequence[_Column], own: int, sums: dict[int, _Column]) -> None:
    """Add samples to the sums of the level of one of their currents."""
    sorted_rows: dict[int, list[int]] = {}
    for t, x in enumerate(columns[own]):
        away = bisect_right(LEVELS_A, int(abs(x)))
        sorted_rows.setdefault(len(LEVELS_A) + (away if x > 0.0 else -away), []).append(t)
    for level, rows in sorted_rows.items():
        new = [
            *(sum(column[t] for t in rows) for column in columns),
            len(rows),
            sum(columns[own][t] ** 2 for t in rows),
        ]
        old = sums.get(level)
        sums[level] = new if old is None else [a + b for a, b in zip(old, new, strict=True)]


def _second_differences(blocks: Sequence[_Column], used: Sequence[Sequence[bool]]) -> _Column:
    """Distance of samples from the mean of their neighbours; zero where one of the three is not used. [A]"""
    return [
        b - 0.5 * (a + c) if all(there) else 0.0
        for x, u in zip(blocks, used, strict=True)
        for a, b, c, there in zip(x, x[1:], x[2:], zip(u, u[1:], u[2:], strict=False), strict=False)
    ]


def _find_spikes(currents: list[_Column], used: Sequence[bool]) -> Generator[None, None, dict[int, list[int]]]:
    """As :func:`calibrator.summaries.summariser.find_spikes`; returns by sample the sign of each branch's spike."""
    K, count, found, half = len(currents), len(used), dict[int, list[int]](), SPIKE_WINDOW // 2
    kept, suspects, weights = list(used), list[int](), list[float]()
    for _ in range(2):  # the second time with gains that the spikes did not bend
        if sum(kept) < FEWEST_FOR_GAINS * K:
            return found
        weights = _junction_weights(currents, kept)
        yield
        residual = [sum(map(mul, weights, row)) for row in zip(*currents, strict=True)]
        yield
        pairs = zip(pairwise(residual), pairwise(used), strict=True)
        change = sorted(abs(b - a) for (a, b), there in pairs if all(there))
        if not change or not change[-1] > max(STEP_OF_SPIKE * _median(change), LEAST_SPIKE_A):
            return found
        yield
        padded = [residual[0]] * half + residual + [residual[-1]] * half
        far = []
        for t, value in enumerate(residual):
            far.append(abs(value - sorted(padded[t : t + SPIKE_WINDOW])[half]))
            if t % 500 == 0:
                yield
        spread = MAD_TO_SD * _median([value for value, there in zip(far, kept, strict=True) if there])
        limit = max(SPIKE_SDS * spread, LEAST_SPIKE_A)
        suspects = [t for t, value in enumerate(far) if used[t] and value > limit]
        kept = list(used)
        for t in suspects:
            kept[t] = False
    for t in suspects:
        window = [min(max(t + step, 0), count - 1) for step in range(-half, half + 1)]
        moves = []
        for weight, current in zip(weights, currents, strict=True):
            around = [weight * current[at] for at in window]
            middle = _median(around)
            moves.append([value - middle for value in around])
        nearby = [max(map(abs, move[half - 1 : half + 2])) for move in moves]
        signs = [0] * K
        for k, move in enumerate(moves):
            own = move[half]
            steps = [math.copysign(1.0, own) * (b - a) for a, b in pairwise(move)]
            edge = min(max(steps[:half]), -min(steps[half:]))
            if sum(nearby) - nearby[k] < OTHERS_MOVE * abs(own) and edge > LEAST_EDGE * abs(own):
                signs[k] = 1 if own * weights[k] > 0.0 else -1
        if any(signs):
            found[t] = signs
    return found


def _junction_weights(currents: list[_Column], kept: Sequence[bool]) -> list[float]:
    """Weights of the branches in the junction law by least squares, that of the one that moves most being one."""
    parts = [[value for value, there in zip(column, kept, strict=True) if there] for column in currents]
    count = len(parts[0])
    parts = [[value - mean for value in part] for part in parts for mean in (sum(part) / count,)]
    gram = [[sum(map(mul, one, other)) for other in parts] for one in parts]
    first = max(range(len(gram)), key=lambda k: gram[k][k])
    others = [k for k in range(len(gram)) if k != first]
    rows = [[*(gram[i][j] for j in others), -gram[i][first]] for i in others]
    solved = [0.0] * len(others)
    scale = max((abs(rows[n][n]) for n in range(len(rows))), default=0.0)
    for n in range(len(rows)):  # Gauss, pivots on the diagonal: the matrix is a covariance
        if not rows[n][n] > 1e-9 * scale:
            rows[n] = [0.0] * len(rows[n])  # a branch that does not move
            continue
        for below in rows[n + 1 :]:
            share = below[n] / rows[n][n]
            below[:] = [a - share * b for a, b in zip(below, rows[n], strict=True)]
    for n in reversed(range(len(rows))):
        if rows[n][n]:
            right = rows[n][-1] - sum(rows[n][m] * solved[m] for m in range(n + 1, len(rows)))
            solved[n] = right / rows[n][n]
    weights = [0.0] * len(gram)
    weights[first] = 1.0
    for k, weight in zip(others, solved, strict=True):
        weights[k] = weight
    return weights
