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
from calibrator.terminal.command_line import run_app
from ecu_node import cli as node_cli
from ecu_node.database import VehicleDatabase, read_database
from ecu_node.layout import read_layout
from ecu_node.parameters import write_parameters
from tests.calibrator.export.exports import parameters_for
from tests.ecu_node.vehicles import LAYOUT

DOCUMENT = Path(__file__).parents[1] / "docs" / "json.md"
WITHOUT = {
    "ecu-node run": "works until it is ended, and publishes its state on the bus",
    "ecu-node clear": "prints nothing",
    "ecu-node template": "prints JSON anyway",
    "ecu-node schema": "prints JSON anyway",
}
"""Commands that have no --json, and why."""


def calibrator_commands() -> Iterator[tuple[str, list[str]]]:
    """Name and options of every command."""

    def inner(name: str, command: Any) -> Iterator[tuple[str, list[str]]]:
        if commands := getattr(command, "commands", {}):
            for word, each in commands.items():
                yield from inner(f"{name} {word}", each)
        else:
            yield name, [option for parameter in command.params for option in parameter.opts]

    yield from inner("calibrator", typer.main.get_command(app))


def node_commands() -> Iterator[tuple[str, list[str]]]:
    parser = node_cli._parser()
    (subparsers,) = [action for action in parser._actions if isinstance(action, argparse._SubParsersAction)]
    for name, command in subparsers.choices.items():
        yield f"ecu-node {name}", list(command._option_string_actions)


COMMANDS = dict([*calibrator_commands(), *node_commands()])


def test_both_programs_were_walked() -> None:
    assert {"calibrator import", "calibrator keys set", "ecu-node inspect"} <= COMMANDS.keys()
    assert WITHOUT.keys() <= COMMANDS.keys()


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_json_or_a_reason(command: str) -> None:
    assert ("--json" in COMMANDS[command]) is (command not in WITHOUT)


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_stands_in_the_document(command: str) -> None:
    program, _, name = command.partition(" ")
    section = DOCUMENT.read_text().partition(f"## {program}\n")[2].partition("\n## ")[0]
    assert f"`{name}`" in section


def documented() -> set[str]:
    return set(re.findall(r"`([a-z0-9_]+)`", DOCUMENT.read_text()))


@pytest.fixture
def database() -> VehicleDatabase:
    return read_database(read_layout(LAYOUT))


def test_a_life_of_signed_parameters_in_json(
    database: VehicleDatabase, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Each step prints one document whose keys are documented, and which names what the next step needs."""
    params = tmp_path / "v1.json"
    write_parameters(parameters_for(database, battery=(0.05, 2.3)), params)

    def done(program: str, *arguments: object) -> dict[str, Any]:
        words = [*map(str, arguments), "--json"]
        code = node_cli.main(words) if program == "ecu-node" else run_app(app, program, words)
        printed = capsys.readouterr()
        assert (code, printed.err) == (0, "")
        found: dict[str, Any] = json.loads(printed.out)
        assert found.keys() <= documented()
        return found

    layout, state = ["--layout", LAYOUT], ["--state", tmp_path / "state"]
    anna, ben = (
        done("calibrator", "keys", "new", name, "--no-passphrase", "--out", tmp_path / "keys")
        for name in ("anna", "ben")
    )
    public, private = (
        [anna["public_key"], ben["public_key"]],
        ["--key", anna["private_key"], "--key", ben["private_key"]],
    )
    keys = done("calibrator", "keys", "set", *public, "--threshold", 2, "--out", tmp_path / "set.json")
    assert (keys["signers"], keys["threshold"]) == (["anna", "ben"], 2)
    signed = done("calibrator", "sign", params, *private, "--out", tmp_path / "signed")["signed"]
    assert signed == [str(tmp_path / "signed" / "v1.json")]
    again = done("calibrator", "sign", params, *private, "--out", tmp_path / "signed")
    assert (again["signed"], again["kept"]) == ([], signed)
    begun = done("ecu-node", "provision", "--vehicle", "v1", "--keys", keys["file"], *state)
    assert begun["key_set"]["signers"].keys() == {"anna", "ben"}
    verified = done("ecu-node", "verify", signed[0], *state, *layout)
    taken = done("ecu-node", "activate", signed[0], *state, *layout)
    assert (verified["taken"], taken["taken"]) == (False, True)
    assert {**verified, "taken": True} == taken
    file = done("ecu-node", "inspect", signed[0], "--keys", keys["file"])
    assert (file["kind"], file["sequence"], file["verified_signers"]) == (
        "parameters",
        taken["sequence"],
        ["anna", "ben"],
    )
    assert file["branches"]["battery"]["offset_a"] == 2.3
    revocation = done(
        *("calibrator", "revoke", "--vehicle", "v1", "--number", taken["sequence"], "--why", "a test"),
        *(*private, "--out", tmp_path / "revocation.json", "--sequence", taken["sequence"] + 1),
    )
    assert done("ecu-node", "inspect", revocation["file"])["revokes"] == [taken["sequence"]]
    done("ecu-node", "revoke", revocation["file"], *state, *layout)
    after = done("ecu-node", "inspect", *state[1:])
    assert (after["revoked"], after["audit_log"], after["problems"]) == ([taken["sequence"]], "whole", [])


def test_exports_tell_their_files_and_notices(
    database: VehicleDatabase, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    params = tmp_path / "v1.json"
    write_parameters(parameters_for(database, battery=(0.05, 2.3)), params)
    out = tmp_path / "hv_calibration.c"
    words = ["export", str(params), "--layout", str(LAYOUT), "--format", "c", "--output", str(out), "--json"]
    assert run_app(app, "calibrator", words) == 0
    printed = capsys.readouterr()
    found = json.loads(printed.out)
    assert printed.err == ""
    assert found.keys() == {"format", "files", "notices"}
    assert all(Path(file).is_file() for file in found["files"])


def test_a_refusal_prints_no_document(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["sign", str(tmp_path / "none.json"), "--key", str(tmp_path / "none.key"), "--out", str(tmp_path), "--json"]
    assert run_app(app, "calibrator", words) == 1
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.count("\n") == 1
