"""Commands of ``ecu-node`` for signed parameters: provision, update, inspect, report."""

import argparse
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from ecu_node import __version__
from ecu_node.core.status import TrustError
from ecu_node.errors import UserError, printable
from ecu_node.program import say_error, write_output, write_result

if TYPE_CHECKING:
    from ecu_node.update.state import ParameterSet, VehicleState

# the commands themselves import what needs python-can, as load_python_can must come first

__all__ = ["add_update_commands"]

_PLACES = ("in_force", "on_trial", "before", "failed")


def add_update_commands(
    commands: "argparse._SubParsersAction[Any]", vehicle: Callable[[str], str], folder: Callable[[str], Path]
) -> None:
    """Add the commands to a parser.

    Parameters
    ----------
    commands : argparse's subparsers
        Subparsers of ``ecu-node``; each sets ``command`` to a callable that takes the options.
    vehicle, folder : callable
        Read the identity of a vehicle and the name of a folder, as types for argparse.
    """
    provision = commands.add_parser(
        "provision",
        help="begin the state of a vehicle: which repository it trusts",
        description="Makes the folder in which a vehicle keeps what it has accepted, with the root of the repository "
        "that it trusts from the beginning. Done once, where the vehicle is made.",
        failed="refused or failed",
    )
    provision.add_argument("--vehicle", required=True, type=vehicle, metavar="ID", help="identity of this vehicle")
    provision.add_argument("--root", required=True, type=Path, metavar="FILE", help="1.root.json of the repository")
    provision.set_defaults(command=_provision)
    update = commands.add_parser(
        "update",
        help="take parameters, or their revocation, from a repository",
        description="Verifies what the repository has for this vehicle (The Update Framework), then vehicle, layout, "
        "DBC, limits, expiry and the step from what is in force. New parameters go on trial in the running node; what "
        "is revoked is not used any more.",
        failed="refused or failed",
    )
    update.add_argument("source", metavar="BUNDLE|FOLDER|URL", help="bundle of this vehicle, or repository")
    update.add_argument("--layout", type=Path, required=True, metavar="FILE", help="layout (TOML), which names the DBC")
    update.add_argument("--dry-run", action="store_true", help="check all, change nothing")
    update.set_defaults(command=_update)
    inspect = commands.add_parser(
        "inspect",
        help="show the state of a vehicle",
        description="Shows what is in force, on trial and trusted.",
        failed="what is in force or on trial cannot be used",
    )
    inspect.set_defaults(command=_inspect)
    report = commands.add_parser(
        "report",
        help="print what the vehicle holds, to be sent to the manufacturer, signed if it has a key",
        description="Prints a version report as JSON: a DSSE envelope if --key is given, else its payload alone.",
    )
    words = "private key of the vehicle: a PEM file, or PUBLIC.pem=URI, as of a security module"
    report.add_argument("--key", metavar="KEY", help=words)
    report.set_defaults(command=_report)
    for command in (provision, update, inspect, report):
        command.add_argument("--state", required=True, type=folder, metavar="FOLDER", help="state of this vehicle")
        if command is not report:
            command.add_argument("--json", action="store_true", help="print JSON")


def _client() -> Any:
    """Import the client, which needs the packages of the extra ``update``."""
    try:
        from ecu_node.update import client  # noqa: PLC0415
    except ModuleNotFoundError as error:
        raise UserError(f"updates need the package {error.name}: pip install 'hv-current-correction[update]'") from None
    return client


def _provision(options: argparse.Namespace) -> int:
    version = _client().provision(options.state, options.vehicle, options.root, datetime.now(UTC))
    facts = {"state": str(options.state), "vehicle": options.vehicle, "root": version}
    text = f"{options.state}: vehicle {options.vehicle} trusts root {version}"
    write_result(facts, printable(text), as_json=options.json)
    return 0


def _update(options: argparse.Namespace) -> int:
    from ecu_node.database import node_database  # noqa: PLC0415
    from ecu_node.update.state import read_state  # noqa: PLC0415

    client, database = _client(), node_database(options.layout)
    text = client.update(options.state, options.source, database, datetime.now(UTC), dry_run=options.dry_run)
    text = f"dry run, nothing is changed: {text}" if options.dry_run else text
    facts = {"taken": not options.dry_run, "text": text, **_facts(read_state(options.state))}
    write_result(facts, printable(text), as_json=options.json)
    return 0


def _facts(state: "VehicleState") -> dict[str, Any]:
    """Return the state as plain values for JSON; ``null`` where there is no set."""
    from ecu_node.update.state import time_text  # noqa: PLC0415

    def of_set(found: "ParameterSet | None") -> dict[str, Any] | None:
        if found is None:
            return None
        number = found.parameters.number
        return {"parameter_set": number, "sha256": found.sha256, "expires": time_text(found.expires)}

    return {
        "vehicle": state.vehicle,
        "latest_time": time_text(state.latest),
        **{name: of_set(getattr(state, name)) for name in _PLACES},
        "ended": state.ended,
        "trusted": {
            name: msgspec.json.decode(text)["signed"]["version"]
            for name in ("root", "timestamp", "snapshot")
            if (text := getattr(state, name)) is not None
        },
    }


def _inspect(options: argparse.Namespace) -> int:
    from ecu_node.update.state import read_state, require_not_expired, time_text  # noqa: PLC0415

    state, now, problems = read_state(options.state), datetime.now(UTC), []
    facts = _facts(state)
    lines = [
        f"vehicle {state.vehicle}; trusts " + ", ".join(f"{role} {v}" for role, v in facts["trusted"].items()),
        f"latest time seen: {facts['latest_time']}",
    ]
    for name in _PLACES:
        found = getattr(state, name)
        words = name.replace("_", " ").replace("before", "in force before").replace("failed", "failed its trial")
        if found is not None:
            lines.append(f"{words}: {found}, expires {time_text(found.expires)}")
            for branch, values in found.parameters.branches.items() if name != "failed" else ():
                applied = "applied" if values.apply else f"not applied ({values.held_back or 'no fault'})"
                drift, offset = f"drift {values.drift:+.4g}", f"offset {values.offset_a:+.4g} A"
                lines.append(f"  branch {branch}: {drift}, {offset}, {applied}")
        if found is not None and name in ("in_force", "on_trial"):
            try:
                require_not_expired(found, state, now)
            except TrustError as error:
                problems.append(f"{options.state}: {error}")
    if state.in_force is None:
        lines.append("nothing is in force" + (f": the last set was {state.ended}" if state.ended else ""))
    if options.json:
        write_output(msgspec.json.encode({**facts, "problems": problems}).decode())
    else:
        write_output("\n".join(map(printable, lines)))
    for problem in problems:
        say_error(f"ecu-node: {problem}")
    return 1 if problems else 0


def _report(options: argparse.Namespace) -> int:
    from ecu_node.update.state import read_state, time_text  # noqa: PLC0415

    facts = {
        "time": time_text(datetime.now(UTC)),
        "tool": f"ecu-node {__version__}",
        **_facts(read_state(options.state)),
    }
    payload = msgspec.json.encode(facts)
    if options.key is None:
        write_output(payload.decode())
        return 0
    _client()
    from securesystemslib.dsse import Envelope  # noqa: PLC0415

    from ecu_node.update.signers import signer_of  # noqa: PLC0415

    envelope = Envelope(payload, "application/vnd.hv-current-correction.report+json", {})
    envelope.sign(signer_of(options.key))
    write_output(msgspec.json.encode(envelope.to_dict()).decode())
    return 0
