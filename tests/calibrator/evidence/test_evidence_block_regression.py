import numpy as np
import pytest

from calibrator.drive import Array
from calibrator.evidence.block_regression import BlockRegression, regress_blocks
from tests.calibrator.evidence.simulated_drives import coloured

BLOCKS, LENGTH = 40, 30
TRUTH = np.array([1.1, -3.0])


def simulate(seed: int, *, memory: float = 0.8, growth: float = 0.0) -> tuple[Array, Array]:
    """Regressors (T, 2) and y (T,) with errors that repeat themselves, larger where the regressor is, by ``growth``."""
    rng = np.random.default_rng(seed)
    T = BLOCKS * LENGTH
    z = np.column_stack([coloured(rng, T, 1, 0.9)[:, 0] * 30.0, np.ones(T)])
    size = 2.0 + growth * np.abs(z[:, 0])
    return z, z @ TRUTH + size * coloured(rng, T, 1, memory)[:, 0]


def moments_of(z: Array, y: Array) -> tuple[Array, Array, float]:
    blocks = z.reshape(BLOCKS, LENGTH, -1)
    gram = np.einsum("btp,btq->bpq", blocks, blocks)
    right = np.einsum("btp,bt->bp", blocks, y.reshape(BLOCKS, LENGTH))
    return gram, right, float(np.mean(y**2))


def without_prior(gram: Array, right: Array, power: float) -> BlockRegression:
    return regress_blocks(gram, right, power, prior_mean=np.zeros(2), prior_precision=np.zeros(2))


def regress(z: Array, y: Array) -> BlockRegression:
    return without_prior(*moments_of(z, y))


def test_estimate_is_that_of_ordinary_least_squares() -> None:
    z, y = simulate(1)
    np.testing.assert_allclose(regress(z, y).estimate, np.linalg.lstsq(z, y, rcond=None)[0], rtol=1e-7)


def test_covariance_is_that_of_the_sandwich_over_blocks() -> None:
    z, y = simulate(2)
    theta = np.linalg.lstsq(z, y, rcond=None)[0]
    bread = np.linalg.inv(z.T @ z)
    scores = ((y - z @ theta)[:, None] * z).reshape(BLOCKS, LENGTH, 2).sum(axis=1)
    sandwich = bread @ scores.T @ scores @ bread * BLOCKS / (BLOCKS - 4)
    fit = regress(z, y)
    np.testing.assert_allclose(fit.influence.T @ fit.influence, sandwich, rtol=1e-6)
    np.testing.assert_allclose(fit.sd, np.sqrt(np.diag(sandwich)), rtol=1e-6)


@pytest.mark.parametrize(("memory", "growth"), [(0.0, 0.0), (0.8, 0.0), (0.8, 0.1)])
def test_standardised_errors_are_standard_normal_over_500_vehicles(memory: float, growth: float) -> None:
    z = []
    for seed in range(500):
        fit = regress(*simulate(seed, memory=memory, growth=growth))
        z.append((fit.estimate - TRUTH) / fit.sd)
    rms = np.sqrt(np.mean(np.square(z), axis=0))
    assert (np.abs(np.mean(z, axis=0)) < 3.5 / np.sqrt(500)).all()
    assert ((rms > 0.9) & (rms < 1.2)).all(), rms


def test_errors_that_last_longer_than_a_block_are_told_too_small_but_not_by_half() -> None:
    z = []
    for seed in range(200):
        fit = regress(*simulate(seed, memory=0.97))
        z.append((fit.estimate - TRUTH) / fit.sd)
    assert (np.sqrt(np.mean(np.square(z), axis=0)) < 2.0).all()


def test_independent_samples_would_be_far_too_sure() -> None:
    naive = []
    for seed in range(100):
        z, y = simulate(seed)
        theta, rss = np.linalg.lstsq(z, y, rcond=None)[:2]
        naive.append((theta - TRUTH) / np.sqrt(np.diag(np.linalg.inv(z.T @ z)) * rss / len(y)))
    assert np.sqrt(np.mean(np.square(naive))) > 1.8


def test_units_pass_through() -> None:
    z, y = simulate(3)
    plain, scaled = regress(z, y), regress(z * np.array([1e-3, 1.0]), 1e3 * y)
    np.testing.assert_allclose(scaled.estimate, plain.estimate * np.array([1e6, 1e3]), rtol=1e-7)
    np.testing.assert_allclose(scaled.sd, plain.sd * np.array([1e6, 1e3]), rtol=1e-6)


def test_order_of_blocks_does_not_matter() -> None:
    gram, right, power = moments_of(*simulate(4))
    order = np.random.default_rng(4).permutation(BLOCKS)
    plain, other = (
        without_prior(gram, right, power),
        without_prior(gram[order], right[order], power),
    )
    np.testing.assert_allclose(other.estimate, plain.estimate, rtol=1e-9)
    np.testing.assert_allclose(other.influence, plain.influence[order], atol=1e-9 * np.abs(plain.influence).max())


def test_a_drive_twice_as_long_is_surer_by_the_root_of_two() -> None:
    gram, right, power = moments_of(*simulate(5))
    once = without_prior(gram, right, power)
    twice = without_prior(np.tile(gram, (2, 1, 1)), np.tile(right, (2, 1)), power)
    np.testing.assert_allclose(twice.sd, once.sd / np.sqrt(2.0), rtol=0.03)


def test_a_regressor_that_does_not_move_keeps_its_prior() -> None:
    gram, right, power = moments_of(*simulate(6))
    gram[:, 0], gram[:, :, 0], right[:, 0] = 0.0, 0.0, 0.0
    fit = regress_blocks(gram, right, power, prior_mean=np.array([1.0, 0.0]), prior_precision=np.array([0.4**-2, 0.0]))
    assert fit.estimate[0] == pytest.approx(1.0)
    assert fit.sd[0] == pytest.approx(0.4, rel=0.01)


def test_a_strong_regressor_outweighs_the_prior() -> None:
    z, y = simulate(7)
    fit = regress_blocks(*moments_of(z, y), prior_mean=np.array([2.0, 0.0]), prior_precision=np.array([0.4**-2, 0.0]))
    np.testing.assert_allclose(fit.estimate, regress(z, y).estimate, atol=3e-3)


def test_an_exact_fit_is_sure_and_finite() -> None:
    z, _ = simulate(8)
    fit = regress(z, z @ TRUTH)
    np.testing.assert_allclose(fit.estimate, TRUTH, rtol=1e-9)
    assert (fit.sd < 1e-6).all()


def test_one_and_two_blocks_give_finite_results() -> None:
    gram, right, power = moments_of(*simulate(9))
    for count in (1, 2):
        assert np.isfinite(without_prior(gram[:count], right[:count], power).sd).all()
