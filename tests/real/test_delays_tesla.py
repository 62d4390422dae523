"""Delays of the branches of a recorded Tesla Model 3: battery current, and two inverters' power over voltage.

Its true delays are not known; that a delay put in is found, and one taken out is gone, can be checked: of the rear
inverter. The front one's currents are small, in steps of 1.4 A, and 95 s are too short to be sure of its delay.
"""

from pathlib import Path

import msgspec
import pytest

from calibrator.drive import Drive
from calibrator.drives.delays import estimate_delays, without_delays
from calibrator.recordings.readers import read_recording
from ecu_node.database import read_database
from ecu_node.layout import read_layout

LAYOUT = Path(__file__).parents[2] / "dbc" / "tesla_model3.toml"
BRANCHES = ("battery", "motor_rear", "motor_front")


@pytest.fixture(scope="module")
def drive(shared_data: Path) -> Drive:
    folder = shared_data / "tesla_model3"
    database = read_database(msgspec.structs.replace(read_layout(LAYOUT), dbc=str(folder / "Model3CAN.dbc")))
    return read_recording(folder / "drive.log.gz", database, vehicle="model3", name="drive").drive


def test_a_delay_taken_out_of_a_real_car_is_gone(drive: Drive) -> None:
    aligned = without_delays(drive, estimate_delays([drive], BRANCHES).by_branch())
    found = estimate_delays([aligned], BRANCHES)
    assert found.known[1]
    assert found.delay_s[1] == pytest.approx(0.0, abs=1e-3)


def test_a_delay_put_into_a_real_car_is_found_within_a_millisecond(drive: Drive) -> None:
    before = estimate_delays([drive], BRANCHES)
    after = estimate_delays([without_delays(drive, {"motor_rear": -0.0731})], BRANCHES)
    assert after.delay_s[1] - before.delay_s[1] == pytest.approx(0.0731, abs=1e-3)
