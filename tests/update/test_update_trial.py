"""A parameter set on trial in a node: a right one comes in force, a wrong one does not, with the reason."""

import math
import shutil
from datetime import timedelta
from functools import partial
from pathlib import Path

import pytest
from msgspec.structs import replace

from ecu_node.core.status import Reason, State
from ecu_node.database import VehicleDatabase, read_database
from ecu_node.layout import read_layout
from ecu_node.parameters import JunctionResidual, VehicleParameters
from ecu_node.update.state import read_state, write_state
from tests.ecu_node.vehicles import LAYOUT, drive, parameters_for
from tests.update.held import NOW, Running, put_on_trial

DRIFT, OFFSET_A = 0.05, 2.0
"""Fault of the battery's sensor in this vehicle. [1, A]"""
TRIAL_S = 30.0
CORRECTING = (State.CORRECTING, Reason.NONE)


@pytest.fixture(scope="module")
def car(tmp_path_factory: pytest.TempPathFactory) -> VehicleDatabase:
    """The project's own layout and DBC, with a short trial."""
    return own_vehicle(tmp_path_factory.mktemp("vehicle"))


def own_vehicle(folder: Path, more: str = "") -> VehicleDatabase:
    shutil.copy(LAYOUT.with_suffix(".dbc"), folder)
    path = folder / LAYOUT.name
    path.write_text(f"{LAYOUT.read_text()}\n[activation]\ntrial_s = {TRIAL_S}\n{more}")
    return read_database(read_layout(path))


class Drive(Running):
    """A vehicle whose battery's sensor is faulty."""

    now_s, contactor, moving = 0.0, 0, True

    def go_on(self, duration_s: float, load_a: float = 0.0, drift: float = DRIFT, offset_a: float = OFFSET_A) -> None:
        """Drive, or stand; a load that nobody measures takes its share from the battery."""

        def motor_a(k: int) -> float:
            return self.moving * (100.0 * math.sin(0.3 * k) + 40.0)

        def battery_a(k: int) -> float:
            return (1.0 + drift) * (motor_a(k) + load_a) + offset_a

        start_s, self.now_s = self.now_s, self.now_s + duration_s
        go = partial(drive, self.database, self.corrector, start_s, self.now_s, ContactorState=self.contactor)
        go(battery_a=battery_a, motor_a=motor_a, period_s=0.1, look=self.store.look)

    def has_said(self, words: str) -> bool:
        return any(words in line for line in self.said)

    @property
    def told(self) -> tuple[State, Reason]:
        return self.corrector.state()


def right(
    car: VehicleDatabase, drift: float = DRIFT, offset_a: float = OFFSET_A, left_a: float = 0.5
) -> VehicleParameters:
    found = parameters_for(car, battery=(drift, offset_a), motor=(0.0, 0.0))
    residual = JunctionResidual(measured_a=math.hypot(left_a, 4.0), corrected_a=left_a, correction_a=4.0)
    return replace(found, junction_residual=residual)


PASSED, FAILED = "has passed its trial", "has failed its trial"


def tried(vehicle: Path, parameters: VehicleParameters, database: VehicleDatabase, **conditions: float) -> Drive:
    """Put parameters on trial, and drive for longer than a trial takes."""
    put_on_trial(vehicle, parameters)
    drive = Drive(vehicle, database)
    drive.go_on(1.1 * TRIAL_S, **conditions)
    return drive


def test_right_set_comes_in_force_after_its_trial_and_not_before(new: Path, car: VehicleDatabase) -> None:
    put_on_trial(new, right(car))
    drive = Drive(new, car)
    drive.go_on(0.9 * TRIAL_S)
    assert drive.told == (State.PASSING_THROUGH, Reason.ON_TRIAL)
    drive.go_on(0.2 * TRIAL_S)
    assert drive.told == CORRECTING
    assert read_state(new).in_force is not None
    assert drive.has_said(PASSED)
    drive.go_on(10.0)
    assert drive.corrector.watch.sums is not None
    assert abs(drive.corrector.watch.sums.corrected_a) < 0.1


WRONG = [(-DRIFT, -OFFSET_A), (0.0, -OFFSET_A), (3.0 * DRIFT, OFFSET_A), (DRIFT, 10.0)]


@pytest.mark.parametrize(("drift", "offset_a"), WRONG)
@pytest.mark.parametrize("left_a", [0.5, 20.0], ids=["small remaining sum", "large remaining sum"])
def test_wrong_set_fails_its_trial(
    new: Path, car: VehicleDatabase, drift: float, offset_a: float, left_a: float
) -> None:
    """Also if the parameter file says that the calibrator saw a large corrected sum."""
    drive = tried(new, right(car, drift, offset_a, left_a=left_a), car)
    assert drive.told == (State.PASSING_THROUGH, Reason.NO_PARAMETERS)
    assert (read_state(new).in_force, read_state(new).on_trial) == (None, None)
    assert drive.has_said(FAILED)


