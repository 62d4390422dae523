"""What logs hold of one branch or input: frames, their rate, gaps, values that cannot be used, and the range seen."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from cantools.database.can import Signal

from calibrator.doctor.read_logs import ReadLog
from calibrator.drive import Array, Channel, Mask
from calibrator.drives.align import TIME_RESOLUTION_S
from calibrator.recordings.decode import bad_values, codes_of_no_value, decode_signal
from calibrator.recordings.e2e_profile import message_is_sound
from ecu_node.database import VehicleDatabase
from ecu_node.layout import SignalName

__all__ = ["ChannelFacts", "channel_facts"]

PROTECTION = "E2E check failed"
FEWEST_CLIPPED = 3
"""In a row at the end of the range: one or two may be the true peak."""


@dataclass(frozen=True, kw_only=True)
class ChannelFacts:
    """One branch or input over all logs.

    Attributes
    ----------
    name, signal, unit : str
        Name in the layout; ``Message.Signal``; unit of `low` and `high`.
    frames : int
        Frames that carry it.
    in_logs, logs : int
        In how many of how many logs.
    period_s, jitter_s, gap_s : float
        Median distance of frames, the 95th percentile of how far distances are from it, and the longest distance; NaN
        with fewer than two frames. [s]
    late : int
        Distances longer than its time-out.
    same_time : int
        Frames with the time stamp of the one before.
    bad : dict of str to int
        Frames that cannot be used, by reason.
    low, high : float
        Least and greatest good value; branches are positive into the junction; NaN without any. [unit]
    moves : bool
        Whether good values differ at all.
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
    same_time: int
    bad: dict[str, int]
    low: float
    high: float
    moves: bool
    clipped: int

    @property
    def bad_frames(self) -> int:
        """Frames that cannot be used."""
        return sum(self.bad.values())

    @property
    def good(self) -> int:
        """Frames that can be used."""
        return self.frames - self.bad_frames

    def as_json(self) -> dict[str, Any]:
        """All of it."""
        return asdict(self)


def channel_facts(
    name: str,
    signal_name: SignalName,
    logs: Sequence[ReadLog],
    database: VehicleDatabase,
    *,
    channels: Sequence[Channel | None],
    timeout_s: float,
    unit: str,
) -> ChannelFacts:
    """Gather what logs hold of one branch or input.

    Parameters
    ----------
    name, signal_name : str
        In the layout, and in the DBC.
    logs : sequence of ReadLog
        The logs.
    database : VehicleDatabase
        DBC and layout.
    channels : sequence of Channel or None
        What became of it in each log: its values.
    timeout_s : float
        Frames farther apart are late. [s]
    unit : str
        Of the values.

    Returns
    -------
    ChannelFacts
        Over all logs.
    """
    message, signal = database.signal(signal_name)
    no_value = codes_of_no_value(database, signal_name)
    steps: list[Array] = []
    frames_of: list[int] = []
    bad = dict.fromkeys((PROTECTION, "too short", "not available", "out of range"), 0)
    clipped = 0
    for log in logs:
        frames, time_s = log.of_message(message)
        decoded = decode_signal(message, signal, frames.data, frames.length, no_value)
        present = decoded.present
        reasons = {
            PROTECTION: ~message_is_sound(database, message, frames.data, frames.length),
            **bad_values(message, signal, frames.data, frames.length, no_value),
        }
        counted = ~present
        for reason, mask in reasons.items():
            bad[reason] += int((mask & ~counted).sum())
            counted |= mask
        steps.append(np.diff(time_s[present]))
        frames_of.append(int(present.sum()))
        clipped += _clipped(signal, decoded.value[present & decoded.good])
    values = _good_values(channels)
    if (other := sum(frames_of) - sum(bad.values()) - len(values)) > 0:
        bad["no voltage"] = other
    return ChannelFacts(
        name=name,
        signal=signal_name,
        unit=unit,
        frames=sum(frames_of),
        in_logs=sum(count > 0 for count in frames_of),
        logs=len(logs),
        **_spacing(np.concatenate([np.zeros(0), *steps]), timeout_s),
        bad={reason: count for reason, count in bad.items() if count},
        low=float(values.min()) if len(values) else np.nan,
        high=float(values.max()) if len(values) else np.nan,
        moves=bool(len(values) and values.max() > values.min()),
        clipped=clipped,
    )


def _spacing(step_s: Array, timeout_s: float) -> dict[str, Any]:
    """Figures of the distances of frames, by the names of :class:`ChannelFacts`."""
    period_s = float(np.median(step_s)) if len(step_s) else np.nan
    return {
        "period_s": period_s,
        "jitter_s": float(np.quantile(np.abs(step_s - period_s), 0.95)) if len(step_s) else np.nan,
        "gap_s": float(step_s.max()) if len(step_s) else np.nan,
        "late": int(np.sum(step_s > timeout_s + TIME_RESOLUTION_S)),
        "same_time": int(np.sum(step_s <= 0.0)),
    }


def _good_values(channels: Sequence[Channel | None]) -> Array:
    return np.concatenate([np.zeros(0), *(c.value[c.good] for c in channels if c is not None)])


def _clipped(signal: Signal, value: Array) -> int:
    """Values at an end, other than 0, of what the signal can show: those with some others in a row."""
    return sum(_in_a_row(np.abs(value - end) < 0.5 * abs(float(signal.scale))) for end in _ends(signal) if end)


def _ends(signal: Signal) -> tuple[float, ...]:
    """Least and greatest physical value that the signal can show and the DBC allows."""
    if signal.is_float:
        return ()
    half = 1 << (signal.length - 1)
    codes = (-half, half - 1) if signal.is_signed else (0, 2 * half - 1)
    low, high = sorted(float(code * signal.scale + signal.offset) for code in codes)
    if signal.minimum or signal.maximum:
        low = max(low, float(signal.minimum) if signal.minimum is not None else low)
        high = min(high, float(signal.maximum) if signal.maximum is not None else high)
    return low, high


def _in_a_row(mask: Mask) -> int:
    """How many are true with at least :data:`FEWEST_CLIPPED` in a row."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(np.int8), [0]])))
    lengths = edges[1::2] - edges[::2]
    return int(lengths[lengths >= FEWEST_CLIPPED].sum())
