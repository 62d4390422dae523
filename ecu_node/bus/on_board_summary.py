"""``ecu-node run --summary``: the node sums up its drives as ``calibrator summarise`` does, in plain Python.

:mod:`ecu_node.summary` defines what is summed. Good samples are kept until a batch of blocks is complete (150 s at
10 Hz, which is what a power cut can lose); then all channels are put on one time base and summed, in a thread that
yields to frames. A record has one entry per batch. It is a file ``FOLDER/VEHICLE/TIME.summary`` of at most
:data:`MOST_BATCHES` batches, replaced as a whole with each batch. Delays are those of the parameter file. Frames are
read from the bus as a logger would read them, beside the node.
"""

import argparse
import math
import sys
import time
from bisect import bisect_right
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial
from itertools import pairwise
from operator import mul
from pathlib import Path
from statistics import median, stdev
from typing import Any, NamedTuple, TypeAlias

from ecu_node import summary as rule
from ecu_node.bus.adapters import connect, filters_of
from ecu_node.bus.steady_bus import SteadyBus
from ecu_node.bus.wiring import Mode, branch_signals, key_of, signal_codes
from ecu_node.core.e2e import protection_of
from ecu_node.core.signals import Codes, FrameKey, PlacedSignal, placed_signal
from ecu_node.core.status import Counters
from ecu_node.database import VehicleDatabase, codes_of_no_value
from ecu_node.documents import write_atomically
from ecu_node.errors import UserError
from ecu_node.formulas import formula_value, parse_formula
from ecu_node.layout import Input
from ecu_node.parameters import VehicleParameters
from ecu_node.summary import SummaryFile, encode_summary, packed

MOST_BATCHES = 48
"""Most batches of a file, two hours at 10 Hz: the file is rewritten with each batch, so it must not grow large."""
MOST_AT_ONCE = 64
"""Most frames taken in one look, so that a flood delays no correction; frames that the bus drops leave a gap."""
DRIVE_GAP_S = 60.0
"""A silence of the bus for this long ends a drive. [s]"""
_MOST_ZERO = 20_000
"""Most samples of a branch that are kept of one window with open contactors."""
_PROBED_S = 30.0
"""Branches and inputs without a good value until this time after the start of a drive count as not fitted. [s]"""
_LONGEST_TURN_S = 0.0005
"""Longest time for which the thread that sums keeps the GIL when a frame comes. [s]"""

_Column = list[float]
_Samples = list[tuple[float, float]]
"""Times [s] and values."""
_Take = Callable[[float, float], None]
"""Takes the time [s] and the value of a sample."""


def _reader(placed: PlacedSignal, codes: Codes) -> Callable[[bytearray], float | None]:
    """Return a function that reads a signal from a payload: NaN if it is no value, None if it is multiplexed out."""
    scale, offset = float(codes.scale), float(codes.offset)

    def value(payload: bytearray) -> float | None:
        code = placed.code(payload)
        if code is None:
            return None if len(payload) >= placed.end else math.nan
        return code * scale + offset if codes.is_value(code) else math.nan

    return value


class _Channel:
    """Good samples of a branch or input since the last batch, with their times [s] at the junction."""

    def __init__(self, limit_s: float, delay_s: float = 0.0) -> None:
        self.limit_s, self._delay_s = limit_s + rule.TIME_RESOLUTION_S, delay_s
        self.samples: _Samples = []

    def put(self, time_s: float, value: float) -> None:
        """Take a sample; one older than the last is left out, and of several at one instant the last counts."""
        sample, samples = (time_s - self._delay_s, value), self.samples
        if math.isnan(value) or (samples and samples[-1][0] > sample[0]):
            return
        if samples and samples[-1][0] == sample[0]:
            samples.pop()
        samples.append(sample)

    def until(self, time_s: float) -> _Samples:
        """Return all samples, then drop those that no instant from a time [s] on needs."""
        samples = self.samples
        self.samples = samples[max(bisect_right(samples, (time_s, math.inf)) - 1, 0) :]
        return samples


