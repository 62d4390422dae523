"""Signals of a database or columns of a table: what units, words and ranges say of them, and what a recording shows."""

import copy
import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from cantools.database.can import Database, Message, Signal
from numpy.typing import NDArray

from calibrator.drive import Array, Channel, Mask
from calibrator.errors import LogError
from calibrator.recordings.decode import decode_signal, raw_values, signal_range
from calibrator.recordings.frame_arrays import Frames, frame_key, repaired_time
from calibrator.recordings.tables import Table
from calibrator.words import CURRENT, POWER, VOLTAGE, words_of
from ecu_node.core.signals import AMPERE, VOLT, WATT, unit_factor
from ecu_node.errors import DatabaseError

__all__ = ["FLOWS", "Candidate", "of_database", "of_table", "with_log", "with_table"]

FLOWS = {"current": AMPERE, "power": WATT, "voltage": VOLT}
"""Quantities of branches, with the units that the layout knows."""
_OTHERS = {
    "torque": {"nm", "n.m", "n*m", "newtometer"},
    "speed": {"km/h", "kph", "kmh", "km/hr", "m/s", "mph", "rpm", "1/min", "kilometerperhour", "minutinver"},
    "temperature": {"degc", "°c", "c", "celsius"},
}
"""Units as databases write them, in lower case and without blanks, by quantity."""
_MEASURED = {"current": CURRENT, "voltage": VOLTAGE, "power": POWER}
"""Words by which a signal without a unit is known, if its name ends with one or begins with a letter for it."""
_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
_FEWEST_BITS = 8
"""Signals without a unit that are shorter are states."""
NO_RANGE = 1e-3
"""A range below this share of what the bits can say is a slip, such as 0 to 1 for a voltage. [1]"""
WRONG_RANGE, FEWEST_OUTSIDE = 0.01, 5
"""Share of values, and how many different ones, outside the database's range, to call the range wrong: a code for
"not available" is one value. [1]"""


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """A signal or column.

    Attributes
    ----------
    name : str
        ``Message.Signal``, or the header of a column.
    quantity : str
        By its unit, or else by its name; empty for others.
    unit, comment : str
        As written.
    own, words : tuple of str
        Words of its name and comment; these, and those of its message and sender.
    factor : float
        Turns values as written into A, V or W; 1 for other quantities.
    low, high : float
        Least and greatest value that bits and range allow [A, V, W]; infinite for columns.
    message, signal : Message, Signal or None
        Of the database; None for columns.
    channel : Channel or None
        What a recording has of it, in A, V or W, whatever range the database gives; None without one.
    formula : str
        Of inputs, if it is computed; empty for what is measured.
    wrong : str
        What the recording shows to be wrong in the database: ``range`` or ``sign``; empty for nothing.
    """

    name: str
    quantity: str
    unit: str
    comment: str
    own: tuple[str, ...]
    words: tuple[str, ...]
    factor: float = 1.0
    low: float = -np.inf
    high: float = np.inf
    message: Message | None = field(default=None, repr=False)
    signal: Signal | None = field(default=None, repr=False)
    channel: Channel | None = field(default=None, repr=False)
    formula: str = ""
    wrong: str = ""

    @property
    def about(self) -> str:
        """Unit and comment, for a remark."""
        comment = " ".join(self.comment.split())
        return (self.unit or "no unit") + (f', "{comment}"' if comment else "")

    @cached_property
    def good(self) -> Array:
        """Good values of the recording, shape (n,)."""
        return self.channel.value[self.channel.good] if self.channel is not None else np.zeros(0)

    @property
    def peak(self) -> float:
        """Greatest magnitude but for wild samples; 0 without any. [A, V, W]"""
        return float(np.quantile(np.abs(self.good), 0.999)) if len(self.good) else 0.0

    def at(self, time_s: Array) -> Array:
        """Good values of the recording at some instants, interpolated; NaN without any."""
        if self.channel is None or not self.channel.good.any():
            return np.full(len(time_s), np.nan)
        return np.interp(time_s, self.channel.time_s[self.channel.good], self.good)


