"""The fault memory: latched faults are stored, listed and cleared."""

import json
import shutil
from pathlib import Path
from typing import Any

import pytest

from ecu_node.bus.faults import FaultMemory
from ecu_node.core.status import Reason, State
from ecu_node.update.state import state_path
from tests.ecu_node.junctions import Junction, driving, three_branches
from tests.ecu_node.processes import ecu_node, running
from tests.ecu_node.vehicles import LAYOUT, AtOnce


class Vehicle:
    """A node with a state folder; :meth:`start` starts it again."""

    def __init__(self, folder: Path) -> None:
        self.state = folder / "state"
        self.state.mkdir()
        state_path(self.state).touch()  # what it says does not matter here
        self.file = self.state / "faults.json"
        self.database = three_branches(folder)
        self.said: list[str] = []
        self.start()

    def start(self) -> None:
        self.now_s = 0.0
        self.junction = Junction(self.database)
        self.corrector = self.junction.corrector
        self.memory = FaultMemory(self.corrector, self.state, self.said.append, AtOnce())

    def later(self, seconds: float) -> None:
        """Let time pass on a bus on which nobody sends."""
        for _ in range(round(seconds)):
            self.now_s += 1.0
            self.corrector.look(self.now_s)
            self.memory.look(self.now_s)

    def latch(self, reason: Reason, *branches: str) -> None:
        self.corrector.latch(reason, branches)
        self.memory.look(self.now_s)

    def latched(self) -> Reason:
        return self.corrector.latched

    def clear(self) -> str:
        """Clear the memory; return what the command printed."""
        done = ecu_node("clear", "--state", self.state)
        assert done.code == 0
        self.later(2.0)
        return done.out.removeprefix(f"{self.state}: ").rstrip()

    def faults(self) -> Any:
        return json.loads(ecu_node("faults", "--state", self.state, "--json").out)


@pytest.fixture
def vehicle(tmp_path: Path) -> Vehicle:
    return Vehicle(tmp_path)


def test_fault_is_stored_with_its_currents(vehicle: Vehicle) -> None:
    assert vehicle.faults() == []
    vehicle.junction.run(5.0, driving)
    vehicle.junction.wrong = {"battery": lambda shown_a: shown_a + 100.0}
    vehicle.junction.run(1.0, driving)
    vehicle.memory.look(6.0)
    (fault,) = vehicle.faults()
    assert (fault["reason"], fault["branches"], fault["count"]) == ("SUM_IMPLAUSIBLE", ["battery"], 1)
    assert fault["active"]
    assert sum(fault["corrected_a"].values()) == pytest.approx(100.0, abs=10.0)
    assert "SUM_IMPLAUSIBLE (battery), active: 1 times" in ecu_node("faults", "--state", vehicle.state).out


@pytest.mark.parametrize(("number", "latched"), [(300, Reason.SUM_IMPLAUSIBLE), (44, Reason.NONE)])
def test_latched_fault_survives_a_restart_until_it_is_cleared(vehicle: Vehicle, number: int, latched: Reason) -> None:
    """With the same parameter set; with another one the node corrects from the start."""
    vehicle.latch(Reason.SUM_IMPLAUSIBLE, "battery")
    vehicle.file.write_text(vehicle.file.read_text().replace('"parameter_set": 300', f'"parameter_set": {number}'))
    vehicle.start()
    vehicle.later(3.0)
    assert vehicle.latched() is latched
    vehicle.clear()
    assert vehicle.latched() is Reason.NONE
    assert vehicle.faults() == []


def test_latched_fault_survives_a_start_at_which_its_parameters_are_not_valid_yet(vehicle: Vehicle) -> None:
    """As where the clock is set only later."""
    vehicle.latch(Reason.SUM_IMPLAUSIBLE, "battery")
    corrector = vehicle.corrector
    number, corrector.reason, corrector.parameter_set = corrector.parameter_set, Reason.NOT_VALID_NOW, 0
    corrector.latch(Reason.NONE)
    vehicle.memory = FaultMemory(corrector, vehicle.state, vehicle.said.append, AtOnce())
    vehicle.later(2.0)
    assert vehicle.latched() is Reason.NONE
    corrector.begin(reason=Reason.NONE, parameter_set=number)
    vehicle.later(2.0)
    assert vehicle.latched() is Reason.SUM_IMPLAUSIBLE
    assert [(fault["active"], fault["count"]) for fault in vehicle.faults()] == [(True, 1)]


def test_bus_sleep_releases_a_stale_branch_and_a_short_gap_does_not(vehicle: Vehicle) -> None:
    """Sleep does not release faults that the junction sum revealed."""
    for count in (1, 2):
        vehicle.latch(Reason.BRANCH_STALE, "motor")
        for seconds, latched in ((2.0, Reason.BRANCH_STALE), (7.0, Reason.NONE)):
            vehicle.later(seconds)
            assert vehicle.latched() is latched
        assert [(fault["active"], fault["count"]) for fault in vehicle.faults()] == [(False, count)]
        vehicle.junction.run(0.1, driving)
        vehicle.later(1.0)
    vehicle.latch(Reason.SUM_IMPLAUSIBLE, "battery")
    vehicle.later(60.0)
    assert vehicle.latched() is Reason.SUM_IMPLAUSIBLE
    assert [fault["active"] for fault in vehicle.faults()] == [True, False], "the last one first"


