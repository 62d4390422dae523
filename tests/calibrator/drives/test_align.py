"""Alignment of channels to one time base, labels of bad samples, and the choice of inputs."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from calibrator.drive import Array, Channel, Drive, Samples
from calibrator.drives.align import align, align_channels, choose_inputs
from calibrator.errors import DriveError
from ecu_node.database import VehicleDatabase
from ecu_node.layout import Layout

PERIOD_S = 0.1


@pytest.fixture
def layout(database: VehicleDatabase) -> Layout:
    return database.layout


def channel(time_s: Array, value: Array, bad: list[int] | None = None) -> Channel:
    good = np.ones(len(time_s), np.bool_)
    good[bad or []] = False
    return Channel(time_s=time_s, value=value, good=good)


def ramp(start_s: float, stop_s: float, period_s: float, slope: float = 1.0) -> Channel:
    time_s = np.arange(start_s, stop_s, period_s)
    return channel(time_s, slope * time_s)


def drive_of(branches: dict[str, Channel], inputs: dict[str, Channel] | None = None) -> Drive:
    return Drive(vehicle="V1", name="d", branches=branches, inputs=inputs or {})


def aligned(layout: Layout, branches: dict[str, Channel]) -> Samples:
    return align(drive_of(branches), layout, tuple(branches), inputs=())


@given(st.lists(st.floats(0.0, 30.0), min_size=2, max_size=60), st.floats(0.05, 3.0))
def test_samples_are_not_extrapolated_and_not_valid_across_long_gaps(times: list[float], limit_s: float) -> None:
    known_s = np.array(sorted(times))
    value = np.sin(known_s)
    channels = {"x": channel(known_s, value)}
    try:
        time_s, values, reasons = align_channels(channels, {"x": limit_s}, period_s=PERIOD_S, where="test")
    except DriveError:
        assert np.floor(known_s[-1] / PERIOD_S + 1e-3) < np.ceil(known_s[0] / PERIOD_S - 1e-3)
        return
    assert np.all(time_s >= known_s[0] - 1e-3)
    assert np.all(time_s <= known_s[-1] + 1e-3)
    np.testing.assert_allclose(time_s / PERIOD_S, np.round(time_s / PERIOD_S), atol=1e-9)
    assert np.all(np.abs(values["x"]) <= np.max(np.abs(value)) + 1e-12)
    for instant, stale in zip(time_s, reasons["stale"], strict=True):
        before, after = known_s[known_s <= instant], known_s[known_s >= instant]
        gap_s = after[0] - before[-1] if before.size and after.size else 0.0
        if abs(gap_s - limit_s) > 2e-3:
            assert stale == (gap_s > limit_s)


def test_bad_samples_are_masked_with_their_reason_and_not_dropped(layout: Layout) -> None:
    time_s = np.arange(0.0, 2.0, 0.1)
    bad = channel(time_s, time_s, bad=[5, 6])
    samples = aligned(layout, {"battery": bad})
    assert np.flatnonzero(~samples.valid).tolist() == [5, 6]
    assert np.flatnonzero(np.isnan(samples.currents_a[:, 0])).tolist() == [5, 6]
    reasons = align_channels({"battery": bad}, {"battery": 0.1}, period_s=PERIOD_S, where="test")[2]
    assert {reason: int(mask.sum()) for reason, mask in reasons.items()} == {"stale": 0, "not good": 2}


def test_instant_at_which_a_derived_input_is_undefined_is_not_valid(layout: Layout) -> None:
    time_s = np.arange(0.0, 2.0, 0.1)
    voltage = np.where(np.arange(20) == 7, 0.0, 400.0)
    inputs = {"voltage": channel(time_s, voltage), "aircon_demand": channel(time_s, 800.0 + 0.0 * time_s)}
    drive = drive_of({"battery": channel(time_s, time_s)}, inputs)
    samples = align(drive, layout, ["battery"], inputs=["aircon_current"])
    assert np.flatnonzero(~samples.valid).tolist() == [7]
    np.testing.assert_allclose(samples.inputs[samples.valid], 2.0)
    assert np.isnan(samples.inputs[7, 0])


def test_error_names_the_missing_channels_and_those_that_the_drive_has(layout: Layout) -> None:
    with pytest.raises(DriveError, match="vehicle V1, drive d: no motor, voltage; it has battery"):
        align(drive_of({"battery": ramp(0.0, 1.0, 0.1)}), layout, ["battery", "motor"], inputs=["voltage"])


@pytest.mark.parametrize(("branches", "words"), [
    ({"battery": channel(np.zeros(1), np.ones(1), bad=[0])}, "drive d: no good sample of battery"),
    ({"battery": ramp(0.0, 1.0, 0.1), "dcdc": ramp(2.0, 3.0, 0.1)}, "no instant in common"),
    ({"battery": channel(np.array([0.0, 1e9]), np.zeros(2))}, "the time stamps are wrong"),
])  # fmt: skip
def test_channels_that_cannot_be_aligned_are_refused(layout: Layout, branches: dict[str, Channel], words: str) -> None:
    with pytest.raises(DriveError, match=words):
        aligned(layout, branches)


def test_model_inputs_missing_in_all_drives_are_left_out_and_named(layout: Layout) -> None:
    available = {item.name for item in layout.input} - {"low_voltage_demand"}
    kept, left_out = choose_inputs(layout, available)
    assert left_out == ("low_voltage_current",)
    assert kept + left_out == tuple(layout.model_inputs)
    assert choose_inputs(layout, set()) == ((), tuple(layout.model_inputs))
