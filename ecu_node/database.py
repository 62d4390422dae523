"""The DBC as the layout uses it: every signal that the layout names is looked up, and its unit is checked."""

import logging
import re
from collections import OrderedDict
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import cantools
from cantools.database.can import Database, Message, Signal
from cantools.database.conversion import BaseConversion

from ecu_node.core.signals import AMPERE, VOLT, WATT, impossible_values, unit_factor, usual_unit
from ecu_node.documents import read_user_file, text_digest
from ecu_node.errors import DatabaseError, LayoutError
from ecu_node.layout import Branch, Layout, SignalName, joint_digest, read_layout, split_signal

__all__ = [
    "VehicleDatabase",
    "codes_of_no_value",
    "means_not_available",
    "node_database",
    "read_database",
]

logging.getLogger("cantools").addHandler(logging.NullHandler())  # it prints of identifiers that stand there twice

_MAX_DBC_BYTES = 16_000_000
"""Largest DBC that is read: real ones have some megabytes, and reading takes a hundred times that in memory."""


_NOT_AVAILABLE = re.compile(
    r"(signal |value |data )?"
    r"(sna|snv|na|n a|not available|unavailable|invalid|not valid|error|not defined|undefined|init)"
    r"( signal| value| data| indicator)?"
)


@dataclass(frozen=True, kw_only=True)
class VehicleDatabase:
    """The messages of a layout's DBC, with look-ups whose errors name file, message and signal."""

    layout: Layout
    databases: Mapping[str, Database]
    """Loaded DBCs by name of the bus, ``""`` if the layout names no buses; empty if it has no DBC."""
    digest: str
    """SHA-256 of the DBC file; see :attr:`.Layout.dbc_digest`."""

    def message(self, name: str, place: str = "") -> Message:
        """Return the message ``Message`` or ``bus:Message``; ``place`` is where the layout names it, for errors.

        DatabaseError if there is no such message, or the name or its identifier is not unique; LayoutError if there is
        no such bus.
        """
        return self._found(name, place)[1]

    def channel_of(self, name: str) -> str | None:
        """Return the channel that ``Message`` or ``bus:Message`` comes on; None if the layout names no buses."""
        bus = self._found(name)[0]
        return next((item.channel for item in self.layout.bus if item.name == bus), None)

    def _found(self, name: str, place: str = "") -> tuple[str, Message]:
        """Return bus and message for ``Message`` or ``bus:Message``."""
        layout, paths = self.layout, self.layout.dbc_paths
        if not paths:
            raise DatabaseError(f"{layout.path}: no 'dbc', so that it fits tables only; give the DBC of the frames")
        bus, is_of_bus, bare = name.rpartition(":")
        if is_of_bus and bus not in paths:
            known = ", ".join(filter(None, paths)) or "none"
            raise LayoutError(f"{layout.path}: {name}: no [[bus]] is named {bus!r}; known are {known}")
        where = f" in {place}" if place else ""
        found = []
        for one in [bus] if is_of_bus else paths:
            with suppress(KeyError):
                found.append((one, self.databases[one].get_message_by_name(bare)))
        if not found:
            searched = paths[bus] if is_of_bus else ", ".join(map(str, paths.values()))
            raise DatabaseError(f"{searched}: no message {bare!r}, which {layout.path} names{where}")
        if len(found) > 1:
            buses = [one for one, _ in found]
            raise DatabaseError(
                f"{layout.path}: message {bare!r}{where} is in the DBCs of the buses "
                f"{' and '.join(buses)}; write '{buses[0]}:{bare}'"
            )
        bus, message = found[0]
        if sum(item.name == bare for item in self.databases[bus].messages) > 1:
            raise DatabaseError(f"{paths[bus]}: {bare!r} is the name of several messages{where}; rename all but one")
        key = message.frame_id, message.is_extended_frame
        same = [item.name for item in self.databases[bus].messages if (item.frame_id, item.is_extended_frame) == key]
        if len(same) > 1:
            raise DatabaseError(
                f"{paths[bus]}: messages {' and '.join(same)} have one identifier, 0x{message.frame_id:X}; take out "
                f"those that are not on this bus"
            )
        return bus, message

    def signal(self, name: str) -> tuple[Message, Signal]:
        """Return message and signal of ``Message.Signal``; raise :class:`DatabaseError` if the DBC lacks one of them,
        or the message has two signals of this name.

        LayoutError if the name has another form, or a bus that the layout does not have.
        Without a DBC the name is that of a column; its signal is then a float in the unit that the layout gives.
        """
        if not self.layout.dbc_files:
            unit = next((item.unit for item in self.layout.branch if item.source == name), None)
            column = Signal(name, 0, 64, conversion=BaseConversion.factory(is_float=True), unit=unit)
            return Message(0, name, 8, [column]), column
        message_name, signal_name = split_signal(name)
        if not signal_name:
            raise LayoutError(
                f"{self.layout.path}: 'Message.Signal' as in the DBC is expected, found \"{name}\"; see the page "
                f"'Layout' of the documentation"
            )
        message = self.message(message_name)
        found = [item for item in message.signals if item.name == signal_name]
        if len(found) > 1:
            raise DatabaseError(
                f"{self.layout.dbc_path}: message {message_name} has several signals named {signal_name!r}; rename all "
                f"but one in the DBC"
            )
        if found:
            return message, found[0]
        raise DatabaseError(
            f"{self.layout.dbc_path}: message {message_name} has no signal {signal_name!r}, which "
            f"{self.layout.path} names; it has {', '.join(signal.name for signal in message.signals)}"
        )

    def current_step_a(self, branch: str) -> float:
        """Return the resolution of a branch's current [A]; 0 if that is computed from other signals, or is a float."""
        name = self.layout.find_branch(branch).signal
        if name is None:
            return 0.0
        _, signal = self.signal(name)
        return 0.0 if signal.is_float else abs(float(signal.scale)) * unit_factor(signal, AMPERE, f"branch {branch}")


