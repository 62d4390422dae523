"""Logs of artificial vehicles: what their frames hold, and the truth that is written beside them."""

from pathlib import Path

import msgspec
import numpy as np
import pytest

from calibrator.artificial.simulate import FleetPlan, Vehicle, simulate_fleet, vehicle_frames
from calibrator.artificial.trips import GroundTruth, RecordedTrips
from calibrator.drive import Array
from calibrator.errors import FleetError
from calibrator.faults import Faults
from calibrator.fleet_truth import read_truth
from ecu_node.database import VehicleDatabase

TIME_S = np.arange(600) * 0.1
BATTERY_A = 50.0 * np.sin(TIME_S / 3.0)
CURRENTS_A = {"battery": BATTERY_A, "motor": -BATTERY_A}
TRIP = GroundTruth(name="t", period_s=0.1, currents_a=CURRENTS_A, inputs={"speed": np.full(600, 50.0)})
FAULTS = Faults(
    hardware_drift=np.array(0.0),
    hardware_offset_a=np.zeros(2),
    drift=np.array([0.0, 0.2]),
    offset_a=np.array([0.0, 10.0]),
)
BRANCHES = (("battery", "HV_Battery", "BatteryCurrent", 1.0), ("motor", "HV_Motor", "MotorCurrent", -1.0))
CYCLE_S = {"battery": 0.020, "motor": 0.010}


def vehicle(noise_a: float) -> Vehicle:
    return Vehicle(
        name="V1",
        branches=("battery", "motor"),
        faults=FAULTS,
        noise_a=noise_a,
        delay_s=np.array([0.0, 0.3]),
        unmeasured_a=3.0,
    )


def decoded(database: VehicleDatabase, noise_a: float, message: str, signal: str) -> tuple[Array, Array]:
    """Instants and values of a signal in the frames of the vehicle."""
    definition = database.message(message)
    series = vehicle_frames(np.random.default_rng(3), database, vehicle(noise_a), TRIP)
    (item,) = (each for each in series if each.arbitration_id == definition.frame_id)
    values = [definition.decode_simple(row.tobytes(), decode_choices=False)[signal] for row in item.data]
    return item.time_s, np.array(values, dtype=float)


def test_frames_hold_the_true_currents_with_fault_delay_and_noise_of_each_sensor(database: VehicleDatabase) -> None:
    instants = []
    for name, message, signal, sign in BRANCHES:
        time_s, value = decoded(database, 0.0, message, signal)
        delay_s = 0.3 if name == "motor" else 0.0
        ideal = np.interp(time_s - delay_s, TIME_S, TRIP.currents_a[name])
        expected = 1.2 * ideal + 10.0 if name == "motor" else ideal + 3.0  # the battery carries the load
        np.testing.assert_allclose(sign * value, expected, atol=0.0101)
        _, noisy = decoded(database, 0.4, message, signal)
        assert np.std(noisy - value) == pytest.approx(0.4, rel=0.1)
        assert np.mean(np.diff(time_s)) == pytest.approx(CYCLE_S[name], rel=0.01)
        assert np.all(np.diff(time_s) > 0.0)
        instants.append(time_s)
    assert not np.intersect1d(instants[0], instants[1]).size


def test_truth_of_a_fleet_is_written_and_read_back(database: VehicleDatabase, tmp_path: Path) -> None:
    plan = FleetPlan(vehicles=1, currents=2, sparsity=20.0, unmeasured_a=(3.0, 0.0))
    trips = RecordedTrips(seed=0, recorded=[TRIP, TRIP], vehicles=1, unseen_s=30.0)
    fleet = simulate_fleet(plan, trips, database, tmp_path / "fleet", workers=1)
    for kind in ("logs", "unseen"):
        assert (tmp_path / "fleet" / kind / "V001" / "drive.log.gz").is_file()
    truth, true_a = fleet.vehicles["V001"], trips.trip(0, "unseen").currents_a["motor"]
    expected_a = (1.0 + truth.hardware_drift) * true_a + truth.hardware_offset_a["motor"]
    assert truth.unseen_mean_a["motor"] == pytest.approx(np.mean(expected_a))
    assert truth.unseen_mean_square_a2["motor"] == pytest.approx(np.mean(expected_a**2))
    path = tmp_path / "fleet" / "truth.json"
    assert read_truth(path) == fleet
    content = msgspec.to_builtins(fleet)
    del content["seed"]
    path.write_bytes(msgspec.json.encode(content))
    with pytest.raises(FleetError, match=r"truth\.json: not a truth\.json of 'calibrator simulate'.*seed"):
        read_truth(path)
