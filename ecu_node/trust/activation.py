"""Accepting what is signed: every check between a file that came and parameters that are in force.

Signatures, kind, vehicle, number above all before, time, layout and DBC, limits, largest step against what is in force;
then the set is on trial (:mod:`ecu_node.trust.trial`), and in force after that. What is refused leaves everything as it
was, but for a line in the audit log.
"""

import hashlib
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from msgspec.structs import replace

from ecu_node.database import VehicleDatabase
from ecu_node.errors import TrustError, UnfitError, UserError
from ecu_node.parameters import BranchParameters, VehicleParameters, check_fit
from ecu_node.sensor_models import GainBySign
from ecu_node.status import Reason
from ecu_node.trust.audit import REFUSED, Event, add_entry, event_now, tell
from ecu_node.trust.key_set import KeySet
from ecu_node.trust.state import (
    Slot,
    SlotName,
    TrustState,
    audit_path,
    read_slot,
    read_state,
    settle_slots,
    slot_of,
    state_path,
    write_slot,
    write_state,
)
from ecu_node.trust.statements import Revocation, SignedParameters, Statement, instant, open_statement, verify
from ecu_node.trust.storage import locked

__all__ = ["Accepted", "accept", "conclude", "examine", "provision", "require_time", "signed_parameters"]

_ALL_KINDS: tuple[type[Statement], ...] = (SignedParameters, KeySet, Revocation)
_REMEMBERED = 64
"""Revoked numbers that are kept; with two slots the last ones are enough."""


@dataclass(frozen=True, kw_only=True)
class Accepted:
    """What a signed file makes of the state."""

    state: TrustState
    event: str
    text: str
    sequence: int | None = None
    slot: SlotName | None = None
    """Where the file is to be kept."""


def provision(folder: Path, vehicle: str, keys: KeySet, now: datetime) -> None:
    """Begin the state of a vehicle: whom it trusts.

    Parameters
    ----------
    folder : Path
        Where; made if it does not exist.
    vehicle : str
        Identity of the vehicle.
    keys : KeySet
        Whom it trusts from now on, until these say otherwise.
    now : datetime
        For the audit log.

    Raises
    ------
    TrustError
        If there is a state already.
    UserError
        If it cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"{folder}: cannot be made: {error.strerror}") from None
    with locked(folder):
        if state_path(folder).exists():
            raise TrustError(
                Reason.NONE, f"{folder}: there is a state already; keys are changed by a signed key set ('activate')"
            )
        event = event_now("provisioned", f"vehicle {vehicle}, key set {keys.version}", now=now)
        _commit(folder, TrustState(vehicle=vehicle, keys=keys), event)


def accept(
    folder: Path,
    content: bytes,
    where: str,
    database: VehicleDatabase,
    now: datetime,
    *,
    kinds: tuple[type[Statement], ...] = _ALL_KINDS,
) -> Accepted:
    """Take a signed file: parameters go on trial, a revocation and a key set hold at once.

    Parameters
    ----------
    folder : Path
        State of the vehicle.
    content : bytes
        Text of the file.
    where : str
        Where it is from, for messages.
    database : VehicleDatabase
        Layout and DBC of the vehicle.
    now : datetime
        The time of day.
    kinds : tuple of types
        Statements that are expected; others are refused.

    Returns
    -------
    Accepted
        What became of it.

    Raises
    ------
    UnfitError
        With the reason why it is refused; it stands in the audit log too.
    UserError
        If the state cannot be written: then it is as before; or if it is written, and the audit log cannot be.
    """
    with locked(folder):
        state = _opened(folder)
        digest = hashlib.sha256(content).hexdigest()
        try:
            accepted = _accepted(_Arrival(folder, state, content, where, now), database, kinds)
        except UnfitError as error:
            add_entry(audit_path(folder), event_now(REFUSED, str(error), now=now, sha256=digest))
            raise
        if accepted.slot is not None:
            write_slot(folder, accepted.slot, content)
        event = event_now(accepted.event, accepted.text, now=now, sequence=accepted.sequence, sha256=digest)
        _commit(folder, accepted.state, event)
    return accepted


def _opened(folder: Path) -> TrustState:
    """The state, after what a power cut has kept from being done is done."""
    state = read_state(folder)
    settle_slots(folder, state)
    tell(audit_path(folder), state.made_by)
    return state


def _commit(folder: Path, state: TrustState, event: Event) -> TrustState:
    """Let a new state hold, all or nothing; what follows here is done by the next command if it cannot be done now."""
    state = replace(state, made_by=event)
    write_state(folder, state)
    try:
        settle_slots(folder, state)
        add_entry(audit_path(folder), event)
    except UserError as error:
        raise UserError(f"{error}; '{event.event}' holds all the same, and is in the audit log later") from None
    return state


def examine(folder: Path, content: bytes, where: str, database: VehicleDatabase, now: datetime) -> Accepted:
    """What :func:`accept` would do; nothing is written. Parameters and errors are those of it."""
    return _accepted(_Arrival(folder, read_state(folder), content, where, now), database, _ALL_KINDS)


@dataclass(frozen=True)
class _Arrival:
    """A signed file, and the state that it meets."""

    folder: Path
    state: TrustState
    content: bytes
    where: str
    now: datetime


def _accepted(arrival: _Arrival, database: VehicleDatabase, kinds: tuple[type[Statement], ...]) -> Accepted:
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
        case SignedParameters() as parameters:
            return _take_parameters(arrival, parameters, by, database)


def _take_keys(arrival: _Arrival, keys: KeySet, by: str) -> Accepted:
    state = arrival.state
    if keys.version != state.keys.version + 1:
        raise TrustError(
            Reason.REPLAYED,
            f"{arrival.where}: key set {keys.version}, and {state.keys.version} is trusted here; the next is expected",
        )
    return Accepted(state=replace(state, keys=keys), event="keys", text=f"key set {keys.version}, {by}")


def _take_revocation(arrival: _Arrival, revocation: Revocation, by: str) -> Accepted:
    state = arrival.state
    _require_next(arrival, revocation.vehicle, revocation.sequence)
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


def _take_parameters(arrival: _Arrival, signed: SignedParameters, by: str, database: VehicleDatabase) -> Accepted:
    state, parameters = arrival.state, signed.parameters
    _require_next(arrival, signed.vehicle, signed.sequence)
    if signed.sequence in state.revoked:
        raise TrustError(Reason.REVOKED, f"{arrival.where}: number {signed.sequence} was revoked; sign it with another")
    require_time(state, signed, arrival.where, arrival.now)
    try:
        check_fit(parameters, database, state.vehicle)
    except UnfitError as error:
        raise UnfitError(error.reason, f"{arrival.where}: {error}") from None
    if not signed.allow_large_step:
        _require_small_step(arrival, parameters, database)
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


def _require_next(arrival: _Arrival, vehicle: str, sequence: int) -> None:
    state = arrival.state
    if vehicle != state.vehicle:
        raise TrustError(Reason.WRONG_VEHICLE, f"{arrival.where}: for vehicle {vehicle!r}, this is {state.vehicle!r}")
    if sequence <= state.highest_sequence:
        raise TrustError(
            Reason.REPLAYED,
            f"{arrival.where}: number {sequence}, and {state.highest_sequence} was accepted before; sign it with a "
            f"higher one",
        )


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
    begin, end = instant(signed.not_before, where), instant(signed.expires, where)
    if now < begin:
        raise TrustError(
            Reason.NOT_VALID_NOW,
            f"{where}: holds from {signed.not_before} on, and now it is {_text(now)}; is the clock set?",
        )
    if max(now, instant(state.newest, where)) >= end:
        raise TrustError(
            Reason.NOT_VALID_NOW, f"{where}: expired at {signed.expires}, and now it is {_text(now)}; sign it anew"
        )


def _text(now: datetime) -> str:
    return now.astimezone(UTC).strftime("%Y-%m-%dT%H:%M:%SZ")


def _require_small_step(arrival: _Arrival, new: VehicleParameters, database: VehicleDatabase) -> None:
    """Refuse what differs from the set in force by more than the layout's largest step."""
    state, layout = arrival.state, database.layout
    if state.in_force is None:
        return
    try:
        before = signed_parameters(arrival.folder, state, state.in_force).parameters
    except TrustError:
        return  # what is damaged is not in force, and must not keep its successor out
    for name in layout.branch_names:
        old, next_ = _applied(before.branches.get(name)), _applied(new.branches.get(name))
        drift = max(abs(a - b) for a, b in zip(old[:2], next_[:2], strict=True))
        offset_a = abs(old[2] - next_[2])
        if drift > layout.activation.step_drift or offset_a > layout.step_offset_a:
            raise TrustError(
                Reason.IMPLAUSIBLE_PARAMETERS,
                f"{arrival.where}: branch {name}: differs from the set in force by {drift:.3g} in drift and "
                f"{offset_a:.3g} A in offset, at most {layout.activation.step_drift:g} and "
                f"{layout.step_offset_a:g} A are allowed; if that is meant, sign with --allow-large-step",
            )