def _aligned(samples: _Samples, instants_s: Sequence[float], limit_s: float) -> _Column:
    """Interpolate samples at instants from the first sample on; NaN in gaps above `limit_s`, and after the last one."""
    times_s, found = [time_s for time_s, _ in samples], []
    for instant_s in instants_s:
        following = bisect_right(times_s, instant_s)
        (before_s, before), (after_s, after) = samples[max(following - 1, 0)], samples[min(following, len(samples) - 1)]
        gap_s, since_s = after_s - before_s, instant_s - before_s  # gap 0 before the first sample and after the last
        if since_s <= (0.0 if gap_s else rule.INSTANT_SLACK * limit_s):
            found.append(before)
        elif gap_s and gap_s <= limit_s:
            found.append(((gap_s - since_s) * before + since_s * after) / gap_s)
        else:
            found.append(math.nan)
    return found


class _Window(NamedTuple):
    """What a branch showed in one window with open contactors. [A]"""

    middle: float
    pieces: _Column
    """Medians of the pieces of the window."""
    samples: int
    total: float
    squares: float
    """``samples``, ``total`` and ``squares`` are number, sum and sum of squares of the distances from the median."""


_Reading: TypeAlias = tuple[float, float] | tuple[None, None]


class _ZeroCurrent:
    """Collects the offsets that the sensors show while the contactors are open."""

    def __init__(self, database: VehicleDatabase) -> None:
        layout = database.layout
        self._steps_a = {name: database.current_step_a(name) for name in layout.branch_names}
        self._open = [] if layout.contactor is None else layout.contactor.open
        self._max_age_s = layout.max_age_s
        self._samples: dict[str, _Samples] | None = None
        """Samples of the window that goes on now, by branch; None if none does."""
        self._first_s = self._last_s = 0.0
        self._windows: dict[str, list[_Window]] = {name: [] for name in layout.branch_names}

    def state(self, time_s: float, value: float) -> None:
        """Take the value of the contactors' input at a time [s], and begin or end a window."""
        is_open = any(math.isclose(value, other, rel_tol=1e-9, abs_tol=1e-9) for other in self._open)
        if self._samples is not None and (not is_open or time_s - self._last_s > self._max_age_s):
            self.end_window()
        if is_open:
            if self._samples is None:
                self._samples, self._first_s = {name: [] for name in self._windows}, time_s
            self._last_s = time_s

    def current(self, branch: str, time_s: float, value_a: float) -> None:
        """Take a good sample of a branch."""
        if self._samples is not None and len(self._samples[branch]) < _MOST_ZERO:
            self._samples[branch].append((time_s, value_a))

    def end_window(self) -> None:
        """End the window; keep each branch's median, without the ends of the window, and medians of its pieces."""
        samples, self._samples = self._samples or {}, None
        first_s, last_s = self._first_s + rule.ZERO_SETTLING_S, self._last_s - rule.ZERO_SETTLING_S
        for name, windows in self._windows.items():
            inside = [sample for sample in samples.get(name, ()) if first_s <= sample[0] <= last_s]
            if inside:
                pieces: dict[int, _Column] = {}
                for time_s, value in inside:
                    pieces.setdefault(int((time_s - inside[0][0]) / rule.ZERO_PIECE_S), []).append(value)
                middle = median(value for _, value in inside)
                far = [value - middle for _, value in inside]
                windows.append(_Window(middle, [*map(median, pieces.values())], len(far), sum(far), _product(far, far)))

    def forget(self) -> None:
        """Forget all windows that have ended."""
        self._windows = {name: [] for name in self._windows}

    def reading(self, branch: str) -> _Reading:
        """Return the offset of a branch and its standard deviation [A]; None for both if there are too few samples."""
        windows = self._windows[branch]
        count = sum(window.samples for window in windows)
        if count < rule.FEWEST_ZERO_SAMPLES:
            return None, None
        mean = sum(window.total for window in windows) / count
        variance = max(sum(window.squares for window in windows) / count - mean**2, 0.0)
        white = math.sqrt(math.pi / 2.0 * variance / count)
        pieces = [piece for window in windows for piece in window.pieces]
        wander = stdev(pieces) / math.sqrt(len(windows)) if len(pieces) > 1 else 0.0
        sd_a = math.sqrt(rule.ZERO_RESOLUTION_A**2 + self._steps_a[branch] ** 2 / 12.0 + max(white, wander) ** 2)
        return sum(window.middle for window in windows) / len(windows), sd_a


