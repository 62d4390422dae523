"""Commands of ``ecu-node`` for signed parameters: provision, activate, revoke, verify, inspect."""

import argparse
import os
import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ecu_node.standard_output import write_output

if TYPE_CHECKING:
    from ecu_node.parameters import BranchParameters
    from ecu_node.trust.key_set import KeySet
    from ecu_node.trust.statements import Statement

__all__ = ["add_trust_commands"]

_CODES = "Exit codes: 0 done, 1 refused or failed, 2 wrong use, 130 interrupted."


def add_trust_commands(commands: "argparse._SubParsersAction[Any]") -> None:
    """Add the commands to a parser.

    Parameters
    ----------
    commands : argparse's subparsers
        Of ``ecu-node``; each command is left in ``command`` as a callable that takes the options.
    """
    provision = commands.add_parser(
        "provision",
        help="begin the state of a vehicle: whom it trusts",
        description="Makes the folder in which a vehicle keeps what it has accepted, with the key set that it trusts "
        "from the beginning. Done once, where the vehicle is made.",
        epilog=_CODES,
    )
    provision.add_argument("--vehicle", required=True, type=_vehicle, metavar="ID", help="identity of this vehicle")
    provision.add_argument("--keys", required=True, type=Path, metavar="FILE", help="first key set ('calibrator keys')")
    _add_state(provision)
    provision.set_defaults(command=_provision)
    for name, what, details in (
        ("activate", "take signed parameters, or a signed key set", "Parameters go on trial in the running node."),
        ("revoke", "take back parameters by a signed revocation", "What was in force before is in force again."),
        ("verify", "would this signed file be taken?", "Every check of 'activate'; nothing is changed."),
    ):
        command = commands.add_parser(
            name,
            help=what,
            description=f"Checks signatures, vehicle, number, time, layout, DBC, limits and the step from what is in "
            f"force. {details}",
            epilog=_CODES,
        )
        command.add_argument("file", type=Path, metavar="FILE", help="signed file")
        _add_state(command)
        command.add_argument(
            "--layout", type=Path, required=True, metavar="FILE", help="layout (TOML), which names the DBC"
        )
        command.set_defaults(command=_take, name=name)
    inspect = commands.add_parser(
        "inspect",
        help="show a signed file, or the state of a vehicle",
        description="Shows what is said there. Of a file no signature is verified; of a state the audit log is.",
        epilog=_CODES,
    )
    inspect.add_argument("what", type=Path, metavar="FILE|FOLDER", help="signed file, or state of a vehicle")
    inspect.set_defaults(command=_inspect)


