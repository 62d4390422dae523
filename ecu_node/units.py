"""Units of the DBC and of tables, as factors that turn them into A, V or W."""

import re
from collections.abc import Mapping
from typing import TYPE_CHECKING

from ecu_node.errors import DatabaseError

if TYPE_CHECKING:
    from cantools.database.can import Signal

__all__ = ["AMPERE", "VOLT", "WATT", "factor_of", "unit_factor", "usual_unit"]

AMPERE: Mapping[str, float] = {"A": 1.0, "mA": 1e-3, "kA": 1e3}
VOLT: Mapping[str, float] = {"V": 1.0, "mV": 1e-3, "kV": 1e3}
WATT: Mapping[str, float] = {"W": 1.0, "kW": 1e3, "mW": 1e-3, "MW": 1e6}

_SPELLED = re.compile(
    r"(?:unit_|\w+:)?(milli|kilo|mega|[mk])?(a|v|w|(?:amp|amper|ampere|volt|watt)s?)([ _]?(ac|dc|rms))?", re.IGNORECASE
)
"""As databases of several makers have it: ``Unit_Amper``, ``current:A``."""
_PER_BIT = re.compile(r"([\d.]+) ?(\w+)/bit\??", re.IGNORECASE)
_PREFIX = {"": "", "milli": "m", "m": "m", "kilo": "k", "k": "k", "mega": "M"}


def usual_unit(text: str) -> str:
    """Unit as this program writes it: ``A`` for ``Amps``, ``[A]`` or ``A_DC``, ``kW`` for ``KW`` or ``kilowatt``.

    What is no spelling of A, V or W comes back without blanks and brackets around it.
    """
    bare = text.strip().strip("[](){}<>").strip()
    found = _SPELLED.fullmatch(bare)
    if bare in WATT or found is None:  # mW and MW differ by their case alone
        return bare
    return _PREFIX[(found[1] or "").lower()] + found[2][0].upper()


def unit_factor(signal: "Signal", known: Mapping[str, float], where: str) -> float:
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
    unit, step = signal.unit or "", 1.0
    if per_bit := _PER_BIT.fullmatch(unit):  # the scale says the same as "50W/bit", or it is 1 and says nothing
        unit, step = per_bit[2], float(per_bit[1]) if signal.scale == 1 else 1.0
    return step * factor_of(unit, known, f"{where}: signal {signal.name}")


def factor_of(unit: str, known: Mapping[str, float], what: str) -> float:
    """As :func:`unit_factor`, of a unit; `what` is in it."""
    if not unit:
        return 1.0
    try:
        return known[usual_unit(unit)]
    except KeyError:
        raise DatabaseError(f"{what} is in {unit!r}; expected {', '.join(known)}") from None
