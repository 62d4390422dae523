"""Sensors that are not linear on trips of the built-in vehicle, with zeros as the default method finds them."""

import numpy as np
import pytest

from calibrator.artificial.builtin_drives import builtin_trip
from calibrator.artificial.ground_truth import GroundTruth, with_branches
from calibrator.artificial.random_fleet import draw_faults
from calibrator.drive import Array
from calibrator.drives.align import Samples
from calibrator.faults import measured_currents, true_currents
from calibrator.sensor_models.choice import LINEAR, choose_sensor_models
from calibrator.sensor_models.families import GainBySign, SensorModel, TemperatureDrift
from calibrator.sensor_models.summary import summarise_sensors

pytest.importorskip("fastsim")
VEHICLES, FULL_SCALE_A, PERIOD_S = 14, 400.0, 0.1
PUT: dict[tuple[int, int], SensorModel] = {
    (2, 0): GainBySign(drift_positive=0.05, drift_negative=-0.1),
    (9, 1): TemperatureDrift(drift=0.0, drift_per_k=0.006, reference_c=25.0),
}


def test_on_builtin_trips_they_are_found_or_said_to_be_undecided_and_no_others() -> None:
    rng = np.random.default_rng(11)
    faults = draw_faults(
        rng, vehicles=VEHICLES, branches=2, sparsity=80.0, magnitude=(0.05, 0.1), full_scale_a=FULL_SCALE_A
    )
    summaries = []
    for j in range(VEHICLES):
        trip = with_branches(builtin_trip(rng, duration_s=900.0, name=f"t{j}"), ("battery", "motor"), "battery")
        temperature_c = rng.uniform(0.0, 25.0) + 25.0 * (1.0 - np.exp(-trip.time_s / 400.0))
        i = true_currents(trip.matrix_a(), faults.take(j))
        i_m = measured_currents(i, faults.take(j))
        for (vehicle, k), sensor in PUT.items():
            if vehicle == j:
                i_m[:, k] = sensor.measured(i[:, k], temperature_c) + faults.offset_a[j, k]
        i_m += rng.normal(0.0, 0.4, i.shape)
        drive = _samples(i_m, trip, temperature_c)
        summaries.append(
            summarise_sensors(
                [drive], zero_a=faults.offset_a[j], period_s=PERIOD_S, temperature="junction_box_temperature"
            )
        )
    choices = choose_sensor_models(summaries)
    found = {(j, k): c.model for j, row in enumerate(choices) for k, c in enumerate(row) if c.model != LINEAR}
    assert found == {(2, 0): "gain by sign"}
    assert {j for j, row in enumerate(choices) if any(c.undecided for c in row)} == {9}


def _samples(i_m: Array, trip: GroundTruth, temperature_c: Array) -> Samples:
    torque, speed, voltage = (trip.inputs[name] for name in ("torque", "speed", "voltage"))
    mechanical = torque * speed / voltage
    inputs = (np.maximum(mechanical, 0.0), np.minimum(mechanical, 0.0), torque**2 / voltage, np.rint(temperature_c))
    return Samples(
        branch_names=("battery", "motor"),
        input_names=("driving_current", "recuperation_current", "copper_loss", "junction_box_temperature"),
        time_s=PERIOD_S * np.arange(float(len(i_m))),
        currents_a=i_m,
        inputs=np.column_stack(inputs),
        valid=np.ones(len(i_m), bool),
        masked={},
    )
