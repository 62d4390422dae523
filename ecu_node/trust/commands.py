"""Commands of ``ecu-node`` for signed parameters: provision, activate, revoke, verify, inspect."""

import argparse
import os
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from ecu_node.errors import printable
from ecu_node.program import say_error, write_output, write_result, write_text

__all__ = ["add_trust_commands"]


def add_trust_commands(commands: "argparse._SubParsersAction[Any]", vehicle: Callable[[str], str]) -> None:
    """Add the commands to a parser.

    Parameters
    ----------
    commands : argparse's subparsers
        Of ``ecu-node``; each command is left in ``command`` as a callable that takes the options.
    vehicle : callable
        Reads the identity of a vehicle, as a type for argparse.
    """
    provision = commands.add_parser(
        "provision",
        help="begin the state of a vehicle: whom it trusts",
        description="Makes the folder in which a vehicle keeps what it has accepted, with the key set that it trusts "
        "from the beginning. Done once, where the vehicle is made.",
        failed="refused or failed",
    )
    provision.add_argument("--vehicle", required=True, type=vehicle, metavar="ID", help="identity of this vehicle")
    provision.add_argument("--keys", required=True, type=Path, metavar="FILE", help="first key set ('calibrator keys')")
    _add_state(provision)
    _add_json(provision)
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
            failed="refused or failed",
        )
        command.add_argument("file", type=Path, metavar="FILE", help="signed file")
        _add_state(command)
        command.add_argument(
            "--layout", type=Path, required=True, metavar="FILE", help="layout (TOML), which names the DBC"
        )
        _add_json(command)
        command.set_defaults(command=_take, name=name)
    inspect = commands.add_parser(
        "inspect",
        help="show a signed file, or the state of a vehicle",
        description="Shows what is said there. Of a file signatures are verified only with --keys. Of a state it is "
        "verified that the slots and the audit log are as they were written, and that what is in force or on trial "
        "holds now; whether it fits layout and DBC, 'ecu-node run' says.",
        failed="what is in force or on trial cannot be used, the audit log is not whole, or with --keys not enough "
        "signers",
    )
    inspect.add_argument("what", type=Path, metavar="FILE|FOLDER", help="signed file, or state of a vehicle")
    inspect.add_argument("--keys", type=Path, metavar="FILE", help="key set with which signatures are verified")
    _add_json(inspect)
    inspect.set_defaults(command=_inspect)


def _add_state(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--state", required=True, type=Path, metavar="FOLDER", help="state of this vehicle")


def _add_json(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--json", action="store_true", help="print JSON")


def _provision(options: argparse.Namespace) -> int:
    from ecu_node.trust.canonical import read_bytes, read_canonical  # noqa: PLC0415
    from ecu_node.trust.inspection import signers_text, statement_facts  # noqa: PLC0415
    from ecu_node.trust.key_set import KEY_SET, KeySet, check_key_set  # noqa: PLC0415
    from ecu_node.trust.provision import provision  # noqa: PLC0415  # cryptography takes time to import

    where = str(options.keys)
    content = read_bytes(options.keys, KEY_SET).removesuffix(b"\n")
    keys = check_key_set(read_canonical(content, KeySet, where, KEY_SET), where)
    provision(options.state, options.vehicle, keys, _now())
    facts = {"state": str(options.state), "vehicle": options.vehicle, "key_set": statement_facts(keys)}
    text = printable(f"{options.state}: vehicle {options.vehicle} trusts {signers_text(keys)}")
    write_result(facts, text, as_json=options.json)
    return 0


def _take(options: argparse.Namespace) -> int:
    from ecu_node.database import node_database  # noqa: PLC0415
    from ecu_node.trust.activation import accept, examine  # noqa: PLC0415
    from ecu_node.trust.canonical import read_bytes  # noqa: PLC0415
    from ecu_node.trust.key_set import KeySet  # noqa: PLC0415
    from ecu_node.trust.statements import Revocation, SignedParameters  # noqa: PLC0415

    database = node_database(options.layout)
    content, where = read_bytes(options.file), str(options.file)
    if options.name == "verify":
        accepted = examine(options.state, content, where, database, _now())
    else:
        kinds = (Revocation,) if options.name == "revoke" else (SignedParameters, KeySet)
        accepted = accept(options.state, content, where, database, _now(), kinds=kinds, on_wait=_say_waiting)
    facts = {
        "taken": options.name != "verify",
        "event": accepted.event,
        "sequence": accepted.sequence,
        "text": accepted.text,
    }
    number = f"number {accepted.sequence}, " if accepted.sequence is not None else ""
    would = "would be accepted: " if options.name == "verify" else ""
    write_result(facts, printable(f"{would}{accepted.event}: {number}{accepted.text}"), as_json=options.json)
    return 0


def _inspect(options: argparse.Namespace) -> int:
    from ecu_node.trust.inspection import inspect_file, inspect_state  # noqa: PLC0415

    if os.path.isdir(options.what):  # noqa: PTH112  # False where the name is too long for a file
        if options.keys is not None:
            say_error("ecu-node: --keys is for a signed file; a state has keys of its own; leave --keys out")
            return 2
        found = inspect_state(options.what, _now())
    else:
        found = inspect_file(options.what, options.keys)
    if options.json:
        write_output(found.as_json())
    else:
        write_text("\n".join(map(printable, found.lines)))
    for problem in found.problems:
        say_error(f"ecu-node: {problem}")
    return 1 if found.problems else 0


def _say_waiting(text: str) -> None:
    say_error(f"ecu-node: {text}")


def _now() -> datetime:
    return datetime.now(UTC)