_NUMBERS = ("mean", "covariance", "noise_a2", "fast_a2", "spikes", "temperature_c")
"""Fields of :class:`SummaryFile` with numbers for each batch."""


class OnBoardSummary:
    """Makes the summary of one vehicle from its frames.

    Parameters
    ----------
    folder : Path
        Folder for records, which are written into a subfolder named after the vehicle.
    vehicle : str
        Name of the vehicle.
    database : VehicleDatabase
        Layout and DBC.
    delays : mapping of str to (float, float or None)
        Delay of each branch and its standard deviation (None: not known); 0 for branches that are not named. [s]
    say : callable
        Takes one line for the log.

    Raises
    ------
    UserError
        If the folder cannot be made.
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
        layout = database.layout
        try:
            (folder / vehicle).mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise UserError(f"--summary {folder}: cannot be used: {error.strerror}; name another folder") from None
        self._folder, self._vehicle, self._database, self._say = folder / vehicle, vehicle, database, say
        self._delays = {name: delays.get(name, (0.0, None)) for name in layout.branch_names}
        self._period_s = layout.period_s
        self._length = max(round(rule.BLOCK_S / layout.period_s), 1)
        self._batch = self._length * max(rule.BATCH_SAMPLES // self._length, 1)
        self._bus: SteadyBus | None = None
        self._zero = _ZeroCurrent(database)
        self.messages: dict[
            FrameKey, tuple[Callable[[bytearray], bool], list[tuple[Callable[[bytearray], float | None], _Take]]]
        ] = {}
        """Messages to read, by identifier: a check of the payload, and a reader and a taker for each signal."""
        self._channels: dict[str, _Channel] = {}
        self._warm = _Channel(math.inf)
        self._read_all()
        self._wait_s = max(channel.limit_s for channel in self._channels.values())
        self._wait_s += max(abs(delay_s) for delay_s, _ in self._delays.values())
        self._background = ThreadPoolExecutor(1, "summary")
        self._job: Future[None] | None = None
        """Job that sums and writes a batch; until it ends only it uses ``_drive_starts`` and the fields of the file."""
        self._has_failed = False
        self._zero_s: float | None = None
        """When the drive began, in time of day [s]; None between drives."""
        self._next: int | None = None
        """Number of the first instant of the time base that was not summed yet; None before the time base begins."""
        self._heard_s = self._last_s = self._due_s = 0.0
        self._recorded: list[str] = []
        self._inputs: list[str] = []
        self._branches: list[str] = []
        self._begin_file()
        self._restart()

    # ---- frames

    def listen(self, bus: SteadyBus) -> None:
        """Take frames from a bus at each :meth:`look` from now on; :meth:`close` closes the bus."""
        self._bus = bus

    def look(self, now_s: float) -> None:
        """Take the frames that have come; ``now_s`` is the steady clock. [s]"""
        for _ in range(MOST_AT_ONCE):
            if self._bus is None or (message := self._bus.receive(0.0)) is None:
                break
            if not message.is_remote_frame:
                key = FrameKey(message.arbitration_id, message.is_extended_id)
                self.take(key, message.data, message.timestamp or time.time())
                self._heard_s = now_s
        if self._zero_s is not None and now_s - self._heard_s > DRIVE_GAP_S:
            self.end_drive()

    def take(self, key: FrameKey, payload: bytearray, stamp_s: float) -> None:
        """Take a frame.

        Parameters
        ----------
        key : FrameKey
            Its identifier.
        payload : bytearray
            Its data.
        stamp_s : float
            Time of day at which it came [s]; a step by more than :data:`DRIVE_GAP_S`, either way, begins another drive.
        """
        if self._zero_s is not None and abs(stamp_s - self._zero_s - self._last_s) > DRIVE_GAP_S:
            self.end_drive()
        if self._zero_s is None:
            self._zero_s = stamp_s
        time_s = self._last_s = stamp_s - self._zero_s
        if (found := self.messages.get(key)) is not None:
            is_sound, readers = found
            sound = is_sound(payload)
            for read, take in readers:
                value = read(payload) if sound else math.nan
                if value is not None:
                    take(time_s, value)
        if time_s > self._due_s:
            self._sum_batch()

    def end_drive(self) -> None:
        """End the drive: sum and write the rest of it; a block counts if at least ``LEAST_SHARE`` of it is valid."""
        self._zero.end_window()
        if self._zero_s is not None and (self._next is not None or self._start()):
            end_s = min(self._channels[name].samples[-1][0] for name in (*self._recorded, *self._branches))
            end = math.floor(end_s / self._period_s + rule.INSTANT_SLACK) + 1
            while self._next is not None and self._next < end:
                self._sum_batch(end)
        self._finish_job()
        self._restart()

    def close(self) -> None:
        """End the drive, and wait until it is written."""
        if self._bus is not None:
            self._bus.close()
        self.end_drive()
        self._background.shutdown()

    def _restart(self) -> None:
        """Make ready for the next drive, which begins with the next frame."""
        self._zero_s = self._next = None
        self._last_s, self._drive_starts = 0.0, True
        self._due_s = _PROBED_S + self._batch * self._period_s + self._wait_s
        for channel in (*self._channels.values(), self._warm):
            channel.samples.clear()

    def _read_all(self) -> None:
        """Set up what is read: inputs, temperature of the sensors, state of the contactors, and branches."""
        layout, database = self._database.layout, self._database
        wanted = layout.base_inputs(layout.fleet_inputs or layout.model_inputs)
        for item in layout.input:
            if item.name in wanted:
                self._channels[item.name] = _Channel(layout.max_age_s)
                self._read_input(item, self._channels[item.name].put)
            if item.name == layout.temperature:
                self._read_input(item, self._warm.put)
            if layout.contactor is not None and item.name == layout.contactor.input:
                self._read_input(item, self._zero.state)
        for branch in layout.branch:
            signals = branch_signals(database, branch, Mode.GATEWAY)
            channel = self._channels[branch.name] = _Channel(branch.timeout_s, self._delays[branch.name][0])
            take: _Take = partial(self._take_current, branch.name, channel, branch.sign)
            if branch.voltage is not None and signals.voltage is not None:
                put_voltage, take = _power_over_voltage(channel.limit_s, take)
                self._read(branch.voltage, signals.voltage, put_voltage)
            self._read(branch.source, signals.source, take)

    def _read_input(self, item: Input, take: _Take) -> None:
        """Have an input read in its own unit; codes whose names mean "not available" are no values."""
        codes = signal_codes(self._database, item.signal, None, f"input {item.name}")
        no_value = codes_of_no_value(self._database, item.signal)
        named = {code: name for code, name in codes.named.items() if code in no_value}
        self._read(item.signal, replace(codes, named=named), take)

    def _read(self, name: str, codes: Codes, take: _Take) -> None:
        """Have a signal read from its message, and each value given to `take`."""
        message, signal = self._database.signal(name)
        protection = protection_of(self._database, message)
        _, readers = self.messages.setdefault(
            key_of(message), (protection.is_intact if protection else lambda _: True, [])
        )
        readers.append((_reader(placed_signal(message, signal), codes), take))

    def _take_current(self, branch: str, channel: _Channel, sign: int, time_s: float, value: float) -> None:
        """Take a current with the sign of its signal, as a sample positive into the junction; NaN is left out."""
        if not math.isnan(value):
            channel.put(time_s, sign * value)
            self._zero.current(branch, time_s, sign * value)

    # ---- batches

    def _start(self) -> bool:
        """Begin the time base of the drive with the branches and inputs that were seen; return whether it can."""
        layout, channels = self._database.layout, self._channels
        fitted = [name for name, item in channels.items() if item.samples and item.samples[0][0] <= _PROBED_S]
        branches = [name for name in layout.branch_names if name in fitted]
        if len(branches) < 2:
            return False
        recorded = [name for name in fitted if name not in branches]
        wanted = layout.fleet_inputs or layout.model_inputs
        inputs = [name for name in wanted if layout.base_inputs([name]) <= {*recorded}]
        self._finish_job()
        if (recorded, inputs, branches) != (self._recorded, self._inputs, self._branches):
            self._recorded, self._inputs, self._branches = recorded, inputs, branches
            self._begin_file()
            if absent := [name for name in channels if name not in fitted]:
                self._say(f"--summary: no good value of {', '.join(absent)}: left out")
        start_s = max(channels[name].samples[0][0] for name in fitted)
        self._next = math.ceil(start_s / self._period_s - rule.INSTANT_SLACK)
        return True

    def _begin_file(self) -> None:
        """Forget the batches of the last file; the next batch begins a new one."""
        self._path: Path | None = None
        self._starts: list[bool] = []
        self._count: list[int] = []
        self._numbers: dict[str, _Column] = {name: [] for name in _NUMBERS}
        self._levels: dict[str, dict[int, _Column]] = {name: {} for name in self._branches}

    def _sum_batch(self, end: int | None = None) -> None:
        """Have the next batch summed in the background, up to instant number `end`; wait for the batch before it."""
        if self._next is None and not self._start():
            self._restart()
            return
        assert self._next is not None
        last = self._next + self._batch if end is None else min(self._next + self._batch, end)
        instants_s = [number * self._period_s for number in range(self._next, last)]
        samples = {name: channel.until(last * self._period_s) for name, channel in self._channels.items()}
        warm = self._warm.until(last * self._period_s)
        self._next, self._due_s = last, (last + self._batch) * self._period_s + self._wait_s
        self._finish_job()
        readings = [self._zero.reading(name) for name in self._branches]
        self._job = self._background.submit(self._sum, instants_s, samples, warm, readings)

    def _finish_job(self) -> None:
        """Wait for the running job; log when writing fails, and when it works again."""
        if self._job is None:
            return
        try:
            self._job.result()
            failed, news = False, "records are written again"
            if len(self._count) >= MOST_BATCHES:
                self._zero.forget()
                self._begin_file()
        except OSError as error:
            failed, news = True, f"{error.strerror}; records are lost until that has changed"
        if failed != self._has_failed:
            self._has_failed = failed
            self._say(f"--summary: {news}")
        self._job = None

    def _columns(self, instants_s: Sequence[float], samples: Mapping[str, _Samples]) -> list[_Column]:
        """Return inputs and currents at each instant, filled up to a whole block; NaN in all where one is NaN."""
        names, layout = [*self._recorded, *self._branches], self._database.layout
        derived = [item for item in layout.derived if layout.base_inputs([item.name]) <= {*self._recorded}]
        rows: list[_Column] = []
        aligned = [_aligned(samples[name], instants_s, self._channels[name].limit_s) for name in names]
        for each in zip(*aligned, strict=True):
            values = dict(zip(names, each, strict=True))
            for item in derived:
                values[item.name] = formula_value(parse_formula(item.formula), values)
            row = [values[name] for name in (*self._inputs, *self._branches)]
            rows.append(row if all(map(math.isfinite, row)) else [math.nan] * len(row))
        rows += [[math.nan] * len(rows[0])] * (-len(rows) % self._length)
        return [[*column] for column in zip(*rows, strict=True)]

    def _sum(
        self, instants_s: Sequence[float], samples: Mapping[str, _Samples], warm: _Samples, readings: list[_Reading]
    ) -> None:
        """Add the blocks of a batch to the file, and write it."""
        columns, K, length = self._columns(instants_s, samples), len(self._branches), self._length
        M = len(columns) - K
        used = [not math.isnan(value) for value in columns[M]]
        currents = [[value if there else 0.0 for value, there in zip(c, used, strict=True)] for c in columns[M:]]
        spikes = _find_spikes(currents, used)
        for t in spikes:
            used[t] = False
        blocks = (slice(first, first + length) for first in range(0, len(used), length))
        kept = [block for block in blocks if sum(used[block]) >= rule.LEAST_SHARE * length]
        chosen = [t for block in kept for t in range(block.start, block.stop) if used[t]]
        if not chosen:
            return
        numbers, count = self._numbers, len(chosen)
        parts = [[column[t] for t in chosen] for column in columns]
        means = [math.fsum(part) / count for part in parts]
        centred = [[value - mean for value in part] for part, mean in zip(parts, means, strict=True)]
        fast = [_second_differences([column[b] for b in kept], [used[b] for b in kept]) for column in columns[M:]]
        for name, own, column in zip(self._branches, parts[M:], columns[M:], strict=True):
            _add_levels(parts, own, self._levels[name])
            least_a2 = self._database.current_step_a(name) ** 2 / 12.0  # of rounding
            noise = sum(sum(used[block]) * max(_white_noise_a2(column[block]), least_a2) for block in kept)
            numbers["noise_a2"].append(noise / count)
        numbers["mean"] += means
        numbers["covariance"] += [part / count for part in _products(centred)]
        numbers["fast_a2"] += _products(fast)
        signs = [signs for t, signs in spikes.items() if any(block.start <= t < block.stop for block in kept)]
        numbers["spikes"] += [sum(sign[k] == way for sign in signs) for k in range(K) for way in (1, -1)]
        times_s = [time_s for time_s, _ in warm]
        warm_c = [warm[max(bisect_right(times_s, instants_s[t]) - 1, 0)][1] for t in chosen if warm]
        numbers["temperature_c"].append(sum(warm_c) / count if warm else math.nan)
        self._starts.append(self._drive_starts)
        self._drive_starts = False
        self._count.append(count)
        self._write(readings)

    def _write(self, readings: list[_Reading]) -> None:
        """Replace the file as a whole; if that fails, its content is written with the next batch."""
        if self._path is None:
            self._path = self._folder / f"{datetime.now(UTC):%Y-%m-%dT%H%M%S.%f}{rule.SUFFIX}"
        layout, database = self._database.layout, self._database
        levels = [sorted(self._levels[name].items()) for name in self._branches]
        record = SummaryFile(
            schema_version=rule.SCHEMA_VERSION,
            vehicle=self._vehicle,
            layout_sha256=layout.digest,
            dbc_sha256=database.digest,
            branches=self._branches,
            inputs=self._inputs,
            recorded=self._recorded,
            period_s=layout.period_s,
            block_s=rule.BLOCK_S,
            delay_s=[self._delays[name][0] for name in self._branches],
            delay_sd_s=[self._delays[name][1] for name in self._branches],
            zero_offset_a=[offset_a for offset_a, _ in readings],
            zero_sd_a=[sd_a for _, sd_a in readings],
            starts=self._starts,
            count=self._count,
            levels=[[level for level, _ in visited] for visited in levels],
            level_sums=packed([x for visited in levels for _, sums in visited for x in sums]),
            **{name: packed(values) for name, values in self._numbers.items()},
        )
        write_atomically(self._path, encode_summary(record))


def _power_over_voltage(limit_s: float, take: _Take) -> tuple[_Take, _Take]:
    """Return a function that takes a voltage, and one that takes a power and passes power / voltage on to `take`.

    A power without a voltage within `limit_s` is dropped.
    """
    latest = -math.inf, 0.0

    def put_voltage(time_s: float, value: float) -> None:
        nonlocal latest
        if not math.isnan(value):
            latest = time_s, value

    def put_power(time_s: float, value: float) -> None:
        volt_s, volt = latest
        if volt and abs(time_s - volt_s) <= limit_s:
            take(time_s, value / volt)

    return put_voltage, put_power


def on_board_summary(
    options: argparse.Namespace,
    bus: Mapping[str, Any],
    database: VehicleDatabase,
    parameters: VehicleParameters | None,
    say: Callable[[str], None],
) -> OnBoardSummary:
    """Make the summary for a run of the node; it opens the sensors' bus a second time and listens like a logger.

    Parameters
    ----------
    options : argparse.Namespace
        Options of ``ecu-node run``.
    bus : mapping
        Bus of the sensors, as the arguments of :func:`ecu_node.bus.adapters.bus_config`.
    database, parameters : VehicleDatabase, VehicleParameters or None
        Layout, DBC and parameters of the vehicle; delays of branches are those of the parameters.
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
    if "/" in vehicle or vehicle.startswith(".") or not vehicle.isprintable():
        raise UserError(f"--summary: vehicle {vehicle!r} cannot name a folder; rename it")
    found = parameters.branches if parameters is not None else {}
    delays = {name: (branch.delay_s or 0.0, branch.delay_sd_s) for name, branch in found.items()}
    summary = OnBoardSummary(options.summary, vehicle, database, delays=delays, say=say)
    # elsewhere python-can filters by itself, and a frame that does not pass would end a look
    filters = filters_of(summary.messages) if bus["interface"] == "socketcan" else None
    opened = partial(connect, filters=filters, **bus)
    sys.setswitchinterval(_LONGEST_TURN_S)
    summary.listen(SteadyBus(opened, Counters(), listen_only=True))
    return summary


