"""A running node whose state is damaged or cannot be written: what was in force stays, and the node goes on."""

import os
import shutil
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from datetime import timedelta
from pathlib import Path

import msgspec
import pytest
from msgspec.structs import replace

from ecu_node.bus.faults import Fault
from ecu_node.core.status import Reason, TrustError
from ecu_node.database import VehicleDatabase
from ecu_node.parameters import VehicleParameters
from ecu_node.update.state import VehicleState, locked, read_state, write_state
from ecu_node.update.trial import ParameterTrial, TrialResult
from tests.ecu_node.processes import ServiceManagerHere, running
from tests.ecu_node.vehicles import LAYOUT
from tests.update.damage import a_folder, cut, without
from tests.update.held import NOW, Running, held, put_on_trial

DRIFT, OTHER_DRIFT = 0.05, 0.06


class _Ended(ParameterTrial):
    """A trial that has passed as soon as it is looked at."""

    def look(self, now_s: float) -> TrialResult | None:
        return TrialResult(passed=True, text="seen")


@pytest.fixture
def ended(state: Path, other: VehicleParameters, database: VehicleDatabase, monkeypatch: pytest.MonkeyPatch) -> Running:
    """A node with set 300 in force, whose trial of set 301 passes at its first look."""
    monkeypatch.setattr("ecu_node.update.store.ParameterTrial", _Ended)
    put_on_trial(state, other)
    running = Running(state, database)
    monkeypatch.setattr(running.corrector.watch, "is_whole", lambda _: True)
    return running


@pytest.mark.parametrize("damage", [without, cut, a_folder])
def test_damaged_state_keeps_parameters(damage: Callable[[Path], None], state: Path, database: VehicleDatabase) -> None:
    """A running node keeps the set in force; a node that starts with a damaged state passes values through."""
    running, path = Running(state, database), state / "state.json"
    whole = path.read_bytes()
    damage(path)
    assert not any(running.look(2.0, 4.0, 6.0))
    assert running.drift == DRIFT
    (line,) = running.said
    assert line.startswith("the state of the vehicle is not read, what was in force stays: ")
    running.now = NOW + timedelta(days=400)
    assert running.look(8.0) == [True], "it expires all the same"
    assert running.corrector.reason is Reason.NOT_VALID_NOW
    started = Running(state, database)
    assert started.corrector.reason in (Reason.MALFORMED_PARAMETERS, Reason.NO_PARAMETERS)
    assert not any(started.look(1.0))
    shutil.rmtree(path, ignore_errors=True)
    path.write_bytes(whole)
    assert started.look(3.0) == [True]
    assert (started.drift, started.corrector.reason) == (DRIFT, Reason.NONE)
    running.now = NOW
    running.look(10.0)
    assert running.drift == DRIFT


def test_state_of_another_vehicle_is_not_used(state: Path, database: VehicleDatabase) -> None:
    in_force = Running(state, database, vehicle="v2").store.in_force
    assert in_force.reason is Reason.WRONG_VEHICLE
    assert in_force.why_not is not None


def test_end_of_a_trial_is_written_later_if_the_state_is_locked(state: Path, ended: Running) -> None:
    with locked(state):
        ended.look(*range(0, 59, 2))
    assert (ended.drift, read_state(state).on_trial is None) == (DRIFT, False)
    (line,) = ended.said[1:]
    assert line.startswith("a decision cannot be written now, what was in force stays, and it is tried again in 60 s: ")
    ended.look(*range(60, 70, 2))
    assert (ended.drift, read_state(state).on_trial) == (OTHER_DRIFT, None)