def test_fault_that_cannot_be_stored_is_logged_once_and_stored_later(vehicle: Vehicle) -> None:
    shutil.rmtree(vehicle.state)
    vehicle.latch(Reason.SUM_IMPLAUSIBLE, "battery")
    vehicle.later(3.0)
    assert vehicle.latched() is Reason.SUM_IMPLAUSIBLE
    assert len([text for text in vehicle.said if "cannot keep the fault" in text]) == 1
    vehicle.state.mkdir()
    vehicle.later(62.0)
    (fault,) = vehicle.faults()
    assert (fault["reason"], fault["active"]) == ("SUM_IMPLAUSIBLE", True)
    vehicle.clear()
    assert vehicle.latched() is Reason.NONE


def test_fault_that_could_not_be_stored_is_cleared(vehicle: Vehicle) -> None:
    """Once: a later one is latched again."""
    away = vehicle.state.rename(vehicle.state.with_name("away"))
    vehicle.latch(Reason.SUM_IMPLAUSIBLE, "battery")
    away.rename(vehicle.state)
    assert vehicle.clear() == "no faults stored"
    assert vehicle.latched() is Reason.NONE
    vehicle.latch(Reason.SUM_IMPLAUSIBLE, "battery")
    vehicle.later(3.0)
    assert vehicle.latched() is Reason.SUM_IMPLAUSIBLE


def test_vanished_state_folder_does_not_clear_a_latched_fault(vehicle: Vehicle) -> None:
    vehicle.latch(Reason.SUM_IMPLAUSIBLE, "battery")
    vehicle.state.rename(vehicle.state.with_name("away"))
    vehicle.later(3.0)
    assert vehicle.latched() is Reason.SUM_IMPLAUSIBLE


def test_node_that_starts_without_its_state_folder_passes_values_through(vehicle: Vehicle) -> None:
    """As where it is not mounted yet: what was active is not known."""
    shutil.rmtree(vehicle.state)
    vehicle.start()
    assert vehicle.latched() is Reason.SUM_IMPLAUSIBLE


def test_cleared_faults_do_not_return(vehicle: Vehicle) -> None:
    vehicle.latch(Reason.BRANCH_STALE, "motor")
    vehicle.latch(Reason.NONE)
    vehicle.latch(Reason.BRANCH_STUCK, "motor")
    assert vehicle.clear() == "2 faults cleared"
    vehicle.latch(Reason.BRANCH_STUCK, "battery")
    assert [fault["reason"] for fault in vehicle.faults()] == ["BRANCH_STUCK"]
    assert vehicle.clear() == "1 fault cleared"
    assert vehicle.clear() == "no faults stored"


DAMAGE = [
    ("[", "{", "cannot read the fault memory: "),
    ("BRANCH_STALE", "OF_A_LATER_VERSION", "cannot read the fault memory: unknown reason 'OF_A_LATER_VERSION'"),
    ("", None, "cannot read the fault memory: it is a folder"),
]


@pytest.mark.parametrize(("old", "new", "why"), DAMAGE)
def test_unreadable_fault_memory_lets_values_through(vehicle: Vehicle, old: str, new: str | None, why: str) -> None:
    """The damaged file stays as it is until then; bus sleep changes nothing."""
    vehicle.latch(Reason.BRANCH_STALE, "motor")
    content = vehicle.file.read_text()
    vehicle.file.unlink()
    if new is None:
        vehicle.file.mkdir()
    else:
        vehicle.file.write_text(content.replace(old, new, 1))
    vehicle.start()
    assert why in vehicle.said[-1]
    vehicle.later(60.0)
    assert (vehicle.latched(), vehicle.corrector.state()[0]) == (Reason.SUM_IMPLAUSIBLE, State.PASSING_THROUGH)
    code, _, err = ecu_node("faults", "--state", vehicle.state)
    assert code == 1
    assert "'ecu-node clear' begins a new one" in err
    if new is None:
        vehicle.file.rmdir()
    assert vehicle.clear() == (
        "no faults stored" if new is None else "a fault memory that could not be read is cleared"
    )
    assert vehicle.latched() is Reason.NONE
    assert vehicle.faults() == []


def test_node_without_vehicle_state_passes_values_through_and_logs_why(tmp_path: Path) -> None:
    bus = ["--interface", "virtual", "--channel", "state"]
    with running("run", "--state", str(tmp_path), "--layout", str(LAYOUT), *bus) as log:
        assert log[-1].endswith("running on virtual state, correcting nothing\n")
    why = f"{tmp_path}: no state of a vehicle there; make one with 'ecu-node provision'"
    assert f"ecu-node: passing measured values through: {why}\n" in log