def read_database(layout: Layout) -> VehicleDatabase:
    """Load the DBC of a layout, or those of its buses, and look up every signal that the layout names.

    Parameters
    ----------
    layout : Layout
        A layout read from a file.

    Returns
    -------
    VehicleDatabase
        The database; all names in the layout exist in it. Without a DBC, names are those of columns.

    Raises
    ------
    DatabaseError
        If the file cannot be read or parsed, lacks a message or signal that the layout names, or a signal of a branch
        has a unit of another quantity.
    LayoutError
        If the layout names a value that an input's signal can never have, or a name is not ``Message.Signal``.
    """
    loaded = {bus: _load(layout, file) for bus, file in layout.dbc_files.items()}
    vehicle = VehicleDatabase(
        layout=layout,
        databases={bus: database for bus, (database, _) in loaded.items()},
        digest=joint_digest([digest for _, digest in loaded.values()]),
    )
    if loaded:
        for branch in layout.branch:
            if not branch.computed:
                _settle_units(vehicle, branch)
        for name in layout.wrong_ranges:
            signal = vehicle.signal(name)[1]
            signal.minimum = signal.maximum = None
        _look_everything_up(vehicle)
    return vehicle


def node_database(path: Path) -> VehicleDatabase:
    """Read a layout and its DBC for a node, which corrects the signals of one bus.

    Parameters
    ----------
    path : Path
        The layout.

    Returns
    -------
    VehicleDatabase
        Layout and DBC.

    Raises
    ------
    LayoutError
        If the layout cannot be read, is one for tables or for several buses, or has a branch that no integer signal
        carries.
    DatabaseError
        If the DBC cannot be read, or lacks what the layout names.
    """
    layout = read_layout(path)
    computed = [branch.name for branch in layout.branch if branch.computed]
    if len(layout.dbc_files) != 1:
        what = "names several buses" if layout.bus else "has no 'dbc', so that it fits tables only"
        raise LayoutError(f"{path}: {what}; the node corrects the signals of one bus: write a layout with its 'dbc'")
    if computed:
        raise LayoutError(
            f"{path}: branch {computed[0]} is computed by a formula; the node corrects only what a signal carries: "
            f"leave the branch out of the node's layout"
        )
    database = read_database(layout)
    for branch in layout.branch:
        if database.signal(branch.source)[1].is_float:
            raise LayoutError(
                f"{path}: branch {branch.name}: {branch.source} is a floating-point number in the DBC; the node "
                f"corrects integer signals only: leave the branch out of the node's layout"
            )
    return database


