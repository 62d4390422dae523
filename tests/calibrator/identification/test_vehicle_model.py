from pathlib import Path

import numpy as np
import pytest

from calibrator.drive import Array, Channel, Drive, DriveFile
from calibrator.drives.store import write_drive
from calibrator.errors import DriveError
from calibrator.faults import corrected_currents
from calibrator.files.parameter_files import current_moments, junction_residual
from calibrator.identification.vehicle_model import VehicleModel, read_vehicle_model
from calibrator.sources.fleet_source import Equipment
from ecu_node.database import VehicleDatabase

INPUTS = ("driving_current", "heater_current")
EQUIPMENT = Equipment(branches=("battery", "motor"), inputs=INPUTS, fleet_inputs=INPUTS, notices=())


def channel(value: Array, good: Array | None = None) -> Channel:
    mask = np.ones(len(value), bool) if good is None else good.astype(bool)
    return Channel(time_s=np.arange(float(len(value))) * 0.1, value=value, good=mask)


def drive(name: str, samples: int, *, heater: bool = True, seed: int = 0) -> Drive:
    """Battery = 2 driving + heater, motor = -1.9 driving - heater - 3: exact, without dynamics."""
    rng = np.random.default_rng(seed)
    torque = np.repeat(rng.uniform(5.0, 100.0, size=samples // 10 + 1), 10)[:samples]
    power = np.repeat(rng.choice([0.0, 2000.0, 4000.0], size=samples // 50 + 1), 50)[:samples] * float(heater)
    speed, voltage = np.full(samples, 40.0), np.full(samples, 400.0)
    driving, heating = torque * speed / voltage, power / voltage
    return Drive(
        vehicle="V1",
        name=name,
        branches={"battery": channel(2.0 * driving + heating), "motor": channel(-1.9 * driving - heating - 3.0)},
        inputs={
            "torque": channel(torque),
            "speed": channel(speed),
            "voltage": channel(voltage),
            "heater_demand": channel(power),
        },
    )


def model_of(database: VehicleDatabase, store: Path, *drives: Drive) -> VehicleModel:
    entries = [
        DriveFile(vehicle=item.vehicle, name=item.name, path=write_drive(store, item, database.layout))
        for item in drives
    ]
    return read_vehicle_model(entries, EQUIPMENT, database)


def test_static_vehicle_is_simulated_exactly_on_held_out_data(database: VehicleDatabase, tmp_path: Path) -> None:
    vehicle = model_of(database, tmp_path, drive("a", 3000))
    assert vehicle.snr_db.min() > 80.0
    assert vehicle.duration_s == pytest.approx(300.0, abs=0.2)
    assert len(vehicle.held_out_inputs) == pytest.approx(600 + vehicle.lead_in, abs=1)


def test_two_drives_of_a_vehicle_are_used_together(database: VehicleDatabase, tmp_path: Path) -> None:
    vehicle = model_of(database, tmp_path, drive("a", 2000), drive("b", 1000, seed=1))
    assert vehicle.drives == ("a", "b")
    assert vehicle.duration_s == pytest.approx(300.0, abs=0.3)
    assert vehicle.snr_db.min() > 80.0


def test_input_that_never_varies_has_no_effect_in_the_model(database: VehicleDatabase, tmp_path: Path) -> None:
    vehicle = model_of(database, tmp_path, drive("a", 3000, heater=False))
    np.testing.assert_array_equal(vehicle.model.D[:, 1], 0.0)
    np.testing.assert_array_equal(vehicle.model.B[:, 1], 0.0)
    varied = np.column_stack([np.full(100, 5.0), np.linspace(0.0, 10.0, 100)])
    np.testing.assert_allclose(vehicle.model.simulate(varied)[:, 0], 10.0, atol=1e-6)


def test_parked_vehicle_is_left_out_in_words(database: VehicleDatabase, tmp_path: Path) -> None:
    moving = drive("a", 3000, heater=False)
    still = channel(np.zeros(3000))
    inputs = {**moving.inputs, "torque": still, "heater_demand": still}
    with pytest.raises(DriveError, match="none of its inputs varies: was it parked"):
        model_of(database, tmp_path, Drive(vehicle="V1", name="a", branches=moving.branches, inputs=inputs))


def test_drive_that_is_good_only_at_its_start_has_held_out_data(database: VehicleDatabase, tmp_path: Path) -> None:
    recorded = drive("a", 3000)
    battery = recorded.branches["battery"]
    half = Channel(time_s=battery.time_s, value=battery.value, good=np.arange(3000) < 1500)
    branches = {**recorded.branches, "battery": half}
    vehicle = model_of(database, tmp_path, Drive(vehicle="V1", name="a", branches=branches, inputs=recorded.inputs))
    assert np.isfinite(vehicle.simulation_error_a).all()
    assert vehicle.duration_s == pytest.approx(150.0, abs=0.2)


def test_three_seconds_are_too_little(database: VehicleDatabase, tmp_path: Path) -> None:
    with pytest.raises(DriveError, match=r"of usable data in 1 drive; at least 60 s are needed"):
        model_of(database, tmp_path, drive("a", 30))


def test_the_junction_residual_from_moments_is_that_of_the_samples(database: VehicleDatabase, tmp_path: Path) -> None:
    recorded = drive("a", 3000)
    vehicle = model_of(database, tmp_path, recorded)
    measured = np.column_stack([recorded.branches[name].value for name in EQUIPMENT.branches])
    drift, offset_a = np.array([0.1, -0.05]), np.array([2.0, -1.0])
    corrected = corrected_currents(measured, drift=drift, offset_a=offset_a)
    found = junction_residual(
        current_moments(vehicle.mean_a, vehicle.moment_a2), gain=1.0 + drift[None], offset_a=offset_a, expected_a=1.5
    )

    def rms(values: Array) -> float:
        return float(np.sqrt(np.mean(values.sum(axis=1) ** 2)))

    assert found.measured_a == pytest.approx(rms(measured), rel=1e-3)
    assert found.corrected_a == pytest.approx(rms(corrected), rel=1e-3)
    assert found.correction_a == pytest.approx(rms(measured - corrected), rel=1e-3)
    assert found.measured_mean_a == pytest.approx(float(measured.sum(axis=1).mean()), rel=1e-3)
    assert found.corrected_mean_a == pytest.approx(float(corrected.sum(axis=1).mean()), rel=1e-3)
    about = [float(np.sqrt(np.mean((sums.sum(axis=1) - 1.5) ** 2))) for sums in (measured, corrected)]
    assert found.about_expected() == pytest.approx(about, rel=1e-3)
