"""A parameter set on trial in a node: what is right comes in force, what is wrong does not, and why."""

import math
import shutil
from collections.abc import Iterator
from datetime import timedelta
from itertools import count
from pathlib import Path

import pytest
from msgspec.structs import replace

from ecu_node.bus.wiring import Mode, wire
from ecu_node.core.signals import FrameKey
from ecu_node.core.status import Reason, State
from ecu_node.database import VehicleDatabase, read_database
from ecu_node.layout import read_layout
from ecu_node.parameters import JunctionResidual, VehicleParameters
from ecu_node.trust.activation import accept
from ecu_node.trust.parameter_store import ParameterStore
from ecu_node.trust.state import read_state
from tests.ecu_node.vehicles import Frame, answers, parameters_for, protected
from tests.trust.signing import NOW, Signers

PERIOD_S = 0.1
DRIFT, OFFSET_A = 0.05, 2.0
"""Of the battery's sensor in this vehicle."""


class Drive:
    """A vehicle whose battery's sensor is faulty, and its node, in time that is counted."""

    def __init__(self, state: Path, database: VehicleDatabase) -> None:
        self.database, self.said = database, list[str]()
        self.days = 0
        self.store = ParameterStore(
            state, database, mode=Mode.OVERLAY, say=self.said.append, now=lambda: NOW + timedelta(days=self.days)
        )
        self.corrector = wire(database, self.store.in_force, 0.0)
        self._steps: Iterator[int] = count()

    def go_on(
        self,
        duration_s: float,
        *,
        load_a: float = 0.0,
        drift: float = DRIFT,
        offset_a: float = OFFSET_A,
        contactor: int = 0,
    ) -> None:
        """Drive; a load that nobody measures takes its share from the battery."""
        others = {"ContactorState": contactor}
        for _ in range(round(duration_s / PERIOD_S)):
            k = next(self._steps)
            now_s = PERIOD_S * k
            motor_a = 100.0 * math.sin(0.3 * k) + 40.0
            battery_a = (1.0 + drift) * (motor_a + load_a) + offset_a
            frames = {
                0x110: ("HV_Battery", {"BatteryCurrent": battery_a, **others}),
                0x120: ("HV_Motor", {"MotorCurrent": motor_a}),
            }
            for identifier, (message, values) in frames.items():
                data = protected(self.database, message, k % 15, **values)
                answers(self.corrector, Frame(FrameKey(identifier, False), data), now_s)
            self.corrector.look(now_s + 0.01)
            self.store.look(self.corrector, now_s + 0.01)

    @property
    def told(self) -> tuple[State, Reason]:
        return self.corrector.state()


def right(database: VehicleDatabase, drift: float = DRIFT, offset_a: float = OFFSET_A) -> VehicleParameters:
    found = parameters_for(database, battery=(drift, offset_a), motor=(0.0, 0.0))
    return replace(found, junction_residual=JunctionResidual(measured_a=4.0, corrected_a=0.5, correction_a=4.0))


def put_on_trial(
    state: Path, signers: Signers, parameters: VehicleParameters, database: VehicleDatabase, number: int
) -> None:
    accept(state, signers.parameters(parameters, number), "f", database, NOW)


def test_a_right_set_is_in_force_after_its_trial_and_not_before(
    state: Path, signers: Signers, database: VehicleDatabase
) -> None:
    put_on_trial(state, signers, right(database), database, 5)
    drive = Drive(state, database)
    drive.go_on(290.0)
    assert drive.told == (State.PASSING_THROUGH, Reason.ON_TRIAL)
    drive.go_on(30.0)
    assert drive.told == (State.CORRECTING, Reason.NONE)
    assert read_state(state).in_force == "a"
    assert any("number 5 has passed its trial" in line for line in drive.said)
    drive.go_on(10.0)
    assert drive.corrector.watch.sums is not None
    assert abs(drive.corrector.watch.sums.corrected_a) < 0.1


@pytest.mark.parametrize(
    ("drift", "offset_a"), [(-DRIFT, -OFFSET_A), (0.0, -OFFSET_A), (3.0 * DRIFT, OFFSET_A), (DRIFT, 10.0)]
)
def test_a_wrong_set_never_comes_in_force(
    state: Path, signers: Signers, database: VehicleDatabase, drift: float, offset_a: float
) -> None:
    put_on_trial(state, signers, right(database, drift, offset_a), database, 5)
    drive = Drive(state, database)
    drive.go_on(330.0)
    assert drive.told == (State.PASSING_THROUGH, Reason.NO_PARAMETERS)
    assert (read_state(state).in_force, read_state(state).on_trial) == (None, None)
    assert any("number 5 has failed its trial" in line for line in drive.said)


def test_while_a_set_is_on_trial_the_one_before_stays_in_force(
    state: Path, signers: Signers, database: VehicleDatabase
) -> None:
    put_on_trial(state, signers, right(database), database, 5)
    drive = Drive(state, database)
    drive.go_on(330.0)
    put_on_trial(state, signers, right(database, -DRIFT, 0.0), database, 6)
    drive.go_on(100.0)
    assert drive.told == (State.CORRECTING, Reason.NONE)
    assert drive.corrector.branches[0].fault.drift == DRIFT
    drive.go_on(250.0)
    assert drive.told == (State.CORRECTING, Reason.NONE)
    assert any("number 6 has failed its trial" in line for line in drive.said)


