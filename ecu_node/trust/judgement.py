"""What a signed file makes of a vehicle's state: every check between a file that came and a new state.

Signatures, kind, vehicle, number above all before, time, layout and DBC, limits, largest step against what is in force.
Nothing is written here.
"""

from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from msgspec.structs import replace

from ecu_node.core.status import Reason, TrustError, UnfitError
from ecu_node.database import VehicleDatabase
from ecu_node.parameters import check_fit
from ecu_node.trust.key_set import KeySet
from ecu_node.trust.largest_step import require_small_step
from ecu_node.trust.state import Slot, SlotName, TrustState, slot_of
from ecu_node.trust.statements import (
    LAST_SEQUENCE,
    MAX_SEQUENCE,
    Revocation,
    SignedParameters,
    Statement,
    verify,
)
from ecu_node.trust.validity import require_time

__all__ = ["ALL_KINDS", "Accepted", "Arrival", "judge_arrival"]

ALL_KINDS: tuple[type[Statement], ...] = (SignedParameters, KeySet, Revocation)
_REMEMBERED = 64
"""Revoked numbers that are kept; with two slots the last ones are enough."""


@dataclass(frozen=True)
class Arrival:
    """A signed file, and the state that it meets."""

    folder: Path
    state: TrustState
    content: bytes
    where: str
    now: datetime


@dataclass(frozen=True, kw_only=True)
class Accepted:
    """What a signed file makes of the state."""

    state: TrustState
    event: str
    text: str
    sequence: int | None = None
    slot: SlotName | None = None
    """Where the file is to be kept."""


def judge_arrival(
    arrival: Arrival, database: VehicleDatabase, kinds: tuple[type[Statement], ...] = ALL_KINDS
) -> Accepted:
    """Decide on a signed file.

    Parameters
    ----------
    arrival : Arrival
        The file, and the state that it meets.
    database : VehicleDatabase
        Layout and DBC of the vehicle.
    kinds : tuple of types
        Statements that are expected; others are refused.

    Returns
    -------
    Accepted
        The state that it asks for.

    Raises
    ------
    UnfitError
        With the reason why it is refused.
    """
    found = verify(arrival.content, arrival.state.keys, arrival.where)
    if not isinstance(found.statement, kinds):
        is_revocation = isinstance(found.statement, Revocation)
        what = "a revocation; use 'ecu-node revoke'" if is_revocation else "no revocation; use 'ecu-node activate'"
        raise TrustError(Reason.MALFORMED_PARAMETERS, f"{arrival.where}: it is {what}")
    by = f"signed by {', '.join(found.signers)}"
    match found.statement:
        case KeySet() as keys:
            return _take_keys(arrival, keys, by)
        case Revocation() as revocation:
            return _take_revocation(arrival, revocation, by)
        case parameters:
            return _take_parameters(arrival, parameters, by, database)


def _take_keys(arrival: Arrival, keys: KeySet, by: str) -> Accepted:
    state = arrival.state
    if keys.version != state.keys.version + 1:
        raise TrustError(
            Reason.REPLAYED,
            f"{arrival.where}: key set {keys.version}, and {state.keys.version} is trusted here; the next is expected",
        )
    return Accepted(state=replace(state, keys=keys), event="keys", text=f"key set {keys.version}, {by}")


def _take_revocation(arrival: Arrival, revocation: Revocation, by: str) -> Accepted:
    state = arrival.state
    _require_vehicle(arrival, revocation.vehicle)
    _require_revocation_number(arrival, revocation.sequence)
    revoked = sorted({*state.revoked, *revocation.revokes})[-_REMEMBERED:]
    slots = {name: slot for name, slot in state.slots.items() if slot.sequence not in revoked}
    in_force = state.in_force if state.in_force in slots else None
    on_trial = state.on_trial if state.on_trial in slots else None
    fallback = state.fallback if state.fallback in slots else None
    if in_force is None:
        in_force, fallback = fallback, None
    numbers = ", ".join(map(str, revocation.revokes))
    return Accepted(
        state=replace(
            state,
            highest_sequence=revocation.sequence,
            newest=max(state.newest, revocation.created),
            slots=slots,
            in_force=in_force,
            on_trial=on_trial,
            fallback=fallback,
            revoked=revoked,
        ),
        event="revoked",
        text=f"{numbers}: {revocation.why}; {_what(slots, in_force)} now; {by}",
        sequence=revocation.sequence,
    )


def _what(slots: dict[SlotName, Slot], name: SlotName | None) -> str:
    return "nothing is in force" if name is None else f"number {slots[name].sequence} is in force"


def _take_parameters(arrival: Arrival, signed: SignedParameters, by: str, database: VehicleDatabase) -> Accepted:
    state, parameters = arrival.state, signed.parameters
    _require_vehicle(arrival, signed.vehicle)
    _require_number(arrival, signed.sequence, highest=MAX_SEQUENCE)
    if signed.sequence in state.revoked:
        raise TrustError(Reason.REVOKED, f"{arrival.where}: number {signed.sequence} was revoked; sign it with another")
    require_time(state, signed, arrival.where, arrival.now)
    try:
        check_fit(parameters, database, state.vehicle)
    except UnfitError as error:
        raise UnfitError(error.reason, f"{arrival.where}: {error}") from None
    if not signed.allow_large_step:
        require_small_step(arrival.folder, state, parameters, database, arrival.where)
    name = state.free_slot()
    return Accepted(
        state=replace(
            state,
            highest_sequence=signed.sequence,
            newest=max(state.newest, signed.not_before),
            slots={**state.slots, name: slot_of(arrival.content, signed.sequence)},
            on_trial=name,
            fallback=None if state.fallback == name else state.fallback,
        ),
        slot=name,
        event="on trial",
        text=f"parameter set {parameters.number}, {by}",
        sequence=signed.sequence,
    )


def _require_vehicle(arrival: Arrival, vehicle: str) -> None:
    expected = arrival.state.vehicle
    if vehicle != expected:
        raise TrustError(Reason.WRONG_VEHICLE, f"{arrival.where}: for vehicle {vehicle!r}, this is {expected!r}")


def _require_revocation_number(arrival: Arrival, sequence: int) -> None:
    """The numbers above those of parameters are for revocations that need them; the last one may come again.

    An old revocation does no harm: what it takes back has a number that is never accepted again.
    """
    before = arrival.state.highest_sequence
    if sequence == before == LAST_SEQUENCE:
        return
    _require_number(arrival, sequence, highest=MAX_SEQUENCE if before < MAX_SEQUENCE else LAST_SEQUENCE)


def _require_number(arrival: Arrival, sequence: int, *, highest: int) -> None:
    before = arrival.state.highest_sequence
    if sequence <= before:
        advice = "sign it with a higher one" if before < highest else "only revocations can be signed for it any more"
        raise TrustError(
            Reason.REPLAYED, f"{arrival.where}: number {sequence}, and {before} was accepted before; {advice}"
        )
    if sequence > highest:
        raise TrustError(
            Reason.REPLAYED,
            f"{arrival.where}: number {sequence}, and the highest is {highest}, as nothing could come after it; "
            f"sign it with a lower one, such as the time in seconds",
        )
