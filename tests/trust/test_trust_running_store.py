"""A running node whose state is damaged or cannot be written: what was in force stays, and the node goes on."""

import os
import shutil
import threading
from collections.abc import Callable
from concurrent.futures import Executor, ThreadPoolExecutor
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from msgspec.structs import replace

from ecu_node.bus.wiring import Mode, wire
from ecu_node.core.corrector import Corrector
from ecu_node.core.status import Reason, TrustError, UnfitError
from ecu_node.database import VehicleDatabase
from ecu_node.parameters import JunctionResidual, VehicleParameters
from ecu_node.trust.activation import accept
from ecu_node.trust.parameter_store import ParameterStore
from ecu_node.trust.state import TrustState, audit_path, read_state
from ecu_node.trust.storage import locked
from ecu_node.trust.trial import ParameterTrial, TrialResult
from tests.trust.damage import a_folder, cut, without, zeros
from tests.trust.signing import Signers

DAY = timedelta(days=1)
DRIFT = 0.05


class Running:
    """A corrector with the store of its parameters, in time that is counted."""

    def __init__(
        self,
        state: Path,
        database: VehicleDatabase,
        *,
        now: Callable[[], datetime] = lambda: datetime.now(UTC),
        background: Executor | None = None,
    ) -> None:
        self.said: list[str] = []
        self.now = now
        self.store = ParameterStore(
            state,
            database,
            mode=Mode.OVERLAY,
            say=self.said.append,
            now=lambda: self.now(),  # noqa: PLW0108  # it may be another one later
            background=background,
        )
        self.corrector: Corrector = wire(database, self.store.in_force, 0.0)

    @property
    def drift(self) -> float:
        return self.corrector.branches[0].fault.drift


@pytest.mark.parametrize("damage", [without, cut, zeros, a_folder])
def test_a_state_that_is_damaged_under_a_running_node_leaves_what_was_in_force(
    damage: Callable[[Path], None], two_slots: Path, database: VehicleDatabase
) -> None:
    running = Running(two_slots, database)
    whole = (two_slots / "state.json").read_bytes()
    damage(two_slots / "state.json")
    for now_s in (2.0, 4.0, 6.0):
        assert not running.store.look(running.corrector, now_s)
    assert running.drift == DRIFT
    (line,) = running.said
    assert line.startswith("the state of the vehicle is not read, what was in force stays: ")
    shutil.rmtree(two_slots / "state.json", ignore_errors=True)
    (two_slots / "state.json").write_bytes(whole)
    running.store.look(running.corrector, 8.0)
    assert (running.drift, len(running.said)) == (DRIFT, 1)


def test_a_state_that_is_mended_under_a_running_node_is_used(two_slots: Path, database: VehicleDatabase) -> None:
    whole = (two_slots / "state.json").read_bytes()
    cut(two_slots / "state.json")
    running = Running(two_slots, database)
    assert running.corrector.reason is Reason.MALFORMED_PARAMETERS
    assert not running.store.look(running.corrector, 1.0)
    (two_slots / "state.json").write_bytes(whole)
    assert running.store.look(running.corrector, 3.0)
    assert (running.drift, running.corrector.reason) == (DRIFT, Reason.NONE)


class _Ended(ParameterTrial):
    """A trial that has seen enough."""

    def look(self, now_s: float) -> TrialResult | None:
        return TrialResult(passed=True, text="seen")


@pytest.fixture
def ended(
    two_slots: Path,
    signers: Signers,
    parameters: VehicleParameters,
    database: VehicleDatabase,
    monkeypatch: pytest.MonkeyPatch,
) -> Running:
    """A node whose trial of number 7, with a drift of 0.06, ends well as soon as it is looked at."""
    monkeypatch.setattr("ecu_node.trust.trial.ParameterTrial", _Ended)
    now = datetime.now(UTC)
    battery = replace(parameters.branches["battery"], drift=0.06)
    other = replace(parameters, branches={**parameters.branches, "battery": battery})
    accept(two_slots, signers.parameters(other, 7, not_before=now - DAY), "f", database, now)
    running = Running(two_slots, database)
    monkeypatch.setattr(running.corrector.watch, "is_whole", lambda _: True)
    return running


def test_a_trial_whose_end_cannot_be_kept_now_is_kept_later(two_slots: Path, ended: Running) -> None:
    with locked(two_slots):
        for now_s in range(0, 59, 2):
            ended.store.look(ended.corrector, float(now_s))
    assert (ended.drift, read_state(two_slots).on_trial) == (DRIFT, "a")
    assert ended.said[1:] == [
        f"how the trial of number 7 ended cannot be kept now, what was in force stays, and it is tried again in 60 s: "
        f"{two_slots}: another process changes it now"
    ]
    for now_s in range(60, 70, 2):
        ended.store.look(ended.corrector, float(now_s))
    assert (ended.drift, read_state(two_slots).in_force) == (0.06, "a")


@pytest.mark.parametrize("damage", [without, cut, a_folder])
def test_a_trial_in_a_damaged_state_does_not_end_the_node(
    damage: Callable[[Path], None], two_slots: Path, ended: Running
) -> None:
    damage(two_slots / "state.json")
    for now_s in (1.0, 3.0, 5.0):
        ended.store.look(ended.corrector, now_s)
    assert ended.drift == DRIFT
    assert all(line.isprintable() for line in ended.said)


def test_a_set_that_is_damaged_during_its_trial_does_not_come_in_force(two_slots: Path, ended: Running) -> None:
    ended.store.look(ended.corrector, 0.0)
    (two_slots / "slot-a.json").write_bytes(b"{}")
    for now_s in (2.0, 4.0):
        ended.store.look(ended.corrector, now_s)
    assert (ended.drift, read_state(two_slots).in_force, read_state(two_slots).on_trial) == (DRIFT, "b", None)


