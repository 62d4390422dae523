"""Lines in the log: each fall-back, each sleep, and their ends, once each."""

from collections.abc import Sequence

import pytest

from ecu_node.bus.run import StateChanges
from ecu_node.bus.wiring import InForce, Mode, key_of, put_in_force, wire
from ecu_node.core.status import Reason
from ecu_node.database import VehicleDatabase
from tests.ecu_node.vehicles import Frame, answers, parameters_for, protected

STEP_S = 0.02
BOTH = ("Battery", "Motor")
AGAIN = ["no branch sends", "branches send again"]
FALLS_BACK = "passing measured values through until the bus has slept: "


class Drive:
    """Frames of battery and motor, and a look after each round; the battery's offset is corrected by 5 A."""

    def __init__(self, database: VehicleDatabase) -> None:
        self.database = database
        fit = InForce(parameters=parameters_for(database, battery=(0.0, 5.0), motor=(0.0, 0.0)))
        self.corrector = wire(database, fit, 0.0)
        self.changes = StateChanges(self.corrector)
        self.now_s, self.round = 0.0, 0

    def go_on(self, duration_s: float, names: Sequence[str], error_a: float = 5.0, swing_a: float = 0.0) -> list[str]:
        """What is said meanwhile, with 20 A from battery to motor; the battery's may swing alone."""
        said = []
        for _ in range(round(duration_s / STEP_S)):
            self.now_s += STEP_S
            self.round += 1
            for name in names:
                more_a = error_a + swing_a * (self.round % 2) if name == "Battery" else 0.0
                data = protected(self.database, f"HV_{name}", self.round % 15, **{f"{name}Current": 20.0 + more_a})
                answers(self.corrector, Frame(key_of(self.database.message(f"HV_{name}")), data), self.now_s)
            self.corrector.look(self.now_s)
            said.append(self.changes.news())
        return [text for text in said if text is not None]

    def load(self, in_force: InForce) -> list[str | None]:
        put_in_force(self.corrector, self.database, in_force, self.now_s, mode=Mode.OVERLAY)
        return [self.changes.news(), self.changes.news()]


@pytest.fixture
def drive(database: VehicleDatabase) -> Drive:
    return Drive(database)


def test_every_silence_and_its_end_is_said_the_first_one_too(drive: Drive) -> None:
    assert drive.go_on(1.0, BOTH) == []
    assert [line for _ in range(3) for line in drive.go_on(1.0, ()) + drive.go_on(1.0, BOTH)] == 3 * AGAIN


@pytest.mark.parametrize("revoked", [False, True])
def test_a_silence_after_a_fall_back_is_said_in_the_same_way_also_without_parameters(
    drive: Drive, revoked: bool
) -> None:
    assert drive.go_on(1.0, BOTH) + drive.go_on(1.0, ("Battery",)) == [
        f"{FALLS_BACK}{Reason.BRANCH_STALE.words} (motor)"
    ]
    if revoked:
        assert drive.load(InForce(parameters=None, reason=Reason.REVOKED)) == [None, None], "it does not correct again"
    assert drive.go_on(7.0, ()) + drive.go_on(1.0, BOTH) == AGAIN


def test_a_correction_that_makes_it_worse_and_a_stuck_branch_are_said_and_that_it_corrects_again(drive: Drive) -> None:
    worse = "the corrected Kirchhoff sum is worse than the measured one"
    assert drive.go_on(12.0, BOTH, error_a=0.0) == [
        f"passing measured values through until other parameters or 'ecu-node clear': {worse}"
    ]
    parameters = parameters_for(drive.database, battery=(0.0, 5.0), motor=(0.0, 0.0))
    assert drive.load(InForce(parameters=parameters)) == ["correcting again", None]
    assert drive.go_on(12.0, BOTH, swing_a=40.0) == [f"{FALLS_BACK}{Reason.BRANCH_STUCK.words} (motor)"]


def test_a_node_without_a_fault_memory_says_that_a_restart_releases(drive: Drive) -> None:
    drive.changes = StateChanges(drive.corrector, has_memory=False)
    (line,) = drive.go_on(12.0, BOTH, error_a=0.0)
    assert "until other parameters or a restart: " in line


def test_parameters_that_are_taken_back_while_the_bus_sleeps_do_not_wake_it_up(drive: Drive) -> None:
    assert drive.go_on(1.0, BOTH) + drive.go_on(1.0, ()) == AGAIN[:1]
    assert drive.load(InForce(parameters=None, reason=Reason.REVOKED)) == [None, None]
    assert drive.go_on(1.0, BOTH) + drive.go_on(1.0, ()) == AGAIN[::-1]