def _load(layout: Layout, file: str) -> tuple[Database, str]:
    """Load a DBC; return its messages and its digest."""
    path = layout.path.parent / file
    try:
        content = read_user_file(path, largest_bytes=_MAX_DBC_BYTES)
        database = _parsed(content, path.suffix.lower()) if content.strip() else Database()
    except OSError as error:
        line = f'it is named by the line dbc = "{file}" of {layout.path}'
        raise DatabaseError(f"{path}: cannot read the DBC: {error.strerror}; {line}") from None
    except (cantools.Error, ValueError, KeyError, TypeError) as error:
        first_line = str(error).splitlines()[0] if str(error) else type(error).__name__
        if isinstance(error.__cause__, IndexError | KeyError):
            raise DatabaseError(
                f"{path}: the library cantools cannot read it ({first_line}), as if an attribute (BA_) were not "
                f"defined (BA_DEF_) or had a value outside its enumeration; open it in a DBC editor, correct that and "
                f"save it"
            ) from None
        raise DatabaseError(f"{path}: not a CAN database: {first_line}") from None
    if not isinstance(database, Database):
        raise DatabaseError(f"{path}: a diagnostics database; a CAN database (DBC) is needed")
    if not database.messages:
        raise DatabaseError(f"{path}: the DBC has no message; check that it is the one that {layout.path} needs")
    for message in database.messages:
        _complete_multiplexers(message)
        for signal in message.signals:
            _name_codes_as_read(signal)
    return database, text_digest(content)


def _complete_multiplexers(message: Message) -> None:
    """Replace shortened names of multiplexers by the full ones.

    DBCs keep names of more than 32 characters in an attribute. cantools takes the names of signals from there, but
    leaves each signal's reference to its multiplexer shortened.
    """
    names = {signal.name for signal in message.signals}
    wanted = {signal.multiplexer_signal for signal in message.signals if signal.multiplexer_signal is not None} - names
    for cut in wanted:
        whole = [s.name for s in message.signals if s.is_multiplexer and s.name.startswith(cut)]
        for signal in message.signals:
            if whole and signal.multiplexer_signal == cut:
                signal.multiplexer_signal = min(whole, key=len)
    if wanted:
        message.refresh(strict=False)


