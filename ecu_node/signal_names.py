"""Names as layouts write them: of things, and of signals of the DBC."""

from typing import Annotated

import msgspec

__all__ = ["Name", "SignalName", "split_signal"]

Name = Annotated[str, msgspec.Meta(pattern=r"^[A-Za-z_][A-Za-z0-9_]*\Z")]
"""A name without blanks."""
SignalName = Annotated[str, msgspec.Meta(pattern=r"^[A-Za-z_][A-Za-z0-9_]*\.[A-Za-z_][A-Za-z0-9_]*\Z")]
"""``Message.Signal``, as both are called in the DBC."""


def split_signal(name: SignalName) -> tuple[str, str]:
    """Split ``Message.Signal`` into its two names."""
    message, _, signal = name.partition(".")
    return message, signal
