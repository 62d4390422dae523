"""Facts for the doctor's checks: what logs or tables contain of the branches and inputs of a layout."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from cantools.database.can import Signal

from calibrator.drive import Array, Channel, Drive, Mask
from calibrator.drives.computed_inputs import computed_inputs, shared_noise
from calibrator.errors import LogError
from calibrator.kirchhoff.junction import RecordedJunction, look_at_junction
from calibrator.kirchhoff.sums import with_voltages
from calibrator.recordings.decode import bit_range, signal_range
from calibrator.recordings.readers import FrameSource, RecordingReport, SignalSource, open_recording, other_address
from ecu_node.database import VehicleDatabase, read_database
from ecu_node.layout import Branch, Input, Layout
from ecu_node.summary import TIME_RESOLUTION_S

__all__ = ["ExaminedLog", "Facts", "facts_of"]

FEWEST_CLIPPED = 3
"""Values in a row at an end of the range that count as clipped; one or two may be the true peak."""
NOTHING = Channel(time_s=np.zeros(0), value=np.zeros(0), good=np.zeros(0, np.bool_))
"""Channel without samples, in place of a branch or input that a drive does not have."""


@dataclass(frozen=True, kw_only=True)
class ExaminedLog:
    """One log or table, and what reading it gave.

    Attributes
    ----------
    name : str
        Path of the file.
    source : SignalSource
        Gives the samples of its signals.
    report : RecordingReport
        Counts of its frames, and what could not be used.
    drive : Drive or LogError
        Its branches and inputs of the layout, or the error why there is no drive: the log has no branch, or a message
        comes on several buses.
    duration_s : float
        From the first to the last frame. [s]
    """

    name: str
    source: SignalSource
    report: RecordingReport
    drive: Drive | LogError
    duration_s: float


@dataclass(frozen=True, kw_only=True)
class Facts:
    """Everything that the checks look at.

    Attributes
    ----------
    database : VehicleDatabase
        DBC and layout.
    logs : sequence of ExaminedLog
        All logs and tables.
    drives : sequence of Drive
        Drives of those logs that have a branch.
    channels : DataFrame
        A row for each branch and input, in the order of the layout:

        - ``name``; ``signal``, column or formula; ``unit`` of ``low`` and ``high``; whether it ``is_branch``, and
          whether it is an input that is ``needed`` for the model;
        - ``frames``: frames, or rows of a table, that carry it; ``in_logs``: how many of all ``logs`` have any;
          ``elsewhere``: what :func:`.other_address` says if none has;
        - ``period_s``, ``jitter_s``, ``gap_s``: median distance of frames, the 95th percentile of how far distances are
          from it, and the longest distance; NaN with fewer than two frames [s]; ``late``: number of distances longer
          than its time-out;
        - ``bad``: numbers of frames that cannot be used, by reason; ``good``: number that can be used;
        - ``low``, ``high``: least and greatest good value, a branch's with its current into the junction positive; NaN
          without any;
        - ``clipped``: number of good values at an end of the signal's range, :data:`FEWEST_CLIPPED` or more in a row.
    computed_inputs : mapping of str to str
        Inputs of models that are computed from a current sensor, and its branch.
    junction : RecordedJunction
        What the sum of the branches shows; its layout has a period that suits the logs, and voltages as more inputs.
    """

    database: VehicleDatabase
    logs: Sequence[ExaminedLog]
    drives: Sequence[Drive]
    channels: pd.DataFrame
    computed_inputs: Mapping[str, str]
    junction: RecordedJunction


def facts_of(layout: Layout, paths: Sequence[Path]) -> Facts:
    """Read the DBC of a layout and the logs or tables of one vehicle, and gather the facts about them.

    Raises
    ------
    UserError
        If DBC or a log cannot be read at all, or the DBC lacks a signal.
    """
    database = read_database(layout)
    extended, needed = with_voltages(database), layout.base_inputs(layout.model_inputs)
    logs = [_read(path, extended) for path in paths]
    drives = [log.drive for log in logs if isinstance(log.drive, Drive)]
    items: list[Branch | Input] = [*layout.branch, *layout.input]
    channels = [_channel(item, logs, database, needed) for item in items]
    return Facts(
        database=database,
        logs=logs,
        drives=drives,
        channels=pd.DataFrame(channels),
        computed_inputs=computed_inputs([shared_noise(drive, sorted(needed), layout) for drive in drives]),
        junction=look_at_junction(drives, extended),
    )


def _read(path: Path, database: VehicleDatabase) -> ExaminedLog:
    source = open_recording(path, database)
    drive: Drive | LogError
    try:
        recording = source.recording(database.layout.name, path.name.partition(".")[0])
        drive, report = recording.drive, recording.report
    except LogError as error:
        drive, report = error, source.report(())
    return ExaminedLog(name=str(path), source=source, report=report, drive=drive, duration_s=float(source.time_s[-1]))


def _channel(
    item: Branch | Input, logs: Sequence[ExaminedLog], database: VehicleDatabase, needed: set[str]
) -> dict[str, Any]:
    """Return the row of ``Facts.channels`` for a branch [A], or for an input in the unit of its signal."""
    branch = item if isinstance(item, Branch) else None
    if isinstance(item, Branch):
        signal, timeout_s, unit = item.source, item.timeout_s, "A"
    else:
        signal, timeout_s, unit = item.signal, database.layout.max_age_s, ""
    clipped, bad, frames = 0, dict[str, int](), list[int]()
    values, steps = list[Array]([np.zeros(0)]), list[Array]([np.zeros(0)])
    for log in logs:
        if isinstance(log.drive, LogError):
            continue
        made = (log.drive.inputs if branch is None else log.drive.branches).get(item.name, NOTHING)
        values.append(made.value[made.good])
        raw, reasons = (made, {"no value": ~made.good}) if branch and branch.computed else log.source.samples(signal)
        counted = np.zeros(len(raw.time_s), np.bool_)
        for reason, mask in reasons.items():
            bad[reason] = bad.get(reason, 0) + int((mask & ~counted).sum())
            counted |= mask
        frames.append(len(raw.time_s))
        steps.append(np.diff(raw.time_s))
        if branch is None or not branch.computed:
            clipped += _clipped(database.signal(signal)[1], raw.value[~counted])
            unit = unit or log.source.unit(signal)
    value, step_s = np.concatenate(values), np.concatenate(steps)
    bad["no voltage"] = sum(frames) - sum(bad.values()) - len(value)
    period_s = float(np.median(step_s)) if len(step_s) else np.nan
    is_absent = not any(frames) and not (branch and branch.computed)
    sources = [log.source for log in logs if is_absent and isinstance(log.source, FrameSource)]
    elsewhere = (other_address(source.frames, database.signal(signal)[0], database) for source in sources)
    return {
        "name": item.name,
        "is_branch": branch is not None,
        "needed": item.name in needed,
        "signal": signal,
        "unit": unit,
        "frames": sum(frames),
        "in_logs": sum(count > 0 for count in frames),
        "logs": len(logs),
        "elsewhere": next(filter(None, elsewhere), ""),
        "period_s": period_s,
        "jitter_s": float(np.quantile(np.abs(step_s - period_s), 0.95)) if len(step_s) else np.nan,
        "gap_s": float(step_s.max()) if len(step_s) else np.nan,
        "late": int(np.sum(step_s > timeout_s + TIME_RESOLUTION_S)),
        "bad": {reason: count for reason, count in bad.items() if count > 0},
        "good": len(value),
        "low": float(value.min()) if len(value) else np.nan,
        "high": float(value.max()) if len(value) else np.nan,
        "clipped": clipped,
    }


def _clipped(signal: Signal, value: Array) -> int:
    """Count values at the least or greatest value that an integer signal can show, unless that is 0.

    Only :data:`FEWEST_CLIPPED` or more in a row count.
    """
    if signal.is_float:
        return 0
    (low, high), span = bit_range(signal), signal_range(signal)
    ends = max(low, span.low), min(high, span.high)
    at_end: list[Mask] = [np.abs(value - end) < 0.5 * abs(float(signal.scale)) for end in ends if end]
    runs = (run for mask in at_end for run in np.split(mask, np.flatnonzero(np.diff(mask)) + 1))
    return sum(len(run) for run in runs if len(run) >= FEWEST_CLIPPED and run.all())
