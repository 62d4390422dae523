"""Units of the DBC, as factors that turn them into A, V or W."""

from collections.abc import Mapping

from cantools.database.can import Signal

from ecu_node.errors import DatabaseError

__all__ = ["AMPERE", "VOLT", "WATT", "unit_factor"]

AMPERE: Mapping[str, float] = {"A": 1.0, "mA": 1e-3, "kA": 1e3}
VOLT: Mapping[str, float] = {"V": 1.0, "mV": 1e-3, "kV": 1e3}
WATT: Mapping[str, float] = {"W": 1.0, "kW": 1e3, "mW": 1e-3, "MW": 1e6}


def unit_factor(signal: Signal, known: Mapping[str, float], where: str) -> float:
    """Factor that turns the values of a signal into the base unit, such as 1000 for kW into W.

    Parameters
    ----------
    signal : Signal
        A signal of the DBC. A signal without unit counts as being in the base unit.
    known : mapping of str to float
        One of :data:`AMPERE`, :data:`VOLT`, :data:`WATT`.
    where : str
        What the signal is for, for the message of the error.

    Returns
    -------
    float
        The factor. [base unit / unit of the signal]

    Raises
    ------
    DatabaseError
        If the unit is of another quantity.
    """
    if not signal.unit:
        return 1.0
    try:
        return known[signal.unit]
    except KeyError:
        raise DatabaseError(
            f"{where}: signal {signal.name} is in {signal.unit!r}; expected {', '.join(known)}"
        ) from None
