"""What logs or tables hold of the branches and inputs of a layout: the facts that the doctor's checks look at."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from cantools.database.can import Signal

from calibrator.drive import Array, Channel, Drive
from calibrator.drives.align import align, base_inputs, choose_inputs
from calibrator.errors import DriveError, LogError
from calibrator.kirchhoff.findings import RecordedJunction, look_at_junction
from calibrator.kirchhoff.signs import multiplied
from calibrator.kirchhoff.sums import VOLTAGE, junction_voltage, with_voltages
from calibrator.recordings.frame_arrays import repaired_time
from calibrator.recordings.frames import read_frames
from calibrator.recordings.readers import (
    FrameSource,
    RecordingReport,
    SignalSource,
    TableSource,
    drive_from_frames,
    drive_from_table,
)
from calibrator.recordings.tables import is_table, read_table
from ecu_node.database import VehicleDatabase, look_everything_up, read_database
from ecu_node.errors import DatabaseError, LayoutError
from ecu_node.layout import Branch, Input, Layout
from ecu_node.summary import TIME_RESOLUTION_S

__all__ = ["MOST_MINUTES", "ChannelFacts", "ExaminedLog", "Facts", "facts_of"]

MOST_MINUTES = 60.0
"""Of each log: an hour tells what is wrong with a layout, and takes some seconds. [min]"""
FEWEST_CLIPPED = 3
"""In a row at the end of the range: one or two may be the true peak."""
LEAST_V, GREATEST_V, USUAL_V = 30.0, 1500.0, 400.0
"""From 48 V systems to the highest that road vehicles have; a slip is a power of ten that leads nearest to most. [V]"""
FEWEST_INSTANTS, LEAST_SHARE = 300, 0.05
"""Of aligned samples, to say how well inputs explain a current: half a minute at 0.1 s; share of the greatest branch's
variation, below which that of a branch is mostly noise. [1]"""


@dataclass(frozen=True, kw_only=True)
class ChannelFacts:
    """One branch or input over all logs.

    Attributes
    ----------
    name, signal, unit : str
        Name in the layout; signal, column or formula; unit of `low` and `high`.
    frames, in_logs, logs : int
        Frames, or rows, that carry it, in how many of how many logs.
    period_s, jitter_s, gap_s : float
        Median distance of frames, the 95th percentile of how far distances are from it, and the longest distance; NaN
        with fewer than two frames. [s]
    late : int
        Distances longer than its time-out.
    bad : dict of str to int
        Frames that cannot be used, by reason.
    low, high : float
        Least and greatest good value; branches are positive into the junction; NaN without any. [unit]
    clipped : int
        Good values at an end of what the signal can show, several in a row.
    """

    name: str
    signal: str
    unit: str
    frames: int
    in_logs: int
    logs: int
    period_s: float
    jitter_s: float
    gap_s: float
    late: int
    bad: dict[str, int]
    low: float
    high: float
    clipped: int

    @property
    def bad_frames(self) -> int:
        """Frames that cannot be used."""
        return sum(self.bad.values())

    @property
    def good(self) -> int:
        """Frames that can be used."""
        return self.frames - self.bad_frames


@dataclass(frozen=True, kw_only=True)
class ExaminedLog:
    """One log or table.

    Attributes
    ----------
    name : str
        Its file.
    source : SignalSource
        Look-ups of signals in it.
    report : RecordingReport
        Its account.
    drive : Drive or LogError
        What it has of the layout, or that it has no branch of it.
    duration_s : float
        From the first to the last frame. [s]
    cut : bool
        Whether it goes on after :data:`MOST_MINUTES`, where it was cut.
    """

    name: str
    source: SignalSource
    report: RecordingReport
    drive: Drive | LogError
    duration_s: float
    cut: bool


@dataclass(frozen=True, kw_only=True)
class Facts:
    """Everything that the checks look at.

    Attributes
    ----------
    layout : Layout
        As the user has it.
    database : VehicleDatabase
        DBC and the part of the layout that it can serve.
    missing : mapping of (str, str) to str
        Why a ``branch`` or ``input`` of this name, or the ``layout``, cannot be looked up.
    logs : tuple of ExaminedLog
        What was looked at.
    branches, inputs : tuple of ChannelFacts
        Of those that the DBC has, in the order of the layout.
    slip : tuple of (str, float, float) or None
        Signal of a voltage that is impossible, its median [V], and the power of ten that makes it usual.
    junction : RecordedJunction
        The sum of the branches, with such a slip put right.
    explained : mapping of str to float
        Share of each current's variation that the model inputs explain; empty if that cannot be told.
    """

    layout: Layout
    database: VehicleDatabase
    missing: Mapping[tuple[str, str], str]
    logs: tuple[ExaminedLog, ...]
    branches: tuple[ChannelFacts, ...]
    inputs: tuple[ChannelFacts, ...]
    slip: tuple[str, float, float] | None
    junction: RecordedJunction
    explained: Mapping[str, float]

    @property
    def drives(self) -> list[Drive]:
        """What the logs gave."""
        return [log.drive for log in self.logs if isinstance(log.drive, Drive)]

    @property
    def needed(self) -> set[str]:
        """Inputs that the model is made of."""
        return base_inputs(self.database.layout, self.database.layout.model_inputs)


def facts_of(layout: Layout, paths: Sequence[Path]) -> Facts:
    """Gather the facts of a layout, whose DBC is read, and of logs or tables of one vehicle.

    Raises
    ------
    UserError
        If DBC or a log cannot be read at all.
    """
    database, missing = _usable_part(layout)
    extended = with_voltages(database)
    logs = [_read(path, extended) for path in paths]
    drives = [log.drive for log in logs if isinstance(log.drive, Drive)]
    slip, right = _voltage_slip(drives, database), drives
    if slip is not None:
        divided = {item.name for item in database.layout.branch if item.voltage == slip[0]}
        right = [multiplied(drive, dict.fromkeys(divided, 1.0 / slip[2])) for drive in drives]
    junction = look_at_junction(right, extended)
    return Facts(
        layout=layout,
        database=database,
        missing=missing,
        logs=tuple(logs),
        branches=tuple(_channel_facts(item, item.timeout_s, logs, database) for item in database.layout.branch),
        inputs=tuple(_channel_facts(item, database.layout.max_age_s, logs, database) for item in database.layout.input),
        slip=slip,
        junction=junction,
        explained=_explained_shares(drives, database.layout, junction.branches),
    )


def _with_layout(database: VehicleDatabase, **keys: Any) -> VehicleDatabase:
    return replace(database, layout=msgspec.structs.replace(database.layout, **keys))


def _usable_part(layout: Layout) -> tuple[VehicleDatabase, dict[tuple[str, str], str]]:
    """DBC, and the layout without what it does not have, and what depends on that; and why for each left out."""
    try:
        return read_database(layout), {}
    except (DatabaseError, LayoutError) as error:
        reason = str(error)
    lists = ("branch", "input", "derived", "model_inputs", "fleet_inputs", "e2e")
    others: dict[str, Any] = {**dict.fromkeys(("contactor", "status", "temperature")), "watch": type(layout.watch)()}
    bare = read_database(msgspec.structs.replace(layout, **{name: [] for name in lists}, **others))
    missing: dict[tuple[str, str], str] = {}

    def kept(items: Iterable[Any], what: str) -> list[Any]:
        good = []
        for item in items:
            try:
                look_everything_up(_with_layout(bare, **{what: [item]}))
                good.append(item)
            except (DatabaseError, LayoutError) as error:
                missing[what, item.name] = str(error)
        return good

    branches, inputs = kept(layout.branch, "branch"), kept(layout.input, "input")
    names = [item.name for item in inputs]
    pruned = msgspec.structs.replace(
        layout,
        branch=branches,
        input=inputs,
        derived=[item for item in layout.derived if base_inputs(layout, [item.name]) <= set(names)],
        model_inputs=list(choose_inputs(layout, names)[0]),
        fleet_inputs=list(choose_inputs(layout, names, names=layout.fleet_inputs)[0]),
        **others,
    )
    return replace(bare, layout=pruned), missing or {("layout", layout.path.name): reason}


def _read(path: Path, database: VehicleDatabase) -> ExaminedLog:
    names, cut = {"vehicle": database.layout.name, "name": path.name.partition(".")[0]}, False
    if is_table(path):
        table = read_table(path)
        source: SignalSource = TableSource(table, database)
        duration_s, make = float(table.time_s[-1]), partial(drive_from_table, table, database, **names)
    else:
        whole = read_frames(path)
        time = repaired_time(whole.time_ns)
        first = int(np.searchsorted(time.time_s, 60.0 * MOST_MINUTES, side="right"))
        frames, cut = whole.take(np.sort(time.order[:first])), first < len(whole)  # in the order of the file
        source, duration_s = FrameSource(frames, database, str(path)), float(time.time_s[first - 1])
        make = partial(drive_from_frames, frames, database, **names, where=str(path))
    drive: Drive | LogError
    try:
        recording = make()
        drive, report = recording.drive, recording.report
    except LogError as error:
        drive, report = error, source.report(())
    return ExaminedLog(name=str(path), source=source, report=report, drive=drive, duration_s=duration_s, cut=cut)


def _channel_facts(
    item: Branch | Input, timeout_s: float, logs: Sequence[ExaminedLog], database: VehicleDatabase
) -> ChannelFacts:
    """Gather what logs hold of one branch [A], or of one input in the unit of its signal."""
    is_branch = isinstance(item, Branch)
    signal = item.source if isinstance(item, Branch) else item.signal
    computed = isinstance(item, Branch) and item.computed
    unit, clipped, bad, frames = "A" if is_branch else "", 0, dict[str, int](), list[int]()
    values, steps = list[Array]([np.zeros(0)]), list[Array]([np.zeros(0)])
    for log in logs:
        if isinstance(log.drive, LogError):
            continue
        made = (log.drive.branches if is_branch else log.drive.inputs).get(item.name)
        if made is not None:
            values.append(made.value[made.good])
        if computed:
            raw = made or Channel(time_s=np.zeros(0), value=np.zeros(0), good=np.zeros(0, np.bool_))
            reasons: Mapping[str, Any] = {"no value": ~raw.good}
        else:
            raw, reasons = log.source.samples(signal)
        counted = np.zeros(len(raw.time_s), np.bool_)
        for reason, mask in reasons.items():
            bad[reason] = bad.get(reason, 0) + int((mask & ~counted).sum())
            counted |= mask
        frames.append(len(raw.time_s))
        steps.append(np.diff(raw.time_s))
        if not computed:
            clipped += _clipped(database.signal(signal)[1], raw.value[~counted])
            unit = unit or log.source.unit(signal)
    value, step_s = np.concatenate(values), np.concatenate(steps)
    if (other := sum(frames) - sum(bad.values()) - len(value)) > 0:
        bad["no voltage"] = other
    period_s = float(np.median(step_s)) if len(step_s) else np.nan
    return ChannelFacts(
        name=item.name,
        signal=signal,
        unit=unit,
        frames=sum(frames),
        in_logs=sum(count > 0 for count in frames),
        logs=len(logs),
        period_s=period_s,
        jitter_s=float(np.quantile(np.abs(step_s - period_s), 0.95)) if len(step_s) else np.nan,
        gap_s=float(step_s.max()) if len(step_s) else np.nan,
        late=int(np.sum(step_s > timeout_s + TIME_RESOLUTION_S)),
        bad={reason: count for reason, count in bad.items() if count},
        low=float(value.min()) if len(value) else np.nan,
        high=float(value.max()) if len(value) else np.nan,
        clipped=clipped,
    )


def _clipped(signal: Signal, value: Array) -> int:
    """Values at an end, other than 0, of what an integer signal can show and the DBC allows; some in a row each."""
    if signal.is_float:
        return 0
    half = 1 << (signal.length - 1)
    codes = (-half, half - 1) if signal.is_signed else (0, 2 * half - 1)
    low, high = sorted(float(code * signal.scale + signal.offset) for code in codes)
    if signal.minimum or signal.maximum:
        low = max(low, float(signal.minimum) if signal.minimum is not None else low)
        high = min(high, float(signal.maximum) if signal.maximum is not None else high)
    at_end = [np.abs(value - end) < 0.5 * abs(float(signal.scale)) for end in (low, high) if end]
    runs = (run for mask in at_end for run in np.split(mask, np.flatnonzero(np.diff(mask)) + 1))
    return sum(len(run) for run in runs if len(run) >= FEWEST_CLIPPED and run.all())


def _voltage_slip(drives: Sequence[Drive], database: VehicleDatabase) -> tuple[str, float, float] | None:
    """Signal, median and factor of a voltage that is none of a vehicle; zero (contactors open) is possible."""
    signal, channels = (
        junction_voltage(database),
        [drive.inputs[VOLTAGE] for drive in drives if VOLTAGE in drive.inputs],
    )
    value = np.concatenate([np.zeros(0), *(channel.value[channel.good] for channel in channels)])
    median_v = float(np.median(np.abs(value))) if len(value) else 0.0
    if signal is None or median_v <= 0.0 or LEAST_V <= median_v <= GREATEST_V:
        return None
    if database.signal(signal)[1].unit != "V":
        return None
    return signal, median_v, 10.0 ** float(np.rint(np.log10(USUAL_V / median_v)))


def _explained_shares(drives: Sequence[Drive], layout: Layout, branches: Sequence[str]) -> dict[str, float]:
    """How much of each current's variation the model inputs explain, as a plain linear model.

    By branch that matters, 1 for all of it; empty if the inputs are not recorded or too little is valid.
    """
    recorded = choose_inputs(layout, set.intersection(*(set(drive.inputs) for drive in drives)))[0] if drives else ()
    if not recorded or not branches:
        return {}
    try:
        samples = [align(drive, layout, branches, inputs=recorded) for drive in drives]
    except DriveError:
        return {}
    inputs = np.concatenate([s.inputs[s.valid] for s in samples])
    currents_a = np.concatenate([s.currents_a[s.valid] for s in samples])
    if len(inputs) < FEWEST_INSTANTS:
        return {}
    spread = inputs.std(axis=0)
    columns = np.column_stack([inputs / np.where(spread > 0.0, spread, 1.0), np.ones(len(inputs))])
    rest = currents_a - columns @ np.linalg.lstsq(columns, currents_a, rcond=1e-8)[0]
    power = currents_a.var(axis=0)
    shares = 1.0 - np.divide(rest.var(axis=0), power, out=np.ones(len(power)), where=power > 0.0)
    return {name: float(shares[k]) for k, name in enumerate(branches) if power[k] > LEAST_SHARE**2 * power.max()}