def test_changed_state_is_read_again_after_a_read_error(
    state: Path, database: VehicleDatabase, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Otherwise a revocation would take effect only at the next start."""

    def broken_disk(folder: Path) -> VehicleState:
        raise TrustError(Reason.NO_PARAMETERS, f"{folder}: Input/output error")

    running = Running(state, database)
    write_state(state, replace(read_state(state), in_force=None, ended="revoked"))
    with monkeypatch.context() as broken:
        broken.setattr("ecu_node.update.store.read_state", broken_disk)
        assert not any(running.look(2.0, 4.0))
    assert running.look(6.0) == [True]
    assert running.corrector.reason is Reason.REVOKED


def test_slow_disk_does_not_block_the_node(
    state: Path, ended: Running, database: VehicleDatabase, monkeypatch: pytest.MonkeyPatch
) -> None:
    writing, may_go_on = threading.Event(), threading.Event()

    def slow_fsync(handle: int, fsync: Callable[[int], None] = os.fsync) -> None:
        writing.set()
        assert may_go_on.wait(20.0)
        fsync(handle)

    monkeypatch.setattr("ecu_node.update.state.os.fsync", slow_fsync)
    with ThreadPoolExecutor(1) as background:
        running = Running(state, database, background=background)
        monkeypatch.setattr(running.corrector.watch, "is_whole", lambda _: True)
        running.look(*range(0, 10, 2))
        assert writing.wait(20.0)
        running.look(10.0)
        assert (running.drift, read_state(state).on_trial is None) == (DRIFT, False)
        may_go_on.set()
    running.look(*range(12, 20, 2))
    assert (running.drift, read_state(state).on_trial) == (OTHER_DRIFT, None)
    assert any("has passed its trial: seen" in line for line in running.said)


def test_set_expiring_on_trial_does_not_come_in_force(state: Path, ended: Running, other: VehicleParameters) -> None:
    put_on_trial(state, other, days=1)
    ended.look(2.0, 2.1)
    ended.now = NOW + timedelta(days=2)
    ended.look(4.0, 6.0, 8.0)
    assert (ended.drift, read_state(state).on_trial) == (DRIFT, None)
    assert "expired at" in (state / "decisions.log").read_text().splitlines()[-1]
    assert ended.said[-1].split(" is ")[1].startswith("not in force, though its trial went well")


def test_trial_starts_once_the_set_is_valid(state: Path, other: VehicleParameters, database: VehicleDatabase) -> None:
    put_on_trial(state, other, days=-1)
    running = Running(state, database)
    running.look(*range(0, 110, 2))
    (line,) = running.said
    assert line.startswith("no trial yet: ")
    put_on_trial(state, other)
    running.look(*range(110, 120, 2))
    assert running.said[-1].endswith(" is on trial")


def test_running_node_loads_a_set_written_to_its_state(
    new: Path, parameters: VehicleParameters, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It tells the service manager, too."""
    manager = ServiceManagerHere(tmp_path / "notify", monkeypatch)
    bus = ["--interface", "virtual", "--channel", "state"]
    with manager.socket, running("run", "--state", str(new), "--layout", str(LAYOUT), *bus) as log:
        write_state(new, replace(read_state(new), in_force=held(parameters, days=36500)))
        said = manager.wait_for("STATUS=parameter set")
    assert said == "STATUS=parameter set 300 is in force, correcting battery, motor"
    assert any("of vehicle v1 is in force" in line for line in log)


def test_node_that_starts_with_a_latched_fault_says_first_that_it_corrects_nothing(
    new: Path, parameters: VehicleParameters
) -> None:
    write_state(new, replace(read_state(new), in_force=held(parameters, days=36500)))
    fault = Fault(reason="SUM_IMPLAUSIBLE", branches=[], parameter_set=300, first="", last="")
    (new / "faults.json").write_bytes(msgspec.json.encode([fault]))
    options = ["--state", str(new), "--layout", str(LAYOUT), "--interface", "virtual", "--channel", "latched"]
    with running("run", *options) as log:
        pass
    assert log[0] == "ecu-node: running on virtual latched, correcting nothing\n"
    assert log[1].startswith("ecu-node: passing measured values through until other parameters or 'ecu-node clear': ")


def test_writer_waits_while_another_one_changes_the_state(state: Path) -> None:
    def change() -> None:
        with locked(state):
            pass

    with ThreadPoolExecutor(1) as pool:
        with locked(state):
            waiting = pool.submit(change)
            with pytest.raises(TimeoutError):
                waiting.result(0.1)
        waiting.result(30.0)
