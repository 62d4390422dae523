"""Models of single vehicles from their drives, and ``calibrator identify`` as a user types it."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import lfilter
from typer.testing import CliRunner, Result

from calibrator.cli import app
from calibrator.drive import Array, Channel, Drive, DriveFile, Equipment, Mask
from calibrator.drives.store import write_drive
from calibrator.errors import DriveError, FleetError
from calibrator.estimator.published_fleet import read_vehicle_model
from calibrator.files.parameter_files import current_moments, junction_residual
from calibrator.published.state_space import VehicleModel
from calibrator.summaries.filter_bank import FilterBank, low_passes, read_bank
from ecu_node.database import VehicleDatabase
from ecu_node.layout import read_layout

INPUTS, BRANCHES = ("driving_current", "heater_current"), ("battery", "motor", "auxiliary")
EQUIPMENT = Equipment(branches=BRANCHES, inputs=INPUTS, fleet_inputs=INPUTS, notices=())
LAYOUT = Path(__file__).parents[3] / "dbc" / "hv_powertrain.toml"
SAMPLES, PERIOD_S = 3000, 0.1
MOTOR_S, SLUGGISH_S = 2.0, 12.0
"""Time constants of the motor of the fleet, and of the one vehicle that is different. [s]"""
SLUGGISH = "V4"


def channel(value: Array, good: Mask | None = None) -> Channel:
    mask = np.ones(len(value), bool) if good is None else good
    return Channel(time_s=np.arange(float(len(value))) * PERIOD_S, value=value, good=mask)


def drive(
    name: str, samples: int = SAMPLES, *, vehicle: str = "V1", lag_s: float = 0.0, noise_a: float = 0.0, seed: int = 0
) -> Drive:
    """A motor that takes the driving current with a lag, and a heater that follows at once."""
    rng = np.random.default_rng(seed)
    torque = np.repeat(rng.uniform(5.0, 100.0, size=samples // 30 + 1), 30)[:samples]
    power = np.repeat(rng.choice([0.0, 2000.0, 4000.0], size=samples // 50 + 1), 50)[:samples]
    speed, voltage = np.full(samples, 40.0), np.full(samples, 400.0)
    pole = np.exp(-PERIOD_S / lag_s) if lag_s else 0.0
    motor, heater = lfilter([1.0 - pole], [1.0, -pole], -torque * speed / voltage), -power / voltage
    currents = np.stack([-motor - heater, motor, heater]) + noise_a * rng.normal(size=(3, samples))
    inputs = {"torque": torque, "speed": speed, "voltage": voltage, "heater_demand": power}
    return Drive(
        vehicle=vehicle,
        name=name,
        branches={key: channel(value) for key, value in zip(BRANCHES, currents, strict=True)},
        inputs={key: channel(value) for key, value in inputs.items()},
    )


def model_of(database: VehicleDatabase, store: Path, *drives: Drive) -> VehicleModel:
    entries = [
        DriveFile(vehicle=item.vehicle, name=item.name, place=write_drive(store, item, database.layout))
        for item in drives
    ]
    return read_vehicle_model(entries, EQUIPMENT, database)


def test_static_vehicle_is_simulated_exactly_from_one_drive_or_two(database: VehicleDatabase, tmp_path: Path) -> None:
    one = model_of(database, tmp_path, drive("whole"))
    two = model_of(database, tmp_path, drive("a", 2000), drive("b", 1000, seed=1))
    assert two.drives == ("a", "b")
    for vehicle in (one, two):
        assert vehicle.snr_db.min() > 80.0
        assert vehicle.duration_s == pytest.approx(300.0, abs=0.3)
    assert len(one.held_out_inputs) == pytest.approx(600 + one.lead_in, abs=1)


def test_parked_and_hardly_recorded_vehicles_are_refused(database: VehicleDatabase, tmp_path: Path) -> None:
    moving, still = drive("a"), channel(np.zeros(SAMPLES))
    parked = replace(moving, inputs={**moving.inputs, "torque": still, "heater_demand": still})
    with pytest.raises(DriveError, match="none of its inputs varies: was it parked"):
        model_of(database, tmp_path, parked)
    with pytest.raises(DriveError, match=r"of usable data in 1 drive; at least 60 s are needed"):
        model_of(database, tmp_path, drive("b", 30))


def test_junction_residual_from_moments_is_that_of_the_samples() -> None:
    measured = np.random.default_rng(1).normal(2.0, 20.0, size=(500, 2))
    drift, offset_a = np.array([0.1, -0.05]), np.array([2.0, -1.0])
    corrected = (measured - offset_a) / (1.0 + drift)
    moments = current_moments(measured.mean(axis=0), measured.T @ measured / len(measured))
    found = junction_residual(moments, gain=1.0 + drift[None], offset_a=offset_a, expected_a=1.5)
    sums = [values.sum(axis=1) for values in (measured, corrected, measured - corrected)]
    rms = [float(np.sqrt(np.mean(values**2))) for values in sums]
    assert [found.measured_a, found.corrected_a, found.correction_a] == pytest.approx(rms)
    means = [float(values.mean()) for values in sums[:2]]
    assert [found.measured_mean_a, found.corrected_mean_a] == pytest.approx(means)
    about = [float(np.sqrt(np.mean((values - 1.5) ** 2))) for values in sums[:2]]
    assert found.about_expected() == pytest.approx(about)


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("identify") / "store"
    for j in range(5):
        lag_s = SLUGGISH_S if f"V{j}" == SLUGGISH else MOTOR_S
        item = drive("drive", vehicle=f"V{j}", lag_s=lag_s, noise_a=0.02, seed=j)
        write_drive(folder, item, read_layout(LAYOUT))
    return folder


def low_pass_bank(inputs: tuple[str, ...], time_constant_s: float) -> FilterBank:
    poles = low_passes(np.array([time_constant_s]), period_s=PERIOD_S)
    return FilterBank(input_names=inputs, period_s=PERIOD_S, poles=poles)


def run_identify(store: Path, *options: object) -> Result:
    """The command in this process, which need not import everything again."""
    arguments = ["identify", str(store), "--layout", str(LAYOUT), "--workers", "1", *map(str, options)]
    return CliRunner().invoke(app, arguments)


def test_given_pole_is_used_and_the_vehicle_that_has_another_is_named(store: Path, tmp_path: Path) -> None:
    given, bank = tmp_path / "given.json", tmp_path / "new" / "bank.json"
    assert run_identify(store, "--out", given).exit_code == 0
    given.write_bytes(low_pass_bank(read_bank(given).input_names, MOTOR_S).to_json())
    run = run_identify(store, "--bank", given, "--out", bank, "--json")
    assert run.exit_code == 0, run.output
    figures = json.loads(run.stdout)
    assert figures["branches"]["motor"]["worst_vehicle"] == SLUGGISH
    assert figures["branches"]["motor"]["median_db"] > 30.0
    assert figures["branches"]["motor"]["worst_db"] == figures["snr_db"][SLUGGISH]["motor"] < 20.0
    assert read_bank(bank).described() == "2 s"
    assert json.loads(run_identify(store, "--bank", bank, "--json").stdout) == figures


def test_bank_of_other_inputs_and_a_folder_as_output_are_refused(store: Path, tmp_path: Path) -> None:
    path = tmp_path / "bank.json"
    path.write_bytes(low_pass_bank(("pedal",), 1.0).to_json())
    run = run_identify(store, "--bank", path)
    with pytest.raises(DriveError, match=r"is of the inputs pedal every 0\.1 s, the fleet has driving_current"):
        raise run.exception or AssertionError(run.output)
    run = run_identify(store, "--out", tmp_path)
    with pytest.raises(FleetError, match="is a folder; name a file in it"):
        raise run.exception or AssertionError(run.output)
