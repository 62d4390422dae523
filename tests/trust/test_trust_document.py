"""The commands of docs/trust.md do what is said there, one after the other, in one folder."""

import re
import shlex
import shutil
from pathlib import Path

import pytest
from msgspec.structs import replace

from calibrator.cli import app
from calibrator.signing.key_files import PASSPHRASE_VARIABLE
from ecu_node.cli import main
from ecu_node.database import read_database
from ecu_node.layout import read_layout
from ecu_node.parameters import write_parameters
from ecu_node.trust.audit import broken_line
from ecu_node.trust.state import audit_path, read_state
from tests.ecu_node.vehicles import LAYOUT, parameters_for

DOCUMENT = Path(__file__).parents[2] / "docs" / "trust.md"
PROGRAMS = ("calibrator", "ecu-node")


def documented_commands() -> list[list[str]]:
    """Commands of the document in their order, but for the node, which runs until it is ended."""
    blocks = re.findall(r"(?ms)^```\n(.*?)^```$", DOCUMENT.read_text())
    lines = "".join(blocks).replace("\\\n", " ").splitlines()
    found = [shlex.split(line, comments=True) for line in lines]
    return [words for words in found if words[:1] and words[0] in PROGRAMS and words[:2] != ["ecu-node", "run"]]


def exit_code(command: list[str]) -> int:
    """Run a command of either program in this process."""
    if command[0] == "ecu-node":
        return main(command[1:])
    try:
        app(args=command[1:], prog_name="calibrator")
    except SystemExit as end:
        return end.code if isinstance(end.code, int) else 0
    return 0


def numbered(command: list[str], first: int) -> list[str]:
    """A command that signs, with a number in the place of the time, which a fast test does not wait for."""
    if command[:3] == ["calibrator", "sign", "result/params/V1.json"]:
        return [*command, "--sequence", str(first)]
    return [*command, "--sequence", str(first + 1)] if command[:2] == ["calibrator", "revoke"] else command


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with the layout and the parameter file of which the document speaks."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv(PASSPHRASE_VARIABLE, "correct horse battery staple")
    shutil.copy(LAYOUT.with_suffix(".dbc"), tmp_path)
    shutil.copy(LAYOUT, tmp_path / "my_car.toml")
    database = read_database(read_layout(tmp_path / "my_car.toml"))
    (tmp_path / "result" / "params").mkdir(parents=True)
    parameters = replace(parameters_for(database, battery=(0.05, 2.0)), vehicle="V1")
    write_parameters(parameters, tmp_path / "result" / "params" / "V1.json")
    return tmp_path


def test_each_documented_command_works_after_the_one_before(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    commands = documented_commands()
    first = next(int(words[words.index("--number") + 1]) for words in commands if "--number" in words)
    for command in commands:
        assert exit_code(numbered(command, first)) == 0, (command, capsys.readouterr().err)
        if command[:3] == ["ecu-node", "activate", "signed/V1.json"]:
            assert f"on trial: number {first}, " in capsys.readouterr().out
    found = read_state(folder / "state")
    assert (found.vehicle, found.keys.version, found.revoked, found.slots) == ("V1", 2, [first], {})
    assert broken_line(audit_path(folder / "state")) is None
