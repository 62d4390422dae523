"""Names of vehicles and drives that are file names on every system."""

import re

from calibrator.errors import DriveError

__all__ = ["is_plain_name", "require_plain_name"]

_PLAIN_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.+@ -]{0,63}")
"""Also a file name on every system, and short enough for the parameter file."""


def is_plain_name(name: str) -> bool:
    """Whether a vehicle or drive may have this name, see :func:`require_plain_name`."""
    return _PLAIN_NAME.fullmatch(name) is not None and not name.endswith((" ", "."))


def require_plain_name(name: str, what: str) -> None:
    """Refuse a vehicle or drive name that cannot be a file name everywhere.

    Parameters
    ----------
    name : str
        The name.
    what : str
        What is named so, the start of the message.

    Raises
    ------
    DriveError
        If the name is empty, longer than 64 characters, has other characters than A to Z, a to z, 0 to 9, ``_ . + @ -``
        and blanks, does not start with a letter, a digit or ``_``, or ends with a dot or a blank.
    """
    if not is_plain_name(name):
        raise DriveError(
            f"{what} {name[:80]!r} cannot be used; expected 1 to 64 letters A to Z, digits, blanks or _ . + @ -, "
            f"not starting with a dash, dot, +, @ or blank, not ending with a dot or blank; rename it"
        )
