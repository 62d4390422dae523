"""Zero-current windows show the offsets of all sensors, and nothing else does."""

import numpy as np
import pytest

from calibrator.drive import Array, Channel, Drive
from calibrator.evidence.zero_current import zero_current_offsets
from ecu_node.layout import Contactor

CONTACTOR = Contactor(input="contactor_state", open=[0.0])
OFFSETS_A = {"battery": 12.5, "motor": -3.0}


def channel(time_s: Array, value: Array) -> Channel:
    return Channel(time_s=time_s, value=value, good=np.isfinite(value))


def drive(*, open_s: tuple[float, float] = (0.0, 30.0), noise_a: float = 0.4, state: bool = True) -> Drive:
    """Contactors open in a window; outside of it 100 A flow."""
    rng = np.random.default_rng(1)
    state_s, time_s = np.arange(0.0, 60.0, 0.1), np.arange(0.03, 60.0, 0.05)
    is_open = (state_s >= open_s[0]) & (state_s < open_s[1])
    flowing = np.where((time_s >= open_s[0]) & (time_s < open_s[1]), 0.0, 100.0)
    branches = {
        name: channel(time_s, sign * flowing + offset + rng.normal(0.0, noise_a, len(time_s)))
        for (name, offset), sign in zip(OFFSETS_A.items(), (1.0, -1.0), strict=True)
    }
    inputs = {"contactor_state": channel(state_s, np.where(is_open, 0.0, 2.0))} if state else {}
    return Drive(vehicle="V", name="d", branches=branches, inputs=inputs)


def test_offsets_are_read_with_their_uncertainty() -> None:
    found = zero_current_offsets([drive()], tuple(OFFSETS_A), CONTACTOR)
    error = found.offset_a - np.array(list(OFFSETS_A.values()))
    assert (np.abs(error) < 4.0 * found.sd_a).all()
    assert (found.sd_a < 0.1).all()


def test_windows_of_several_drives_add_up() -> None:
    one = zero_current_offsets([drive()], tuple(OFFSETS_A), CONTACTOR)
    four = zero_current_offsets([drive()] * 4, tuple(OFFSETS_A), CONTACTOR)
    assert (four.sd_a < one.sd_a).all()


@pytest.mark.parametrize(
    "without",
    [drive(open_s=(0.0, 0.0)), drive(open_s=(10.0, 13.0)), drive(state=False)],
    ids=["never", "short", "no signal"],
)
def test_without_a_window_there_is_no_reading(without: Drive) -> None:
    assert np.isnan(zero_current_offsets([without], tuple(OFFSETS_A), CONTACTOR).offset_a).all()


def test_a_layout_without_contactor_knows_no_window() -> None:
    assert np.isnan(zero_current_offsets([drive()], tuple(OFFSETS_A), None).offset_a).all()


def test_a_branch_that_was_not_recorded_has_no_reading() -> None:
    found = zero_current_offsets([drive()], ("battery", "dcdc"), CONTACTOR)
    assert np.isfinite(found.offset_a).tolist() == [True, False]
