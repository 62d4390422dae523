"""Signals that a layout names, and their codes in the DBC."""

from collections.abc import Mapping
from dataclasses import replace

from ecu_node.codes import Codes, read_codes
from ecu_node.database import VehicleDatabase
from ecu_node.errors import LayoutError
from ecu_node.layout import SignalName

__all__ = ["input_signal", "signal_codes"]


def signal_codes(
    database: VehicleDatabase,
    name: SignalName,
    units: Mapping[str, float],
    what: str,
    no_value: list[int] | None = None,
) -> Codes:
    """Codes of a signal, with those that the layout itself says are no value.

    Parameters
    ----------
    database : VehicleDatabase
        Layout and DBC.
    name : str
        The signal, as MESSAGE.SIGNAL.
    units : mapping of str to float
        One of the tables of :mod:`ecu_node.units`; values come out in its base unit.
    what : str
        What the signal is for, for messages of errors.
    no_value : list of int, optional
        Codes that are no value, whatever the DBC says.

    Raises
    ------
    DatabaseError
        If the signal cannot be read, see :func:`ecu_node.codes.read_codes`.
    LayoutError
        If the signal has no such codes.
    """
    codes = read_codes(database.signal(name)[1], units, f"{database.layout.path}: {what}")
    place = codes.place
    if impossible := [code for code in no_value or [] if not place.lowest <= code <= place.highest]:
        raise LayoutError(
            f"{database.layout.path}: {what}: no_value: {name} has no code {', '.join(map(str, impossible))}; it has "
            f"{place.lowest} to {place.highest}"
        )
    extra = dict.fromkeys(no_value or [], "no value")
    return replace(codes, named={**extra, **codes.named}) if extra else codes


def input_signal(database: VehicleDatabase, name: str | None) -> SignalName | None:
    """Signal of the input of this name; None if there is none."""
    return next((item.signal for item in database.layout.input if item.name == name), None)
