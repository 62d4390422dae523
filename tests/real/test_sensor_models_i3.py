"""Sensors that are not linear on recorded trips of the BMW i3: found, and none called so where all are linear."""

from pathlib import Path

import numpy as np
import pytest

from calibrator.artificial.ground_truth import GroundTruth, ground_truth_from_drive, with_branches
from calibrator.artificial.random_fleet import draw_faults
from calibrator.drive import Array
from calibrator.drives.align import Samples
from calibrator.drives.store import iterate_drives
from calibrator.faults import Faults, measured_currents, true_currents
from calibrator.sensor_models.choice import LINEAR, SensorModelChoice, choose_sensor_models
from calibrator.sensor_models.families import GainBySign, SensorModel, TemperatureDrift
from calibrator.sensor_models.summary import summarise_sensors
from ecu_node.layout import read_layout
from tests.real.delay_trips import LAYOUT, import_trips

BRANCHES = ("battery", "motor", "auxiliary")
PUT: dict[tuple[int, int], SensorModel] = {
    (3, 0): GainBySign(drift_positive=0.1, drift_negative=-0.06),
    (10, 1): GainBySign(drift_positive=0.0, drift_negative=0.16),
    (16, 1): TemperatureDrift(drift=0.0, drift_per_k=-0.005, reference_c=25.0),
}


@pytest.fixture(scope="module")
def trips(shared_data: Path, tmp_path_factory: pytest.TempPathFactory) -> list[GroundTruth]:
    store = tmp_path_factory.mktemp("i3") / "store"
    import_trips(shared_data, store)
    found = [ground_truth_from_drive(drive, 0.1) for drive in iterate_drives(store, read_layout(LAYOUT))]
    return [with_branches(trip, BRANCHES, "motor") for trip in found if trip is not None]


@pytest.mark.parametrize("branches", [2, 3])
def test_of_recorded_trips_with_linear_sensors_none_is_called_otherwise(
    trips: list[GroundTruth], branches: int
) -> None:
    choices = [choice for seed in range(4) for choice in _choices(trips, branches, {}, seed)]
    assert [c for row in choices for c in row if c.model != LINEAR] == []


@pytest.mark.parametrize("branches", [2, 3])
def test_on_recorded_trips_sensors_that_are_not_linear_are_found_or_said_to_be_undecided(
    trips: list[GroundTruth], branches: int
) -> None:
    choices = _choices(trips, branches, PUT, 5)
    found = {(j, k) for j, row in enumerate(choices) for k, c in enumerate(row) if c.model != LINEAR}
    noticed = {j for j, row in enumerate(choices) if any(c.undecided or c.model != LINEAR for c in row)}
    assert found <= PUT.keys()
    assert len(found) >= 2
    assert noticed == {j for j, _ in PUT}


def _choices(
    trips: list[GroundTruth], branches: int, put: dict[tuple[int, int], SensorModel], seed: int
) -> list[list[SensorModelChoice]]:
    rng = np.random.default_rng([17, seed])
    faults = draw_faults(
        rng, vehicles=len(trips), branches=branches, sparsity=60.0, magnitude=(0.02, 0.1), full_scale_a=400.0
    )
    summaries = []
    for j, trip in enumerate(trips):
        drive = _samples(rng, with_branches(trip, BRANCHES[:branches], "motor"), faults.take(j), put, j)
        zero_a = faults.offset_a[j]
        summaries.append(summarise_sensors([drive], zero_a=zero_a, period_s=0.1, temperature="temperature"))
    return choose_sensor_models(summaries)


def _samples(
    rng: np.random.Generator, trip: GroundTruth, faults: Faults, put: dict[tuple[int, int], SensorModel], j: int
) -> Samples:
    """Measured currents of vehicle j, the inputs of the layout, and a junction box that warms up."""
    temperature_c = rng.uniform(0.0, 25.0) + rng.uniform(20.0, 40.0) * (1.0 - np.exp(-trip.time_s / 500.0))
    i = true_currents(trip.matrix_a(), faults)
    i_m = measured_currents(i, faults)
    for (vehicle, k), sensor in put.items():
        if vehicle == j:
            i_m[:, k] = sensor.measured(i[:, k], temperature_c) + faults.offset_a[k]
    inputs = np.column_stack([_model_inputs(trip), np.rint(temperature_c)])
    return Samples(
        branch_names=tuple(trip.currents_a),
        input_names=("driving", "recuperation", "copper", "heater", "aircon", "temperature"),
        time_s=trip.time_s,
        currents_a=i_m + rng.normal(0.0, 0.4, i_m.shape),
        inputs=inputs,
        valid=np.ones(len(i_m), bool),
        masked={},
    )


def _model_inputs(trip: GroundTruth) -> Array:
    voltage, torque = trip.inputs["voltage"], trip.inputs["torque"]
    mechanical = torque * trip.inputs["speed"] / voltage
    demands = [trip.inputs[name] / voltage for name in ("heater_demand", "aircon_demand")]
    return np.column_stack([np.maximum(mechanical, 0.0), np.minimum(mechanical, 0.0), torque**2 / voltage, *demands])