# ---- sums of a batch


def _product(one: Sequence[float], other: Sequence[float]) -> float:
    """Return the sum of the products of two columns."""
    return math.fsum(map(mul, one, other))


def _products(columns: Sequence[Sequence[float]]) -> _Column:
    """Return the sums of the products of each two columns: the lower triangle of their matrix."""
    return [_product(one, other) for i, one in enumerate(columns) for other in columns[: i + 1]]


def _white_noise_a2(current_a: Sequence[float]) -> float:
    """Estimate the variance of white noise in a block from its median third difference. [A^2]

    NaN is a gap; the result is 0 if no four consecutive samples are known.
    """
    x = current_a
    third = [abs(late - early - 3.0 * (c - b)) for early, b, c, late in zip(x, x[1:], x[2:], x[3:], strict=False)]
    known = [value for value in third if not math.isnan(value)]
    if not known:
        return 0.0
    return (median(known) / rule.NORMAL_MEDIAN) ** 2 / rule.DIFFERENCE_GAIN / (1.0 + rule.MEDIAN_EXCESS / len(known))


def _add_levels(columns: Sequence[_Column], own: _Column, sums: dict[int, _Column]) -> None:
    """Add each sample to the sums of the level in which the branch's own current is then."""
    sorted_rows: dict[int, list[int]] = {}
    for t, x in enumerate(own):
        away = bisect_right(rule.LEVELS_A, int(abs(x)))
        sorted_rows.setdefault(len(rule.LEVELS_A) + (away if x > 0.0 else -away), []).append(t)
    for level, rows in sorted_rows.items():
        new = [*(sum(column[t] for t in rows) for column in columns), len(rows), sum(own[t] ** 2 for t in rows)]
        old = sums.get(level)
        sums[level] = new if old is None else [a + b for a, b in zip(old, new, strict=True)]


