"""
One car with a sensor that you trust
====================================

Three currents of one car meet in its junction, and the battery's sensor was checked on a bench. The junction law then
gives the gain errors of the others. Their offsets need one fact more: here, that no other load is on the junction.
"""

import numpy as np
import pandas as pd

from calibrator import Junction, JunctionCalibrator

rng = np.random.default_rng(1)
time_s = pd.Index(np.arange(0.0, 600.0, 0.1), name="time [s]")
pedal = np.repeat(rng.uniform(-60.0, 150.0, 121), 50)  # something else every 5 s
motor_a = -np.convolve(pedal, np.full(20, 0.05), mode="same")[: len(time_s)]
heater_a = -12.0 * np.repeat(rng.integers(0, 2, 21), 300)[: len(time_s)]
true = pd.DataFrame({"battery": -motor_a - heater_a, "motor": motor_a, "heater": heater_a}, time_s)
measured = true * [1.0, 1.06, 1.0] + rng.normal(0.0, 0.2, true.shape)  # the motor's sensor reads 6 % too much

junction = Junction(branches=["battery", "motor", "heater"], full_scale_a=400.0)
calibrator = JunctionCalibrator(trusted=["battery"], load=(0.0, 0.1)).fit(measured, junction)
calibrator.parameters_[["branch", "gain_error", "gain_error_sd", "offset_a", "offset_sd_a", "corrected"]]

# %%
# How sure that is, and what is corrected:
print(calibrator.vehicles_["vehicle"].explain())

# %%
# The sum of the currents, which should be 0 A, before and after:
corrected = calibrator.vehicles_["vehicle"].correct(measured)
sums = pd.DataFrame({"measured": measured.sum(axis=1), "corrected": corrected.sum(axis=1)})
axes = sums[:120.0].plot(ylabel="sum of the currents [A]", figsize=(8.0, 4.0))
