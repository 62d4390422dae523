"""
A fleet of twelve vehicles
==========================

No sensor is trusted: each vehicle is compared with the others, and its currents with the junction law. Four have a
faulty sensor. The recordings are made up; with recordings of your own only the second block is needed.
"""

import numpy as np
import pandas as pd

from calibrator import Fleet, FleetCalibrator, Junction

FAULTS = {"V02": ("battery", 0.08, 0), "V05": ("motor", 0, 12), "V08": ("battery", -0.05, 0), "V11": ("motor", 0.12, 0)}


def recorded_drive(vehicle: str, rng: np.random.Generator) -> pd.DataFrame:
    """Half an hour at 10 Hz; currents in A, positive into the junction: measured = (1 + gain error) * true + offset."""
    time_s = np.arange(0.0, 1800.0, 0.1)
    torque_nm = 7.5 * np.convolve(np.repeat(rng.uniform(-0.6, 1.0, 361), 50)[: len(time_s)], np.ones(20), mode="same")
    speed_rpm = np.clip(3000.0 + 15.0 * np.cumsum(torque_nm) * 0.01, 500.0, 9000.0)
    power_w, heater_w = torque_nm * speed_rpm * 0.1047, 3000.0 * np.repeat(rng.integers(0, 2, 30), 600)
    currents_a = pd.DataFrame({"battery": power_w + heater_w, "motor": -power_w, "heater": -heater_w}, time_s) / 360.0
    branch, gain_error, offset_a = FAULTS.get(vehicle, ("motor", 0.0, 0.0))
    currents_a[branch] = (1.0 + gain_error) * currents_a[branch] + offset_a
    return (currents_a + rng.normal(0.0, 0.3, currents_a.shape)).assign(power_w=power_w, heater_w=heater_w)


# %%
# A data frame per vehicle; what is not a branch is an input, on which the currents depend.
rng = np.random.default_rng(1)
recordings = {name: recorded_drive(name, rng) for name in (f"V{number:02d}" for number in range(1, 13))}
junction = Junction(branches=["battery", "motor", "heater"], full_scale_a=400.0)
calibrator = FleetCalibrator().fit(Fleet.from_frames(recordings, junction, inputs=["power_w", "heater_w"]))
calibrator.parameters_.query("corrected")[["vehicle", "branch", "gain_error", "offset_a", "confidence"]]

# %%
print(calibrator.vehicles_["V02"].explain())
