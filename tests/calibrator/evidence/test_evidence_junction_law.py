from dataclasses import replace

import numpy as np
import pytest

from calibrator.drive import Array
from calibrator.evidence.block_regression import BlockRegression
from calibrator.evidence.collect import LEAST_GAIN
from calibrator.evidence.fleet_moments import stack_summaries
from calibrator.evidence.junction_law import junction_law
from calibrator.summaries.moments import DriveSummary
from calibrator.summaries.summariser import summarise
from tests.calibrator.evidence.simulated_drives import PERIOD_S, coloured, samples_of


def smooth(rng: np.random.Generator, samples: int) -> Array:
    """A current that changes slowly against the sampling, variance about 1."""
    white = rng.normal(size=samples + 200)
    window = np.hanning(41)
    return np.asarray(np.convolve(white, window / np.sqrt(np.sum(window**2)), "same")[100:-100])


def summary_of(
    seed: int, *, noise_a: tuple[float, ...], size_a: tuple[float, ...], samples: int = 3600, load_a: float = 0.0
) -> tuple[DriveSummary, Array]:
    """Consumers of these sizes fed by the first branch, with faults; and the true (g_2 .. g_K, c)."""
    rng = np.random.default_rng(seed)
    consumers = np.stack([size * (smooth(rng, samples) + 0.5) for size in size_a], axis=1)
    i = np.column_stack([-consumers.sum(axis=1) - load_a, consumers])
    K = i.shape[1]
    d = rng.uniform(-0.1, 0.1, size=(K,))
    o = rng.uniform(-5.0, 5.0, size=(K,))
    i_m = (1.0 + d) * i + o + rng.normal(size=i.shape) * np.array(noise_a)
    gain = -(1.0 + d[0]) / (1.0 + d[1:])
    truth = np.append(gain, (1.0 + d[0]) * (np.sum(o / (1.0 + d)) - load_a))
    return summarise([samples_of(np.zeros((samples, 0)), i_m)], period_s=PERIOD_S), truth


def law_of(summary: DriveSummary) -> BlockRegression:
    return junction_law(stack_summaries([summary])).of_vehicle(0)


def standardised(fits: list[tuple[BlockRegression, Array]]) -> Array:
    return np.array([(fit.estimate - truth) / fit.sd for fit, truth in fits])


def test_gain_ratios_and_constant_are_exact_without_noise() -> None:
    summary, truth = summary_of(1, noise_a=(0.0, 0.0, 0.0), size_a=(80.0, 10.0))
    fit = law_of(summary)
    np.testing.assert_allclose(fit.estimate, truth, rtol=2e-4, atol=1e-3)


@pytest.mark.parametrize("size_a", [(80.0,), (80.0, 6.0)])
def test_standardised_errors_are_standard_normal(size_a: tuple[float, ...]) -> None:
    K = len(size_a) + 1
    fits = []
    for seed in range(120):
        summary, truth = summary_of(seed, noise_a=(0.5,) * K, size_a=size_a, samples=1800)
        fits.append((law_of(summary), truth))
    z = standardised(fits)
    rms = np.sqrt(np.mean(z**2, axis=0))
    assert (np.abs(z.mean(axis=0)) < 0.35).all(), z.mean(axis=0)
    assert ((rms > 0.75) & (rms < 1.3)).all(), rms


def test_noise_on_a_small_branch_does_not_draw_its_gain_to_zero() -> None:
    errors, plain = [], []
    for seed in range(60):
        summary, truth = summary_of(seed, noise_a=(0.5, 0.5, 2.0), size_a=(80.0, 6.0), samples=3600)
        errors.append(law_of(summary).estimate[1] / truth[1])
        gram, right = summary.total[1:, 1:], summary.total[0, 1:]
        plain.append(np.linalg.solve(gram, right)[1] / truth[1])
    assert np.mean(plain) < 0.93, "least squares does"
    assert np.mean(errors) == pytest.approx(1.0, abs=0.006)


def test_unit_of_current_only_scales_the_constant() -> None:
    summary, _ = summary_of(3, noise_a=(0.5, 0.5, 0.5), size_a=(80.0, 10.0))
    scale = np.array([1e3, 1e3, 1e3, 1.0])
    scaled = replace(summary, moments=summary.moments * np.outer(scale, scale), noise_a2=1e6 * summary.noise_a2)
    plain, milli = law_of(summary), law_of(scaled)
    np.testing.assert_allclose(milli.estimate, plain.estimate * np.array([1.0, 1.0, 1e3]), rtol=1e-6)
    np.testing.assert_allclose(milli.sd, plain.sd * np.array([1.0, 1.0, 1e3]), rtol=1e-5)


def test_order_of_the_consumers_does_not_matter() -> None:
    summary, _ = summary_of(4, noise_a=(0.5, 0.5, 0.5), size_a=(80.0, 10.0))
    plain, swapped = law_of(summary), law_of(summary.take_branches([0, 2, 1]))
    np.testing.assert_allclose(swapped.estimate, plain.estimate[[1, 0, 2]], rtol=1e-9)


def test_a_load_that_no_branch_measures_moves_the_constant_alone() -> None:
    with_load, truth = summary_of(5, noise_a=(0.5, 0.5, 0.5), size_a=(80.0, 10.0), load_a=3.0)
    fit = law_of(with_load)
    assert (np.abs(fit.estimate - truth) < 5.0 * fit.sd).all()
    without, _ = summary_of(5, noise_a=(0.5, 0.5, 0.5), size_a=(80.0, 10.0))
    np.testing.assert_allclose(fit.estimate[:2], law_of(without).estimate[:2], rtol=1e-6)


def test_a_branch_that_never_moves_keeps_the_prior_and_says_so() -> None:
    summary, _ = summary_of(6, noise_a=(0.5, 0.5, 0.0), size_a=(80.0, 0.0))
    fit = law_of(summary)
    assert fit.estimate[1] == pytest.approx(-1.0, abs=0.05)
    assert fit.sd[1] == pytest.approx(0.4, rel=0.1)
    assert fit.sd[0] < 0.01


def test_a_branch_of_noise_alone_gets_a_gain_that_no_sensor_has() -> None:
    rng = np.random.default_rng(7)
    motor = 80.0 * coloured(rng, 3600, 1, 0.98)[:, 0]
    currents = np.column_stack([-motor, motor, np.zeros(3600)]) + rng.normal(size=(3600, 3)) * (0.3, 0.3, 1.0)
    fit = law_of(summarise([samples_of(np.zeros((3600, 0)), currents)], period_s=PERIOD_S))
    assert -fit.estimate[1] < LEAST_GAIN
    assert fit.estimate[0] == pytest.approx(-1.0, abs=0.002)


def test_fast_currents_with_equal_noise_are_not_over_corrected() -> None:
    ratio = []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        consumers = coloured(rng, 3600, 2, 0.8) * np.array([80.0, 8.0])
        currents = np.column_stack([-consumers.sum(axis=1), consumers]) + rng.normal(size=(3600, 3))
        ratio.append(law_of(summarise([samples_of(np.zeros((3600, 0)), currents)], period_s=PERIOD_S)).estimate)
    np.testing.assert_allclose(np.mean(ratio, axis=0)[:2], -1.0, atol=0.003)
