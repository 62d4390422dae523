"""Numbers as the pages write them."""

import math
from datetime import datetime

__all__ = ["amperes", "moment", "percent", "share", "with_sd"]

UNKNOWN = "–"
MINUS = "−"


def amperes(value: float | None, *, digits: int = 2, sign: bool = False) -> str:
    """A current [A], with its unit; a dash if it is not known."""
    return _number(value, digits, sign=sign, unit=" A")


def percent(value: float | None, digits: int, *, sign: bool = False) -> str:
    """A share or a relative change [1] in percent; a dash if it is not known."""
    return _number(None if value is None else 100.0 * value, digits, sign=sign, unit=" %")


def moment(text: str) -> str:
    """A time as ISO 8601 tells it, to the minute; as it is if it is none."""
    try:
        return f"{datetime.fromisoformat(text):%Y-%m-%d %H:%M %Z}".strip()
    except ValueError:
        return text


def share(part: int, whole: int) -> str:
    """A part of a whole in percent."""
    return percent(part / whole if whole else None, 0)


def with_sd(value: float, sd: float | None, *, factor: float, unit: str) -> str:
    """A value with its standard deviation, both multiplied by a factor; exactly 0 is no fault, and has no sign."""
    told = _number(factor * value, 2, sign=True, unit="") if value else "0"
    known = sd is not None and math.isfinite(sd)
    return f"{told} ± {factor * sd:.2f}{unit}" if known and sd is not None else f"{told}{unit}"


def _number(value: float | None, digits: int, *, sign: bool, unit: str) -> str:
    if value is None or not math.isfinite(value):
        return UNKNOWN
    return f"{value:{'+' if sign else ''}.{digits}f}{unit}".replace("-", MINUS)