def _add_state(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--state", required=True, type=Path, metavar="FOLDER", help="state of this vehicle")


def _vehicle(text: str) -> str:
    if not text.strip() or len(text) > 64:  # as in the parameter file
        raise argparse.ArgumentTypeError("the vehicle's identity is expected, of at most 64 characters")
    return text


def _provision(options: argparse.Namespace) -> int:
    from ecu_node.trust.canonical import printable, read_bytes, read_canonical  # noqa: PLC0415
    from ecu_node.trust.key_set import KEY_SET, KeySet, check_key_set  # noqa: PLC0415
    from ecu_node.trust.provision import provision  # noqa: PLC0415  # cryptography takes time to import

    where = str(options.keys)
    content = read_bytes(options.keys, KEY_SET).removesuffix(b"\n")
    keys = check_key_set(read_canonical(content, KeySet, where, KEY_SET), where)
    provision(options.state, options.vehicle, keys, _now())
    write_output(printable(f"{options.state}: vehicle {options.vehicle} trusts {_signers(keys)}"))
    return 0


def _take(options: argparse.Namespace) -> int:
    from ecu_node.database import read_database  # noqa: PLC0415
    from ecu_node.layout import read_layout  # noqa: PLC0415
    from ecu_node.trust.activation import accept, examine  # noqa: PLC0415
    from ecu_node.trust.canonical import printable, read_bytes  # noqa: PLC0415
    from ecu_node.trust.key_set import KeySet  # noqa: PLC0415
    from ecu_node.trust.statements import Revocation, SignedParameters  # noqa: PLC0415

    database = read_database(read_layout(options.layout))
    content, where = read_bytes(options.file), str(options.file)
    if options.name == "verify":
        accepted = examine(options.state, content, where, database, _now())
    else:
        kinds = (Revocation,) if options.name == "revoke" else (SignedParameters, KeySet)
        accepted = accept(options.state, content, where, database, _now(), kinds=kinds)
    number = f"number {accepted.sequence}, " if accepted.sequence is not None else ""
    would = "would be accepted: " if options.name == "verify" else ""
    write_output(printable(f"{would}{accepted.event}: {number}{accepted.text}"))
    return 0


def _inspect(options: argparse.Namespace) -> int:
    return _inspect_state(options.what) if os.path.isdir(options.what) else _inspect_file(options.what)  # noqa: PTH112


def _inspect_file(path: Path) -> int:
    from ecu_node.trust.canonical import printable, read_bytes  # noqa: PLC0415
    from ecu_node.trust.statements import open_statement  # noqa: PLC0415

    envelope, statement = open_statement(read_bytes(path), str(path))
    lines = [*_statement_lines(statement), "signatures, not verified, of keys:"]
    lines += [f"  {signature.keyid}" for signature in envelope.signatures]
    write_output("\n".join(map(printable, lines)))
    return 0


def _statement_lines(statement: "Statement") -> list[str]:
    from ecu_node.trust.key_set import KeySet  # noqa: PLC0415
    from ecu_node.trust.statements import Revocation  # noqa: PLC0415

    if isinstance(statement, KeySet):
        return [f"key set {statement.version}: {_signers(statement)}", *_keys(statement)]
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
        lines.append(f"branch {name}: {_drift(branch)}, offset {branch.offset_a:+.4g} A, {applied}")
    return lines


def _drift(branch: "BranchParameters") -> str:
    from ecu_node.sensor_models import GainBySign, TemperatureDrift  # noqa: PLC0415

    match branch.sensor_model:
        case GainBySign() as model:
            return f"drift {model.drift_positive:+.4g} into and {model.drift_negative:+.4g} out of the junction"
        case TemperatureDrift() as model:
            return f"drift {branch.drift:+.4g} at {model.reference_c:g} degC, {model.drift_per_k:+.4g} per K"
        case None:
            return f"drift {branch.drift:+.4g}"


def _inspect_state(folder: Path) -> int:
    from ecu_node.trust.audit import broken_line, is_told  # noqa: PLC0415
    from ecu_node.trust.state import audit_path, read_state  # noqa: PLC0415

    state = read_state(folder)
    lines = [
        f"vehicle {state.vehicle}, highest number {state.highest_sequence}",
        f"key set {state.keys.version}: {_signers(state.keys)}",
        *_keys(state.keys),
    ]
    for name, slot in sorted(state.slots.items()):
        places = {state.in_force: "in force", state.on_trial: "on trial", state.fallback: "in force before"}
        what = places.get(name, "not used")
        lines.append(f"slot {name}: number {slot.sequence}, {what}")
    lines += [f"revoked: {', '.join(map(str, state.revoked))}"] * bool(state.revoked)
    if state.made_by is not None and not is_told(audit_path(folder), state.made_by):
        lines.append(f"not in the audit log yet, the next command adds it: {state.made_by.event}")
    broken = broken_line(audit_path(folder))
    write_output("\n".join([*lines, "audit log: whole" if broken is None else f"audit log: line {broken} was changed"]))
    if broken is not None:
        print(f"ecu-node: {audit_path(folder)}: line {broken} is not what was written there", file=sys.stderr)
    return 0 if broken is None else 1


def _signers(keys: "KeySet") -> str:
    return f"{keys.threshold} of {', '.join(sorted(key.name for key in keys.keys.values()))}"


def _keys(keys: "KeySet") -> list[str]:
    """Whose key is which, to be compared with what the signers themselves say (NAME.pub)."""
    return [f"  {key.name}: {key.ed25519}" for key in sorted(keys.keys.values(), key=lambda key: key.name)]


def _now() -> datetime:
    return datetime.now(UTC)