def test_a_set_of_which_the_calibrator_promises_less_passes_with_less(
    state: Path, signers: Signers, database: VehicleDatabase
) -> None:
    """A load that no sensor sees is half of the change: the share is about 0."""
    half = replace(
        right(database), junction_residual=JunctionResidual(measured_a=1.0, corrected_a=1.0, correction_a=3.0)
    )
    results = []
    for number, parameters in ((5, right(database)), (6, half)):
        put_on_trial(state, signers, parameters, database, number)
        drive = Drive(state, database)
        drive.go_on(330.0, load_a=-3.0)
        results.append(any("has passed" in line for line in drive.said))
    assert results == [False, True]


def test_a_set_is_tried_about_the_sum_that_right_sensors_show(
    state: Path, signers: Signers, database: VehicleDatabase
) -> None:
    """A load that no sensor sees hides no error, and is no error itself."""
    expected = replace(right(database).junction_residual, expected_a=3.0, measured_mean_a=7.0, corrected_mean_a=3.0)
    takes_load_for_offset = right(database, 0.0, 3.0)
    results = []
    for number, parameters in ((5, right(database)), (6, takes_load_for_offset)):
        put_on_trial(state, signers, replace(parameters, junction_residual=expected), database, number)
        drive = Drive(state, database)
        faulty = parameters is not takes_load_for_offset
        drive.go_on(360.0, load_a=3.0, drift=DRIFT if faulty else 0.0, offset_a=OFFSET_A if faulty else 0.0)
        results.append(any("has passed" in line for line in drive.said))
        if faulty:
            assert drive.told == (State.CORRECTING, Reason.NONE), "the watch does not take the load for an error either"
    assert results == [True, False]


def test_a_set_that_takes_away_an_error_and_leaves_another_is_not_of_this_vehicle(
    state: Path, signers: Signers, database: VehicleDatabase
) -> None:
    put_on_trial(state, signers, right(database, DRIFT / 2.0, OFFSET_A / 2.0), database, 5)
    drive = Drive(state, database)
    drive.go_on(330.0)
    (told,) = (line for line in drive.said if "its trial" in line)
    assert "has failed" in told
    assert "at most 2 A were to be left" in told


def test_a_set_that_does_not_say_what_it_changes_may_leave_anything(
    state: Path, signers: Signers, database: VehicleDatabase
) -> None:
    """As one that was written by hand: what is taken away is measured all the same."""
    unknown = JunctionResidual(measured_a=4.0, corrected_a=0.5)
    put_on_trial(state, signers, replace(right(database), junction_residual=unknown), database, 5)
    drive = Drive(state, database)
    drive.go_on(330.0, load_a=-0.5)
    assert any("number 5 has passed its trial" in line for line in drive.said)


def test_a_trial_waits_while_a_current_is_not_measured(
    state: Path, signers: Signers, database: VehicleDatabase, tmp_path: Path
) -> None:
    """As while the vehicle charges, where the layout says so."""
    shutil.copy(database.layout.dbc_path, tmp_path)
    text = database.layout.path.read_text() + '\n[watch]\ninput = "contactor_state"\nvalid = [2]\n'
    (tmp_path / "watched.toml").write_text(text)
    own = read_database(read_layout(tmp_path / "watched.toml"))
    put_on_trial(state, signers, right(own), own, 5)
    drive = Drive(state, own)
    drive.go_on(330.0, contactor=1)
    assert drive.told == (State.PASSING_THROUGH, Reason.ON_TRIAL)
    drive.go_on(330.0, contactor=2)
    assert drive.told == (State.CORRECTING, Reason.NONE)


def test_standing_is_no_trial(state: Path, signers: Signers, database: VehicleDatabase) -> None:
    put_on_trial(state, signers, right(database), database, 5)
    drive = Drive(state, database)
    for _ in range(4000):
        k = next(drive._steps)
        for identifier, message in ((0x110, "HV_Battery"), (0x120, "HV_Motor")):
            answers(
                drive.corrector, Frame(FrameKey(identifier, False), protected(database, message, k % 15)), PERIOD_S * k
            )
        drive.corrector.look(PERIOD_S * k + 0.01)
        drive.store.look(drive.corrector, PERIOD_S * k + 0.01)
    assert drive.told == (State.PASSING_THROUGH, Reason.ON_TRIAL)


def test_a_revocation_holds_at_once_in_a_running_node(state: Path, signers: Signers, database: VehicleDatabase) -> None:
    put_on_trial(state, signers, right(database), database, 5)
    drive = Drive(state, database)
    drive.go_on(330.0)
    accept(state, signers.revocation(6, 5), "f", database, NOW)
    drive.go_on(2.0)
    assert drive.told == (State.PASSING_THROUGH, Reason.REVOKED)
    assert drive.said[-1].startswith("passing measured values through: ")


def test_what_expires_while_the_node_runs_is_not_used_any_more(
    state: Path, signers: Signers, database: VehicleDatabase
) -> None:
    put_on_trial(state, signers, right(database), database, 5)
    drive = Drive(state, database)
    drive.go_on(330.0)
    drive.days = 366
    drive.go_on(2.0)
    assert drive.told == (State.PASSING_THROUGH, Reason.NOT_VALID_NOW)


def test_a_slot_that_is_changed_under_a_running_node_is_not_used_any_more(
    state: Path, signers: Signers, database: VehicleDatabase
) -> None:
    put_on_trial(state, signers, right(database), database, 5)
    drive = Drive(state, database)
    drive.go_on(330.0)
    (state / "slot-a.json").write_bytes(b"{}")
    drive.go_on(2.0)
    assert drive.told == (State.PASSING_THROUGH, Reason.NOT_SIGNED)
