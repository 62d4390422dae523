"""Samples into summaries: sums equal those of the samples; spikes and invalid samples are left out."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calibrator.drive import Array, Channel, Drive, Samples
from calibrator.errors import DriveError
from calibrator.summaries.filter_bank import FilterBank, low_passes
from calibrator.summaries.moments import BLOCK_S, LEVEL_EDGES_A, add_up
from calibrator.summaries.summariser import find_spikes, summarise_samples
from calibrator.summaries.vehicle_summary import zero_current_offsets
from ecu_node.database import read_database
from ecu_node.layout import read_layout
from tests.calibrator.estimator.simulated_drives import PERIOD_S, Conditions, coloured, drive_of, no_faults, samples_of

SAMPLES = 1800


def coloured_drive() -> Samples:
    """Currents that change slowly against the sampling, balanced, with noise."""
    rng = np.random.default_rng(0)
    i = 60.0 * coloured(rng, SAMPLES, 3, 0.995) @ (np.eye(3) - 1.0 / 3.0)
    return samples_of(rng.normal(size=(SAMPLES, 2)), i + rng.normal(0.0, 0.4, i.shape))


def a_drive(seed: int, samples: int = 300, noise_a: float = 0.3) -> Samples:
    conditions = Conditions(samples=samples, noise_a=noise_a)
    return drive_of(np.random.default_rng(seed), no_faults(1, 3).take(0), conditions)


def a_bank(*time_constants_s: float) -> FilterBank:
    poles = low_passes(np.array(time_constants_s), period_s=PERIOD_S)
    return FilterBank(input_names=a_drive(0).input_names, period_s=PERIOD_S, poles=poles)


def test_sum_of_summaries_equals_the_summary_of_all_drives() -> None:
    first, second = a_drive(2), a_drive(3, samples=170)
    warm_c = [20.0 + 0.01 * drive.time_s for drive in (first, second)]
    together = summarise_samples([first, second], period_s=PERIOD_S, bank=a_bank(3.0, 8.0), temperatures_c=warm_c)
    alone = [
        summarise_samples([drive], period_s=PERIOD_S, bank=a_bank(3.0, 8.0), temperatures_c=[warm])
        for drive, warm in zip((first, second), warm_c, strict=True)
    ]
    both = add_up(alone)
    assert both.fit is not None
    assert together.fit is not None
    pairs = [(vars(one), vars(other)) for one, other in ((both, together), (both.fit, together.fit))]
    for one, other in pairs:
        for name in one.keys() - {"fit", "bank"}:
            np.testing.assert_allclose(one[name], other[name], rtol=1e-9, atol=1e-7)
    assert both.bank == together.bank


def test_shortened_summary_adds_up_moments_and_averages_noise_and_known_temperatures() -> None:
    drive = a_drive(4, samples=120)
    warm_c = np.where(drive.time_s < 30.0, np.nan, 20.0 + 0.1 * drive.time_s)
    whole = summarise_samples([drive], period_s=PERIOD_S, temperatures_c=[warm_c])
    short = whole.shortened(2)
    assert len(whole.moments) == 4
    assert whole.fit is not None
    assert short.fit is not None
    np.testing.assert_allclose(short.total, whole.total)
    np.testing.assert_allclose(short.noise_a2, whole.noise_a2.reshape(2, 2, -1).mean(axis=1), rtol=0.01)
    first, *_ = known_c = whole.fit.temperature_c[1:]
    assert np.isnan(whole.fit.temperature_c[0])
    np.testing.assert_allclose(short.fit.temperature_c, [first, known_c[1:].mean()])


def test_adding_up_summaries_of_different_filter_banks_is_refused() -> None:
    drive = a_drive(2)
    plain, filtered = (summarise_samples([drive], period_s=PERIOD_S, bank=bank) for bank in (None, a_bank(3.0)))
    with pytest.raises(DriveError, match=r"made with 2 filter banks \(.*\); expected one"):
        add_up([plain, filtered])


def test_filter_bank_with_other_inputs_or_period_is_refused() -> None:
    drive, bank = a_drive(2), a_bank(3.0)
    with pytest.raises(DriveError, match="align the drive with the bank's inputs"):
        summarise_samples([drive.with_inputs(drive.input_names[1:])], period_s=PERIOD_S, bank=bank)
    with pytest.raises(DriveError, match=r"every 0\.5 s, a filter bank of .* every 1 s"):
        summarise_samples([drive], period_s=0.5, bank=bank)


@pytest.mark.parametrize("time_constants_s", [(), (2.0, 9.0)])
def test_moments_equal_those_of_the_samples(time_constants_s: tuple[float, ...]) -> None:
    drive, bank = a_drive(8, samples=3000), a_bank(*time_constants_s)
    filtered, used = bank.run(drive.inputs, drive.valid)
    kept = used & (used.reshape(-1, 30).sum(axis=1) >= 6).repeat(30)
    columns = np.column_stack([filtered, drive.currents_a, np.ones(3000)])[kept]
    summary = summarise_samples([drive], period_s=PERIOD_S, bank=bank)
    np.testing.assert_allclose(summary.total, columns.T @ columns, rtol=1e-10)
    currents_a = drive.currents_a[kept]
    np.testing.assert_allclose(summary.mean_a, currents_a.mean(axis=0))
    np.testing.assert_allclose(summary.mean_product_a2, currents_a.T @ currents_a / kept.sum())
    assert (summary.duration_s, BLOCK_S) == (kept.sum() * PERIOD_S, 30.0 * PERIOD_S)


@pytest.mark.parametrize("samples", [30, 300])
def test_white_noise_is_estimated_without_bias(samples: int) -> None:
    rng = np.random.default_rng(6)
    variance = [
        summarise_samples(
            [samples_of(np.zeros((samples, 0)), rng.normal(0.0, 2.0, (samples, 2)))], period_s=PERIOD_S
        ).noise_a2
        for _ in range(400)
    ]
    assert np.mean(np.concatenate(variance)) == pytest.approx(4.0, rel=0.03)


def test_a_drive_without_enough_valid_samples_is_refused_with_the_reason() -> None:
    drive = a_drive(7, samples=200)
    with pytest.raises(DriveError, match="no 30 s of drive in which 20% of the samples are valid"):
        summarise_samples([replace(drive, valid=np.zeros(200, bool))], period_s=PERIOD_S)
    with pytest.raises(DriveError, match="once its filter bank has settled, 300 s after a start"):
        summarise_samples([drive], period_s=PERIOD_S, bank=a_bank(100.0))


def test_samples_are_summed_by_the_level_of_their_current() -> None:
    drive = coloured_drive()
    fit = summarise_samples([drive], period_s=PERIOD_S).fit
    assert fit is not None
    columns = np.column_stack([drive.inputs, drive.currents_a, np.ones(SAMPLES)])
    for k in range(3):
        x = drive.currents_a[:, k]
        # at an edge itself a sample belongs to the level farther from zero
        level = np.where(x > 0.0, np.searchsorted(LEVEL_EDGES_A, x, "right"), np.searchsorted(LEVEL_EDGES_A, x, "left"))
        for number in range(len(LEVEL_EDGES_A) + 1):
            there = level == number
            np.testing.assert_allclose(fit.levels[k, number, :-1], columns[there].sum(axis=0), atol=1e-8)
            np.testing.assert_allclose(fit.levels[k, number, -1], np.sum(x[there] ** 2), atol=1e-8)


def test_spikes_are_labelled_by_branch_and_sign_and_left_out() -> None:
    drive = coloured_drive()
    bad = drive.currents_a.copy()
    bad[[200, 700, 1100], 1] += 50.0
    bad[[400, 401, 402], 2] -= 40.0
    summary = summarise_samples([replace(drive, currents_a=bad)], period_s=PERIOD_S)
    assert summary.fit is not None
    np.testing.assert_array_equal(summary.fit.spikes.sum(axis=0), [[0, 0], [3, 0], [0, 3]])
    kept = np.setdiff1d(np.arange(SAMPLES), [200, 400, 401, 402, 700, 1100])
    columns = np.column_stack([drive.inputs, drive.currents_a, np.ones(SAMPLES)])[kept]
    np.testing.assert_allclose(summary.total, columns.T @ columns)


def test_real_current_pulses_and_residual_delays_are_not_spikes() -> None:
    drive, pulse = coloured_drive(), np.zeros((SAMPLES, 3))
    pulse[[200, 700, 1100]] = [100.0, -60.0, -40.0]
    steps = 80.0 * (np.arange(SAMPLES) // 100 % 2)
    late = np.append(steps[0], steps[:-1])
    for flowing in (pulse, np.column_stack([steps, -late, 0.0 * steps])):
        assert not find_spikes(drive.currents_a + flowing, drive.valid).any()


@pytest.mark.parametrize("gain", [-1.0, 0.4, 1.8])
def test_spikes_are_found_for_any_gains_of_the_sensors(gain: float) -> None:
    bad = coloured_drive().currents_a * [1.0, gain, 1.0]
    bad[500, 0] += 60.0
    found = find_spikes(bad, np.ones(SAMPLES, bool))
    assert np.argwhere(found).tolist() == [[500, 0]]
    assert found[500, 0] == 1


# Zero-current windows show the offsets of all sensors, and nothing else does


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
    """The same drive with ``by_a`` added to all currents. [A]"""
    branches = {name: replace(current, value=current.value + by_a) for name, current in plain.branches.items()}
    return replace(plain, branches=branches)


def test_offsets_are_read_in_zero_current_windows_with_uncertainty() -> None:
    found = zero_current_offsets([drive()], tuple(OFFSETS_A), DATABASE)
    error = found.offset_a - np.array(list(OFFSETS_A.values()))
    assert (np.abs(error) < 4.0 * found.sd_a).all()
    assert (found.sd_a < 0.1).all()


@pytest.mark.parametrize(
    "without",
    [drive(open_s=(0.0, 0.0)), drive(open_s=(10.0, 13.0)), drive(state=False)],
    ids=["contactors never open", "window too short", "no contactor signal"],
)
def test_no_zero_current_window_gives_no_reading(without: Drive) -> None:
    assert np.isnan(zero_current_offsets([without], tuple(OFFSETS_A), DATABASE).offset_a).all()


@pytest.mark.parametrize(("noise_a", "step_a", "is_read"), [(0.4, 0.1, False), (0.02, 1.0, True)])
def test_zeros_that_a_control_unit_writes_while_contactors_are_open_are_no_reading(
    noise_a: float, step_a: float, is_read: bool
) -> None:
    plain, branches = drive(noise_a=noise_a), dict[str, Channel]()
    for name, current in plain.branches.items():
        shown_a = step_a * np.round((current.value + 30.0 * np.sin(0.3 * current.time_s)) / step_a)
        branches[name] = replace(current, value=np.where(current.time_s < 30.0, 0.0, shown_a))
    found = zero_current_offsets([replace(plain, branches=branches)], tuple(OFFSETS_A), DATABASE)
    assert np.isfinite(found.offset_a).tolist() == [is_read] * 2


def test_disagreeing_zero_current_windows_increase_the_uncertainty() -> None:
    drives = [drive(), shifted(drive(), 1.0)]
    found = zero_current_offsets(drives, tuple(OFFSETS_A), DATABASE)
    np.testing.assert_allclose(found.offset_a, np.array(list(OFFSETS_A.values())) + 0.5, atol=0.05)
    assert (found.sd_a > 0.3).all()


def test_sd_of_a_zero_current_offset_covers_an_offset_that_wanders_in_the_window() -> None:
    z = []
    for seed in range(100):
        wander = np.cumsum(np.random.default_rng(seed).normal(0.0, 0.3 / np.sqrt(600.0), 1200))
        found = zero_current_offsets([shifted(drive(), wander)], ("battery",), DATABASE)
        z.append((found.offset_a[0] - OFFSETS_A["battery"] - wander[:600].mean()) / found.sd_a[0])
    assert np.sqrt(np.mean(np.square(z))) < 1.5


def test_gap_in_the_contactor_messages_is_not_a_window() -> None:
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
