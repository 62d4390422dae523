"""Every command that finds or makes something prints it as JSON where asked, and docs/json.md names the keys."""

import argparse
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import typer

from calibrator.cli import app
from ecu_node import cli as node_cli
from ecu_node.database import VehicleDatabase
from ecu_node.parameters import write_parameters
from tests.ecu_node.processes import ecu_node
from tests.ecu_node.vehicles import LAYOUT, parameters_for
from tests.update.repo import calibrator

DOCUMENT = Path(__file__).parents[1] / "docs" / "json.md"
WITHOUT = {
    "ecu-node run": "works until it is ended, and publishes its state on the bus",
    "ecu-node clear": "prints nothing",
    "ecu-node template": "prints JSON anyway",
    "ecu-node schema": "prints JSON anyway",
    "ecu-node report": "prints JSON anyway",
}
"""Commands that have no --json, and why."""


def commands_of(name: str, command: Any) -> Iterator[tuple[str, Any]]:
    """Name and command of a group and of all in it."""
    yield name, command
    for word, each in getattr(command, "commands", {}).items():
        yield from commands_of(f"{name} {word}", each)


CALIBRATOR = dict(commands_of("calibrator", typer.main.get_command(app)))
(_SUBPARSERS,) = [item for item in node_cli._parser()._actions if isinstance(item, argparse._SubParsersAction)]
ECU_NODE = {f"ecu-node {name}": list(command._option_string_actions) for name, command in _SUBPARSERS.choices.items()}
COMMANDS = ECU_NODE | {
    name: [option for parameter in command.params for option in parameter.opts]
    for name, command in CALIBRATOR.items()
    if not hasattr(command, "commands")
}


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_json_unless_listed_as_an_exception(command: str) -> None:
    assert ("--json" in COMMANDS[command]) is (command not in WITHOUT)


def test_json_of_each_step_of_an_update_has_documented_keys(database: VehicleDatabase, tmp_path: Path) -> None:
    """Each step prints one document whose keys are documented, and which names what the next step needs."""
    documented = set(re.findall(r"`([a-z0-9_]+)`", DOCUMENT.read_text()))

    def done(command: str, *arguments: object) -> dict[str, Any]:
        program, *words = command.split()
        ended = {"ecu-node": ecu_node, "calibrator": calibrator}[program](*words, *arguments, "--json")
        assert (ended.code, ended.err) == (0, "")
        found: dict[str, Any] = json.loads(ended.out)
        assert found.keys() <= documented
        return found

    params, repo, layout = tmp_path / "v1.json", tmp_path / "repo", ("--layout", LAYOUT)
    state = ("--state", tmp_path / "state")
    write_parameters(parameters_for(database, battery=(0.05, 2.3)), params)
    exported = done("calibrator export --format c", params, *layout, "--output", tmp_path / "c" / "car.c")
    assert (exported["format"], exported["notices"]) == ("c", [])
    assert all(Path(file).is_file() for file in exported["files"])
    made = done("calibrator repository key anna --no-passphrase --out", tmp_path / "keys")
    public, publish = made["public_key"], ("calibrator repository publish", repo, "--key", made["private_key"])
    roles = [word for role in ("--root", "--targets", "--snapshot", "--timestamp") for word in (role, public)]
    assert done("calibrator repository init", repo, *roles)["root"] == {"keys": 1, "threshold": 1}
    assert done("calibrator repository add", repo, params)["added"] == 1
    assert done(*publish)["published"] == 3
    done("ecu-node provision --vehicle v1 --root", repo / "metadata" / "1.root.json", *state)
    (bundle,) = done("calibrator repository bundle", repo, "v1", "--out", tmp_path / "bundles")["bundles"]
    would = done("ecu-node update --dry-run", bundle, *state, *layout)
    taken = done("ecu-node update", bundle, *state, *layout)
    assert (would["taken"], taken["taken"], taken["on_trial"]["parameter_set"]) == (False, True, 300)
    assert done("calibrator repository revoke", repo, "v1")["revoked"] == ["v1"]
    done("calibrator repository rotate", repo, "timestamp", "--public", public)
    done(*publish)
    assert done("ecu-node update", repo, *state, *layout)["on_trial"] is None
    after = done("ecu-node inspect", *state)
    assert (after["ended"], after["trusted"]["root"], after["problems"]) == ("revoked", 2, [])