def of_database(database: Database) -> list[Candidate]:
    """All signals of a database that a layout can name, in its order.

    Signals that no control unit sends (``VECTOR__INDEPENDENT_SIG_MSG``) are none.
    """
    found = []
    for message in database.messages:
        if message.name == "VECTOR__INDEPENDENT_SIG_MSG" or not _NAME.fullmatch(message.name):
            continue
        rest = words_of(message.name, message.comment, *message.senders)
        for signal in message.signals:
            if not _NAME.fullmatch(signal.name):
                continue
            quantity, factor = _quantity(signal)
            span = signal_range(signal, factor)
            codes = (-(1 << signal.length - 1), (1 << signal.length - 1) - 1)
            codes = codes if signal.is_signed else (0, (1 << signal.length) - 1)
            ends = sorted(factor * (code * float(signal.scale) + float(signal.offset)) for code in codes)
            if span.high - span.low < NO_RANGE * (ends[1] - ends[0]):
                span = replace(span, low=-np.inf, high=np.inf)
            own = words_of(signal.name, signal.comment)
            found.append(
                Candidate(
                    name=f"{message.name}.{signal.name}",
                    quantity=quantity,
                    unit=signal.unit or "",
                    comment=signal.comment or "",
                    own=own,
                    words=(*own, *rest),
                    factor=factor,
                    low=max(ends[0], span.low),
                    high=min(ends[1], span.high),
                    message=message,
                    signal=signal,
                )
            )
    return found


def _quantity(signal: Signal) -> tuple[str, float]:
    for quantity, units in FLOWS.items():
        try:
            factor = unit_factor(signal, units, "")
        except DatabaseError:
            continue
        if signal.unit:
            return quantity, factor
        is_state = signal.length < _FEWEST_BITS or bool(signal.choices)
        return "" if is_state else _named_quantity(words_of(signal.name)), 1.0
    return _other(signal.unit or ""), 1.0


def _named_quantity(named: Sequence[str]) -> str:
    letters = [word for word in named if not word.isdigit()] or [""]
    for quantity, words in _MEASURED.items():
        if letters[-1] in words or letters[0] in words & {"i", "u", "p"}:
            return quantity
    return ""


def _other(unit: str) -> str:
    plain = re.sub(r"^(unit_|\w+:)|\s", "", unit.lower()).partition("*0")[0]  # "Nm *0.5": as the scale has it
    return next((quantity for quantity, units in _OTHERS.items() if plain in units), "")


def with_log(found: Sequence[Candidate], frames: Frames) -> list[Candidate]:
    """Those of some signals that a log holds, with what it shows of them.

    Parameters
    ----------
    found : sequence of Candidate
        Signals of the database.
    frames : Frames
        Of the log; of an identifier on several buses, the one with most frames counts.

    Returns
    -------
    list of Candidate
        Without those whose message, or multiplexed part of it, never comes.
    """
    time = repaired_time(frames.time_ns)
    ordered, kept = frames.take(time.order), list[Candidate]()
    rows: dict[int, NDArray[np.intp]] = {}
    for item in found:
        if item.message is None or item.signal is None or not item.quantity:
            continue
        key = frame_key(item.message.frame_id, extended=item.message.is_extended_frame)
        if key not in rows:
            rows[key] = _on_one_bus(np.flatnonzero(ordered.key == np.uint32(key)), ordered)
        part, is_flow = ordered.take(rows[key]), item.quantity in FLOWS
        unlimited = copy.copy(item.signal)
        unlimited.minimum = unlimited.maximum = None
        named = frozenset(map(int, item.signal.choices or {})) if is_flow else None
        every = decode_signal(item.message, unlimited, part.data, part.length, named)
        if not every.present.any():
            continue
        turned = _signed(item.signal, part, every.good) if is_flow else None
        value = item.factor * (every.value if turned is None else turned)
        inside = signal_range(item.signal).holds(every.value) | (turned is not None)
        here = every.present
        seen = _recorded(
            item, Channel(time_s=time.time_s[rows[key]][here], value=value[here], good=every.good[here]), inside[here]
        )
        kept.append(seen if turned is None else replace(seen, wrong="sign"))
    return kept


