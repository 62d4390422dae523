"""calibrator identify as a user types it: a drive store in, figures and a bank file out."""

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import lfilter
from typer.testing import CliRunner, Result

from calibrator.cli import app
from calibrator.drive import Array, Channel, Drive
from calibrator.drives.store import write_drive
from calibrator.errors import DriveError, FleetError
from calibrator.summaries.filter_bank import low_pass_bank, read_bank
from ecu_node.layout import read_layout

LAYOUT = Path(__file__).parents[2] / "dbc" / "hv_powertrain.toml"
PERIOD_S = 0.1
SAMPLES = 3000
MOTOR_S, SLUGGISH_S = 2.0, 12.0
"""Time constants of the motor of the fleet, and of the one vehicle that is different. [s]"""
SLUGGISH = "V4"


def identify(store: Path, *options: object) -> Result:
    """The command in this process, which need not import everything again."""
    return CliRunner().invoke(
        app, ["identify", str(store), "--layout", str(LAYOUT), "--workers", "1", *map(str, options)]
    )


def low_pass(values: Array, time_constant_s: float) -> Array:
    pole = np.exp(-PERIOD_S / time_constant_s)
    return np.asarray(lfilter([0.0, 1.0 - pole], [1.0, -pole], values))


def drive(vehicle: int) -> Drive:
    """A motor that follows torque slowly, a heater that follows at once."""
    rng = np.random.default_rng(vehicle)
    torque = np.repeat(rng.uniform(5.0, 100.0, SAMPLES // 30), 30)
    power = np.repeat(rng.choice([0.0, 2000.0, 4000.0], SAMPLES // 50), 50)
    speed, voltage = np.full(SAMPLES, 40.0), np.full(SAMPLES, 400.0)
    motor = -low_pass(torque * speed / voltage, SLUGGISH_S if f"V{vehicle}" == SLUGGISH else MOTOR_S)
    heater = -power / voltage
    noise = 0.02 * rng.normal(size=(3, SAMPLES))
    currents = {"battery": -motor - heater, "motor": motor, "auxiliary": heater}
    inputs = {"torque": torque, "speed": speed, "voltage": voltage, "heater_demand": power}
    return Drive(
        vehicle=f"V{vehicle}",
        name="drive",
        branches={name: channel(value + e) for (name, value), e in zip(currents.items(), noise, strict=True)},
        inputs={name: channel(value) for name, value in inputs.items()},
    )


def channel(value: Array) -> Channel:
    return Channel(time_s=PERIOD_S * np.arange(len(value)), value=value, good=np.ones(len(value), bool))


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("identify") / "store"
    for vehicle in range(5):
        write_drive(folder, drive(vehicle), read_layout(LAYOUT))
    return folder


def test_the_pole_that_is_given_is_used_and_the_vehicle_that_has_another_is_named(store: Path, tmp_path: Path) -> None:
    bank = tmp_path / "new" / "bank.json"
    run = identify(store, "--poles", MOTOR_S, "--out", bank, "--json")
    assert run.exit_code == 0, run.output
    figures = json.loads(run.stdout)
    assert list(figures["own_models"]) == [SLUGGISH]
    assert figures["branches"]["motor"]["worst_vehicle"] == SLUGGISH
    assert figures["branches"]["motor"]["median_db"] > 30.0
    assert figures["own_models"][SLUGGISH]["snr_db"]["motor"] > figures["snr_db"][SLUGGISH]["motor"] + 3.0
    assert read_bank(bank).described() == "2 s"
    again = identify(store, "--bank", bank, "--json")
    assert json.loads(again.stdout) == figures


def test_a_bank_is_chosen_that_simulates_the_fleet(store: Path) -> None:
    run = identify(store)
    assert run.exit_code == 0, run.output
    assert "the plain inputs" not in run.stdout
    (motor,) = [line.split() for line in run.stdout.splitlines() if line.startswith("motor ")]
    assert float(motor[1]) > 30.0
    assert "vehicles: 5" in run.stdout


def test_a_bank_of_other_inputs_is_refused(store: Path, tmp_path: Path) -> None:
    path = tmp_path / "bank.json"
    path.write_bytes(low_pass_bank(("pedal",), [1.0], period_s=PERIOD_S).to_json())
    run = identify(store, "--bank", path)
    with pytest.raises(DriveError, match=r"is of the inputs pedal every 0\.1 s, the fleet has driving_current"):
        raise run.exception or AssertionError(run.output)


def test_a_folder_is_no_file_to_write_to(store: Path, tmp_path: Path) -> None:
    run = identify(store, "--out", tmp_path)
    with pytest.raises(FleetError, match="is a folder; name a file in it"):
        raise run.exception or AssertionError(run.output)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--poles", "1", "--bank", "x"), "give --bank or --poles"),
        (("--poles", "1,fast"), "1,fast: expected time constants with commas"),
        (("--poles", "0"), "each from 0.01 to 600 s"),
    ],
)
def test_wrong_use_is_told_before_anything_is_read(options: tuple[str, ...], message: str) -> None:
    run = identify(Path("none"), *options)
    assert run.exit_code == 2
    assert message in " ".join(run.stderr.replace("│", " ").split())
