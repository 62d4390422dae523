"""
A log through the node, and the sum before and after
====================================================

A vehicle is calibrated by one sensor that is trusted; then its node answers the frames of another drive. A shell does
as well for the commands. On a bus ``calibrator replay`` and ``ecu-node run`` take the place of the second block.
"""

from pathlib import Path
from tempfile import mkdtemp

import can
import pandas as pd
from typer.testing import CliRunner

from calibrator.cli import app
from calibrator.recordings.log_formats import read_frames
from ecu_node.bus.wiring import choose_parameters, wire
from ecu_node.database import read_database
from ecu_node.layout import read_layout

calibrator, layout, out = CliRunner().invoke, Path("../dbc/hv_powertrain.toml"), Path(mkdtemp())
calibrator(app, f"simulate --vehicles 2 --minutes 2 --unseen-minutes 1 --seed 3 --layout {layout} --out {out}/fleet")
known = "--trusted motor --load 0:0.1"
print(calibrator(app, f"calibrate {out}/fleet/logs/V002 {known} --layout {layout} --out {out}/result").stdout)

# %%
# Each frame of a branch is answered by one with the corrected current:
database = read_database(read_layout(layout))
node = wire(database, choose_parameters(out / "result/params/V002.json", database, "V002"), 0.0)
with can.Logger(out / "both.log") as log:
    for frame in read_frames(out / "fleet/unseen/V002/drive.log.gz").messages():
        log(frame)
        source = node.sources.get((frame.arbitration_id, frame.is_extended_id))
        for answer in source.answer(frame.data, frame.timestamp) if source else ():
            log(can.Message(frame.timestamp, *answer.key, data=answer.data))
print(calibrator(app, f"kirchhoff {out}/both.log --layout {layout} --table {out}/sums.csv").stdout)
axes = pd.read_csv(out / "sums.csv", index_col="time_s").filter(regex="^sum").plot(ylabel="sum [A]", figsize=(8.0, 4.0))
