"""The commands of docs/trust.md, in their order, on a vehicle that is attacked before each recovery."""

import re
import shlex
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace
from tuf.api.metadata import Targets

from ecu_node.database import VehicleDatabase
from ecu_node.parameters import VehicleParameters, write_parameters
from ecu_node.update.signers import PASSPHRASE_VARIABLE
from ecu_node.update.state import read_state
from tests.ecu_node.vehicles import LAYOUT
from tests.update.repo import Repo, pass_trial

TEXT = (Path(__file__).parents[2] / "docs" / "trust.md").read_text()


def commands(text: str) -> list[str]:
    return [
        line for block in re.findall(r"```\n(.*?)```", text, re.DOTALL) for line in block.splitlines() if line.strip()
    ]


def section(name: str) -> list[str]:
    """Commands of one recovery."""
    return commands(re.findall(rf"<!-- run: {name} -->\n(```\n.*?```)", TEXT, re.DOTALL)[0])


@pytest.fixture
def place(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    database: VehicleDatabase,
    parameters: VehicleParameters,
    offered: Repo,
) -> Repo:
    """A folder with a layout and a result, where the document's commands are run."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv(PASSPHRASE_VARIABLE, "a passphrase for tests")
    shutil.copy(LAYOUT, tmp_path / "my_car.toml")
    shutil.copy(database.layout.dbc_path, tmp_path)
    (tmp_path / "result" / "params").mkdir(parents=True)
    found = Repo(tmp_path, offered.calibrator, offered.node)
    found.vehicle = "V1"
    write_parameters(replace(parameters, vehicle="V1"), tmp_path / "result" / "params" / "V1.json")
    return found


def run(place: Repo, lines: list[str]) -> None:
    assert lines
    for line in lines:
        program, *words = shlex.split(line)
        if program == "export":  # the passphrase; the fixture has set one
            continue
        code, _, err = (place.calibrator if program == "calibrator" else place.node)(*words)
        assert code == 0, f"{line}: {err}"


def number(place: Repo, set_number: int) -> None:
    """Put another parameter file into the result."""
    path = place.folder / "result" / "params" / "V1.json"
    path.write_text(re.sub(r'"number": ?\d+', f'"number": {set_number}', path.read_text()))


def publish(place: Repo, *names: str) -> None:
    place.done("add", place.path, place.folder / "result" / "params")
    place.publish(*names)


def test_documented_commands_work_and_recover_from_each_stolen_key(place: Repo) -> None:
    first, _, recovery = TEXT.partition("## When a key is stolen or lost")
    lines = commands(first)
    revoking = next(k for k, line in enumerate(lines) if " revoke " in line)
    run(place, lines[:revoking])
    state = place.folder / "state"
    pass_trial(state)
    run(place, lines[revoking:])
    assert read_state(state).in_force is None
    number(place, 301)
    publish(place, "anna", "ben", "online")
    place.updated(state)
    pass_trial(state)
    assert commands(recovery) == [line for name in ("online", "targets", "root", "anew") for line in section(name)]

    fast_forward(place, "online")
    number(place, 302)
    place.done("add", place.path, place.folder / "result" / "params")
    recover(place, "online", 302)

    def evil(targets: Targets) -> None:
        targets.version += 1000

    fast_forward(place, "online-2", place.bin, evil, "anna", "ben")
    number(place, 303)
    recover(place, "targets", 303)

    recover(place, "root", 303)
    place.forge("root", lambda _: None, "anna", "emil")  # anna's key is the stolen one
    place.refused(state, "root was signed by ")

    run(place, section("anew"))
    assert read_state(place.folder / "state-2").on_trial is not None


def fast_forward(
    place: Repo, online: str, role: str | None = None, change: Callable[[Any], None] = lambda _: None, *names: str
) -> None:
    """The vehicle takes metadata with far versions that a thief signed; the repository itself stays as it is."""
    state, copy = place.folder / "state", place.folder / "stolen"
    shutil.rmtree(copy, ignore_errors=True)
    copy.mkdir()
    stolen = place.copy(copy)
    stolen.vehicle = place.vehicle
    if role is not None:
        stolen.forge(role, change, *names)
        stolen.relist(role, online)

    def far(signed: Any) -> None:
        signed.version += 100_000

    stolen.forge("snapshot", far, online)
    stolen.point(online)
    stolen.forge("timestamp", far, online)
    stolen.updated(state)
    place.publish("anna", "ben", online)
    place.refused(state, "older than what was accepted before")


def recover(place: Repo, name: str, set_number: int) -> None:
    """After the commands of the document the vehicle takes what the repository has."""
    run(place, section(name))
    state = place.folder / "state"
    assert f"parameter set {set_number} (" in place.updated(state)
    if read_state(state).on_trial is not None:
        pass_trial(state)
    found = read_state(state).in_force
    assert found is not None
    assert found.parameters.number == set_number
