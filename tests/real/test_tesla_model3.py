"""The recorded drive of a Tesla Model 3 with its own DBC and the layout of this repository."""

from pathlib import Path

import can
import cantools
import numpy as np
from cantools.database.can import Database

from calibrator.recordings.readers import read_recording
from ecu_node.database import read_database
from ecu_node.layout import read_layout


def test_tesla_currents_decode_as_cantools_decodes_them(tesla: Path) -> None:
    layout = read_layout(tesla / "tesla_model3.toml")
    recording = read_recording(tesla / "drive.log.gz", read_database(layout), vehicle="model3", name="drive")
    database = cantools.database.load_file(tesla / "Model3CAN.dbc", strict=False)
    assert isinstance(database, Database)
    current: list[float] = []
    rear: list[float] = []
    voltage = np.nan
    for message in can.LogReader(tesla / "drive.log.gz"):
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
