"""A running node whose state is damaged or cannot be written: what was in force stays, and the node goes on."""

import shutil
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from msgspec.structs import replace

from ecu_node.corrector import Corrector
from ecu_node.database import VehicleDatabase
from ecu_node.guard import Mode
from ecu_node.parameters import VehicleParameters
from ecu_node.status import Reason
from ecu_node.trust.activation import accept
from ecu_node.trust.parameter_store import ParameterStore
from ecu_node.trust.state import read_state
from ecu_node.trust.storage import locked
from ecu_node.trust.trial import Trial, TrialResult
from ecu_node.wiring import wire
from tests.trust.damage import a_folder, cut, without, zeros
from tests.trust.signing import Signers

DAY = timedelta(days=1)
DRIFT = 0.05


class Running:
    """A corrector with the store of its parameters, in time that is counted."""

    def __init__(self, state: Path, database: VehicleDatabase) -> None:
        self.said: list[str] = []
        self.store = ParameterStore(
            state, database, mode=Mode.OVERLAY, say=self.said.append, now=lambda: datetime.now(UTC)
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


class _Ended(Trial):
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
    monkeypatch.setattr("ecu_node.trust.parameter_store.Trial", _Ended)
    now = datetime.now(UTC)
    battery = replace(parameters.branches["battery"], drift=0.06)
    other = replace(parameters, branches={**parameters.branches, "battery": battery})
    accept(two_slots, signers.parameters(other, 7, not_before=now - DAY), "f", database, now)
    running = Running(two_slots, database)
    monkeypatch.setattr(running.corrector.watch, "is_whole", lambda: True)
    return running


def test_a_trial_whose_end_cannot_be_kept_now_is_kept_later(two_slots: Path, ended: Running) -> None:
    with locked(two_slots):
        for now_s in range(0, 59, 2):
            ended.store.look(ended.corrector, float(now_s))
    assert (ended.drift, read_state(two_slots).on_trial) == (DRIFT, "a")
    assert ended.said[1:] == [
        f"how the trial of number 7 ended cannot be kept, what was in force stays: {two_slots}: another process "
        f"changes it now; try again"
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
