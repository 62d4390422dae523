"""Parameters of a running node: replaced by what fits, kept otherwise."""

import os
from collections.abc import Callable
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


@pytest.mark.parametrize(
    ("spoil", "reason", "words"),
    [
        *(
            (lambda whole, cut=cut: whole[:cut], Reason.MALFORMED_PARAMETERS, "not a parameter file")
            for cut in (0, 1, 300)
        ),
        (
            lambda whole: whole.replace(b'"v1"', b'"v2"'),
            Reason.WRONG_VEHICLE,
            "parameters are for vehicle 'v2', this is",
        ),
        (lambda _: None, Reason.NO_PARAMETERS, "no such parameter file; name one that is there"),
    ],
    ids=["empty", "one byte", "half written", "of another vehicle", "gone"],
)
def test_unfit_file_changes_nothing_until_a_fit_one_comes(
    path: Path, database: VehicleDatabase, spoil: Callable[[bytes], bytes | None], reason: Reason, words: str
) -> None:
    """In a running node what was in force stays; one that starts with it passes through, and publishes why."""
    whole, running = path.read_bytes(), Running(path, database)
    if (content := spoil(whole)) is None:
        path.unlink()
    else:
        path.write_bytes(content)
    assert [running.file.look(running.corrector, now_s) for now_s in (2.0, 4.0)] == [False, False]
    assert (running.drift, running.corrector.reason) == (0.25, Reason.NONE)
    (line,) = running.said
    assert line.startswith(f"new parameters are not used, those before stay in force: {path}: {words}")
    started = Running(path, database)
    assert (started.drift, started.corrector.reason) == (0.0, reason)
    assert (started.file.in_force.why_not or "").startswith(f"{path}: {words}")
    path.write_bytes(whole.replace(b"0.25", b"0.15"))
    for node in (running, started):
        assert node.file.look(node.corrector, 6.0)
        assert (node.drift, node.corrector.reason) == (0.15, Reason.NONE)
    assert running.corrector.counters.reload_failures == 1


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
