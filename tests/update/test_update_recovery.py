"""The commands of docs/trust.md, in their order, on a vehicle that is attacked before each recovery."""

import re
import shlex
import shutil
from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace

from ecu_node.parameters import VehicleParameters, write_parameters
from ecu_node.update.signers import PASSPHRASE_VARIABLE
from ecu_node.update.state import read_state
from tests.ecu_node.vehicles import LAYOUT
from tests.update.repo import Repo, pass_trial

TEXT = (Path(__file__).parents[2] / "docs" / "trust.md").read_text()


def commands(text: str) -> list[str]:
    blocks = re.findall(r"```\n(.*?)```", text, re.DOTALL)
    return [line for block in blocks for line in block.splitlines() if line.strip()]


def section(name: str) -> list[str]:
    """Commands of docs/trust.md for one recovery, marked with its name."""
    return commands(re.findall(rf"<!-- run: {name} -->\n(```\n.*?```)", TEXT, re.DOTALL)[0])


class Place(Repo):
    """A folder with a layout and a result, where the document's commands run; a vehicle that a thief attacks."""

    def __init__(self, folder: Path, parameters: VehicleParameters) -> None:
        super().__init__(folder)
        self.vehicle, self.state, self.parameters = "V1", folder / "state", replace(parameters, vehicle="V1")
        self.params = folder / "result" / "params"
        self.params.mkdir(parents=True)
        self.number(300)

    def number(self, number: int) -> None:
        """Put another parameter file into the result."""
        write_parameters(replace(self.parameters, number=number), self.params / "V1.json")

    def run(self, lines: list[str]) -> None:
        assert lines
        for line in lines:
            program, *words = shlex.split(line)
            if program != "export":  # the passphrase; the fixture has set one
                done = (self.calibrator if program == "calibrator" else self.node)(*words)
                assert done.code == 0, f"{line}: {done.err}"

    def fast_forward(self, online: str, role: str | None = None, *names: str) -> None:
        """The vehicle takes metadata with far versions that a thief signed; the repository itself stays as it is."""

        def far(signed: Any) -> None:
            signed.version += 100_000

        shutil.rmtree(self.folder / "stolen", ignore_errors=True)
        (self.folder / "stolen").mkdir()
        stolen = self.copy(self.folder / "stolen")
        stolen.vehicle = self.vehicle
        if role is not None:
            stolen.forge(role, far, *names)
            stolen.relist(role, online)
        stolen.forge("snapshot", far, online)
        stolen.point(online)
        stolen.forge("timestamp", far, online)
        stolen.updated(self.state)
        self.publish("anna", "ben", online)
        self.refused(self.state, "older than what was accepted before")

    def recover(self, name: str, number: int) -> None:
        """After the commands of the document the vehicle takes what the repository has."""
        self.run(section(name))
        assert f"parameter set {number} (" in self.updated(self.state)
        if read_state(self.state).on_trial is not None:
            pass_trial(self.state)
        found = read_state(self.state).in_force
        assert found is not None
        assert found.parameters.number == number


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, parameters: VehicleParameters) -> Place:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv(PASSPHRASE_VARIABLE, "a passphrase for tests")
    shutil.copy(LAYOUT, tmp_path / "my_car.toml")
    shutil.copy(LAYOUT.with_suffix(".dbc"), tmp_path)
    return Place(tmp_path, parameters)


def test_documented_commands_work_and_recover_from_each_stolen_key(place: Place) -> None:
    first, _, recovery = TEXT.partition("## When a key is stolen or lost")
    assert commands(recovery) == [line for name in ("online", "targets", "root", "anew") for line in section(name)]
    lines = commands(first)
    revoking = next(k for k, line in enumerate(lines) if " revoke " in line)
    place.run(lines[:revoking])
    pass_trial(place.state)
    place.run(lines[revoking:])
    assert read_state(place.state).in_force is None
    place.number(301)
    place.done("add", place.path, place.params)
    place.publish("anna", "ben", "online")
    place.updated(place.state)
    pass_trial(place.state)

    place.fast_forward("online")
    place.number(302)
    place.done("add", place.path, place.params)
    place.recover("online", 302)

    place.fast_forward("online-2", place.bin, "anna", "ben")
    place.number(303)
    place.recover("targets", 303)

    place.recover("root", 303)
    place.forge("root", lambda _: None, "anna", "emil")  # anna's key is the stolen one
    place.refused(place.state, "root was signed by ")

    place.run(section("anew"))
    assert read_state(place.folder / "state-2").on_trial is not None
