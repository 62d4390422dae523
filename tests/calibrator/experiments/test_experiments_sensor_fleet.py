"""Sensors that are not linear through the whole calibration: what the node makes of it on drives it has not seen."""

import dataclasses
from pathlib import Path

import msgspec
import numpy as np
import pytest

from calibrator.experiments.sensor_fleet import SensorCase, SensorFleet, calibrate_sensors, draw_sensors
from calibrator.experiments.sensor_score import score_sensors, unseen_errors_a
from calibrator.sensor_models.choice import LINEAR
from calibrator.sensor_models.fleet import SensorFindings
from ecu_node.branch_plans import branch_plan
from ecu_node.check import check_report, report_text
from ecu_node.correction import SignPlan, TemperaturePlans
from ecu_node.database import VehicleDatabase
from ecu_node.guard import Mode
from ecu_node.in_force import InForce, sensor_fault
from ecu_node.layout import Layout
from ecu_node.parameter_fit import check_fit
from ecu_node.parameters import VehicleParameters, read_parameters, write_parameters
from ecu_node.sensor_models import GainBySign, SensorModel, TemperatureDrift
from ecu_node.wiring import wire
from tests.calibrator.experiments.small_trials import LAYOUT, small_fleet

CASE = SensorCase(vehicles=40, sparsity=90.0, difference=(0.1, 0.2), drift_per_k=(0.003, 0.006), duration_s=1200.0)
ALONE = dataclasses.replace(CASE, sparsity=100.0, largest_drift=0.0)
"""Nothing else is wrong with a sensor that would be worth correcting."""
Calibrated = tuple[SensorFleet, dict[str, VehicleParameters], SensorFindings]


def calibrated(case: SensorCase, seed: int = 3) -> Calibrated:
    recorded = small_fleet()
    fleet = draw_sensors(recorded, case, seed)
    return fleet, *calibrate_sensors(fleet, recorded.database)


@pytest.fixture(scope="module")
def bent() -> Calibrated:
    return calibrated(CASE)


def deployed(found: Calibrated) -> dict[tuple[int, int], SensorModel]:
    fleet, parameters, _ = found
    return {
        (j, k): branch.sensor_model
        for j, name in enumerate(fleet.names)
        for k, branch in enumerate(parameters[name].branches.values())
        if branch.apply and branch.sensor_model is not None
    }


def test_sensors_of_both_families_are_corrected_and_each_is_better_on_drives_not_seen(
    bent: Calibrated, database: VehicleDatabase
) -> None:
    models = deployed(bent)
    assert any(isinstance(model, GainBySign) for model in models.values())
    assert any(isinstance(model, TemperatureDrift) for model in models.values())
    fleet, parameters, _ = bent
    for j, k in models:
        measured_a, corrected_a = unseen_errors_a(fleet, j, parameters[fleet.names[j]], database)
        assert corrected_a[k] < 0.5 * measured_a[k]


def test_what_is_corrected_is_what_was_put_in_and_its_harm_is_below_the_limit(bent: Calibrated) -> None:
    fleet, parameters, _ = bent
    for j, k in deployed(bent):
        assert fleet.put[j][0] == k
        branch = parameters[fleet.names[j]].branches[fleet.branches[k]]
        assert branch.held_back is None
        assert branch.harm_probability is not None
        assert branch.harm_probability < 1e-3
        assert parameters[fleet.names[j]].verdict == "corrected"


def test_the_junction_sum_told_is_that_of_what_is_applied(bent: Calibrated) -> None:
    fleet, parameters, _ = bent
    noise_a = 0.4 * np.random.default_rng(1).standard_normal(fleet.learnt[0].measured_a.shape)
    for (j, _), model in deployed(bent).items():
        told, trip = parameters[fleet.names[j]], fleet.learnt[j]
        faults = [sensor_fault(fleet.recorded.database, InForce(parameters=told), name) for name in fleet.branches]
        currents = [
            [fault.true_current(i_m, at_c) for i_m, at_c in zip(values, trip.temperature_c.tolist(), strict=True)]
            for fault, values in zip(faults, (trip.measured_a + noise_a).T.tolist(), strict=True)
        ]
        residual_a = float(np.sqrt(np.mean(np.sum(np.array(currents, dtype=float), axis=0) ** 2)))
        near = 0.15 if isinstance(model, GainBySign) else 0.03  # by sign: where noise changes the sign, only nearly
        assert told.junction_residual.corrected_a == pytest.approx(residual_a, rel=near)


def test_the_node_takes_the_parameters_and_shows_their_models(
    bent: Calibrated, database: VehicleDatabase, tmp_path: Path
) -> None:
    fleet, parameters, _ = bent
    for (j, k), model in deployed(bent).items():
        path = tmp_path / f"{fleet.names[j]}.json"
        write_parameters(parameters[fleet.names[j]], path)
        read = read_parameters(path)
        assert read == parameters[fleet.names[j]]
        check_fit(read, database, fleet.names[j])
        wire(database, InForce(parameters=read), start_s=0.0)
        branch = database.layout.find_branch(fleet.branches[k])
        plan = branch_plan(
            database, branch, sensor_fault(database, InForce(parameters=read), branch.name), Mode.OVERLAY
        )
        assert isinstance(plan, SignPlan if isinstance(model, GainBySign) else TemperaturePlans)
        report = check_report(path, LAYOUT, fleet.names[j])
        assert report["warnings"] == []
        assert f"sensor model {report['branches'][branch.name]['sensor_model']!r}" in report_text(report)


def test_where_the_layout_names_no_temperature_no_drift_with_it_is_corrected(database: VehicleDatabase) -> None:
    recorded = small_fleet()
    fleet = draw_sensors(recorded, CASE, 3)
    layout: Layout = msgspec.structs.replace(database.layout, temperature=None)
    parameters, findings = calibrate_sensors(fleet, dataclasses.replace(database, layout=layout))
    assert {c.model for row in findings.choices for c in row} <= {LINEAR, "gain by sign"}
    models = deployed((fleet, parameters, findings))
    assert models
    assert all(isinstance(model, GainBySign) for model in models.values())


@pytest.mark.parametrize(
    "case",
    [
        dataclasses.replace(ALONE, difference=(0.004, 0.006), drift_per_k=(0.0001, 0.0002)),
        dataclasses.replace(ALONE, difference=(0.01, 0.014), drift_per_k=(0.0002, 0.0004), duration_s=150.0),
        dataclasses.replace(CASE, share=0.0),
    ],
    ids=["weak", "too little driving", "none"],
)
def test_what_is_not_sure_is_not_corrected_with_a_model(case: SensorCase) -> None:
    assert deployed(calibrated(case)) == {}


def test_a_score_counts_each_sensor_once(bent: Calibrated, database: VehicleDatabase) -> None:
    score = score_sensors(*bent, database)
    assert score.not_linear == round(CASE.share * CASE.vehicles)
    assert score.deployed == len(deployed(bent))
    assert score.deployed <= score.decided <= score.not_linear
    assert (score.harmed, score.wrong) == (0, 0)
    assert score.rms_corrected_a < score.rms_measured_a
