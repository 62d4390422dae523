"""The fault memory: what was latched is kept, told, and cleared."""

import json
from concurrent.futures import Executor, Future
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any

import pytest

from ecu_node.bus.faults import FaultMemory
from ecu_node.cli import main
from ecu_node.core.status import Reason, State
from tests.ecu_node.junctions import Junction, driving, three_branches


class AtOnce(Executor):
    """Does in the foreground what is to be done in the background."""

    def submit(self, fn: Any, /, *args: Any, **kwargs: Any) -> Future[Any]:
        done: Future[Any] = Future()
        done.set_result(fn(*args, **kwargs))
        return done


class Vehicle:
    """A node with a state folder; started anew as often as wanted."""

    def __init__(self, folder: Path) -> None:
        self.state = folder / "state"
        self.state.mkdir()
        self.database = three_branches(folder)
        self.said: list[str] = []
        self.start()

    def start(self) -> None:
        self.junction = Junction(self.database)
        self.corrector = self.junction.corrector
        self.memory = FaultMemory(self.corrector, self.state, self.said.append, AtOnce())

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds)):
            self.junction.run(1.0, driving)
            self.memory.look(self.junction.now_s)

    def sleep(self, seconds: float) -> None:
        start_s = self.junction.now_s
        for k in range(round(10.0 * seconds)):
            self.corrector.look(start_s + 0.1 * k)
        self.junction.step += round(seconds / self.junction.period_s)
        self.memory.look(self.junction.now_s)

    def break_battery(self) -> None:
        self.junction.wrong = {"battery": lambda shown_a: shown_a + 100.0}

    def faults(self) -> Any:
        with redirect_stdout(StringIO()) as said:
            assert main(["faults", "--state", str(self.state), "--json"]) == 0
        return json.loads(said.getvalue())


@pytest.fixture
def vehicle(tmp_path: Path) -> Vehicle:
    return Vehicle(tmp_path)


def test_a_fault_is_kept_with_its_currents(vehicle: Vehicle, capsys: pytest.CaptureFixture[str]) -> None:
    vehicle.run(5)
    assert vehicle.faults() == []
    vehicle.break_battery()
    vehicle.run(1)
    (fault,) = vehicle.faults()
    assert (fault["reason"], fault["branches"], fault["count"]) == ("SUM_IMPLAUSIBLE", ["battery"], 1)
    assert fault["active"]
    sum_a = sum(fault["corrected_a"].values())
    assert sum_a == pytest.approx(100.0, abs=10.0)
    assert main(["faults", "--state", str(vehicle.state)]) == 0
    assert "SUM_IMPLAUSIBLE (battery), active: 1 times" in capsys.readouterr().out


def test_what_was_latched_stays_so_over_a_restart_until_it_is_cleared(vehicle: Vehicle) -> None:
    vehicle.break_battery()
    vehicle.run(1)
    vehicle.start()
    vehicle.run(3)
    assert vehicle.corrector.state() == (State.PASSING_THROUGH, Reason.SUM_IMPLAUSIBLE)
    assert main(["clear", "--state", str(vehicle.state)]) == 0
    vehicle.run(3)
    assert vehicle.corrector.state() == (State.CORRECTING, Reason.NONE)
    assert vehicle.faults() == []


def test_a_fault_of_the_sums_stays_while_the_bus_sleeps(vehicle: Vehicle) -> None:
    vehicle.break_battery()
    vehicle.run(1)
    vehicle.sleep(60.0)
    assert vehicle.corrector.latched is Reason.SUM_IMPLAUSIBLE


