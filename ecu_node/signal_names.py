"""Names as layouts write them: of things, and of signals of the DBC or columns of tables."""

from typing import Annotated

import msgspec

__all__ = ["Name", "SignalName", "split_signal"]

Name = Annotated[str, msgspec.Meta(pattern=r"^[A-Za-z_][A-Za-z0-9_]*\Z")]
"""A name without blanks."""
SignalName = Annotated[str, msgspec.Meta(pattern=r"^[^\s\x00-\x1f]([^\x00-\x1f]*[^\s\x00-\x1f])?\Z")]
"""``Message.Signal``, as both are called in the DBC, or ``bus:Message.Signal``; without a DBC a column of a table."""


def split_signal(name: SignalName) -> tuple[str, str]:
    """Split ``Message.Signal`` into its two names; a bus stays with the message."""
    message, _, signal = name.partition(".")
    return message, signal
