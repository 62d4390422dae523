"""A sensor that breaks after the calibration: the node no longer says that its values are corrected."""

import math
from pathlib import Path

import pytest

from ecu_node.core.status import Quality, Reason, State
from tests.ecu_node.junctions import NAMES, Junction, driving, three_branches


@pytest.fixture
def junction(tmp_path: Path) -> Junction:
    return Junction(three_branches(tmp_path))


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("jump_a", [50.0, -200.0])
def test_jump_of_a_sensor_stops_the_correction_within_100_ms(junction: Junction, name: str, jump_a: float) -> None:
    junction.break_sensors(10.0, driving, **{name: lambda shown_a: shown_a + jump_a})
    assert junction.corrected_for_s <= 0.1
    assert junction.corrector.state() == (State.PASSING_THROUGH, Reason.SUM_IMPLAUSIBLE)
    assert junction.corrector.latched_branches == (name,)
    assert junction.corrected_after == 0
    others = dict.fromkeys(NAMES, Quality.PASSED_THROUGH)
    assert junction.qualities == others | {name: Quality.IMPLAUSIBLE}


GAIN_CHANGES = [("motor", 1.2, 0, 5), ("battery", 0.8, 0, 5), ("battery", 3, 0, 5), ("battery", 1, 0.01, 30)]


@pytest.mark.parametrize(("name", "gain", "growth_per_s", "within_s"), GAIN_CHANGES)
def test_gain_change_of_a_sensor_stops_the_correction(
    junction: Junction, name: str, gain: float, growth_per_s: float, within_s: float
) -> None:
    junction.break_sensors(
        within_s, driving, **{name: lambda shown_a: shown_a * (gain + growth_per_s * (junction.now_s - 15.0))}
    )
    assert junction.corrector.latched is Reason.SUM_IMPLAUSIBLE
    assert junction.corrector.latched_branches[0] == name
    assert junction.corrected_after == 0


def test_branch_with_a_creeping_offset_is_among_the_branches_named(junction: Junction) -> None:
    def parked(_: float) -> dict[str, float]:
        return {"battery": 6.0, "motor": 0.0, "heater": 6.0}

    junction.break_sensors(15.0, parked, motor=lambda shown_a: shown_a + 1.0 * (junction.now_s - 15.0))
    assert junction.corrector.latched is Reason.SUM_IMPLAUSIBLE
    assert "motor" in junction.corrector.latched_branches


@pytest.mark.parametrize("name", NAMES)
def test_branch_that_jumps_at_constant_currents_is_among_the_branches_named(tmp_path: Path, name: str) -> None:
    def charging(_: float) -> dict[str, float]:
        return {"battery": -80.0, "motor": -92.0, "heater": 12.0}

    junction = Junction(three_branches(tmp_path), noise_a=0.0)
    junction.break_sensors(10.0, charging, **{name: lambda shown_a: shown_a + 18.0})
    assert junction.corrector.latched is Reason.SUM_IMPLAUSIBLE, "a still branch may be right, and the other one jump"
    assert name in junction.corrector.latched_branches
    assert junction.qualities[name] == Quality.IMPLAUSIBLE


@pytest.mark.parametrize("forged_a", [50.0, -120.0])
def test_forged_frame_before_each_real_one_stops_the_correction(junction: Junction, forged_a: float) -> None:
    junction.break_sensors(0.0, driving)
    junction.forged = {"battery": forged_a}
    junction.run(5.0, driving)
    assert junction.corrected_for_s <= 0.1
    assert junction.corrector.latched_branches == ("battery",)
    assert junction.corrected_after == 0


def test_only_the_broken_battery_sensor_is_named_beside_a_steady_load(junction: Junction) -> None:
    def steady_heater(time_s: float) -> dict[str, float]:
        return driving(time_s) | {"battery": driving(time_s)["motor"] + 10.0, "heater": 10.0}

    junction.noise_a = 0.0
    junction.break_sensors(20.0, steady_heater, battery=lambda shown_a: 1.5 * shown_a)
    assert junction.corrector.latched is Reason.SUM_IMPLAUSIBLE
    assert junction.corrector.latched_branches == ("battery",)


