"""Sensors that are not linear as a user meets them: a drive store in, parameter files and notices out."""

import pickle
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pytest

from calibrator.artificial.builtin_drives import builtin_trip
from calibrator.artificial.ground_truth import GroundTruth, with_branches
from calibrator.artificial.random_fleet import draw_faults
from calibrator.calibration.calibrate_fleet import calibrate_fleet
from calibrator.calibration.in_order import Workers
from calibrator.calibration_settings import HARM_LIMIT, CalibrationSettings
from calibrator.drive import Array, Channel, Drive
from calibrator.drives.store import write_drive
from calibrator.faults import measured_currents, true_currents
from calibrator.results.run_record import read_run
from calibrator.sensor_models.families import FAMILIES
from calibrator.sensor_models.families import GainBySign as GainBySignSensor
from ecu_node.database import read_database
from ecu_node.in_force import InForce
from ecu_node.layout import read_layout
from ecu_node.parameter_fit import check_fit
from ecu_node.parameters import VehicleParameters, read_parameters
from ecu_node.sensor_models import GainBySign
from ecu_node.wiring import wire
from tests.calibrator.command_here import calibrator

pytest.importorskip("fastsim")
LAYOUT = Path(__file__).parents[2] / "dbc" / "hv_powertrain.toml"
VEHICLES, BRANCHES = 12, ("battery", "motor")
BENT, BENT_BRANCH = 4, "battery"
SENSOR = GainBySignSensor(drift_positive=0.06, drift_negative=-0.12)
NOISE_A = 0.4
Calibrated = Mapping[str, VehicleParameters]


def calibrate_here(store: Path, out: Path, settings: CalibrationSettings) -> Calibrated:
    """The same in this process, which need not start others."""
    calibrate_fleet(store, read_database(read_layout(LAYOUT)), out, settings, workers=Workers(processes=1))
    return {path.stem: read_parameters(path) for path in sorted((out / "params").iterdir())}


def calibrate(store: Path, out: Path, *options: str) -> Calibrated:
    run = calibrator("calibrate", store, "--layout", LAYOUT, "--out", out, *options)
    assert run.returncode == 0, run.stderr
    return {path.stem: read_parameters(path) for path in sorted((out / "params").iterdir())}


@pytest.fixture(scope="module")
def trips() -> list[GroundTruth]:
    rng = np.random.default_rng(7)
    drawn = [builtin_trip(rng, duration_s=360.0, name="trip") for _ in range(VEHICLES)]
    return [with_branches(trip, BRANCHES, "battery") for trip in drawn]


def write_store(store: Path, trips: Sequence[GroundTruth], *, bent: bool) -> Path:
    """Write a drive of 6 minutes per vehicle; with one sensor that is not linear, or with none."""
    layout, rng = read_layout(LAYOUT), np.random.default_rng(8)
    faults = draw_faults(
        rng,
        vehicles=VEHICLES,
        branches=2,
        sparsity=80.0,
        magnitude=(0.05, 0.1),
        full_scale_a=layout.full_scale_a,
    )
    for j, trip in enumerate(trips):
        i = true_currents(trip.matrix_a(), faults.take(j))
        i_m = measured_currents(i, faults.take(j))
        if bent and j == BENT:
            k = BRANCHES.index(BENT_BRANCH)
            i_m[:, k] = SENSOR.measured(i[:, k], np.zeros(len(i))) + faults.offset_a[j, k]
        write_drive(store, recorded(trip, i_m + rng.normal(0.0, NOISE_A, i.shape), name(j)), layout)
    return store


def recorded(trip: GroundTruth, i_m: Array, vehicle: str) -> Drive:
    temperature = np.linspace(15.0, 35.0, len(i_m))
    inputs = {**trip.inputs, "junction_box_temperature": temperature}

    def channel(value: Array) -> Channel:
        return Channel(time_s=trip.time_s, value=value, good=np.ones(len(value), np.bool_))

    return Drive(
        vehicle=vehicle,
        name="trip",
        branches={branch: channel(i_m[:, k]) for k, branch in enumerate(BRANCHES)},
        inputs={key: channel(value) for key, value in inputs.items()},
    )


def name(j: int) -> str:
    return f"V{j:02d}"


