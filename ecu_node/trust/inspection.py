"""What ``ecu-node inspect`` shows: a signed file, a key set, or the state of a vehicle, and what is wrong with it."""

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

import msgspec

from ecu_node.core.status import UnfitError
from ecu_node.trust.audit import End, broken_line, end_of_log
from ecu_node.trust.canonical import read_bytes, read_canonical
from ecu_node.trust.key_set import KEY_SET, KeySet, check_key_set
from ecu_node.trust.state import SlotName, TrustState, audit_path, read_state, signed_parameters, slot_path
from ecu_node.trust.statements import Revocation, SignedParameters, Statement, open_statement, verify
from ecu_node.trust.unsigned import unsigned_kind
from ecu_node.trust.validity import require_time

__all__ = ["Inspection", "inspect_file", "inspect_state", "signers_text", "statement_facts"]


@dataclass(frozen=True)
class Inspection:
    """What is shown, and what is wrong, a line each; and the same for programs."""

    lines: list[str]
    problems: list[str] = field(default_factory=list)
    facts: dict[str, Any] = field(default_factory=dict)

    def as_json(self) -> str:
        """Facts and problems as JSON."""
        return json.dumps({**self.facts, "problems": self.problems}, indent=2)


def inspect_file(path: Path, keys: Path | None) -> Inspection:
    """Show a signed file, or a key set.

    Parameters
    ----------
    path : Path
        The file.
    keys : Path or None
        Key set with which signatures are verified; None: they are not.

    Returns
    -------
    Inspection
        Wrong is, with a key set, that not enough of it vouch for the file.

    Raises
    ------
    TrustError
        If one of the files cannot be read, or is something else.
    """
    content, where = read_bytes(path), str(path)
    trusted = _key_set(keys) if keys is not None else None
    if unsigned_kind(content) == "key set":
        plain = _plain_key_set(content, where)
        lines = [*_statement_lines(plain), "not signed: a vehicle may begin with it"]
        problems = [f"{where}: nobody signed this key set"] * (trusted is not None)
        return Inspection(lines, problems, statement_facts(plain) | _signatures(()))
    envelope, statement = open_statement(content, where)
    lines, keyids = _statement_lines(statement), [signature.keyid for signature in envelope.signatures]
    facts = statement_facts(statement)
    if trusted is None:
        lines += ["signatures, not verified, of keys:", *(f"  {keyid}" for keyid in keyids)]
        return Inspection(lines, facts=facts | _signatures(keyids))
    try:
        names = verify(content, trusted, where).signers
    except UnfitError as error:
        return Inspection(lines, [str(error)], facts | _signatures(keyids, signers=[]))
    lines.append(f"signed by {', '.join(names)}; enough, {signers_text(trusted)} are needed")
    return Inspection(lines, facts=facts | _signatures(keyids, signers=names))


def _signatures(keyids: Sequence[str], signers: Sequence[str] | None = None) -> dict[str, Any]:
    """Whose keys have signed, and which signers were verified to be enough; None: nothing was verified."""
    return {"signed_by_keyids": list(keyids), "verified_signers": None if signers is None else list(signers)}


def _key_set(path: Path) -> KeySet:
    """A key set as it is, signed or not."""
    content, where = read_bytes(path, KEY_SET), str(path)
    if unsigned_kind(content) == "key set":
        return _plain_key_set(content, where)
    _, statement = open_statement(content, where)
    if not isinstance(statement, KeySet):
        return _plain_key_set(content, where)
    return statement


def _plain_key_set(content: bytes, where: str) -> KeySet:
    return check_key_set(read_canonical(content.removesuffix(b"\n"), KeySet, where, KEY_SET), where)


def _statement_lines(statement: Statement) -> list[str]:
    if isinstance(statement, KeySet):
        return [f"key set {statement.version}: {signers_text(statement)}", *_keys(statement)]
    if isinstance(statement, Revocation):
        numbers = ", ".join(map(str, statement.revokes))
        return [
            f"revocation number {statement.sequence} for vehicle {statement.vehicle}: {numbers}; {statement.why}",
            f"made at {statement.created}, before which no vehicle that takes it believes to be any more",
        ]
    parameters = statement.parameters
    lines = [
        f"parameter set {parameters.number} for vehicle {statement.vehicle}, number {statement.sequence}",
        f"holds from {statement.not_before} to {statement.expires}",
        f"layout {parameters.layout.name}, DBC {parameters.dbc.name}; verdict: {parameters.verdict}",
    ]
    lines += ["may differ a lot from what is in force"] * statement.allow_large_step
    for name, branch in parameters.branches.items():
        applied = "applied" if branch.apply else f"not applied ({branch.held_back or 'no fault'})"
        lines.append(f"branch {name}: drift {branch.drift:+.4g}, offset {branch.offset_a:+.4g} A, {applied}")
    return lines