def test_sensor_that_stays_constant_while_other_currents_move_is_named_as_stuck(junction: Junction) -> None:
    def accelerating(time_s: float) -> dict[str, float]:
        motor_a = 40.0 + max(time_s - 15.0, 0.0) * 10.0
        return {"battery": motor_a + 10.0, "motor": motor_a, "heater": 10.0}

    junction.break_sensors(10.0, accelerating, battery=lambda _: 54.5)
    assert (junction.corrector.latched, junction.corrector.latched_branches) == (Reason.BRANCH_STUCK, ("battery",))
    assert junction.corrected_for_s <= 5.0


@pytest.mark.parametrize("name", NAMES)
def test_stuck_branch_is_named_even_if_the_allowed_deviation_of_the_sum_is_large(tmp_path: Path, name: str) -> None:
    """The sum shows no jump, gain error or offset, but after a while the watch sees that one code never changes."""

    def swinging(time_s: float) -> dict[str, float]:
        motor_a, heater_a = 60.0 + 30.0 * math.sin(0.7 * time_s), 60.0 + 30.0 * math.sin(3.1 * time_s)
        return {"battery": motor_a + heater_a, "motor": motor_a, "heater": heater_a}

    junction = Junction(three_branches(tmp_path), sd_a=15.0)
    junction.wrong = {name: lambda _: 120.0 if name == "battery" else 60.0}
    junction.run(8.5, swinging)
    assert junction.corrector.state() == (State.CORRECTING, Reason.NONE)
    junction.run(1.0, swinging)
    assert (junction.corrector.latched, junction.corrector.latched_branches) == (Reason.BRANCH_STUCK, (name,))


def test_steady_load_beside_a_corrected_gain_error_is_not_taken_for_stuck(junction: Junction) -> None:
    def swinging(time_s: float) -> dict[str, float]:
        motor_a = 350.0 * math.sin(0.7 * time_s)
        return {"battery": motor_a + 20.0, "motor": motor_a, "heater": 20.0}

    junction.wrong = {"heater": lambda _: 19.1}
    junction.run(25.0, swinging)
    assert junction.corrector.state() == (State.CORRECTING, Reason.NONE)


def test_quality_signal_of_two_bits_shows_implausible_as_invalid(tmp_path: Path) -> None:
    junction = Junction(three_branches(tmp_path, quality_bits=2))
    junction.run(5.0, driving)
    junction.wrong = {"battery": lambda shown_a: shown_a + 100.0}
    junction.run(1.0, driving)
    assert junction.qualities["battery"] == Quality.INVALID


def test_load_steps_are_not_a_fault(junction: Junction) -> None:
    """Frames come one after the other, and the motor's sensor is 20 ms late: for a moment one branch moves alone."""

    def steps(time_s: float) -> dict[str, float]:
        heater_a = 60.0 if time_s % 3.0 < 1.5 else 0.0
        late_s = time_s - 0.02
        motor_a, late_a = (200.0 if at_s % 4.0 < 1.0 else -80.0 for at_s in (time_s, late_s))
        return {"battery": motor_a + heater_a, "motor": late_a, "heater": heater_a}

    junction.run(15.0, steps)
    assert junction.corrector.state() == (State.CORRECTING, Reason.NONE)


def test_gross_fault_is_detected_without_residual_standard_deviations(tmp_path: Path) -> None:
    """A sum no larger than what the calibrator saw is not taken for a fault."""
    junction = Junction(three_branches(tmp_path), sd_a=None, sd_per_a=None, corrected_a=60.0)
    junction.wrong = {"heater": lambda shown_a: shown_a + 60.0}
    junction.run(20.0, driving)
    assert junction.corrector.latched_branches == ()
    junction.wrong = {"battery": lambda shown_a: 6.0 * shown_a}
    junction.run(5.0, driving)
    assert junction.corrector.latched is Reason.SUM_IMPLAUSIBLE