def findings(calibrated: Calibrated) -> dict[str, tuple[object, ...]]:
    """What was found, without when."""
    return {
        vehicle: tuple(getattr(item, field) for field in item.__struct_fields__ if field != "provenance")
        for vehicle, item in calibrated.items()
    }


@pytest.fixture(scope="module")
def bent_store(trips: list[GroundTruth], tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_store(tmp_path_factory.mktemp("bent") / "store", trips, bent=True)


@pytest.fixture(scope="module")
def with_flag(bent_store: Path) -> Calibrated:
    return calibrate(bent_store, bent_store.parent / "with", "--sensor-models")


@pytest.fixture(scope="module")
def without_flag(bent_store: Path) -> Calibrated:
    return calibrate_here(bent_store, bent_store.parent / "without", CalibrationSettings())


def test_a_gain_that_differs_by_sign_stands_in_the_parameter_file(with_flag: Calibrated) -> None:
    branch = with_flag[name(BENT)].branches[BENT_BRANCH]
    model = branch.sensor_model
    assert isinstance(model, GainBySign)
    assert model.drift_positive - model.drift_negative == pytest.approx(0.18, abs=0.04)
    assert branch.drift == pytest.approx(0.5 * (model.drift_positive + model.drift_negative))
    assert branch.fault_probability is not None
    assert branch.fault_probability > 0.95


def test_no_other_branch_gets_a_sensor_model(with_flag: Calibrated) -> None:
    found = [(v, n) for v, item in with_flag.items() for n, branch in item.branches.items() if branch.sensor_model]
    assert found == [(name(BENT), BENT_BRANCH)]


def test_a_branch_with_a_sensor_model_is_applied_if_harm_is_improbable_and_every_file_fits(
    with_flag: Calibrated,
) -> None:
    database = read_database(read_layout(LAYOUT))
    for vehicle, item in with_flag.items():
        check_fit(item, database, vehicle)
        wire(database, InForce(parameters=item), start_s=0.0)
    branch = with_flag[name(BENT)].branches[BENT_BRANCH]
    assert branch.harm_probability is not None
    assert branch.apply == (branch.harm_probability < HARM_LIMIT)
    assert branch.held_back == (None if branch.apply else "harm limit")
    assert with_flag[name(BENT)].verdict == ("corrected" if branch.apply else "cannot tell")


def test_the_node_shows_what_it_does_with_the_model(bent_store: Path, with_flag: Calibrated) -> None:
    path = bent_store.parent / "with" / "params" / f"{name(BENT)}.json"
    command = [sys.executable, "-m", "ecu_node", "check", "--params", path, "--layout", LAYOUT, "--vehicle", name(BENT)]
    run = subprocess.run([*map(str, command)], capture_output=True, text=True, check=False, timeout=60)
    assert run.returncode == 0, run.stderr
    shown = "sensor model 'gain by sign', positive currents" in run.stdout
    assert shown == with_flag[name(BENT)].branches[BENT_BRANCH].apply


def test_the_notices_name_vehicle_branch_and_model(bent_store: Path, with_flag: Calibrated) -> None:
    notices = read_run(bent_store.parent / "with").notices
    assert any(name(BENT) in notice and "battery (gain by sign)" in notice for notice in notices)


def test_without_the_flag_nothing_is_said_of_sensor_models(bent_store: Path, without_flag: Calibrated) -> None:
    assert all(branch.sensor_model is None for item in without_flag.values() for branch in item.branches.values())
    assert not any("linear" in notice for notice in read_run(bent_store.parent / "without").notices)


def test_a_fleet_of_linear_sensors_has_the_same_parameters_with_and_without_the_flag(
    trips: list[GroundTruth], tmp_path: Path
) -> None:
    store = write_store(tmp_path / "store", trips, bent=False)
    with_it = calibrate_here(store, tmp_path / "with", CalibrationSettings(sensor_models=True))
    assert findings(with_it) == findings(calibrate_here(store, tmp_path / "without", CalibrationSettings()))


def test_families_are_equal_after_they_went_to_another_process() -> None:
    assert pickle.loads(pickle.dumps(FAMILIES)) == FAMILIES
    assert len(set(FAMILIES)) == len(FAMILIES)
