"""When signed parameters hold: not before they say so, and not after."""

from datetime import UTC, datetime

from ecu_node.core.status import Reason, TrustError
from ecu_node.trust.state import TrustState
from ecu_node.trust.statements import SignedParameters, instant

__all__ = ["require_not_expired", "require_time"]


def require_time(state: TrustState, signed: SignedParameters, where: str, now: datetime) -> None:
    """Check that signed parameters hold now.

    Parameters
    ----------
    state : TrustState
        Of the vehicle; the time is not before the newest statement that it accepted, whatever its clock says.
    signed : SignedParameters
        The parameters.
    where : str
        Where they are from, for messages.
    now : datetime
        The time of day.

    Raises
    ------
    TrustError
        With reason NOT_VALID_NOW.
    """
    if now < instant(signed.not_before, where):
        raise TrustError(
            Reason.NOT_VALID_NOW,
            f"{where}: holds from {signed.not_before} on, and now it is {_text(now)}; is the clock set?",
        )
    require_not_expired(state, signed, where, now)


def require_not_expired(state: TrustState, signed: SignedParameters, where: str, now: datetime) -> None:
    """Check that the time of signed parameters is not over; parameters and errors as for :func:`require_time`."""
    end = instant(signed.expires, where)
    if now >= end:
        raise TrustError(
            Reason.NOT_VALID_NOW, f"{where}: expired at {signed.expires}, and now it is {_text(now)}; sign it anew"
        )
    if instant(state.newest, where) >= end:
        raise TrustError(
            Reason.NOT_VALID_NOW,
            f"{where}: expired at {signed.expires}: the newest file accepted here is of {state.newest}, though the "
            f"clock says {_text(now)}; sign it anew",
        )


def _text(now: datetime) -> str:
    return now.astimezone(UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