def test_a_trial_begins_once_the_clock_is_set(
    two_slots: Path, signers: Signers, parameters: VehicleParameters, database: VehicleDatabase
) -> None:
    """As where the time comes from a satellite some seconds after the start."""
    now = datetime.now(UTC)
    accept(two_slots, signers.parameters(parameters, 7, not_before=now - DAY), "f", database, now)
    running = Running(two_slots, database, now=lambda: now - 1000 * DAY)
    assert running.corrector.reason is Reason.NOT_VALID_NOW
    for now_s in range(0, 110, 2):  # it is tried again each minute, and told once
        running.store.look(running.corrector, float(now_s))
    (line,) = running.said
    assert line.startswith("no trial yet: ")
    assert "is the clock set?" in line
    running.now = lambda: now
    for now_s in range(110, 130, 2):
        running.store.look(running.corrector, float(now_s))
    assert (running.drift, running.corrector.reason) == (DRIFT, Reason.NONE)
    assert "number 7 is on trial: parameter set 300" in running.said


def test_a_state_that_could_not_be_read_for_a_moment_is_read_again(
    two_slots: Path, signers: Signers, database: VehicleDatabase, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Else a revocation would not be heeded before the next start."""
    running = Running(two_slots, database)
    accept(two_slots, signers.revocation(7, 5, 6), "f", database, datetime.now(UTC))
    with monkeypatch.context() as broken:
        broken.setattr("ecu_node.trust.parameter_store.read_state", a_broken_disk)
        assert not running.store.look(running.corrector, 2.0)
        assert not running.store.look(running.corrector, 4.0)
    assert running.store.look(running.corrector, 6.0)
    assert running.corrector.reason is Reason.REVOKED
    assert [line.partition(": ")[0] for line in running.said] == [
        "the state of the vehicle is not read, what was in force stays",
        "numbers 5, 6 were revoked; nothing is in force",
        "passing measured values through",
    ]


def a_broken_disk(folder: Path) -> TrustState:
    raise TrustError(Reason.NO_PARAMETERS, f"{folder}: Input/output error")


def test_what_is_in_force_expires_also_while_the_state_cannot_be_read(
    two_slots: Path, database: VehicleDatabase
) -> None:
    running = Running(two_slots, database)
    (two_slots / "state.json").unlink()
    assert not running.store.look(running.corrector, 2.0)
    running.now = lambda: datetime.now(UTC) + 400 * DAY
    assert running.store.look(running.corrector, 4.0)
    assert running.corrector.reason is Reason.NOT_VALID_NOW


def test_a_slow_disk_does_not_hold_the_node_up_at_the_end_of_a_trial(
    two_slots: Path, ended: Running, database: VehicleDatabase, monkeypatch: pytest.MonkeyPatch
) -> None:
    writing, may_go_on = threading.Event(), threading.Event()

    def slow_fsync(handle: int, fsync: Callable[[int], None] = os.fsync) -> None:
        writing.set()
        assert may_go_on.wait(20.0)
        fsync(handle)

    monkeypatch.setattr("ecu_node.trust.storage.os.fsync", slow_fsync)
    with ThreadPoolExecutor(1) as background:
        running = Running(two_slots, database, background=background)
        monkeypatch.setattr(running.corrector.watch, "is_whole", lambda _: True)
        for now_s in range(0, 10, 2):
            running.store.look(running.corrector, float(now_s))
        assert writing.wait(20.0)
        running.store.look(running.corrector, 10.0)
        assert (running.drift, read_state(two_slots).on_trial) == (DRIFT, "a")
        may_go_on.set()
    for now_s in range(12, 20, 2):
        running.store.look(running.corrector, float(now_s))
    assert (running.drift, read_state(two_slots).in_force) == (0.06, "a")
    assert "number 7 has passed its trial: seen" in running.said


def test_a_set_that_expires_during_its_trial_leaves_what_was_in_force(
    two_slots: Path, ended: Running, signers: Signers, parameters: VehicleParameters, database: VehicleDatabase
) -> None:
    now = datetime.now(UTC)
    short = signers.parameters(parameters, 8, not_before=now - DAY, expires=now + DAY)
    accept(two_slots, short, "f", database, now)
    ended.store.look(ended.corrector, 0.0)
    ended.store.look(ended.corrector, 0.1)
    assert ended.said[-1] == "number 8 is on trial: parameter set 300"
    ended.now = lambda: now + 2 * DAY
    for now_s in (2.0, 4.0, 6.0):
        ended.store.look(ended.corrector, now_s)
    assert (ended.drift, read_state(two_slots).in_force, read_state(two_slots).on_trial) == (DRIFT, "b", None)
    assert "expired at" in audit_path(two_slots).read_text().splitlines()[-1]
    assert ended.said[-1].startswith("number 8 is not in force, though its trial went well")


def test_sums_that_no_vehicle_has_are_refused_and_end_no_node(
    two_slots: Path, signers: Signers, parameters: VehicleParameters, database: VehicleDatabase
) -> None:
    now = datetime.now(UTC)
    wrong = replace(parameters, junction_residual=JunctionResidual(measured_a=1e200, corrected_a=0.1))
    with pytest.raises(UnfitError, match=r"junction_residual\.measured_a") as caught:
        accept(two_slots, signers.parameters(wrong, 7, not_before=now - DAY), "f", database, now)
    assert caught.value.reason is Reason.MALFORMED_PARAMETERS
