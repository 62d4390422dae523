"""Choice of sensor models: found where they are, never where sensors are linear, never for what the fleet shares."""

from dataclasses import replace

import numpy as np
import pytest

from calibrator.errors import FleetError
from calibrator.sensor_models.choice import LEAST_LOG_BAYES, LEAST_VEHICLES, LINEAR, choose_sensor_models
from calibrator.sensor_models.families import GainBySign, SensorModel, TemperatureDrift
from calibrator.sensor_models.linear_part import chosen_sensor
from calibrator.sensor_models.summary import summarise_sensors
from tests.calibrator.sensor_models.sensor_fleets import PERIOD_S, TEMPERATURE, SensorFleet, make_fleet

PUT: dict[tuple[int, int], SensorModel] = {
    (3, 0): GainBySign(drift_positive=0.08, drift_negative=-0.05),
    (7, 1): GainBySign(drift_positive=0.0, drift_negative=0.18),
    (11, 0): TemperatureDrift(drift=0.02, drift_per_k=0.004, reference_c=25.0),
    (15, 1): TemperatureDrift(drift=0.0, drift_per_k=-0.005, reference_c=25.0),
}
NAME: dict[type, str] = {GainBySign: "gain by sign", TemperatureDrift: "temperature"}


@pytest.fixture(scope="module", params=[2, 3])
def fleet(request: pytest.FixtureRequest) -> SensorFleet:
    """Thirty vehicles of which four have one sensor that is not linear."""
    return make_fleet(vehicles=30, branches=request.param, put=PUT, seed=1)


def test_the_sensors_that_are_not_linear_are_found_and_no_others(fleet: SensorFleet) -> None:
    choices = choose_sensor_models(fleet.summaries())
    found = {(j, k): c.model for j, row in enumerate(choices) for k, c in enumerate(row) if c.model != LINEAR}
    assert found == {place: NAME[type(sensor)] for place, sensor in PUT.items()}


def test_what_is_found_is_what_was_put_in(fleet: SensorFleet) -> None:
    choices = choose_sensor_models(fleet.summaries())
    for place, sensor in PUT.items():
        choice = choices[place[0]][place[1]]
        assert choice.log_bayes_factor >= LEAST_LOG_BAYES
        if isinstance(sensor, GainBySign):
            true = 1.0 - (1.0 + sensor.drift_negative) / (1.0 + sensor.drift_positive)
        else:
            assert isinstance(sensor, TemperatureDrift)
            true = sensor.drift_per_k / (1.0 + sensor.drift + sensor.drift_per_k * choice.reference)
        assert choice.excess == pytest.approx(true, abs=4.0 * choice.excess_sd)
        assert choice.excess_sd < 0.2 * abs(true)


def test_the_chosen_sensor_gives_the_true_current_back() -> None:
    fleet = make_fleet(vehicles=30, put=PUT, seed=1)
    choices = choose_sensor_models(fleet.summaries())
    for (j, k), sensor in PUT.items():
        temperature_c, i = fleet.samples[j].inputs[:, -1], fleet.true_a[j][:, k]
        beyond_zero = fleet.samples[j].currents_a[:, k] - fleet.faults.offset_a[j, k]
        drift = sensor.drift_negative if isinstance(sensor, GainBySign) else 0.0
        if isinstance(sensor, TemperatureDrift):
            drift = sensor.drift + sensor.drift_per_k * choices[j][k].reference
        found = chosen_sensor(choices[j][k], drift)
        assert found is not None
        error_a = found.inverse(beyond_zero, temperature_c) - i
        linear_a = beyond_zero * float(beyond_zero @ i / (beyond_zero @ beyond_zero)) - i
        assert np.std(error_a) < 0.6 * np.std(linear_a)
        assert np.std(error_a) < 0.55


def test_of_500_vehicles_with_linear_sensors_none_is_called_otherwise() -> None:
    fleet = make_fleet(vehicles=500, minutes=4.0, sparsity=60.0, seed=2)
    choices = choose_sensor_models(fleet.summaries())
    assert [c for row in choices for c in row if c.model != LINEAR or c.undecided] == []


def test_a_nonlinearity_that_the_whole_fleet_shows_is_the_models() -> None:
    everywhere: dict[tuple[int, int], SensorModel] = {
        (j, 0): GainBySign(drift_positive=0.1, drift_negative=0.0) for j in range(20)
    }
    fleet = make_fleet(vehicles=20, put=everywhere, seed=3)
    assert {c.model for row in choose_sensor_models(fleet.summaries()) for c in row} == {LINEAR}


