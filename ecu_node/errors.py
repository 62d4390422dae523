"""Errors a user can cause. Each message is one line: what, where, what was expected, what to do.

The command line turns every :class:`UserError` into that line and an exit code; nothing else is caught.
"""

__all__ = ["BusError", "DatabaseError", "LayoutError", "ParameterError", "UserError"]


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
