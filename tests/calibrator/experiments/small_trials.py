"""Small drives and trials for the tests of the experiments."""

from collections.abc import Collection, Iterable
from pathlib import Path

import numpy as np
from scipy.signal import lfilter

from calibrator.artificial.trips import GroundTruth
from calibrator.drive import Array, Channel, Drive
from calibrator.drives.store import write_drive
from calibrator.experiments.common_drive import CommonDrive
from calibrator.experiments.recorded_trips import RecordedFleet
from ecu_node.database import read_database
from ecu_node.layout import read_layout
from tests.calibrator.conftest import LAYOUT


def smooth_drive(branches: int = 2, samples: int = 6000) -> CommonDrive:
    """Currents that follow smooth random inputs through a lag; the last branch takes the balance."""
    rng = np.random.default_rng(0)
    inputs = _smooth(rng, (samples, branches)) * 200.0
    free = lfilter([0.2], [1.0, -0.8], inputs[:, : branches - 1], axis=0) + 5.0
    i_s: Array = np.column_stack([free, -free.sum(axis=1)])
    return CommonDrive(name="smooth", i_s=i_s, inputs=inputs, full_scale_a=400.0, unseen=i_s[::-1])


def small_fleet(trips: int = 12, samples: int = 3000) -> RecordedFleet:
    """Trips of a car with three branches, whose currents follow from the model's inputs but for a small rest."""
    made = tuple(_trip(np.random.default_rng(k), f"trip-{k}", samples) for k in range(trips))
    return RecordedFleet(name="small", trips=made, database=read_database(read_layout(LAYOUT)))


def write_store(folder: Path, trips: Iterable[GroundTruth], *, lacking: Collection[str] = ()) -> Path:
    """A drive store of trips as ``calibrator import`` leaves it; the third trip lacks the channels ``lacking``."""
    for number, trip in enumerate(trips):
        channels = {
            name: Channel(time_s=trip.time_s, value=x, good=np.isfinite(x))
            for name, x in {**trip.currents_a, **trip.inputs}.items()
            if number != 2 or name not in lacking
        }
        inputs = {name: channels.pop(name) for name in trip.inputs if name in channels}
        drive = Drive(vehicle=f"trip-{number:02d}", name="d", branches=channels, inputs=inputs)
        write_drive(folder, drive, read_layout(LAYOUT))
    return folder


def _trip(rng: np.random.Generator, name: str, samples: int) -> GroundTruth:
    speed = 40.0 + 60.0 * _smooth(rng, (samples,))
    speed = np.maximum(speed, 0.0)
    torque = 150.0 * _smooth(rng, (samples,))
    voltage = 370.0 + 5.0 * _smooth(rng, (samples,))
    heater = 3000.0 * (rng.random(samples // 200).repeat(200) > 0.5)
    motor = (12.0 * torque * speed + 0.1 * torque**2) / voltage + 1.0 * _smooth(rng, (samples,))
    auxiliary = heater / voltage
    return GroundTruth(
        name=name,
        period_s=0.1,
        currents_a={"battery": motor + auxiliary, "motor": -motor, "auxiliary": -auxiliary},
        inputs={"voltage": voltage, "torque": torque, "speed": speed, "heater_demand": heater},
    )


def _smooth(rng: np.random.Generator, shape: tuple[int, ...]) -> Array:
    """Random numbers that change within seconds, with mean 0 and a standard deviation of about 1/6."""
    return np.asarray(lfilter([0.05], [1.0, -0.95], rng.normal(size=shape), axis=0))
