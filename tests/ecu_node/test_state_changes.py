"""Lines in the log: each fall-back, each sleep, and their ends, once each."""

import pytest

from ecu_node.bus.run import StateChanges
from ecu_node.bus.wiring import InForce, Mode, put_in_force
from ecu_node.core.status import Reason
from ecu_node.database import VehicleDatabase
from tests.ecu_node.vehicles import answers, battery, corrector_for, parameters_for

FALLS_BACK = "passing measured values through until"


class Node:
    """A node whose battery may send; what it says of its state."""

    def __init__(self, database: VehicleDatabase, *, has_memory: bool = True) -> None:
        self.database, self.now_s = database, 0.0
        self.corrector = corrector_for(database, battery=(0.0, 5.0))
        self.changes = StateChanges(self.corrector, has_memory=has_memory)

    def drive(self) -> str | None:
        answers(self.corrector, battery(self.database, round(self.now_s) % 15), self.now_s)
        return self.later(0.02)

    def later(self, seconds: float) -> str | None:
        self.now_s += seconds
        self.corrector.look(self.now_s)
        news = self.changes.news()
        assert self.changes.news() is None, "once each"
        return news

    def latch(self, reason: Reason, *branches: str) -> str | None:
        self.corrector.latch(reason, branches)
        return self.changes.news()

    def load(self, in_force: InForce) -> str | None:
        put_in_force(self.corrector, self.database, in_force, self.now_s, mode=Mode.OVERLAY)
        return self.changes.news()


@pytest.mark.parametrize("before", [Reason.NONE, Reason.BRANCH_STALE])
@pytest.mark.parametrize("revoked", [False, True])
def test_every_bus_silence_and_its_end_are_reported(database: VehicleDatabase, before: Reason, revoked: bool) -> None:
    """After a fall-back, or without parameters, in the same way."""
    node = Node(database)
    assert node.drive() is None
    node.latch(before, "motor")
    if revoked:
        assert node.load(InForce(parameters=None, reason=Reason.REVOKED)) is None, "it does not correct again"
    for _ in range(2):
        assert [node.later(1.0), node.later(6.0), node.drive()] == ["no branch sends", None, "branches send again"]


def test_fall_back_is_reported_with_reason_end_and_resumption(database: VehicleDatabase) -> None:
    node = Node(database)
    stuck = node.latch(Reason.BRANCH_STUCK, "motor", "dcdc")
    assert stuck == f"{FALLS_BACK} the bus has slept: {Reason.BRANCH_STUCK.words} (motor, dcdc)"
    wrong = node.latch(Reason.SUM_IMPLAUSIBLE, "motor", "dcdc")
    until = f"{FALLS_BACK} other parameters or 'ecu-node clear'"
    assert wrong == f"{until}: {Reason.SUM_IMPLAUSIBLE.words} (motor or dcdc)"
    assert node.latch(Reason.CORRECTION_WORSE) == f"{until}: {Reason.CORRECTION_WORSE.words}"
    fit = InForce(parameters=parameters_for(database, battery=(0.0, 5.0)))
    assert node.load(fit) == "correcting again"
    alone = Node(database, has_memory=False)
    assert f"{FALLS_BACK} a restart: " in (alone.latch(Reason.CORRECTION_WORSE) or "")


def test_revocation_during_bus_sleep_is_not_reported_as_waking_up(database: VehicleDatabase) -> None:
    node = Node(database)
    assert [node.drive(), node.later(1.0)] == [None, "no branch sends"]
    assert node.load(InForce(parameters=None, reason=Reason.REVOKED)) is None