def inspect_state(folder: Path, now: datetime) -> Inspection:
    """Show the state of a vehicle.

    Parameters
    ----------
    folder : Path
        Made by 'ecu-node provision'.
    now : datetime
        The time of day.

    Returns
    -------
    Inspection
        Wrong is what is in force or on trial and cannot be used, and an audit log that is not what was written.

    Raises
    ------
    UserError
        If state or audit log cannot be read.
    """
    state = read_state(folder)
    found = Inspection(
        [
            f"vehicle {state.vehicle}, highest number {state.highest_sequence}",
            f"key set {state.keys.version}: {signers_text(state.keys)}",
            *_keys(state.keys),
        ],
        facts={
            "kind": "state",
            "vehicle": state.vehicle,
            "highest_sequence": state.highest_sequence,
            "key_set": statement_facts(state.keys),
            "slots": {},
            "revoked": list(state.revoked),
        },
    )
    for name in sorted(state.slots):
        _show_slot(found, folder, state, name, now)
    found.lines.extend(["nothing is in force"] * (state.in_force is None))
    found.lines.extend([f"revoked: {', '.join(map(str, state.revoked))}"] * bool(state.revoked))
    _show_log(found, audit_path(folder), state)
    return found


def _show_slot(found: Inspection, folder: Path, state: TrustState, name: SlotName, now: datetime) -> None:
    places = {state.in_force: "in force", state.on_trial: "on trial", state.fallback: "in force before"}
    facts = {"sequence": state.slots[name].sequence, "place": places.get(name, "not used")}
    shown = f"slot {name}: number {state.slots[name].sequence}, {places.get(name, 'not used')}"
    where = str(slot_path(folder, name))
    try:
        signed = signed_parameters(folder, state, name)
    except UnfitError as error:
        found.lines.append(f"{shown}; damaged, it is not used")
        why: str | None = str(error)
    else:
        facts |= {
            "parameter_set": signed.parameters.number,
            "not_before": signed.not_before,
            "expires": signed.expires,
        }
        why = _why_not_now(state, signed, where, now)
        dates = f"parameter set {signed.parameters.number}, holds from {signed.not_before} to {signed.expires}"
        early = "does not hold yet" if now.strftime("%Y-%m-%dT%H:%M:%SZ") < signed.not_before else "expired"
        found.lines.append(f"{shown}; {dates}" + (f"; {early}, it is not used" if why is not None else ""))
    found.facts["slots"][name] = {**facts, "why_not_used": why}
    if why is not None and name in (state.in_force, state.on_trial):
        found.problems.append(why)


def _why_not_now(state: TrustState, signed: SignedParameters, where: str, now: datetime) -> str | None:
    try:
        require_time(state, signed, where, now)
    except UnfitError as error:
        return str(error)
    return None


def _show_log(found: Inspection, path: Path, state: TrustState) -> None:
    broken = broken_line(path)
    end = end_of_log(path, state.made_by) if state.made_by is not None else End.TOLD
    if end is End.LEFT and state.made_by is not None:
        found.lines.append(f"not in the audit log yet, the next command adds it: {state.made_by.event}")
    found.facts["audit_log"] = "changed" if broken is not None else "cut" if end is End.LOST else "whole"
    if broken is not None:
        found.lines.append(f"audit log: line {broken} was changed")
        found.problems.append(f"{path}: line {broken} is not what was written there")
    elif end is End.LOST:
        found.lines.append("audit log: lines are missing at its end")
        found.problems.append(f"{path}: lines are missing at its end, or all of it: somebody cut or removed it")
    else:
        found.lines.append("audit log: whole")


def statement_facts(statement: Statement) -> dict[str, Any]:
    """What a statement says, for programs: numbers with their units in the names, times as ISO 8601."""
    if isinstance(statement, KeySet):
        keys = sorted(statement.keys.values(), key=lambda key: key.name)
        return {
            "kind": "key set",
            "version": statement.version,
            "threshold": statement.threshold,
            "signers": {key.name: key.ed25519 for key in keys},
        }
    if isinstance(statement, Revocation):
        facts = msgspec.structs.asdict(statement)
        return {"kind": "revocation", **{name: value for name, value in facts.items() if name != "schema_version"}}
    parameters = statement.parameters
    return {
        "kind": "parameters",
        "vehicle": statement.vehicle,
        "sequence": statement.sequence,
        "parameter_set": parameters.number,
        "not_before": statement.not_before,
        "expires": statement.expires,
        "layout": parameters.layout.name,
        "dbc": parameters.dbc.name,
        "verdict": parameters.verdict,
        "allow_large_step": statement.allow_large_step,
        "branches": msgspec.to_builtins(parameters.branches),
    }


def signers_text(keys: KeySet) -> str:
    """How many of whom."""
    return f"{keys.threshold} of {', '.join(sorted(key.name for key in keys.keys.values()))}"


def _keys(keys: KeySet) -> list[str]:
    """Whose key is which, to be compared with what the signers themselves say (NAME.pub)."""
    return [f"  {key.name}: {key.ed25519}" for key in sorted(keys.keys.values(), key=lambda key: key.name)]
