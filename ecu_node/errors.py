"""Errors a user can cause. Each message is one line: what, where, what was expected, what to do.

The command line turns every :class:`UserError` into that line and exit code 1; for other exceptions see
``ecu_node.program.end_of``.
"""

__all__ = ["BusError", "DatabaseError", "LayoutError", "ParameterError", "UserError", "printable", "shown_name"]

_LONGEST_NAME = 64
"""Most characters of a name that are shown."""


class UserError(Exception):
    """Something in the user's hands is wrong: a file, an option, a bus."""


class LayoutError(UserError):
    """The layout file cannot be used (unreadable, wrong field, contradictory)."""


class DatabaseError(UserError):
    """The DBC cannot be used, or lacks a message or signal that the layout names."""


class ParameterError(UserError):
    """The parameter file cannot be used (malformed, another vehicle, another DBC, implausible)."""


class BusError(UserError):
    """The CAN bus cannot be opened, or fails while in use."""


def printable(text: str) -> str:
    """Escape the characters of an untrusted text that would break the line or move the cursor."""
    return "".join(char if char.isprintable() else ascii(char)[1:-1] for char in text)


def shown_name(name: str) -> str:
    """Shorten a name from an untrusted file, and escape it, so that it stays within a line."""
    return printable(name if len(name) <= _LONGEST_NAME else f"{name[:_LONGEST_NAME]}...")
