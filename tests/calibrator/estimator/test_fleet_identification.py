"""``calibrator identify``: the filter bank chosen for known vehicles follows them; models of single vehicles."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import lfilter

from calibrator.drive import Array, Channel, Drive, DriveFile, Equipment, Samples
from calibrator.drives.store import write_drive
from calibrator.errors import DriveError
from calibrator.estimator.fleet_identification import choose_filter_bank, held_out_snr_db
from calibrator.estimator.published_fleet import read_vehicle_model
from calibrator.estimator.vehicle_parameters import current_moments, junction_residual
from calibrator.published.state_space import VehicleModel
from calibrator.summaries.filter_bank import FilterBank, read_bank
from calibrator.summaries.summariser import summarise_samples
from ecu_node.database import VehicleDatabase
from ecu_node.layout import read_layout
from tests.calibrator.command_here import reported
from tests.calibrator.conftest import LAYOUT
from tests.calibrator.estimator.simulated_drives import coloured, samples_of

INPUTS, BRANCHES = ("driving_current", "heater_current"), ("battery", "motor", "auxiliary")
PERIOD_S = 0.1

# A bank that is chosen


def filtered(inputs: Array, *poles: complex) -> Array:
    """Each pole as a low-pass, or resonance, of a mixture of the inputs, shape (T, number of poles)."""
    mixtures = inputs @ np.random.default_rng(0).normal(size=(inputs.shape[1], len(poles)))
    found = []
    for mixture, p in zip(mixtures.T, poles, strict=True):
        a = np.array([1.0, -p.real]) if not p.imag else np.array([1.0, -2.0 * p.real, abs(p) ** 2])
        found.append(lfilter([a.sum()], a, mixture))
    return np.stack(found, axis=1)


def recorded(number: int, *poles: complex, snr_db: float, samples: int = 6000) -> Samples:
    """A drive of a vehicle with these poles: three inputs, four branches whose currents sum to zero, white noise."""
    rng = np.random.default_rng(number)
    inputs = 0.5 + coloured(rng, samples, 3, 0.95)
    inputs[:, 0] = np.repeat(rng.normal(size=samples // 50), 50)
    coupling = np.random.default_rng(1).normal(size=(len(poles) + 3, 4))
    clean = np.hstack([filtered(inputs, *poles), inputs]) @ (20.0 * (coupling - coupling.mean(axis=1, keepdims=True)))
    return samples_of(inputs, clean + rng.normal(size=clean.shape) * clean.std(axis=0) * 10.0 ** (-snr_db / 20.0))


def differing_vehicle(number: int, samples: int) -> Samples:
    """Four lags and a resonance, each within 15 % of the fleet's."""
    factors = 1.0 + 0.15 * np.random.default_rng([1, number]).uniform(-1.0, 1.0, 5)
    lags = np.exp(-PERIOD_S / (np.array([0.3, 1.0, 4.0, 15.0]) * factors[:4])).astype(complex)
    resonance = np.exp(PERIOD_S * 2.0 * np.pi * 0.5 * factors[4] * complex(-0.35, np.sqrt(1.0 - 0.35**2)))
    return recorded(number, *lags, resonance, snr_db=60.0, samples=samples)


def test_filter_bank_of_some_vehicles_fits_others_with_different_poles() -> None:
    bank = choose_filter_bank([[differing_vehicle(j, 6000)] for j in range(100, 104)], period_s=PERIOD_S)
    plain = FilterBank(input_names=bank.input_names, period_s=PERIOD_S)
    drives = [differing_vehicle(j, 12_000) for j in range(4)]
    with_bank, without = (
        held_out_snr_db([summarise_samples([each], period_s=PERIOD_S, bank=of) for each in drives])
        for of in (bank, plain)
    )
    assert without.max() < 20.0
    assert np.median(with_bank) > 50.0
    assert with_bank.min() > 40.0


# Drives of a motor that takes the driving current with a lag, and a heater that follows at once

SAMPLES = 3000
MOTOR_S, SLUGGISH_S, SLUGGISH = 2.0, 12.0, "V4"
"""Time constants of the motor of the fleet, and of the one vehicle that is different. [s]"""


