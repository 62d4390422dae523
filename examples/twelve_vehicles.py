"""Twelve vehicles from data frames to what their current sensors do wrong.

Run it: ``python examples/twelve_vehicles.py``. The first part makes recordings up, of which four vehicles have a faulty
sensor; with recordings of your own, the five lines after the empty one in main are all that is needed.
"""

import numpy as np
import pandas as pd

from calibrator import Fleet, FleetCalibrator, Junction

FAULTS = {  # measured = (1 + gain error) * true + offset
    "V02": ("battery", 0.08, 0.0),
    "V05": ("motor", 0.0, 12.0),
    "V08": ("battery", -0.05, 0.0),
    "V11": ("motor", 0.12, 0.0),
}


def recorded_drive(vehicle: str, rng: np.random.Generator) -> pd.DataFrame:
    """Half an hour with a row every 0.1 s; currents in A, positive into the junction."""
    time_s = np.arange(0.0, 1800.0, 0.1)
    pedal = np.repeat(rng.uniform(-0.6, 1.0, 361), 50)[: len(time_s)]  # something else every 5 s
    torque_nm = 150.0 * np.convolve(pedal, np.ones(20) / 20.0, mode="same")
    speed_rpm = np.clip(3000.0 + 15.0 * np.cumsum(torque_nm) * 0.01, 500.0, 9000.0)
    heater_w = 3000.0 * np.repeat(rng.integers(0, 2, 31), 600)[: len(time_s)]
    power_w = torque_nm * speed_rpm * 2.0 * np.pi / 60.0
    true_a = {"motor": -power_w / 360.0, "heater": -heater_w / 360.0}
    true_a["battery"] = -true_a["motor"] - true_a["heater"]
    branch, gain_error, offset_a = FAULTS.get(vehicle, ("motor", 0.0, 0.0))
    true_a[branch] = (1.0 + gain_error) * true_a[branch] + offset_a
    measured_a = {name: current + rng.normal(0.0, 0.3, len(time_s)) for name, current in true_a.items()}
    return pd.DataFrame(measured_a | {"power_w": power_w, "heater_w": heater_w}, index=time_s)


def main() -> FleetCalibrator:
    """Calibrate the twelve vehicles."""
    rng = np.random.default_rng(1)
    recordings = {name: recorded_drive(name, rng) for name in (f"V{number:02d}" for number in range(1, 13))}

    junction = Junction(branches=["battery", "motor", "heater"], full_scale_a=400.0)
    fleet = Fleet.from_frames(recordings, junction, inputs=["power_w", "heater_w"])
    calibrator = FleetCalibrator().fit(fleet)
    found = calibrator.parameters_
    print(found.loc[found["corrected"], ["vehicle", "branch", "gain_error", "offset_a"]].to_string(index=False))
    print(calibrator.vehicles_["V02"].explain())
    return calibrator


if __name__ == "__main__":
    main()
