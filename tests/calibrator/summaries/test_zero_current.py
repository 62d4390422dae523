"""Zero-current windows show the offsets of all sensors, and nothing else does."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calibrator.drive import Array, Channel, Drive
from calibrator.summaries.vehicle_summary import zero_current_offsets
from ecu_node.database import read_database
from ecu_node.layout import read_layout

DATABASE = read_database(read_layout(Path(__file__).parents[3] / "dbc" / "hv_powertrain.toml"))
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


def shifted(plain: Drive, by_a: Array | float) -> Drive:
    """The same drive with more on all currents."""
    branches = {name: replace(current, value=current.value + by_a) for name, current in plain.branches.items()}
    return replace(plain, branches=branches)


def test_offsets_are_read_with_their_uncertainty() -> None:
    found = zero_current_offsets([drive()], tuple(OFFSETS_A), DATABASE)
    error = found.offset_a - np.array(list(OFFSETS_A.values()))
    assert (np.abs(error) < 4.0 * found.sd_a).all()
    assert (found.sd_a < 0.1).all()


@pytest.mark.parametrize(
    "without",
    [drive(open_s=(0.0, 0.0)), drive(open_s=(10.0, 13.0)), drive(state=False)],
    ids=["never", "short", "no signal"],
)
def test_without_a_window_there_is_no_reading(without: Drive) -> None:
    assert np.isnan(zero_current_offsets([without], tuple(OFFSETS_A), DATABASE).offset_a).all()


def test_windows_that_differ_are_believed_less() -> None:
    drives = [drive(), shifted(drive(), 1.0)]
    found = zero_current_offsets(drives, tuple(OFFSETS_A), DATABASE)
    np.testing.assert_allclose(found.offset_a, np.array(list(OFFSETS_A.values())) + 0.5, atol=0.05)
    assert (found.sd_a > 0.3).all()


def test_what_wanders_within_a_window_does_not_average_out() -> None:
    z = []
    for seed in range(100):
        wander = np.cumsum(np.random.default_rng(seed).normal(0.0, 0.3 / np.sqrt(600.0), 1200))
        found = zero_current_offsets([shifted(drive(), wander)], ("battery",), DATABASE)
        z.append((found.offset_a[0] - OFFSETS_A["battery"] - wander[:600].mean()) / found.sd_a[0])
    assert np.sqrt(np.mean(np.square(z))) < 1.5


def test_a_gap_in_the_contactor_messages_is_no_window() -> None:
    gap = drive(open_s=(0.0, 60.0))
    state = gap.inputs["contactor_state"]
    known = (state.time_s < 8.0) | (state.time_s > 52.0)
    flowing = {
        name: replace(current, value=current.value + 80.0 * ((current.time_s > 10.0) & (current.time_s < 50.0)))
        for name, current in gap.branches.items()
    }
    inputs = {"contactor_state": channel(state.time_s[known], state.value[known])}
    found = zero_current_offsets([replace(gap, branches=flowing, inputs=inputs)], tuple(OFFSETS_A), DATABASE)
    np.testing.assert_allclose(found.offset_a, list(OFFSETS_A.values()), atol=0.2)
