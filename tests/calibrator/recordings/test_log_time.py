import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from calibrator.recordings.frame_arrays import CLOCK_GAP_S, repaired_time


def nanoseconds(*seconds: float) -> NDArray[np.int64]:
    return np.array([round(s * 1e9) for s in seconds], np.int64)


def test_increasing_time_stays_as_it_is() -> None:
    time = repaired_time(nanoseconds(1000.0, 1000.5, 1000.5, 1003.0))
    np.testing.assert_allclose(time.time_s, [0.0, 0.5, 0.5, 3.0])
    assert (time.disordered, time.clock_steps) == (0, 0)


def test_slight_disorder_is_sorted_and_counted() -> None:
    time = repaired_time(nanoseconds(10.0, 10.2, 10.1, 10.3))
    assert time.order.tolist() == [0, 2, 1, 3]
    np.testing.assert_allclose(time.time_s, [0.0, 0.1, 0.2, 0.3])
    assert (time.disordered, time.clock_steps) == (1, 0)


def test_a_clock_set_back_becomes_a_gap() -> None:
    time = repaired_time(nanoseconds(5000.0, 5001.0, 100.0, 101.0))
    np.testing.assert_allclose(time.time_s, [0.0, 1.0, 1.0 + CLOCK_GAP_S, 2.0 + CLOCK_GAP_S])
    assert (time.disordered, time.clock_steps) == (0, 1)


def test_a_clock_set_from_1970_to_today_does_not_make_a_drive_of_years() -> None:
    time = repaired_time(nanoseconds(0.0, 1.0, 1.7e9, 1.7e9 + 1.0))
    np.testing.assert_allclose(time.time_s, [0.0, 1.0, 1.0 + CLOCK_GAP_S, 2.0 + CLOCK_GAP_S])
    assert time.clock_steps == 1


@given(st.lists(st.integers(0, 8 * 10**18), min_size=1, max_size=50))
def test_time_never_decreases_and_no_frame_is_lost(time_ns: list[int]) -> None:
    time = repaired_time(np.array(time_ns, np.int64))
    assert sorted(time.order.tolist()) == list(range(len(time_ns)))
    assert time.time_s[0] == 0.0
    assert np.all(np.diff(time.time_s) >= 0.0)
