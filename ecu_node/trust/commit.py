"""One change of a vehicle's state, all or nothing, and what a power cut has kept from being done after it."""

from pathlib import Path

from msgspec.structs import replace

from ecu_node.errors import UserError
from ecu_node.trust.audit import Event, add_entry, next_entry, tell
from ecu_node.trust.state import TrustState, audit_path, read_state, settle_slots, write_state

__all__ = ["commit", "opened"]


def opened(folder: Path) -> TrustState:
    """Read the state for a change, after what a power cut has kept from being done is done.

    Parameters
    ----------
    folder : Path
        State of the vehicle; locked.

    Returns
    -------
    TrustState
        What it has accepted.

    Raises
    ------
    UserError
        If the state cannot be read, or what is left to do cannot be done.
    """
    state = read_state(folder)
    settle_slots(folder, state)
    tell(audit_path(folder), state.made_by)
    return state


def commit(folder: Path, state: TrustState, event: Event) -> TrustState:
    """Let a new state hold; what follows that is done by the next command if it cannot be done now.

    Parameters
    ----------
    folder : Path
        State of the vehicle; locked.
    state : TrustState
        The new one; what it speaks of is written beside its slot already.
    event : Event
        What makes it so.

    Returns
    -------
    TrustState
        As it is written.

    Raises
    ------
    UserError
        If it cannot be written: then it is as before; or if it is written, and the audit log cannot be.
    """
    state = replace(state, made_by=next_entry(audit_path(folder), event))
    write_state(folder, state)
    try:
        settle_slots(folder, state)
        add_entry(audit_path(folder), event)
    except UserError as error:
        raise UserError(f"{error}; '{event.event}' holds all the same, and is in the audit log later") from None
    return state