def test_a_short_gap_on_the_bus_releases_nothing_and_sleep_does(vehicle: Vehicle) -> None:
    vehicle.run(5)
    vehicle.corrector.latch(Reason.BRANCH_STALE, ["motor"])
    vehicle.memory.look(vehicle.junction.now_s)
    vehicle.sleep(1.0)
    vehicle.run(2)
    assert vehicle.corrector.latched is Reason.BRANCH_STALE
    vehicle.sleep(7.0)
    vehicle.run(1)
    assert vehicle.corrector.state() == (State.CORRECTING, Reason.NONE)
    vehicle.corrector.latch(Reason.BRANCH_STALE, ["motor"])
    vehicle.memory.look(vehicle.junction.now_s)
    vehicle.sleep(7.0)
    (fault,) = vehicle.faults()
    assert (fault["active"], fault["count"]) == (False, 2)


def test_a_fault_that_could_not_be_kept_is_told_ends_nothing_and_is_kept_later(vehicle: Vehicle) -> None:
    vehicle.state.rmdir()
    vehicle.break_battery()
    vehicle.run(3)
    assert vehicle.corrector.latched is Reason.SUM_IMPLAUSIBLE
    assert len([text for text in vehicle.said if "cannot keep the fault" in text]) == 1
    vehicle.state.mkdir()
    vehicle.run(62)
    (fault,) = vehicle.faults()
    assert (fault["reason"], fault["active"]) == ("SUM_IMPLAUSIBLE", True)
    vehicle.junction.wrong = {}
    assert main(["clear", "--state", str(vehicle.state)]) == 0
    vehicle.run(3)
    assert vehicle.corrector.state() == (State.CORRECTING, Reason.NONE)


def test_a_state_folder_that_vanishes_clears_nothing(vehicle: Vehicle) -> None:
    vehicle.break_battery()
    vehicle.run(1)
    vehicle.junction.wrong = {}
    vehicle.state.rename(vehicle.state.with_name("away"))
    vehicle.run(3)
    assert vehicle.corrector.latched is Reason.SUM_IMPLAUSIBLE


def test_faults_that_are_over_are_cleared_for_good(vehicle: Vehicle) -> None:
    vehicle.corrector.latch(Reason.BRANCH_STALE, ["motor"])
    vehicle.memory.look(0.0)
    vehicle.corrector.release()
    vehicle.memory.look(0.0)
    assert main(["clear", "--state", str(vehicle.state)]) == 0
    vehicle.memory.look(2.0)
    vehicle.corrector.latch(Reason.BRANCH_STUCK, ["battery"])
    vehicle.memory.look(2.0)
    assert [fault["reason"] for fault in vehicle.faults()] == ["BRANCH_STUCK"]


def test_a_damaged_memory_is_one_line(vehicle: Vehicle, capsys: pytest.CaptureFixture[str]) -> None:
    (vehicle.state / "faults.json").write_text("{")
    vehicle.start()
    assert "cannot read the fault memory" in vehicle.said[-1]
    assert main(["faults", "--state", str(vehicle.state)]) == 1
    assert "'ecu-node clear' begins a new one" in capsys.readouterr().err
    (vehicle.state / "faults.json").unlink()
    (vehicle.state / "faults.json").mkdir()
    assert main(["faults", "--state", str(vehicle.state)]) == 1


def test_a_memory_with_an_unknown_reason_is_one_line(vehicle: Vehicle) -> None:
    vehicle.break_battery()
    vehicle.run(1)
    file = vehicle.state / "faults.json"
    file.write_text(file.read_text().replace("SUM_IMPLAUSIBLE", "OF_A_LATER_VERSION"))
    vehicle.start()
    assert "cannot read the fault memory: unknown reason 'OF_A_LATER_VERSION'" in vehicle.said[-1]


@pytest.mark.parametrize("command", ["faults", "clear"])
def test_a_folder_that_is_not_there_is_one_line(
    command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([command, "--state", str(tmp_path / "none")]) == 1
    assert "no such state folder" in capsys.readouterr().err


def test_another_set_is_tried(vehicle: Vehicle) -> None:
    vehicle.break_battery()
    vehicle.run(1)
    content = (vehicle.state / "faults.json").read_text()
    (vehicle.state / "faults.json").write_text(content.replace('"parameter_set": 44', '"parameter_set": 43'))
    vehicle.start()
    assert vehicle.corrector.latched is Reason.NONE
