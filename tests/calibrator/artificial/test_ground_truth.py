import numpy as np
import pytest

from calibrator.artificial.trips import (
    GroundTruth,
    cut_and_rejoin,
    ground_truth_from_drive,
    with_branches,
)
from calibrator.drive import Channel, Drive


def trip(samples: int = 100, name: str = "trip", level: float = 10.0) -> GroundTruth:
    speed = np.where(np.arange(samples) % 20 < 5, 0.0, 30.0)
    battery = level + np.arange(samples, dtype=float)
    auxiliary = np.full(samples, -2.0)
    return GroundTruth(
        name=name,
        period_s=0.1,
        currents_a={"battery": battery, "motor": -battery - auxiliary, "auxiliary": auxiliary},
        inputs={"speed": speed},
    )


def test_balancing_branch_is_minus_the_sum_of_the_others() -> None:
    two = with_branches(trip(), ("battery", "motor"), "motor")
    np.testing.assert_array_equal(two.currents_a["motor"], -trip().currents_a["battery"])
    np.testing.assert_allclose(two.matrix_a().sum(axis=1), 0.0)


def test_rejoined_trip_is_made_of_pieces_between_standstills() -> None:
    source = trip(200)
    joined = cut_and_rejoin(np.random.default_rng(0), [source], duration_s=10.0, name="new")
    assert len(joined) >= 100
    current = joined.currents_a["battery"]
    jumps = np.flatnonzero(np.abs(np.diff(current)) > 1.0)
    assert jumps.size > 0
    assert np.all(joined.inputs["speed"][jumps] == 0.0)
    assert set(current) <= set(source.currents_a["battery"])
    np.testing.assert_allclose(joined.matrix_a().sum(axis=1), 0.0, atol=1e-12)


def test_recorded_drive_becomes_a_trip_over_the_span_of_all_channels() -> None:
    def channel(start: float) -> Channel:
        time_s = start + np.arange(100) * 0.1
        good = np.ones(100, dtype=bool)
        good[50] = False
        return Channel(time_s=time_s, value=np.where(good, 2.0 * time_s, 1e9), good=good)

    drive = Drive(vehicle="V", name="d", branches={"battery": channel(0.0)}, inputs={"speed": channel(0.5)})
    made = ground_truth_from_drive(drive, 0.1)
    assert made is not None
    np.testing.assert_allclose(made.currents_a["battery"], 2.0 * (0.5 + made.time_s))
    assert len(made) == pytest.approx(94, abs=1)


def test_drive_without_good_samples_is_no_trip() -> None:
    bad = Channel(time_s=np.arange(3.0), value=np.zeros(3), good=np.zeros(3, dtype=bool))
    assert ground_truth_from_drive(Drive(vehicle="V", name="d", branches={"battery": bad}, inputs={}), 0.1) is None