def _second_differences(blocks: Sequence[_Column], used: Sequence[Sequence[bool]]) -> _Column:
    """Return distances of samples from the mean of their neighbours; 0 if one of the three is not used. [A]"""
    return [
        b - 0.5 * (a + c) if all(there) else 0.0
        for x, u in zip(blocks, used, strict=True)
        for a, b, c, there in zip(x, x[1:], x[2:], zip(u, u[1:], u[2:], strict=False), strict=False)
    ]


def _find_spikes(currents: list[_Column], used: Sequence[bool]) -> dict[int, list[int]]:
    """Find spikes as :func:`calibrator.summaries.summariser.find_spikes` does.

    Returns, by number of the sample, the sign of the spike of each branch: 1, -1, or 0 for none.
    """
    K, count, found, half = len(currents), len(used), dict[int, list[int]](), rule.SPIKE_WINDOW // 2
    kept, suspects, weights = list(used), list[int](), list[float]()
    for _ in range(2):  # the second time with gains that the spikes did not distort
        if sum(kept) < rule.FEWEST_FOR_GAINS * K:
            return found
        weights = _junction_weights(currents, kept)
        residual = [sum(map(mul, weights, row)) for row in zip(*currents, strict=True)]
        pairs = zip(pairwise(residual), pairwise(used), strict=True)
        change = sorted(abs(b - a) for (a, b), there in pairs if all(there))
        if not change or not change[-1] > max(rule.STEP_OF_SPIKE * median(change), rule.LEAST_SPIKE_A):
            return found
        padded = [residual[0]] * half + residual + [residual[-1]] * half
        far = [abs(x - sorted(padded[t : t + rule.SPIKE_WINDOW])[half]) for t, x in enumerate(residual)]
        spread = rule.MAD_TO_SD * median([value for value, there in zip(far, kept, strict=True) if there])
        limit = max(rule.SPIKE_SDS * spread, rule.LEAST_SPIKE_A)
        suspects = [t for t, value in enumerate(far) if used[t] and value > limit]
        kept = list(used)
        for t in suspects:
            kept[t] = False
    for t in suspects:
        window = [min(max(t + step, 0), count - 1) for step in range(-half, half + 1)]
        moves = []
        for weight, current in zip(weights, currents, strict=True):
            around = [weight * current[at] for at in window]
            middle = median(around)
            moves.append([value - middle for value in around])
        nearby = [max(map(abs, move[half - 1 : half + 2])) for move in moves]
        signs = [0] * K
        for k, move in enumerate(moves):
            own = move[half]
            steps = [math.copysign(1.0, own) * (b - a) for a, b in pairwise(move)]
            edge = min(max(steps[:half]), -min(steps[half:]))
            if sum(nearby) - nearby[k] < rule.OTHERS_MOVE * abs(own) and edge > rule.LEAST_EDGE * abs(own):
                signs[k] = 1 if own * weights[k] > 0.0 else -1
        if any(signs):
            found[t] = signs
    return found


