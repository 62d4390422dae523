"""When something is signed, and its place in the row of numbers of a vehicle."""

from datetime import UTC, datetime, timedelta

from calibrator.errors import SigningError

__all__ = ["require_near_number", "signing_time", "time_text"]

_TIME = "%Y-%m-%dT%H:%M:%SZ"
_FIRST, _LAST = datetime(2025, 1, 1, tzinfo=UTC), datetime(9900, 1, 1, tzinfo=UTC)
"""Between these a clock can be right, and times of what is signed can be written."""
_FURTHEST = timedelta(days=1)
"""A number may be this much above the time: clocks of signers differ."""


def signing_time(now: datetime) -> datetime:
    """Check the clock of the machine, from which numbers and times of what is signed are.

    Parameters
    ----------
    now : datetime
        What it says.

    Returns
    -------
    datetime
        The same, in whole seconds.

    Raises
    ------
    SigningError
        If it cannot be right.
    """
    if not _FIRST <= now < _LAST:
        raise SigningError(
            f"the clock of this machine says {now.isoformat(timespec='seconds')}; set it: numbers and times of what is "
            f"signed are made from it"
        )
    return now.replace(microsecond=0)


def time_text(when: datetime) -> str:
    """A time as statements say it."""
    return when.strftime(_TIME)


def require_near_number(sequence: int | None, now: datetime, *, far: bool) -> None:
    """Refuse a number far above the time: after it a vehicle would refuse every number that is made from the time.

    Parameters
    ----------
    sequence : int or None
        The number; None: made from the time.
    now : datetime
        The time of signing.
    far : bool
        Take it all the same.

    Raises
    ------
    SigningError
        If it is more than a day above the time in seconds.
    """
    if sequence is not None and not far and sequence > int((now + _FURTHEST).timestamp()):
        raise SigningError(
            f"--sequence {sequence}: above the time in seconds, {int(now.timestamp())}, so a vehicle that took it "
            f"would refuse all numbers made from the time; is there a digit too many? If it has to be, --far-sequence"
        )
