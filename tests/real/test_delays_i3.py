"""Delays of the branches on recorded trips of a BMW i3 as frames, with faults of 5 to 25 % and a load without sensor.

The recordings have no motor current: it is minus the sum of the others, so its truth is not independent of theirs.
"""

from pathlib import Path

import numpy as np
import pytest

from tests.real.delay_trips import DelayErrors, delay_errors, rms


@pytest.fixture(scope="module")
def three(i3_store: Path) -> DelayErrors:
    return delay_errors(i3_store, branches=3)


@pytest.mark.long
def test_battery_and_motor_are_told_apart_to_half_a_millisecond_on_all_32_trips(i3_store: Path) -> None:
    two = delay_errors(i3_store, branches=2)
    assert two.known.shape == (32, 1)
    assert two.known.all()
    assert rms(two.error_s) < 0.5e-3
    assert 0.7 < rms(two.error_s / two.sd_s) < 1.5


@pytest.mark.long
def test_with_the_auxiliaries_as_third_branch_the_motor_is_found_as_well(three: DelayErrors) -> None:
    assert three.known.shape == (27, 2)
    assert three.known[:, 0].all()
    assert rms(three.error_s[:, 0]) < 0.5e-3
    assert 0.7 < rms(three.error_s[:, 0] / three.sd_s[:, 0]) < 1.6


@pytest.mark.long
def test_the_auxiliaries_are_found_within_5_ms_or_flagged(three: DelayErrors) -> None:
    known = three.known[:, 1]
    assert 0 < known.sum() < len(known)
    assert rms(three.error_s[known, 1]) < 5e-3
    assert np.abs(three.error_s[known, 1]).max() < 15e-3
