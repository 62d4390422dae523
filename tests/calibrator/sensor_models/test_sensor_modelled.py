"""Sensors with a model, against the samples that their moments are made of."""

from dataclasses import asdict, replace

import numpy as np
import pytest

from calibrator.drive import Array
from calibrator.files.parameter_files import junction_residual
from calibrator.sensor_models.choice import SensorModelChoice
from calibrator.sensor_models.families import GainBySign, SensorModel, TemperatureDrift
from calibrator.sensor_models.linear_part import chosen_sensor, linear_summary, sensor_parameters
from calibrator.sensor_models.modelled import ModelledVehicle, modelled_vehicle, usual_sections
from calibrator.sensor_models.sections import ColumnMoments, usual_moments
from calibrator.sensor_models.summary import SensorSummary
from ecu_node.sensor_fault import SensorFault
from tests.calibrator.sensor_models.sensor_fleets import SensorFleet, make_fleet

LINEAR = SensorModelChoice(log_bayes_factor=-3.0)
BY_SIGN = SensorModelChoice(model="gain by sign", excess=0.12, excess_sd=0.01, log_bayes_factor=30.0)
WARM = SensorModelChoice(model="temperature", excess=0.004, excess_sd=1e-4, reference=-8.0, log_bayes_factor=30.0)
J = 2


@pytest.fixture(scope="module")
def fleet() -> SensorFleet:
    put: dict[tuple[int, int], SensorModel] = {
        (J, 0): GainBySign(drift_positive=0.1, drift_negative=-0.03),
        (J, 1): TemperatureDrift(drift=0.03, drift_per_k=0.004, reference_c=17.0),
    }
    return make_fleet(vehicles=4, put=put, seed=1)


@pytest.fixture(scope="module")
def summaries(fleet: SensorFleet) -> list[SensorSummary]:
    return fleet.summaries()


def modelled(summaries: list[SensorSummary], *choices: SensorModelChoice) -> ModelledVehicle:
    found = modelled_vehicle(summaries[J], choices, usual_sections(summaries))
    assert found is not None
    return found


@pytest.mark.parametrize("changed", [{0: 0.05}, {1: 0.001}, {0: 0.0, 1: 0.002}, {}])
def test_another_excess_gives_the_linear_parts_of_another_choice(
    summaries: list[SensorSummary], changed: dict[int, float]
) -> None:
    rows = [BY_SIGN, WARM]
    other = [replace(c, excess=changed.get(k, c.excess)) for k, c in enumerate(rows)]
    found = modelled(summaries, *rows).with_excess(changed)
    np.testing.assert_allclose(found.moments, linear_summary(summaries[J], other).moments, rtol=1e-7, atol=1e-6)


def test_an_excess_of_zero_gives_the_measured_currents_back(summaries: list[SensorSummary]) -> None:
    found = modelled(summaries, BY_SIGN, WARM).with_excess({0: 0.0, 1: 0.0})
    np.testing.assert_allclose(found.moments, summaries[J].summary.moments, rtol=1e-7, atol=1e-6)


def test_a_vehicle_of_linear_sensors_has_none(summaries: list[SensorSummary]) -> None:
    assert modelled_vehicle(summaries[J], [LINEAR, LINEAR], usual_sections(summaries)) is None


@pytest.mark.parametrize(("k", "choice"), [(0, BY_SIGN), (1, WARM)])
def test_the_error_of_a_sensor_follows_from_its_sections(
    fleet: SensorFleet, summaries: list[SensorSummary], k: int, choice: SensorModelChoice
) -> None:
    rows = [choice if each == k else LINEAR for each in range(2)]
    (sensor,) = modelled(summaries, *rows).sensors
    x = fleet.samples[J].currents_a[:, k] - fleet.faults.offset_a[J, k]
    drift, temperature_c = 0.02, fleet.samples[J].inputs[:, -1]
    true = chosen_sensor(choice, drift)
    assert true is not None
    error_a = true.measured(x, temperature_c) - x
    gain = (1.0 + drift) * sensor.family.gain(np.array(choice.excess), sensor.own.at) - 1.0
    assert np.sum(gain**2 * sensor.own.sum_a2) == pytest.approx(np.mean(error_a**2), rel=1e-3)
    assert sensor.own.share.sum() == pytest.approx(1.0)
    assert sensor.own.sum_a.sum() == pytest.approx(x.mean(), abs=1e-9)


def test_the_usual_drive_of_alike_vehicles_is_theirs_and_holds_their_different_temperatures(
    summaries: list[SensorSummary],
) -> None:
    usual = usual_sections(summaries)["temperature", 0]
    alone = [usual_sections([each])["temperature", 0] for each in summaries]
    assert np.ptp(usual.at) > max(np.ptp(each.at) for each in alone)
    same = usual_sections([summaries[0]] * 3)["gain by sign", 1]
    np.testing.assert_allclose(same.sum_a2, usual_sections([summaries[0]])["gain by sign", 1].sum_a2)


def test_vehicles_that_stand_take_no_part_in_the_usual_drive() -> None:
    moving = ColumnMoments(x=3.0, xx=400.0, h=8.0, hx=250.0, hh=250.0)
    standing = ColumnMoments(x=0.0, xx=0.0, h=0.0, hx=0.0, hh=0.0)
    assert asdict(usual_moments([moving, standing])) == pytest.approx(asdict(moving))
    assert usual_moments([standing]) == standing


def test_the_junction_sum_after_correction_is_that_of_the_nodes_formula(
    fleet: SensorFleet, summaries: list[SensorSummary]
) -> None:
    vehicle, drift = modelled(summaries, BY_SIGN, WARM), np.array([-0.03, 0.05])
    offset_a, samples = fleet.faults.offset_a[J], fleet.samples[J]
    corrected: list[Array] = []
    for k, choice in enumerate([BY_SIGN, WARM]):
        said = sensor_parameters(choice, float(drift[k]))
        assert said is not None
        fault = SensorFault(drift=said[0], offset_a=float(offset_a[k]), model=said[1])
        pairs = zip(samples.currents_a[:, k].tolist(), samples.inputs[:, -1].tolist(), strict=True)
        corrected.append(np.array([fault.true_current(i_m, at_c) for i_m, at_c in pairs], dtype=float))
    gain = np.tile(1.0 + drift, (len(vehicle.linear_parts.moments), 1))
    for sensor in vehicle.sensors:
        gain[:, sensor.branch] *= sensor.block_gain()
    parts = vehicle.linear_parts
    found = junction_residual(
        parts.moments[:, parts.inputs :, parts.inputs :], gain=gain, offset_a=offset_a, expected_a=0.0
    )
    assert found.corrected_a == pytest.approx(float(np.sqrt(np.mean(np.sum(corrected, axis=0) ** 2))), rel=0.02)