def _name_codes_as_read(signal: Signal) -> None:
    """Let names stand for codes as they are read: databases also write 65535 for -1 of a signed one, or the reverse."""
    named, size = dict(signal.choices or {}), 1 << signal.length
    codes = range(-size // 2, size // 2) if signal.is_signed else range(size)
    if not signal.is_float and any(code not in codes for code in named):
        as_read = {(code - codes.start) % size + codes.start: name for code, name in named.items() if abs(code) < size}
        signal.choices = OrderedDict(as_read | {code: name for code, name in named.items() if code in codes})


_ENCODINGS = {"dbc": "cp1252", "sym": "cp1252", "arxml": "utf-8", "kcd": "utf-8", "cdd": "utf-8"}
"""Encodings of the formats, by suffix, as in cantools."""
_EXTENDED = 1 << 31
_OF_MESSAGE = re.compile(r'(\s*(?:BO_|VAL_|BO_TX_BU_|CM_ (?:BO_|SG_)|SIG_VALTYPE_|BA_ "\w+" (?:BO_|SG_)) )(\d+)')


def _parsed(content: bytes, suffix: str) -> object:
    """Parse a file with cantools, and correct two slips that many public DBCs have.

    These are 29-bit identifiers that are not marked as extended, and value tables for signals that do not exist.
    """
    kind = suffix.removeprefix(".")
    text = content.decode(_ENCODINGS.get(kind, "utf-8"), errors="replace")
    try:
        return cantools.database.load_string(text, kind if kind in _ENCODINGS else None, strict=False)
    except (cantools.Error, ValueError) as error:
        if kind != "dbc" or not re.search("more than 11 bits|unused VAL_", str(error)):
            raise
    signals: set[tuple[str, str]] = set()
    lines, message = [], ""
    for line in text.splitlines():
        if found := _OF_MESSAGE.match(line):
            number = int(found[2])
            message = str(number | _EXTENDED if 0x7FF < number < _EXTENDED else number)
            line = f"{found[1]}{message}{line[found.end() :]}"  # noqa: PLW2901
        if found := re.match(r"\s*SG_ (\w+)", line):
            signals.add((message, found[1]))
        lines.append(line)
    names = [(line, re.match(r"VAL_ (\d+) (\w+)", line)) for line in lines]
    known = [line for line, name in names if name is None or name.groups() in signals]
    return cantools.database.load_string("\n".join(known) + "\n", "dbc", strict=False)


def _settle_units(vehicle: VehicleDatabase, branch: Branch) -> None:
    """Give a branch the unit of the layout; its corrected signal, too, where the DBC gives that none or the same."""
    measured = vehicle.signal(branch.source)[1]
    corrected = vehicle.signal(branch.corrected)[1] if branch.corrected is not None else None
    in_dbc = measured.unit or ""
    if branch.unit is not None:
        measured.unit = branch.unit
        if corrected is not None and corrected.unit in {None, "", in_dbc}:
            corrected.unit = branch.unit
    elif corrected is not None and not corrected.unit and usual_unit(in_dbc) in {*AMPERE, *WATT} - {"A", "W"}:
        raise DatabaseError(
            f"{vehicle.layout.path}: branch {branch.name}: {branch.source} is in {in_dbc}, and {branch.corrected} has "
            f"no unit in the DBC; give it its unit there"
        )


def _look_everything_up(vehicle: VehicleDatabase) -> None:
    """Look up every signal that the layout names; errors are those of :func:`read_database`."""
    layout = vehicle.layout
    for branch in layout.branch:
        where = f"{layout.path}: branch {branch.name}"
        for name, unit in (
            (branch.signal, AMPERE),
            (branch.power, WATT),
            (branch.voltage, VOLT),
            (branch.corrected, AMPERE if branch.signal is not None else WATT),
        ):
            if name is not None:
                unit_factor(vehicle.signal(name)[1], unit, where)
        if branch.quality is not None:
            vehicle.signal(branch.quality)
    waited = [("[watch] valid", layout.watch.input, layout.watch.valid)]
    if layout.contactor is not None:
        waited.append(("[contactor] open", layout.contactor.input, layout.contactor.open))
    for item in layout.input:
        _, signal = vehicle.signal(item.signal)
        for key, name, values in waited:
            if name == item.name and (never := impossible_values(signal, values)):  # it would never come
                raise LayoutError(
                    f"{layout.path}: {key}: {', '.join(f'{value:g}' for value in never)} is no value of {item.signal}, "
                    f"which has {signal.length} bits, scale {signal.scale:g} and offset {signal.offset:g}"
                )
    if layout.status is not None:
        for name in layout.status.signals.values():
            vehicle.signal(name)
    for place, entry in layout.protections:
        for name in entry.messages:
            vehicle.message(name, place)


def means_not_available(name: str) -> bool:
    """Check whether a name in a value table says that there is no value.

    Such names are SNA, "Signal not available", "Invalid", "Error", "Not_Defined" or "Init", in any spelling, with or
    without "signal", "value" or "data". Names that only contain such words ("No error") are values.

    Parameters
    ----------
    name : str
        The name that the DBC gives to a raw value.
    """
    spaced = re.sub(r"(?<=[a-z])(?=[A-Z])|[^A-Za-z0-9]+", " ", name)
    return _NOT_AVAILABLE.fullmatch(spaced.strip().lower()) is not None


def codes_of_no_value(database: VehicleDatabase, name: SignalName) -> frozenset[int]:
    """Return the raw codes of a signal that are no values.

    Parameters
    ----------
    database : VehicleDatabase
        DBC and layout.
    name : str
        The signal, as MESSAGE.SIGNAL.

    Returns
    -------
    frozenset of int
        For a branch's current, power, voltage or corrected signal: every code with a name, as in
        :mod:`ecu_node.core.signals`, and for the measured one also the branch's ``no_value``. For other signals (a gear
        selector), whose names may stand for values: only codes with a name that :func:`means_not_available`.
    """
    named: Mapping[int, object] = database.signal(name)[1].choices or {}
    branches = [item for item in database.layout.branch if name in {item.source, item.voltage, item.corrected}]
    if not branches:
        return frozenset(int(code) for code, text in named.items() if means_not_available(str(text)))
    extra = [code for item in branches if item.source == name for code in item.no_value]
    return frozenset([*map(int, named), *extra])
