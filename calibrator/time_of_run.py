"""When a result was made."""

import os
from datetime import UTC, datetime

from calibrator.errors import FleetError

__all__ = ["time_of_run"]


def time_of_run() -> str:
    """The time now, ISO 8601; that of SOURCE_DATE_EPOCH, if it is set, makes results alike to the bit.

    Raises
    ------
    FleetError
        If SOURCE_DATE_EPOCH is no number of seconds.
    """
    epoch = os.environ.get("SOURCE_DATE_EPOCH")
    if epoch is not None and not epoch.isdecimal():
        raise FleetError(f"SOURCE_DATE_EPOCH is {epoch!r}; expected seconds since 1970, or leave it unset")
    now = datetime.now(UTC) if epoch is None else datetime.fromtimestamp(int(epoch), UTC)
    return now.isoformat(timespec="seconds")
