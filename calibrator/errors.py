"""Errors of the off-board side; see :mod:`ecu_node.errors` for what they have in common."""

import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ecu_node.errors import UserError

__all__ = [
    "INTERNAL_ERROR",
    "ContradictionError",
    "DriveError",
    "ExportError",
    "FleetError",
    "LogError",
    "ProposalError",
    "RepositoryStateError",
    "internal_error",
    "naming",
]

INTERNAL_ERROR = "internal error: "
"""Start of the reason for leaving out a vehicle, where a fault of the program is the cause."""


def internal_error(error: Exception) -> str:
    """Return the reason for leaving out a vehicle on which the program itself failed, with the failing line."""
    place = traceback.extract_tb(error.__traceback__)[-1]
    return f"{INTERNAL_ERROR}{type(error).__name__}: {error} ({Path(place.filename).name}:{place.lineno}); report it"


@contextmanager
def naming(shown: str, copy: Path) -> Iterator[None]:
    """Replace the path of a local copy by the name that the user knows in all user errors raised within the block."""
    try:
        yield
    except UserError as error:
        raise type(error)(str(error).replace(str(copy), shown)) from None


class LogError(UserError):
    """A log or table cannot be used: missing, damaged or empty, of no known format, without branches, or ambiguous.

    Attributes
    ----------
    what, remedy : str
        What is wrong, and what to do; `remedy` is empty if `what` also tells what to do.
    """

    def __init__(self, what: str, remedy: str = "") -> None:
        super().__init__(f"{what}; {remedy}" if remedy else what)
        self.what, self.remedy = what, remedy


class DriveError(UserError):
    """A drive cannot be used (too short, a branch missing, no valid samples)."""


class FleetError(UserError):
    """A fleet cannot be calibrated (too small, contradictory), or a file or folder cannot be used or written."""


class ContradictionError(UserError):
    """Options contradict each other: wrong use, whatever is in the files."""


class RepositoryStateError(UserError):
    """A repository cannot be used, or lacks signatures or a vehicle."""


class ProposalError(UserError):
    """A layout cannot be proposed (nothing that looks like a branch, a file that exists)."""


class ExportError(UserError):
    """Parameters cannot be taken into another format (too wide for its arithmetic, texts that it cannot hold)."""