def _applied(branch: BranchParameters | None) -> tuple[float, float, float]:
    """Drifts for currents into and out of the junction, and offset, as they are applied. [1, 1, A]"""
    if branch is None or not branch.apply:
        return 0.0, 0.0, 0.0
    model = branch.sensor_model
    if isinstance(model, GainBySign):
        return model.drift_positive, model.drift_negative, branch.offset_a
    return branch.drift, branch.drift, branch.offset_a


def signed_parameters(folder: Path, state: TrustState, name: SlotName) -> SignedParameters:
    """What stands in a slot.

    Parameters
    ----------
    folder : Path
        State of the vehicle.
    state : TrustState
        Of the same.
    name : SlotName
        Which slot.

    Returns
    -------
    SignedParameters
        As they were accepted.

    Raises
    ------
    TrustError
        If the slot does not hold what was accepted.
    """
    content = read_slot(folder, state, name)
    _, statement = open_statement(content, str(folder / f"slot-{name}.json"))
    assert isinstance(statement, SignedParameters), "nothing else is written into a slot"
    return statement


def conclude(folder: Path, sequence: int, *, passed: bool, text: str, now: datetime) -> TrustState:
    """End a trial: the set is in force, or gone. Does not wait for other processes, as the bus would wait too.

    Parameters
    ----------
    folder : Path
        State of the vehicle.
    sequence : int
        Number of the set that was tried.
    passed : bool
        Whether it showed what it promised; a set that cannot be read any more has not.
    text : str
        What was seen.
    now : datetime
        For the audit log.

    Returns
    -------
    TrustState
        The state after that; as it was if another set is on trial by now.

    Raises
    ------
    UserError
        If the state cannot be read or written; as for :func:`accept`.
    """
    with locked(folder, wait=False):
        state = _opened(folder)
        name = state.on_trial
        if name is None or state.slots[name].sequence != sequence:
            return state
        try:
            read_slot(folder, state, name)
        except TrustError as error:
            passed, text = False, str(error)
        if passed:
            state = replace(state, in_force=name, on_trial=None, fallback=state.in_force)
        else:
            slots = {other: slot for other, slot in state.slots.items() if other != name}
            state = replace(state, slots=slots, on_trial=None)
        return _commit(folder, state, event_now("in force" if passed else "failed", text, now=now, sequence=sequence))
