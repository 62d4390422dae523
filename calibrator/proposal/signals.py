"""Signals of a DBC with what their units and words say, and with what a log shows of them."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from cantools.database.can import Message, Signal

from calibrator.doctor.words import words_of
from calibrator.drive import Channel
from calibrator.recordings.decode import decode_signal
from calibrator.recordings.frame_arrays import Frames, frame_key
from calibrator.recordings.log_time import repaired_time
from ecu_node.database import VehicleDatabase
from ecu_node.units import AMPERE, VOLT, WATT

__all__ = ["QUANTITIES", "Candidate", "Seen", "candidates", "with_log"]

QUANTITIES: Mapping[str, frozenset[str]] = {
    "current": frozenset(AMPERE),
    "power": frozenset(WATT),
    "voltage": frozenset(VOLT),
    "torque": frozenset({"Nm", "NM", "N m", "N*m"}),
    "speed": frozenset({"km/h", "kph", "KPH", "kmh", "km/hr", "m/s", "mph", "MPH", "rpm", "RPM", "1/min"}),
    "acceleration": frozenset({"m/s2", "m/s^2", "m/s²", "g", "G"}),
    "share": frozenset({"%"}),
    "temperature": frozenset({"degC", "°C", "C", "deg C", "Celsius"}),
}
"""Units as DBC files write them, by quantity. Those of the first three are the layout's own."""
MEASURED = frozenset({"current", "power", "voltage"})
"""Of branches: no code that has a name is a value of theirs."""
_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")


@dataclass(frozen=True, kw_only=True)
class Seen:
    """What a log shows of a signal.

    Attributes
    ----------
    channel : Channel
        Its values, in the unit of the DBC.
    period_s, gap_s : float
        Median and longest distance of its frames. [s]
    low, high, spread : float
        Least and greatest good value, and standard deviation; NaN without any.
    roughness : float
        Root mean square of steps over that of white noise of the same spread: near 1 for values that jump about. [1]
    """

    channel: Channel
    period_s: float
    gap_s: float
    low: float
    high: float
    spread: float
    roughness: float

    @property
    def good_share(self) -> float:
        """Share of frames that can be used. [1]"""
        return float(self.channel.good.mean()) if len(self.channel.good) else 0.0


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """One signal.

    Attributes
    ----------
    message, signal : Message, Signal
        Of the DBC.
    quantity : str
        Of :data:`QUANTITIES`, by its unit; empty for others.
    own, words : tuple of str
        Words of its name and comment; these, and those of its message and sender.
    seen : Seen or None
        None without a log.
    """

    message: Message
    signal: Signal
    quantity: str
    own: tuple[str, ...]
    words: tuple[str, ...]
    seen: Seen | None = None

    @property
    def name(self) -> str:
        """``Message.Signal``."""
        return f"{self.message.name}.{self.signal.name}"

    @property
    def can_be_negative(self) -> bool:
        """Whether the DBC lets it be negative."""
        if self.signal.minimum or self.signal.maximum:
            return self.signal.minimum is None or float(self.signal.minimum) < 0.0
        return bool(self.signal.is_signed) or float(self.signal.offset) < 0.0

    @property
    def reach(self) -> float:
        """Greatest magnitude that DBC and width allow, in the unit of the DBC."""
        half = 1 << (self.signal.length - 1)
        codes = (-half, half - 1) if self.signal.is_signed else (0, 2 * half - 1)
        widest = max(abs(code * float(self.signal.scale) + float(self.signal.offset)) for code in codes)
        limits = [abs(float(limit)) for limit in (self.signal.minimum, self.signal.maximum) if limit]
        return min(widest, max(limits)) if limits else widest

    @property
    def about(self) -> str:
        """Unit and comment, for a remark."""
        comment = " ".join((self.signal.comment or "").split())
        return f"{self.signal.unit or 'no unit'}" + (f', "{comment}"' if comment else "")


def candidates(database: VehicleDatabase) -> list[Candidate]:
    """All signals of a DBC that a layout can name.

    Parameters
    ----------
    database : VehicleDatabase
        The DBC.

    Returns
    -------
    list of Candidate
        In the order of the DBC.
    """
    found = []
    for message in database.database.messages:
        for signal in message.signals:
            if _NAME.fullmatch(message.name) and _NAME.fullmatch(signal.name):
                own = words_of(signal.name, signal.comment)
                rest = words_of(message.name, message.comment, *message.senders)
                quantity = next((name for name, units in QUANTITIES.items() if signal.unit in units), "")
                found.append(Candidate(message=message, signal=signal, quantity=quantity, own=own, words=(*own, *rest)))
    return found


def with_log(found: list[Candidate], frames: Frames) -> list[Candidate]:
    """Those of some signals that a log holds, with what it shows of them.

    Parameters
    ----------
    found : list of Candidate
        Signals of the DBC.
    frames : Frames
        Of the log.

    Returns
    -------
    list of Candidate
        Without those whose message, or multiplexed part of it, never comes.
    """
    time = repaired_time(frames.time_ns)
    ordered = frames.take(time.order)
    kept: list[Candidate] = []
    for key in np.unique(ordered.key).tolist():
        index = np.flatnonzero(ordered.key == np.uint32(key))
        part, time_s = ordered.take(index), time.time_s[index]
        for item in found:
            message = item.message
            if frame_key(message.frame_id, extended=message.is_extended_frame) != key:
                continue
            named = frozenset(map(int, item.signal.choices or {})) if item.quantity in MEASURED else None
            decoded = decode_signal(message, item.signal, part.data, part.length, named)
            if decoded.present.any():
                channel = Channel(
                    time_s=time_s[decoded.present],
                    value=decoded.value[decoded.present],
                    good=decoded.good[decoded.present],
                )
                kept.append(replace(item, seen=_seen(channel)))
    return kept


def _seen(channel: Channel) -> Seen:
    value = channel.value[channel.good]
    steps_s = np.diff(channel.time_s)
    spread = float(value.std()) if len(value) else np.nan
    jumps = float(np.sqrt(np.mean(np.diff(value) ** 2) / 2.0)) if len(value) > 1 else 0.0
    return Seen(
        channel=channel,
        period_s=float(np.median(steps_s)) if len(steps_s) else np.nan,
        gap_s=float(steps_s.max()) if len(steps_s) else np.nan,
        low=float(value.min()) if len(value) else np.nan,
        high=float(value.max()) if len(value) else np.nan,
        spread=spread,
        roughness=jumps / spread if spread > 0.0 else 0.0,
    )
