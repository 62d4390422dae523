"""What a vehicle has accepted, on its disk: two slots for signed files, and which of them is in force.

    state.json      which slot is in force, which on trial; the highest number accepted; whom to trust
    slot-a.json     a signed file, as it came
    slot-b.json     another one
    audit.log       what happened

A signed file is written beside its slot first, then ``state.json`` is replaced, and then the file takes its place.
``state.json`` holds the SHA-256 of each slot: of the file in the slot and the one beside it that one counts. So after a
power cut at any moment the state is that of before or of after, both slots whole. It holds that of itself, too: a bit
that the disk has changed might otherwise lower a number, drop a key, or put the other slot in force.
"""

import hashlib
from pathlib import Path
from typing import Annotated, Literal

import msgspec

from ecu_node.core.status import Reason, TrustError
from ecu_node.documents import UnsuitableFileError, read_user_file
from ecu_node.trust.audit import AuditEntry
from ecu_node.trust.canonical import MAX_BYTES, Expected, canonical_bytes, malformed, read_bytes, read_canonical
from ecu_node.trust.key_set import KeySet, check_key_set
from ecu_node.trust.statements import SignedParameters, instant, open_statement
from ecu_node.trust.storage import move_file, replace_file, write_file

__all__ = [
    "Slot",
    "SlotName",
    "TrustState",
    "audit_path",
    "read_slot",
    "read_state",
    "settle_slots",
    "signed_parameters",
    "slot_of",
    "slot_path",
    "state_path",
    "write_slot",
    "write_state",
]

SlotName = Literal["a", "b"]
_STATE = Expected(
    what="the state of a vehicle", advice="remove the folder, make it anew with 'ecu-node provision', and activate anew"
)
_Digest = Annotated[str, msgspec.Meta(pattern="^[0-9a-f]{64}$")]


class Slot(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What stands in a slot."""

    sequence: int
    sha256: _Digest


class TrustState(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What a vehicle has accepted."""

    schema_version: Literal[1] = 1
    vehicle: Annotated[str, msgspec.Meta(min_length=1, max_length=64)]
    keys: KeySet
    highest_sequence: Annotated[int, msgspec.Meta(ge=0)] = 0
    newest: Annotated[str, msgspec.Meta(description="the time is not before this: of the newest statement")] = (
        "1970-01-01T00:00:00Z"
    )
    slots: dict[SlotName, Slot] = {}
    in_force: SlotName | None = None
    on_trial: SlotName | None = None
    fallback: Annotated[SlotName | None, msgspec.Meta(description="what was in force before, for a roll-back")] = None
    revoked: Annotated[list[int], msgspec.Meta(description="sequence numbers, the last ones")] = []
    made_by: Annotated[
        AuditEntry | None, msgspec.Meta(description="what made it so: the line that is added to the audit log")
    ] = None

    def free_slot(self) -> SlotName:
        """The slot for what comes next: that of the trial which it ends, else one that is not in force."""
        return self.on_trial or ("b" if self.in_force == "a" else "a")


class _SealedState(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Content of ``state.json``."""

    sha256: Annotated[_Digest, msgspec.Meta(description="of the text of the state")]
    state: TrustState


def state_path(folder: Path) -> Path:
    """Where the state stands."""
    return folder / "state.json"


def read_state(folder: Path) -> TrustState:
    """Read the state of a vehicle.

    Parameters
    ----------
    folder : Path
        Made by 'ecu-node provision'.

    Returns
    -------
    TrustState
        What it has accepted.

    Raises
    ------
    TrustError
        If there is none, or it is damaged.
    """
    path = state_path(folder)
    content = _state_bytes(folder)
    state = read_canonical(content, _SealedState, str(path), _STATE).state
    if _sealed(content[len(_sealed(b"")) - 1 : -1]) != content:
        raise malformed(str(path), "it is not what was written there", _STATE)
    named = [name for name in (state.in_force, state.on_trial) if name is not None]
    if len(set(named)) < len(named) or not set(named) <= state.slots.keys():
        raise malformed(str(path), "slots in force and on trial do not go together", _STATE)
    check_key_set(state.keys, str(path))
    instant(state.newest, str(path))
    return state


def _state_bytes(folder: Path) -> bytes:
    try:
        return read_user_file(state_path(folder), largest_bytes=MAX_BYTES)
    except FileNotFoundError:
        raise TrustError(
            Reason.NO_PARAMETERS, f"{folder}: no state of a vehicle there; make one with 'ecu-node provision'"
        ) from None
    except UnsuitableFileError as error:
        raise malformed(str(state_path(folder)), str(error), _STATE) from None
    except OSError as error:
        raise TrustError(
            Reason.NO_PARAMETERS, f"{state_path(folder)}: cannot read the state of the vehicle: {error.strerror}"
        ) from None


def write_state(folder: Path, state: TrustState) -> None:
    """Put a new state in the place of the one before; all that it speaks of must be written already."""
    replace_file(state_path(folder), _sealed(canonical_bytes(state)))


def _sealed(state: bytes) -> bytes:
    """Canonical JSON with the digest of a state before it."""
    return b'{"sha256":"%b","state":%b}' % (hashlib.sha256(state).hexdigest().encode(), state)


def write_slot(folder: Path, name: SlotName, content: bytes) -> None:
    """Write a signed file beside a slot; it counts once the state holds :func:`slot_of` it."""
    write_file(_beside(folder, name), content)


def settle_slots(folder: Path, state: TrustState) -> None:
    """Let the files that were written beside their slots take their places.

    Parameters
    ----------
    folder : Path
        Of the state; locked.
    state : TrustState
        Of the same, as it is written.

    Raises
    ------
    UserError
        If it cannot be done; the slots are whole all the same, but must not be written.
    """
    for name, slot in state.slots.items():
        if _held(_beside(folder, name), slot) is not None:
            move_file(_beside(folder, name), slot_path(folder, name))


def slot_of(content: bytes, sequence: int) -> Slot:
    """What the state holds of a signed file with this number."""
    return Slot(sequence=sequence, sha256=hashlib.sha256(content).hexdigest())


def read_slot(folder: Path, state: TrustState, name: SlotName) -> bytes:
    """Read a slot.

    Parameters
    ----------
    folder : Path
        Of the state.
    state : TrustState
        Of the same.
    name : SlotName
        Which.

    Returns
    -------
    bytes
        The signed file.

    Raises
    ------
    TrustError
        If it is not what was accepted.
    """
    path, slot = slot_path(folder, name), state.slots.get(name)
    if slot is not None and (content := _held(_beside(folder, name), slot)) is not None:
        return content
    content = read_bytes(path)
    if slot is None or slot_of(content, slot.sequence) != slot:
        raise TrustError(Reason.NOT_SIGNED, f"{path}: not what was accepted; activate parameters anew")
    return content


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


def audit_path(folder: Path) -> Path:
    """Where the audit log stands."""
    return folder / "audit.log"


def slot_path(folder: Path, name: SlotName) -> Path:
    """Where a slot stands."""
    return folder / f"slot-{name}.json"


def _beside(folder: Path, name: SlotName) -> Path:
    return folder / f"slot-{name}.json.next"


def _held(path: Path, slot: Slot) -> bytes | None:
    """Content of a file if it is what the state knows of."""
    try:
        content = read_bytes(path)
    except TrustError:
        return None
    return content if slot_of(content, slot.sequence) == slot else None
