"""Parameters of a running node: replaced by what fits, kept otherwise."""

import os
from pathlib import Path

import pytest

from ecu_node.bus.run import ParameterFile
from ecu_node.bus.wiring import Mode, wire
from ecu_node.core.corrector import Corrector
from ecu_node.core.status import Reason
from ecu_node.database import VehicleDatabase
from ecu_node.parameters import write_parameters
from tests.ecu_node.vehicles import SMALL_DBC, MakeDatabase, parameters_for


@pytest.fixture
def path(database: VehicleDatabase, tmp_path: Path) -> Path:
    path = tmp_path / "v1.json"
    write_parameters(parameters_for(database, battery=(0.25, 5.0)), path)
    return path


class Running:
    """A corrector with its parameter file, and what was said."""

    def __init__(self, path: Path, database: VehicleDatabase, *, mode: Mode = Mode.OVERLAY) -> None:
        self.said: list[str] = []
        self.file = ParameterFile(path, database, "v1", mode=mode, say=self.said.append)
        self.corrector: Corrector = wire(database, self.file.in_force, 0.0, mode=mode)
        self.file.look(self.corrector, 0.0)

    @property
    def drift(self) -> float:
        return self.corrector.branches[0].fault.drift


def test_a_changed_file_is_put_in_force_within_a_second(path: Path, database: VehicleDatabase) -> None:
    """Also one of the same size and time."""
    running, before = Running(path, database), path.stat()
    assert (running.drift, running.file.look(running.corrector, 5.0)) == (0.25, False)
    path.write_bytes(path.read_bytes().replace(b"0.25", b"0.15"))
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))
    assert path.stat().st_size == before.st_size
    assert not running.file.look(running.corrector, 5.5), "it looks once a second"
    assert running.file.look(running.corrector, 6.0)
    assert (running.drift, running.corrector.counters.reloads) == (0.15, 1)
    assert running.said == ["parameter set 300 of vehicle v1 is in force"]


@pytest.mark.parametrize("cut", [0, 1, 300])
def test_half_written_file_changes_nothing(path: Path, database: VehicleDatabase, tmp_path: Path, cut: int) -> None:
    running = Running(path, database)
    write_parameters(parameters_for(database, battery=(0.125, 5.0)), tmp_path / "new.json")
    whole = (tmp_path / "new.json").read_bytes()
    path.write_bytes(whole[:cut])
    assert not running.file.look(running.corrector, 2.0)
    assert (running.drift, running.corrector.reason) == (0.25, Reason.NONE)
    (line,) = running.said
    assert line.startswith(f"new parameters are not used, those before stay in force: {path}: not a parameter file")
    assert not running.file.look(running.corrector, 4.0)
    path.write_bytes(whole)
    assert running.file.look(running.corrector, 6.0)
    assert running.drift == 0.125
    assert running.corrector.counters.reload_failures == 1


def test_a_file_that_is_gone_or_of_another_vehicle_changes_nothing(path: Path, database: VehicleDatabase) -> None:
    running = Running(path, database)
    path.write_bytes(path.read_bytes().replace(b'"v1"', b'"v2"'))
    assert not running.file.look(running.corrector, 2.0)
    path.unlink()
    assert not running.file.look(running.corrector, 4.0)
    assert running.drift == 0.25
    assert "parameters are for vehicle 'v2', this is 'v1'" in running.said[0]
    assert running.said[1].endswith("no such parameter file; name one that is there")


@pytest.mark.parametrize(
    ("old", "new", "reason", "words"),
    [
        (b"{", b"", Reason.MALFORMED_PARAMETERS, "not a parameter file"),
        (b'"v1"', b'"v2"', Reason.WRONG_VEHICLE, "parameters are for vehicle 'v2', this is 'v1'"),
    ],
)
def test_file_that_comes_later_is_used(
    path: Path, database: VehicleDatabase, old: bytes, new: bytes, reason: Reason, words: str
) -> None:
    """What stood there at the start is not used, and why is published."""
    content = path.read_bytes()
    path.write_bytes(content.replace(old, new, 1))
    running = Running(path, database)
    assert (running.drift, running.corrector.reason) == (0.0, reason)
    assert (running.file.in_force.why_not or "").startswith(f"{path}: {words}")
    path.write_bytes(content)
    assert running.file.look(running.corrector, 2.0)
    assert (running.corrector.reason, running.drift) == (Reason.NONE, 0.25)


@pytest.mark.parametrize("mode", [Mode.OVERLAY, Mode.GATEWAY])
def test_after_a_change_all_is_as_after_a_start(make_database: MakeDatabase, path: Path, mode: Mode) -> None:
    """Measured and corrected signal count differently here."""
    database = make_database(dbc=SMALL_DBC.replace("SG_ Battery : 0|16@1- (0.1,0)", "SG_ Battery : 0|16@1- (0.2,0)"))
    write_parameters(parameters_for(database, motor=(0.0, 1.0)), path)
    running = Running(path, database, mode=mode)
    write_parameters(parameters_for(database, battery=(0.125, 5.0)), path)
    assert running.file.look(running.corrector, 2.0)
    fresh = wire(database, running.file.in_force, 2.0, mode=mode)
    for live, new in zip(running.corrector.branches, fresh.branches, strict=True):
        assert (live.plan, live.fault) == (new.plan, new.fault)
        assert live.deadline_s == new.deadline_s
