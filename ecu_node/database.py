"""The DBC as the layout uses it: every named signal found, with its unit turned into A, V or W."""

from dataclasses import dataclass

import cantools
from cantools.database.can import Database, Message, Signal

from ecu_node.codes import impossible_values
from ecu_node.errors import DatabaseError, LayoutError
from ecu_node.layout import Layout, split_signal
from ecu_node.units import AMPERE, VOLT, WATT, unit_factor
from ecu_node.user_files import UnsuitableFileError, read_user_file, text_digest

__all__ = ["MAX_DBC_BYTES", "VehicleDatabase", "look_everything_up", "read_database"]

MAX_DBC_BYTES = 16_000_000
"""The largest DBCs have some megabytes; to read one takes a hundred times its size in memory."""


@dataclass(frozen=True, kw_only=True)
class VehicleDatabase:
    """The messages of one DBC, with look-ups whose errors name file, message and signal."""

    layout: Layout
    database: Database
    digest: str
    """SHA-256 of the DBC file."""

    def message(self, name: str, place: str = "") -> Message:
        """Return the message of this name, which stands at this place of the layout, or raise DatabaseError."""
        try:
            return self.database.get_message_by_name(name)
        except KeyError:
            where = f" in {place}" if place else ""
            raise DatabaseError(
                f"{self.layout.dbc_path}: no message {name!r}, which {self.layout.path} names{where}"
            ) from None

    def signal(self, name: str) -> tuple[Message, Signal]:
        """Return message and signal of ``Message.Signal``, or raise :class:`DatabaseError`."""
        message_name, signal_name = split_signal(name)
        message = self.message(message_name)
        for signal in message.signals:
            if signal.name == signal_name:
                return message, signal
        known = ", ".join(signal.name for signal in message.signals)
        raise DatabaseError(
            f"{self.layout.dbc_path}: message {message_name} has no signal {signal_name!r}, which {self.layout.path} "
            f"names; it has {known}"
        )

    def current_step_a(self, branch: str) -> float:
        """Step of the signal of a branch [A]; 0 where its current is a quotient of two signals."""
        name = self.layout.find_branch(branch).signal
        if name is None:
            return 0.0
        _, signal = self.signal(name)
        return float(signal.scale) * unit_factor(signal, AMPERE, f"branch {branch}")


def read_database(layout: Layout) -> VehicleDatabase:
    """Load the DBC of a layout and look every signal up that the layout names.

    Parameters
    ----------
    layout : Layout
        A layout read from a file.

    Returns
    -------
    VehicleDatabase
        The database, with all names of the layout known to exist.

    Raises
    ------
    DatabaseError
        If the file cannot be read or parsed, or lacks messages or a signal that the layout names.
    LayoutError
        If the layout names a value of an input that its signal can never have.
    """
    path = layout.dbc_path
    try:
        content = read_user_file(path, largest_bytes=MAX_DBC_BYTES)
        if not content.strip():
            raise DatabaseError(f"{path}: the DBC is empty, it has no message; copy it again")
        database = cantools.database.load_file(path, strict=False)
        if read_user_file(path, largest_bytes=MAX_DBC_BYTES) != content:
            raise DatabaseError(f"{path}: the DBC was changed while it was read; try again")
    except (OSError, UnsuitableFileError) as error:
        why = error.strerror if isinstance(error, OSError) else error
        raise DatabaseError(
            f'{path}: cannot read the DBC: {why}; it is named by the line dbc = "{layout.dbc}" of {layout.path}'
        ) from None
    except (cantools.Error, ValueError, KeyError, TypeError) as error:
        first_line = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise DatabaseError(f"{path}: not a CAN database: {first_line}") from None
    if not isinstance(database, Database):
        raise DatabaseError(f"{path}: a diagnostics database; a CAN database (DBC) is needed")
    if not database.messages:
        raise DatabaseError(f"{path}: the DBC has no message; check that it is the one that {layout.path} needs")
    vehicle = VehicleDatabase(layout=layout, database=database, digest=text_digest(content))
    look_everything_up(vehicle)
    return vehicle


def look_everything_up(vehicle: VehicleDatabase) -> None:
    """Look every signal up that the layout names; raises as :func:`read_database` does."""
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
    for item in layout.input:
        vehicle.signal(item.signal)
    _check_values(vehicle)
    if layout.status is not None:
        for field in ("state", "reason", "parameter_set", "alive_counter", "sum_measured", "sum_corrected"):
            signal = getattr(layout.status, field)
            if signal is not None:
                vehicle.signal(f"{layout.status.message}.{signal}")
    for place, entry in layout.protections:
        for name in entry.messages:
            vehicle.message(name, place)


def _check_values(vehicle: VehicleDatabase) -> None:
    """Refuse values of inputs that their signals can never have: what waits for them would wait for ever."""
    layout = vehicle.layout
    signals = {item.name: item.signal for item in layout.input}
    wanted = []
    if layout.contactor is not None:
        wanted.append(("[contactor] open", layout.contactor.input, layout.contactor.open))
    if layout.watch.input is not None:
        wanted.append(("[watch] valid", layout.watch.input, layout.watch.valid))
    for key, name, values in wanted:
        _, signal = vehicle.signal(signals[name])
        if never := impossible_values(signal, values):
            raise LayoutError(
                f"{layout.path}: {key}: {', '.join(f'{value:g}' for value in never)} is no value of {signals[name]}, "
                f"which has {signal.length} bits, scale {signal.scale:g} and offset {signal.offset:g}"
            )
