"""Signals of a database or columns of a table, described by units, words and ranges, and by what a recording shows."""

import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property, partial

import numpy as np
from cantools.database.can import Database, Message, Signal

from calibrator.drive import Array, Channel, Mask
from calibrator.errors import LogError
from calibrator.recordings.decode import bit_range, decode_signal, raw_values, signal_range
from calibrator.recordings.frame_arrays import Frames, frame_key, repaired_time
from calibrator.recordings.tables import Table, peak_of
from calibrator.words import CURRENT, POWER, VOLTAGE, words_of
from ecu_node.core.signals import AMPERE, VOLT, WATT, factor_of, unit_factor
from ecu_node.errors import DatabaseError

__all__ = ["Candidate", "of_database", "of_table", "with_log", "with_table"]

FLOWS = {"current": AMPERE, "power": WATT, "voltage": VOLT}
"""Quantities from which a branch current is made, with the units that the layout knows."""
_OTHERS = {
    "torque": {"nm", "n.m", "n*m", "newtometer"},
    "speed": {"km/h", "kph", "kmh", "km/hr", "m/s", "mph", "rpm", "1/min", "kilometerperhour", "minutinver"},
    "temperature": {"degc", "°c", "c", "celsius"},
}
"""Units as databases write them, in lower case and without blanks, by quantity."""
_MEASURED = {"current": CURRENT, "voltage": VOLTAGE, "power": POWER}
"""Words that give a signal without a unit its quantity, if its name ends with one or begins with i, u or p."""
_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
_FEWEST_BITS = 8
"""A signal without a unit and with fewer bits is a state."""
NO_RANGE = 1e-3
"""A range below this share of what the bits can show is a mistake of the database, such as 0 to 1 for a voltage. [1]"""
WRONG_RANGE, FEWEST_OUTSIDE = 0.01, 5
"""The range of the database is wrong if more than this share of the values, and at least so many different ones, are
outside it; a code for "not available" is only one value. [1]"""


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """A signal or column, and how well it fits as a branch.

    Attributes
    ----------
    name : str
        ``Message.Signal``, or the header of a column.
    quantity : str
        ``current``, ``voltage``, ``torque`` ..., by its unit or else by its name; empty if it is of no use here.
    unit, comment : str
        As written in the file; of a column without numbers the comment says so.
    own, words : tuple of str
        Words of its name and comment; these and the words of its message and senders.
    factor : float
        Turns values as written into A, V or W; 1 for other quantities.
    low, high : float
        Least and greatest value that bits and range allow [A, V, W]; infinite for columns.
    message, signal : Message, Signal or None
        Message and signal of the database; None for columns.
    channel : Channel or None
        Its samples in a recording, in A, V or W, also those outside the range of the database; None without recording.
    formula : str
        Formula of inputs if it is computed; empty if it is measured.
    wrong : str
        What the recording shows to be wrong in the database: ``range`` or ``sign``; empty if nothing is.
    place : str
        Where it probably flows, one of :data:`calibrator.words.PLACES`; empty if no word tells.
    score : float
        How well it fits as a branch; from :data:`.TAKEN` on it can be one.
    why : str
        Main reason why it is a branch, or why it is none.
    branch : str
        Name of the branch that it is, such as ``motor_rear``; empty if it is none.
    sign : int
        Of a branch: 1 if it is positive into the junction, -1 if out of it.
    sign_reason : str
        How the sign is known.
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
    place: str = ""
    score: float = 0.0
    why: str = ""
    branch: str = ""
    sign: int = 1
    sign_reason: str = ""

    @property
    def about(self) -> str:
        """Unit and comment as one text, for a remark in the layout."""
        comment = " ".join(self.comment.split())
        return (self.unit or "no unit") + (f', "{comment}"' if comment else "")

    @property
    def points(self) -> float:
        """Score limited to the range 0 to 100, as users see it."""
        return min(max(self.score, 0.0), 100.0)

    @property
    def reach(self) -> float:
        """Greatest magnitude that bits and range allow. [A, V, W]"""
        return max(abs(self.low), abs(self.high))

    @cached_property
    def good(self) -> Array:
        """Good values of the recording, shape (n,)."""
        return self.channel.value[self.channel.good] if self.channel is not None else np.zeros(0)

    @property
    def peak(self) -> float:
        """Greatest magnitude, wild samples excepted; 0 without good values. [A, V, W]"""
        return peak_of(self.good)

    def at(self, time_s: Array) -> Array:
        """Return the values (T,) at instants `time_s` (T,), interpolated between good ones; NaN if there is none."""
        if self.channel is None or not len(self.good):
            return np.full(len(time_s), np.nan)
        return np.interp(time_s, self.channel.time_s[self.channel.good], self.good)


def of_database(database: Database) -> list[Candidate]:
    """Return all signals of a database that a layout can name, in the order of the database.

    Signals that no control unit sends (``VECTOR__INDEPENDENT_SIG_MSG``) are left out.
    """
    return [
        _of_signal(message, signal)
        for message in database.messages
        for signal in message.signals
        if message.name != "VECTOR__INDEPENDENT_SIG_MSG"
        if _NAME.fullmatch(message.name) and _NAME.fullmatch(signal.name)
    ]


def _of_signal(message: Message, signal: Signal) -> Candidate:
    own, unit = words_of(signal.name, signal.comment), signal.unit or ""
    is_state = not unit and (signal.length < _FEWEST_BITS or bool(signal.choices))
    quantity, factor = ("", 1.0) if is_state else _quantity(signal.name, unit, partial(unit_factor, signal))
    (low, high), span = bit_range(signal, factor), signal_range(signal, factor)
    if span.high - span.low >= NO_RANGE * (high - low):
        low, high = max(low, span.low), min(high, span.high)
    return Candidate(
        name=f"{message.name}.{signal.name}",
        quantity=quantity,
        unit=unit,
        comment=signal.comment or "",
        own=own,
        words=(*own, *words_of(message.name, message.comment, *message.senders)),
        factor=factor,
        low=low,
        high=high,
        message=message,
        signal=signal,
    )


def of_table(table: Table) -> list[Candidate]:
    """Return all columns of a table with their values; columns without numbers come last, without good values."""
    found = []
    unknown = {name: np.full(len(table.time_s), np.nan) for name in table.texts}
    for name, value in (table.columns | unknown).items():
        own, unit = words_of(name), table.units.get(name, "")
        quantity, factor = _quantity(name, unit, partial(factor_of, unit))
        channel = Channel(time_s=table.time_s, value=factor * value, good=np.isfinite(value))
        item = Candidate(name=name, quantity=quantity, unit=unit, comment=table.texts.get(name, ""), own=own, words=own)
        found.append(replace(item, factor=factor, channel=channel))
    return found


def _quantity(name: str, unit: str, factor_in: Callable[[Mapping[str, float], str], float]) -> tuple[str, float]:
    """Return the quantity, by unit or else by name, and the factor from its values to A, V or W; else ("", 1.0)."""
    if not unit:
        letters = [word for word in words_of(name) if not word.isdigit()] or [""]
        for quantity, words in _MEASURED.items():
            if letters[-1] in words or letters[0] in words & {"i", "u", "p"}:
                return quantity, 1.0
        return "", 1.0
    for quantity, units in FLOWS.items():
        with suppress(DatabaseError):
            return quantity, factor_in(units, "")
    plain = re.sub(r"^(unit_|\w+:)|\s", "", unit.lower()).partition("*0")[0]  # "Nm *0.5" repeats the scale
    return next((quantity for quantity, units in _OTHERS.items() if plain in units), ""), 1.0


def with_log(found: Sequence[Candidate], frames: Frames) -> list[Candidate]:
    """Return those of the given signals that a log holds, with their values in it.

    Parameters
    ----------
    found : sequence of Candidate
        Signals of the database.
    frames : Frames
        Frames of the log. If several buses have an identifier, the one with most of its frames counts.

    Returns
    -------
    list of Candidate
        Without signals that have no quantity, or whose message, or multiplexed part of it, never comes.
    """
    time = repaired_time(frames.time_ns)
    ordered, kept, parts = frames.take(time.order), list[Candidate](), dict[int, tuple[Array, Frames]]()
    for item in found:
        if item.message is None or item.signal is None or not item.quantity:
            continue
        key = frame_key(item.message.frame_id, extended=item.message.is_extended_frame)
        if key not in parts:
            rows = np.flatnonzero(ordered.key == np.uint32(key))
            channels = ordered.channel[rows]
            rows = rows[channels == np.bincount(channels, minlength=1).argmax()]
            parts[key] = time.time_s[rows], ordered.take(rows)
        (time_s, part), is_flow = parts[key], item.quantity in FLOWS
        named = frozenset(map(int, item.signal.choices or {})) if is_flow else None
        every = decode_signal(item.message, item.signal, part.data, part.length, named)
        good = every.present & np.isfinite(every.value) & ~(every.bad["too short"] | every.bad["not available"])
        if every.present.any():
            turned = _signed(item.signal, part, good) if is_flow else None
            value = item.factor * (every.value if turned is None else turned)
            inside, here = ~every.bad["out of range"] | (turned is not None), every.present
            channel = Channel(time_s=time_s[here], value=value[here], good=good[here])
            seen = _recorded(item, channel, inside[here])
            kept.append(seen if turned is None else replace(seen, wrong="sign"))
    return kept


def _recorded(item: Candidate, channel: Channel, inside: Mask) -> Candidate:
    """Return the candidate with its recorded values; if many exceed its range, the range is wrong and they are good."""
    outside = channel.good & ~inside
    wrong = (
        outside.sum() > WRONG_RANGE * channel.good.sum() and len(np.unique(channel.value[outside])) >= FEWEST_OUTSIDE
    )
    channel = replace(channel, good=channel.good & (inside | wrong))
    return replace(item, channel=channel, wrong="range" if wrong else "")


def with_table(found: Sequence[Candidate], table: Table) -> list[Candidate]:
    """Return those signals that are columns of a table (``Message.Signal`` or ``Signal``), with their values.

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
    """Return the values with the highest bit read as a sign, if they then vary far less; else None."""
    if signal.is_signed or signal.is_float or signal.length < _FEWEST_BITS or not good.any():
        return None
    raw = raw_values(signal, frames.data, frames.length)[0].astype(np.float64)
    turned = np.where(raw >= 2.0 ** (signal.length - 1), raw - 2.0**signal.length, raw)
    negative = np.unique(turned[good & (turned < 0.0)])
    if len(negative) < FEWEST_OUTSIDE or turned[good].std() > 0.3 * raw[good].std():
        return None
    return turned * float(signal.scale) + float(signal.offset)
