from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calibrator.artificial.simulate import (
    Vehicle,
    vehicle_drive,
    vehicle_frames,
    write_vehicle,
)
from calibrator.artificial.trips import GroundTruth
from calibrator.faults import Faults
from calibrator.recordings.write_logs import FrameSeries
from ecu_node.database import VehicleDatabase

SOUND: dict[str, Any] = {"noise_a": 0.0, "delay_s": np.zeros(2), "unmeasured_a": 0.0}


def faults(drift: float = 0.0, offset_a: float = 0.0, hardware_drift: float = 0.0) -> Faults:
    return Faults(
        hardware_drift=np.float64(hardware_drift),  # type: ignore[arg-type]
        hardware_offset_a=np.zeros(2),
        drift=np.array([0.0, drift]),
        offset_a=np.array([0.0, offset_a]),
    )


def trip() -> GroundTruth:
    time_s = np.arange(600) * 0.1
    battery = 50.0 * np.sin(time_s / 3.0)
    return GroundTruth(
        name="t", period_s=0.1, currents_a={"battery": battery, "motor": -battery}, inputs={"speed": np.full(600, 50.0)}
    )


def vehicle(faults_: Faults, **disturbances: Any) -> Vehicle:
    return Vehicle(name="V1", branches=("battery", "motor"), faults=faults_, **(SOUND | disturbances))


def decoded(
    database: VehicleDatabase, series: list[FrameSeries], message: str, signal: str
) -> tuple[np.ndarray, np.ndarray]:
    item = next(s for s in series if s.arbitration_id == database.message(message).frame_id)
    values = [database.message(message).decode_simple(r.tobytes(), decode_choices=False)[signal] for r in item.data]
    return item.time_s, np.array(values, dtype=float)


def frames(database: VehicleDatabase, v: Vehicle) -> list[FrameSeries]:
    return vehicle_frames(np.random.default_rng(3), database, v, trip())


def test_frames_show_the_true_currents_through_faulty_late_and_noisy_sensors(database: VehicleDatabase) -> None:
    quiet = vehicle(faults(0.2, 10.0), delay_s=np.array([0.0, 0.3]), unmeasured_a=3.0)
    for message, signal, name, sign in (
        ("HV_Battery", "BatteryCurrent", "battery", 1.0),
        ("HV_Motor", "MotorCurrent", "motor", -1.0),
    ):
        time_s, value = decoded(database, frames(database, quiet), message, signal)
        delay_s = 0.3 if name == "motor" else 0.0
        ideal = np.interp(time_s - delay_s, trip().time_s, trip().currents_a[name])
        expected = 1.2 * ideal + 10.0 if name == "motor" else ideal + 3.0  # the battery carries the load
        np.testing.assert_allclose(sign * value, expected, atol=0.0101)
        _, noisy = decoded(database, frames(database, replace(quiet, noise_a=0.4)), message, signal)
        assert np.std(noisy - value) == pytest.approx(0.4, rel=0.1)


def test_messages_keep_their_cycle_time_and_their_own_instants(database: VehicleDatabase) -> None:
    series = {s.arbitration_id: s.time_s for s in frames(database, vehicle(faults()))}
    assert np.mean(np.diff(series[272])) == pytest.approx(0.020, rel=0.01)
    assert np.mean(np.diff(series[288])) == pytest.approx(0.010, rel=0.01)
    assert not np.intersect1d(series[272], series[288]).size
    assert all(np.all(np.diff(time_s) > 0.0) for time_s in series.values())


def test_truth_holds_the_moments_of_the_true_currents(database: VehicleDatabase, tmp_path: Path) -> None:
    v = vehicle(faults(0.2, 10.0, hardware_drift=0.1))
    truth = write_vehicle(tmp_path, database, v, calibration=trip(), unseen=trip(), seed=(1, 2))
    expected = 1.1 * trip().currents_a["battery"]
    assert truth.unseen_mean_a["battery"] == pytest.approx(np.mean(expected))
    assert truth.unseen_mean_square_a2["motor"] == pytest.approx(np.mean(expected**2))
    assert truth.drift == {"battery": 0.0, "motor": 0.2}
    assert (tmp_path / "logs" / "V1" / "drive.log.gz").is_file()
    assert (tmp_path / "unseen" / "V1" / "drive.log.gz").is_file()


def test_drive_without_frames_is_what_the_frames_decode_to(database: VehicleDatabase) -> None:
    v = vehicle(faults(0.2, 10.0), noise_a=1.0, delay_s=np.array([0.0, 0.2]), unmeasured_a=2.0)
    drive = vehicle_drive(np.random.default_rng(3), database, v, trip())
    series = frames(database, v)
    for name, sign, message, signal in (
        ("battery", 1.0, "HV_Battery", "BatteryCurrent"),
        ("motor", -1.0, "HV_Motor", "MotorCurrent"),
    ):
        time_s, value = decoded(database, series, message, signal)
        np.testing.assert_array_equal(drive.branches[name].time_s, time_s)
        np.testing.assert_allclose(drive.branches[name].value, sign * value, atol=1e-9)
        assert drive.branches[name].good.all()
    _, speed = decoded(database, series, "VD_Motion", "VehicleSpeed")
    np.testing.assert_allclose(drive.inputs["speed"].value, speed, atol=1e-9)