def channel(value: Array) -> Channel:
    return Channel(time_s=np.arange(float(len(value))) * PERIOD_S, value=value, good=np.ones(len(value), bool))


def drive(
    name: str, samples: int = SAMPLES, *, vehicle: str = "V1", lag_s: float = 0.0, noise_a: float = 0.0, seed: int = 0
) -> Drive:
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
    places = [(item, write_drive(store, item, database.layout)) for item in drives]
    entries = [DriveFile(vehicle=item.vehicle, name=item.name, place=place) for item, place in places]
    equipment = Equipment(branches=BRANCHES, inputs=INPUTS, fleet_inputs=INPUTS, notices=())
    return read_vehicle_model(entries, equipment, database)


def test_vehicle_without_dynamics_is_simulated_exactly(database: VehicleDatabase, tmp_path: Path) -> None:
    one = model_of(database, tmp_path, drive("whole"))
    two = model_of(database, tmp_path, drive("a", 2000), drive("b", 1000, seed=1))
    assert two.drives == ("a", "b")
    for vehicle in (one, two):
        assert vehicle.snr_db.min() > 80.0
        assert vehicle.duration_s == pytest.approx(300.0, abs=0.3)
    assert len(one.held_out_inputs) == pytest.approx(600 + one.lead_in, abs=1)


def test_vehicle_that_was_parked_or_has_less_than_60_s_of_data_is_refused(
    database: VehicleDatabase, tmp_path: Path
) -> None:
    moving, still = drive("a"), channel(np.zeros(SAMPLES))
    parked = replace(moving, inputs={**moving.inputs, "torque": still, "heater_demand": still})
    with pytest.raises(DriveError, match="none of its inputs varies: was it parked"):
        model_of(database, tmp_path, parked)
    with pytest.raises(DriveError, match=r"of usable data in 1 drive; at least 60 s are needed"):
        model_of(database, tmp_path, drive("b", 30))


def test_junction_residual_from_moments_equals_that_of_the_samples() -> None:
    measured = np.random.default_rng(1).normal(2.0, 20.0, size=(500, 2))
    drift, offset_a = np.array([0.1, -0.05]), np.array([2.0, -1.0])
    corrected = (measured - offset_a) / (1.0 + drift)
    moments = current_moments(measured.mean(axis=0), measured.T @ measured / len(measured))
    found = junction_residual(moments, gain=1.0 + drift[None], offset_a=offset_a, expected_a=1.5)
    sums = [values.sum(axis=1) for values in (measured, corrected, measured - corrected)]
    rms = [float(np.sqrt(np.mean(values**2))) for values in sums]
    assert [found.measured_a, found.corrected_a, found.correction_a] == pytest.approx(rms)
    assert [found.measured_mean_a, found.corrected_mean_a] == pytest.approx([sums[0].mean(), sums[1].mean()])
    about = [float(np.sqrt(np.mean((values - 1.5) ** 2))) for values in sums[:2]]
    assert found.about_expected() == pytest.approx(about)


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder, layout = tmp_path_factory.mktemp("identify") / "store", read_layout(LAYOUT)
    for j in range(5):
        lag_s = SLUGGISH_S if f"V{j}" == SLUGGISH else MOTOR_S
        write_drive(folder, drive("drive", 1800, vehicle=f"V{j}", lag_s=lag_s, noise_a=0.02, seed=j), layout)
    return folder


def test_identify_writes_the_bank_and_names_the_worst_fitted_vehicle(store: Path, tmp_path: Path) -> None:
    bank = tmp_path / "new" / "bank.json"
    figures = reported("identify", store, "--layout", LAYOUT, "--workers", 1, "--out", bank)
    worst = figures["branches"]["motor"]["worst_vehicle"]
    assert figures["snr_db"][worst]["motor"] == min(each["motor"] for each in figures["snr_db"].values())
    assert figures["branches"]["motor"]["median_db"] > 30.0
    assert read_bank(bank).described() == figures["bank"]["described"]
