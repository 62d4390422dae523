"""The recorded drive of a Tesla Model 3 with its own DBC and the layout of this repository."""

from pathlib import Path

import can
import cantools
import msgspec
import numpy as np
import pytest
from cantools.database.can import Database

from calibrator.recordings.log_formats import read_frames
from calibrator.recordings.readers import read_recording
from ecu_node.database import VehicleDatabase, read_database
from ecu_node.layout import read_layout

ROOT = Path(__file__).parents[2]
LAYOUT = ROOT / "dbc" / "tesla_model3.toml"


@pytest.fixture(scope="module")
def folder(shared_data: Path) -> Path:
    return shared_data / "tesla_model3"


@pytest.fixture(scope="module")
def tesla(folder: Path) -> VehicleDatabase:
    layout = msgspec.structs.replace(read_layout(LAYOUT), dbc=str(folder / "Model3CAN.dbc"))
    return read_database(layout)


def test_tesla_frames_are_read_as_python_can_reads_them(folder: Path) -> None:
    frames = read_frames(folder / "drive.log.gz")
    messages = list(can.LogReader(folder / "drive.log.gz"))
    assert frames.key.tolist() == [message.arbitration_id for message in messages]
    assert [frames.data[k, :n].tobytes() for k, n in enumerate(frames.length)] == [bytes(m.data) for m in messages]
    assert frames.damaged == 0


def test_tesla_currents_decode_as_cantools_decodes_them(folder: Path, tesla: VehicleDatabase) -> None:
    recording = read_recording(folder / "drive.log.gz", tesla, vehicle="model3", name="drive")
    database = cantools.database.load_file(folder / "Model3CAN.dbc", strict=False)
    assert isinstance(database, Database)
    current: list[float] = []
    rear: list[float] = []
    voltage = np.nan
    for message in can.LogReader(folder / "drive.log.gz"):
        if message.arbitration_id not in {0x132, 0x266}:
            continue
        values = database.decode_message(message.arbitration_id, bytes(message.data), decode_choices=False)
        assert isinstance(values, dict)
        if message.arbitration_id == 0x132:
            voltage = float(str(values["BattVoltage132"]))
            current.append(float(str(values["SmoothBattCurrent132"])))
        else:
            rear.append(-1000.0 * float(str(values["RearPower266"])) / voltage)
    assert recording.report.notices() == []
    np.testing.assert_allclose(recording.drive.branches["battery"].value, current, rtol=1e-12)
    np.testing.assert_allclose(recording.drive.branches["motor_rear"].value, rear, rtol=1e-12)