def test_the_order_of_the_vehicles_plays_no_part(fleet: SensorFleet) -> None:
    summaries = fleet.summaries()
    choices, backwards = choose_sensor_models(summaries), choose_sensor_models(summaries[::-1])
    for row, mirrored in zip(choices, backwards[::-1], strict=True):
        assert [c.model for c in row] == [c.model for c in mirrored]
        assert [c.excess for c in row] == pytest.approx([c.excess for c in mirrored], rel=1e-3)


def test_the_order_of_the_branches_plays_no_part() -> None:
    fleet = make_fleet(vehicles=30, put=PUT, seed=1)
    swapped = [
        summarise_sensors(
            [replace(drive, currents_a=drive.currents_a[:, ::-1])],
            zero_a=zero_a[::-1],
            period_s=PERIOD_S,
            temperature=TEMPERATURE,
        )
        for drive, zero_a in zip(fleet.samples, fleet.faults.offset_a, strict=True)
    ]
    choices, mirrored = choose_sensor_models(fleet.summaries()), choose_sensor_models(swapped)
    for row, other in zip(choices, mirrored, strict=True):
        assert [c.model for c in row] == [c.model for c in other[::-1]]


def test_a_common_gain_of_a_sensor_plays_no_part() -> None:
    fleet = make_fleet(vehicles=30, put=PUT, seed=1)
    j, k = 3, 0
    gained = list(fleet.samples)
    currents_a, zeros_a = gained[j].currents_a.copy(), fleet.faults.offset_a.copy()
    currents_a[:, k] *= 1.2
    zeros_a[j, k] *= 1.2
    gained[j] = replace(gained[j], currents_a=currents_a)
    other = replace(fleet, samples=gained, faults=replace(fleet.faults, offset_a=zeros_a))
    before, after = choose_sensor_models(fleet.summaries())[j][k], choose_sensor_models(other.summaries())[j][k]
    assert after.model == before.model
    assert after.excess == pytest.approx(before.excess, abs=0.2 * before.excess_sd)


def test_a_zero_that_is_off_by_an_ampere_or_two_does_little() -> None:
    fleet = make_fleet(vehicles=30, put=PUT, seed=1)
    shifted = replace(fleet, faults=replace(fleet.faults, offset_a=fleet.faults.offset_a + 1.5))
    choices = choose_sensor_models(shifted.summaries())
    assert {(j, k) for j, row in enumerate(choices) for k, c in enumerate(row) if c.model != LINEAR} == PUT.keys()


def test_at_a_constant_temperature_no_drift_with_it_is_found() -> None:
    fleet = make_fleet(vehicles=12, seed=4)
    constant = [
        replace(drive, inputs=np.column_stack([drive.inputs[:, :-1], np.full(len(drive.inputs), 31.0)]))
        for drive in fleet.samples
    ]
    choices = choose_sensor_models(replace(fleet, samples=constant).summaries())
    assert {c.model for row in choices for c in row} == {LINEAR}


def test_of_a_current_of_one_sign_nothing_is_said() -> None:
    heater = 2
    choices = choose_sensor_models(make_fleet(vehicles=12, branches=3, seed=5).summaries(temperature=TEMPERATURE))
    assert {c.model for c in (row[heater] for row in choices)} == {LINEAR}


def test_where_the_branch_cannot_be_told_it_is_not_guessed() -> None:
    put: dict[tuple[int, int], SensorModel] = {(3, 0): GainBySign(drift_positive=0.02, drift_negative=0.0)}
    row = choose_sensor_models(make_fleet(vehicles=30, put=put, seed=6).summaries())[3]
    assert [c.model for c in row] == [LINEAR, LINEAR]
    assert [c.undecided for c in row] == [True, True]


def test_a_fleet_that_is_too_small_is_called_linear() -> None:
    few = make_fleet(vehicles=LEAST_VEHICLES - 1, put={(3, 0): PUT[3, 0]}, seed=7)
    choices = choose_sensor_models(few.summaries())
    assert {(c.model, c.log_bayes_factor) for row in choices for c in row} == {(LINEAR, 0.0)}


def test_vehicles_that_are_not_alike_are_refused_in_one_line() -> None:
    two, three = make_fleet(vehicles=8, seed=8), make_fleet(vehicles=8, branches=3, seed=8)
    with pytest.raises(FleetError, match=r"^vehicles differ in branches, inputs or temperature signal; search those"):
        choose_sensor_models([*two.summaries(), *three.summaries()])


def test_an_excess_that_no_sensor_has_is_not_believed() -> None:
    put: dict[tuple[int, int], SensorModel] = {(3, 0): GainBySign(drift_positive=0.9, drift_negative=-0.1)}
    choice = choose_sensor_models(make_fleet(vehicles=30, put=put, seed=1).summaries())[3][0]
    assert choice.log_bayes_factor >= LEAST_LOG_BAYES
    assert (choice.model, choice.undecided) == (LINEAR, True)