def test_previous_set_stays_in_force_during_and_after_a_failed_trial(new: Path, car: VehicleDatabase) -> None:
    drive = tried(new, right(car), car)
    put_on_trial(new, right(car, -DRIFT, 0.0))
    drive.go_on(0.5 * TRIAL_S)
    assert drive.told == CORRECTING
    assert drive.corrector.branches[0].fault.drift == DRIFT
    drive.go_on(0.6 * TRIAL_S)
    assert drive.told == CORRECTING
    assert drive.has_said(FAILED)


def test_set_on_trial_is_judged_relative_to_the_expected_sum(new: Path, car: VehicleDatabase) -> None:
    """A load that no sensor sees hides no error, and is no error itself."""
    expected = replace(right(car).junction_residual, expected_a=3.0, measured_mean_a=7.0, corrected_mean_a=3.0)
    found = replace(right(car), junction_residual=expected)
    drive = tried(new, found, car, load_a=3.0)
    drive.go_on(30.0, load_a=3.0)
    assert drive.told == CORRECTING, "the watch does not take the load for an error either"
    takes_load_for_offset = replace(right(car, 0.0, 3.0), junction_residual=expected)
    drive = tried(new, takes_load_for_offset, car, load_a=3.0, drift=0.0, offset_a=0.0)
    assert drive.has_said(FAILED)


def test_set_that_corrects_half_of_the_error_fails_its_trial(new: Path, car: VehicleDatabase) -> None:
    drive = tried(new, right(car, DRIFT / 2.0, OFFSET_A / 2.0), car)
    (told,) = (line for line in drive.said if FAILED in line)
    assert "at most 2 A were to be left" in told
    assert tried(new, right(car), car, load_a=-3.0).has_said(FAILED), "a load that no sensor sees is half of the change"


Numbers = dict[str, float]
UNCHANGED = {"drift": 0.0, "offset_a": 0.0}


BY_HAND = JunctionResidual(measured_a=4.0, corrected_a=0.5)
PROMISES_HALF = JunctionResidual(measured_a=1.0, corrected_a=1.0, correction_a=3.0)
LOWERING = {
    "without a change": (UNCHANGED, None, UNCHANGED, "no change that counts"),
    "without a predicted change, as written by hand": ({}, BY_HAND, {"load_a": -0.5}, PASSED),
    "promises half, and a load is half": ({}, PROMISES_HALF, {"load_a": -3.0}, PASSED),
}


@pytest.mark.parametrize(("fault", "residual", "conditions", "words"), LOWERING.values(), ids=LOWERING)
def test_set_that_lowers_the_sum_as_predicted_passes_its_trial(
    fault: Numbers, residual: JunctionResidual | None, conditions: Numbers, words: str, new: Path, car: VehicleDatabase
) -> None:
    parameters = right(car, **fault)
    promising = replace(parameters, junction_residual=residual or parameters.junction_residual)
    assert tried(new, promising, car, **conditions).has_said(words)


def test_trial_time_counts_only_in_valid_watch_states_while_current_flows(new: Path, tmp_path: Path) -> None:
    """A layout may so exclude charging from the trial."""
    own = own_vehicle(tmp_path, '[watch]\ninput = "contactor_state"\nvalid = [2]\n')
    put_on_trial(new, right(own))
    drive, no_trial_yet = Drive(new, own), (State.PASSING_THROUGH, Reason.ON_TRIAL)
    phases = ((1, True, no_trial_yet), (2, False, no_trial_yet), (2, True, CORRECTING))
    for drive.contactor, drive.moving, expected in phases:
        drive.go_on(1.1 * TRIAL_S)
        assert drive.told == expected


def test_revocation_takes_effect_at_once_in_a_running_node(new: Path, car: VehicleDatabase) -> None:
    drive = tried(new, right(car), car)
    write_state(new, replace(read_state(new), in_force=None, ended="revoked"))
    drive.go_on(2.0)
    assert drive.told == (State.PASSING_THROUGH, Reason.REVOKED)
    assert drive.said[-1].startswith("passing measured values through: ")


def test_set_expired_for_two_minutes_does_not_return_if_the_clock_goes_back(new: Path, car: VehicleDatabase) -> None:
    drive = tried(new, right(car), car)
    drive.now = NOW + timedelta(days=366)
    drive.go_on(2.0)
    assert drive.told == (State.PASSING_THROUGH, Reason.NOT_VALID_NOW)
    drive.now = NOW  # the clock was wrong for a moment
    drive.go_on(2.0)
    assert drive.told == CORRECTING
    for drive.now in (NOW + timedelta(days=366), NOW + timedelta(days=366, minutes=2), NOW):
        drive.go_on(3.0)
        assert drive.told == (State.PASSING_THROUGH, Reason.NOT_VALID_NOW)
    assert read_state(new).in_force is None