def _on_one_bus(rows: NDArray[np.intp], frames: Frames) -> NDArray[np.intp]:
    channels = frames.channel[rows]
    return np.asarray(rows[channels == np.bincount(channels).argmax()]) if len(rows) else rows


def _recorded(item: Candidate, channel: Channel, inside: Mask) -> Candidate:
    """The candidate with its values; a range of the database that these show to be wrong is not applied to them."""
    outside = channel.good & ~inside
    wrong = (
        outside.sum() > WRONG_RANGE * channel.good.sum() and len(np.unique(channel.value[outside])) >= FEWEST_OUTSIDE
    )
    channel = replace(channel, good=channel.good & (inside | wrong))
    return replace(item, channel=channel, wrong="range" if wrong else "")


def with_table(found: Sequence[Candidate], table: Table) -> list[Candidate]:
    """Those of some signals that a table has as columns, called ``Message.Signal`` or ``Signal``, with their values.

    Parameters
    ----------
    found : sequence of Candidate
        Signals of the database.
    table : Table
        The recording.

    Returns
    -------
    list of Candidate
        Without those that have no column.

    Raises
    ------
    LogError
        If a column could be currents, powers or voltages of two messages.
    """
    kept: dict[str, Candidate] = {}
    for item in found:
        header = table.header(item.name) if item.quantity else None
        if header is None or item.signal is None:
            continue
        if header in kept and item.quantity in FLOWS:
            raise LogError(
                f"{table.path}: column {header!r} could be {kept[header].name} and {item.name}; call columns after "
                f"message and signal"
            )
        value = table.columns[header] * FLOWS.get(item.quantity, {}).get(table.units.get(header, ""), item.factor)
        inside = signal_range(item.signal, item.factor).holds(value)
        kept[header] = _recorded(item, Channel(time_s=table.time_s, value=value, good=np.isfinite(value)), inside)
    return list(kept.values())


def _signed(signal: Signal, frames: Frames, good: Mask) -> Array | None:
    """Values as if the highest bit were a sign, if the codes jump between both ends without that; else None."""
    if signal.is_signed or signal.is_float or signal.length < _FEWEST_BITS or not good.any():
        return None
    raw = raw_values(signal, frames.data, frames.length)[0].astype(np.float64)
    turned = np.where(raw >= 2.0 ** (signal.length - 1), raw - 2.0**signal.length, raw)
    negative = np.unique(turned[good & (turned < 0.0)])
    if len(negative) < FEWEST_OUTSIDE or turned[good].std() > 0.3 * raw[good].std():
        return None
    return turned * float(signal.scale) + float(signal.offset)


def of_table(table: Table) -> list[Candidate]:
    """The columns of a table, in its order."""
    found = []
    unknown = {name: np.full(len(table.time_s), np.nan) for name in table.texts}
    for name, value in (table.columns | unknown).items():
        own = words_of(name)
        unit = table.units.get(name, "")
        quantity, factor = next(
            ((quantity, units[unit]) for quantity, units in FLOWS.items() if unit in units),
            (_other(unit) if unit else _named_quantity(own), 1.0),
        )
        channel = Channel(time_s=table.time_s, value=factor * value, good=np.isfinite(value))
        found.append(
            Candidate(
                name=name,
                quantity=quantity,
                unit=unit,
                comment=table.texts.get(name, ""),
                own=own,
                words=own,
                factor=factor,
                channel=channel,
            )
        )
    return found
