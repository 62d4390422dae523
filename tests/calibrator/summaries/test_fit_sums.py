from dataclasses import replace

import numpy as np
import pytest

from calibrator.drive import Array
from calibrator.drives.align import Samples
from calibrator.summaries.fit_sums import LEVEL_EDGES_A, FitSums, find_spikes, second_differences
from calibrator.summaries.summariser import summarise_samples
from tests.calibrator.estimator.simulated_drives import PERIOD_S, coloured, samples_of

SAMPLES = 1800


def a_drive(seed: int = 0, K: int = 3) -> Samples:
    """Currents that change slowly against the sampling, balanced, with noise."""
    rng = np.random.default_rng(seed)
    i = 60.0 * coloured(rng, SAMPLES, K, 0.995) @ (np.eye(K) - 1.0 / K)
    return samples_of(rng.normal(size=(SAMPLES, 2)), i + rng.normal(0.0, 0.4, i.shape))


def fit_of(*drives: Samples, temperatures_c: list[Array] | None = None) -> FitSums:
    fit = summarise_samples(list(drives), period_s=PERIOD_S, temperatures_c=temperatures_c).fit
    assert fit is not None
    return fit


def test_levels_are_sums_of_the_samples_at_each_level() -> None:
    drive = a_drive()
    levels = fit_of(drive).levels
    columns = np.column_stack([drive.inputs, drive.currents_a, np.ones(SAMPLES)])
    for k in range(3):
        x = drive.currents_a[:, k]
        # at an edge itself a sample belongs to the level farther from zero
        level = np.where(x > 0.0, np.searchsorted(LEVEL_EDGES_A, x, "right"), np.searchsorted(LEVEL_EDGES_A, x, "left"))
        for number in range(len(LEVEL_EDGES_A) + 1):
            there = level == number
            np.testing.assert_allclose(levels[k, number, :-1], columns[there].sum(axis=0), atol=1e-8)
            np.testing.assert_allclose(levels[k, number, -1], np.sum(x[there] ** 2), atol=1e-8)


def test_all_levels_together_are_the_moments() -> None:
    drive = a_drive()
    valid = np.random.default_rng(1).random(SAMPLES) > 0.1
    summary = summarise_samples([replace(drive, valid=valid)], period_s=PERIOD_S)
    assert summary.fit is not None
    for k in range(3):
        np.testing.assert_allclose(summary.fit.levels[k, :, :-1].sum(axis=0), summary.total[-1], atol=1e-7)
        np.testing.assert_allclose(summary.fit.levels[k, :, -1].sum(), summary.total[2 + k, 2 + k])


def test_fast_changes_tell_white_noise() -> None:
    fit = fit_of(a_drive())
    weights = np.ones(3)  # in the sum of the currents nothing but noise is left
    variance = weights @ fit.fast_a2.sum(axis=0) @ weights / 1.5 / SAMPLES
    assert variance == pytest.approx(3 * 0.4**2, rel=0.1)


def test_second_differences_need_three_samples() -> None:
    used = np.array([True, True, True, False, True, True])
    x = np.array([[0.0], [3.0], [0.0], [9.0], [0.0], [5.0]])
    np.testing.assert_array_equal(second_differences(x, used)[:, 0], [3.0, 0.0, 0.0, 0.0])


def test_temperatures_are_means_of_blocks_and_may_be_unknown() -> None:
    warm_c = np.linspace(10.0, 40.0, SAMPLES)
    warm_c[:30] = np.nan
    fit = fit_of(a_drive(), temperatures_c=[warm_c])
    assert np.isnan(fit.temperature_c[0])
    np.testing.assert_allclose(fit.temperature_c[1:], warm_c.reshape(-1, 30)[1:].mean(axis=1))
    assert np.isnan(fit_of(a_drive()).temperature_c).all()


def test_starts_of_drives_are_known() -> None:
    fit = fit_of(a_drive(0), a_drive(1))
    assert np.flatnonzero(fit.starts).tolist() == [0, SAMPLES // 30]


def test_spikes_are_labelled_by_branch_and_sign_and_left_out() -> None:
    drive = a_drive()
    bad = drive.currents_a.copy()
    bad[[200, 700, 1100], 1] += 50.0
    bad[[400, 401, 402], 2] -= 40.0
    summary = summarise_samples([replace(drive, currents_a=bad)], period_s=PERIOD_S)
    assert summary.fit is not None
    np.testing.assert_array_equal(summary.fit.spikes.sum(axis=0), [[0, 0], [3, 0], [0, 3]])
    kept = np.setdiff1d(np.arange(SAMPLES), [200, 400, 401, 402, 700, 1100])
    columns = np.column_stack([drive.inputs, drive.currents_a, np.ones(SAMPLES)])[kept]
    np.testing.assert_allclose(summary.total, columns.T @ columns)


def test_current_that_really_flows_is_no_spike() -> None:
    drive = a_drive()
    pulse = np.zeros((SAMPLES, 3))
    pulse[[200, 700, 1100]] = [100.0, -60.0, -40.0]
    assert not find_spikes(drive.currents_a + pulse, drive.valid).any()


def test_delay_that_is_left_makes_no_spikes() -> None:
    drive = a_drive()
    steps = 80.0 * (np.arange(SAMPLES) // 100 % 2)
    late = np.roll(steps, 1)
    late[0] = steps[0]
    moved = drive.currents_a + np.column_stack([steps, -late, 0.0 * steps])
    assert not find_spikes(moved, drive.valid).any()


@pytest.mark.parametrize("gain", [-1.0, 0.4, 1.8])
def test_spikes_are_found_whatever_the_gains(gain: float) -> None:
    bad = a_drive().currents_a * [1.0, gain, 1.0]
    bad[500, 0] += 60.0
    found = find_spikes(bad, np.ones(SAMPLES, bool))
    assert np.argwhere(found).tolist() == [[500, 0]]
    assert found[500, 0] == 1


def test_joined_blocks_hold_the_same_sums() -> None:
    summary = summarise_samples([a_drive()], period_s=PERIOD_S, temperatures_c=[np.linspace(0.0, 30.0, SAMPLES)])
    fit, samples = summary.fit, summary.moments[:, -1, -1]
    assert fit is not None
    joined = fit.joined(np.arange(0, len(samples), 2), samples)
    np.testing.assert_allclose(joined.fast_a2.sum(axis=0), fit.fast_a2.sum(axis=0))
    np.testing.assert_allclose(joined.temperature_c, fit.temperature_c.reshape(-1, 2).mean(axis=1))
    assert joined.starts.sum() == 1
