"""
From a spreadsheet
==================

A table as a European spreadsheet writes it: semicolons, decimal commas, units in the header, time in ms. A layout of a
few lines says which columns are the branches; delimiter, decimal sign, units and time column are found.
"""

from pathlib import Path
from tempfile import mkdtemp

import numpy as np
import pandas as pd

from calibrator import JunctionCalibrator, read_log

folder, rng, time_ms = Path(mkdtemp()), np.random.default_rng(2), np.arange(0, 300_000, 100)
motor_a = np.convolve(np.repeat(rng.uniform(-40.0, 90.0, 61), 50), np.full(20, 0.05), mode="same")[: len(time_ms)]
columns = {"Zeit [ms]": time_ms, "Batterie [A]": motor_a, "Wechselrichter [A]": 0.95 * motor_a}
table = pd.DataFrame(columns).round(1)
table.to_csv(folder / "fahrt.csv", sep=";", decimal=",", index=False)
(folder / "car.toml").write_text("""
schema = 1
name = "car"
full_scale_a = 200
branch = [
    { name = "battery", signal = "Batterie", sign = 1 },
    { name = "motor", signal = "Wechselrichter", sign = -1 },  # positive out of the junction
]
""")
print((folder / "fahrt.csv").read_text()[:120])
read_log(folder / "fahrt.csv", folder / "car.toml").to_frame().tail(3)

# %%
# The same as ``calibrator calibrate fahrt.csv --layout car.toml --trusted battery --load 0:0.1 --out result``:
calibrator = JunctionCalibrator(trusted=["battery"], load=(0.0, 0.1)).fit(folder / "fahrt.csv", folder / "car.toml")
print(calibrator.summary())
