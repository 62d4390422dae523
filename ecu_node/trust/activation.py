"""Accepting what is signed: from a file that came to parameters that are in force, each step kept on the disk.

What is accepted (:mod:`ecu_node.trust.judgement`) goes on trial (:mod:`ecu_node.trust.trial`), and is in force after
it. What is refused leaves everything as it was, but for a line in the audit log.
"""

import hashlib
from collections.abc import Callable
from datetime import datetime
from pathlib import Path

from msgspec.structs import replace

from ecu_node.core.status import TrustError, UnfitError
from ecu_node.database import VehicleDatabase
from ecu_node.trust.audit import REFUSED, add_entry, event_now
from ecu_node.trust.commit import commit, opened
from ecu_node.trust.judgement import ALL_KINDS, Accepted, Arrival, judge_arrival
from ecu_node.trust.key_set import KeySet
from ecu_node.trust.state import TrustState, audit_path, read_state, signed_parameters, write_slot
from ecu_node.trust.statements import Statement, open_statement
from ecu_node.trust.storage import locked
from ecu_node.trust.validity import require_not_expired

__all__ = ["accept", "conclude", "examine"]


def accept(
    folder: Path,
    content: bytes,
    where: str,
    database: VehicleDatabase,
    now: datetime,
    *,
    kinds: tuple[type[Statement], ...] = ALL_KINDS,
    on_wait: Callable[[str], None] | None = None,
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
    on_wait : callable or None
        Takes one line for the user if another process holds the state for more than a moment.

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
    with locked(folder, on_wait=on_wait):
        state = opened(folder)
        digest = hashlib.sha256(content).hexdigest()
        try:
            accepted = judge_arrival(Arrival(folder, state, content, where, now), database, kinds)
        except UnfitError as error:
            event = event_now(REFUSED, str(error), now=now, sequence=_number(content), sha256=digest)
            add_entry(audit_path(folder), event)
            raise
        if accepted.slot is not None:
            write_slot(folder, accepted.slot, content)
        event = event_now(accepted.event, accepted.text, now=now, sequence=accepted.sequence, sha256=digest)
        commit(folder, accepted.state, event)
    return accepted


def _number(content: bytes) -> int | None:
    """Number that a file gives itself, whoever wrote it; None if it has none."""
    try:
        _, statement = open_statement(content, "")
    except UnfitError:
        return None
    return None if isinstance(statement, KeySet) else statement.sequence


def examine(folder: Path, content: bytes, where: str, database: VehicleDatabase, now: datetime) -> Accepted:
    """What :func:`accept` would do; nothing is written. Parameters and errors are those of it."""
    return judge_arrival(Arrival(folder, read_state(folder), content, where, now), database)


def conclude(folder: Path, sequence: int, *, passed: bool, text: str, now: datetime) -> TrustState:
    """End a trial: the set is in force, or gone. Does not wait for other processes, as the bus would wait too.

    Parameters
    ----------
    folder : Path
        State of the vehicle.
    sequence : int
        Number of the set that was tried.
    passed : bool
        Whether it showed what it promised; a set that cannot be read any more, or expired meanwhile, has not.
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
        state = opened(folder)
        name = state.on_trial
        if name is None or state.slots[name].sequence != sequence:
            return state
        try:
            require_not_expired(state, signed_parameters(folder, state, name), str(folder), now)
        except TrustError as error:
            passed, text = False, str(error)
        if passed:
            state = replace(state, in_force=name, on_trial=None, fallback=state.in_force)
        else:
            slots = {other: slot for other, slot in state.slots.items() if other != name}
            state = replace(state, slots=slots, on_trial=None)
        return commit(folder, state, event_now("in force" if passed else "failed", text, now=now, sequence=sequence))
