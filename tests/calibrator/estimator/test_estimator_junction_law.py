"""Junction law: gain ratios and constant of a vehicle's own currents, without bias from noise."""

import numpy as np
import pytest

from calibrator.drive import Array
from calibrator.estimator.evidence import LEAST_GAIN, VehicleRegressions, junction_regression, stack_summaries
from calibrator.summaries.moments import DriveSummary
from calibrator.summaries.summariser import summarise_samples
from tests.calibrator.estimator.simulated_drives import PERIOD_S, coloured, samples_of


def law_of(*summaries: DriveSummary) -> VehicleRegressions:
    return junction_regression(stack_summaries(summaries))


def summary_of_currents(currents_a: Array) -> DriveSummary:
    return summarise_samples([samples_of(np.zeros((len(currents_a), 0)), currents_a)], period_s=PERIOD_S)


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
    return summary_of_currents(i_m), np.append(gain, (1.0 + d[0]) * (np.sum(o / (1.0 + d)) - load_a))


@pytest.mark.parametrize("size_a", [pytest.param((80.0,), marks=pytest.mark.long), (80.0, 6.0)])
def test_standardised_errors_are_standard_normal(size_a: tuple[float, ...]) -> None:
    noise_a = (0.5,) * (len(size_a) + 1)
    summaries, truths = zip(
        *(summary_of(seed, noise_a=noise_a, size_a=size_a, samples=1800) for seed in range(120)), strict=True
    )
    fit = law_of(*summaries)
    z = (fit.estimate - np.array(truths)) / fit.sd
    rms = np.sqrt(np.mean(z**2, axis=0))
    assert (np.abs(z.mean(axis=0)) < 0.35).all(), z.mean(axis=0)
    assert ((rms > 0.75) & (rms < 1.3)).all(), rms


def test_noise_on_a_small_branch_does_not_draw_its_gain_to_zero() -> None:
    ratio, plain = [], []
    for seed in range(60):
        summary, truth = summary_of(seed, noise_a=(0.5, 0.5, 2.0), size_a=(80.0, 6.0))
        ratio.append(law_of(summary).estimate[0, 1] / truth[1])
        plain.append(np.linalg.solve(summary.total[1:, 1:], summary.total[0, 1:])[1] / truth[1])
    assert np.mean(plain) < 0.93, "least squares does"
    assert np.mean(ratio) == pytest.approx(1.0, abs=0.006)


def test_branch_that_never_moves_keeps_the_prior_and_one_of_noise_gets_no_sensor_s_gain() -> None:
    still = law_of(summary_of(6, noise_a=(0.5, 0.5, 0.0), size_a=(80.0, 0.0))[0])
    assert still.estimate[0, 1] == pytest.approx(-1.0, abs=0.05)
    assert still.sd[0, 1] == pytest.approx(0.4, rel=0.1)
    assert still.sd[0, 0] < 0.01
    rng = np.random.default_rng(7)
    motor = 80.0 * coloured(rng, 3600, 1, 0.98)[:, 0]
    currents = np.column_stack([-motor, motor, np.zeros(3600)]) + rng.normal(size=(3600, 3)) * (0.3, 0.3, 1.0)
    noisy = law_of(summary_of_currents(currents))
    assert -noisy.estimate[0, 1] < LEAST_GAIN
    assert noisy.estimate[0, 0] == pytest.approx(-1.0, abs=0.002)