def _junction_weights(currents: list[_Column], kept: Sequence[bool]) -> list[float]:
    """Fit the weights of the branches in the junction law by least squares; the branch that moves most has weight 1."""
    parts = [[value for value, there in zip(column, kept, strict=True) if there] for column in currents]
    count = len(parts[0])
    parts = [[value - mean for value in part] for part in parts for mean in (sum(part) / count,)]
    gram = [[sum(map(mul, one, other)) for other in parts] for one in parts]
    first = max(range(len(gram)), key=lambda k: gram[k][k])
    others = [k for k in range(len(gram)) if k != first]
    rows = [[*(gram[i][j] for j in others), -gram[i][first]] for i in others]
    scale = max((abs(row[n]) for n, row in enumerate(rows)), default=0.0)
    for n, pivot in enumerate(rows):  # Gauss-Jordan with pivots on the diagonal, as the matrix is a covariance
        if not pivot[n] > 1e-9 * scale:
            pivot[:] = [0.0] * len(pivot)  # a branch that does not move
            continue
        for other in rows:
            if other is not pivot:
                share = other[n] / pivot[n]
                other[:] = [a - share * b for a, b in zip(other, pivot, strict=True)]
    weights = [1.0] * len(gram)
    for n, k in enumerate(others):
        weights[k] = rows[n][-1] / rows[n][n] if rows[n][n] else 0.0
    return weights
