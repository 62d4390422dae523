"""Regression on blocks of moments: estimate and covariance against samples, and what changes neither."""

import numpy as np
import pytest

from calibrator.drive import Array
from calibrator.estimator.moments import Blocks, VehicleRegressions, regress_vehicles
from tests.calibrator.estimator.simulated_drives import coloured

BLOCKS, LENGTH = 40, 30
TRUTH = np.array([1.1, -3.0])
Moments = tuple[Array, Array, float]


def simulate(seed: int, *, memory: float = 0.8, growth: float = 0.0) -> tuple[Array, Array]:
    """Regressors (T, 2) and y (T,) with errors that repeat themselves, larger where the regressor is, by ``growth``."""
    rng = np.random.default_rng(seed)
    T = BLOCKS * LENGTH
    z = np.column_stack([coloured(rng, T, 1, 0.9)[:, 0] * 30.0, np.ones(T)])
    size = 2.0 + growth * np.abs(z[:, 0])
    return z, z @ TRUTH + size * coloured(rng, T, 1, memory)[:, 0]


def moments_of(z: Array, y: Array) -> Moments:
    blocks = z.reshape(BLOCKS, LENGTH, -1)
    gram = np.einsum("btp,btq->bpq", blocks, blocks)
    return gram, np.einsum("btp,bt->bp", blocks, y.reshape(BLOCKS, LENGTH)), float(np.mean(y**2))


def regress(*vehicles: Moments, prior_mean: float = 0.0, precision: float = 0.0) -> VehicleRegressions:
    """Regressions of vehicles with a prior of the slope."""
    gram, right, power = zip(*vehicles, strict=True)
    return regress_vehicles(
        np.concatenate(gram),
        np.concatenate(right),
        np.array(power),
        Blocks.of_lengths([len(part) for part in right]),
        prior_mean=np.array([prior_mean, 0.0]),
        prior_precision=np.array([precision, 0.0]),
    )


def test_estimate_and_covariance_are_least_squares_and_its_sandwich_over_blocks() -> None:
    z, y = simulate(2)
    theta = np.linalg.lstsq(z, y, rcond=None)[0]
    bread = np.linalg.inv(z.T @ z)
    scores = ((y - z @ theta)[:, None] * z).reshape(BLOCKS, LENGTH, 2).sum(axis=1)
    sandwich = bread @ scores.T @ scores @ bread * BLOCKS / (BLOCKS - 4)
    fit = regress(moments_of(z, y))
    np.testing.assert_allclose(fit.estimate[0], theta, rtol=1e-7)
    np.testing.assert_allclose(fit.influence.T @ fit.influence, sandwich, rtol=1e-6)
    np.testing.assert_allclose(fit.sd[0], np.sqrt(np.diag(sandwich)), rtol=1e-6)


@pytest.mark.parametrize(("memory", "growth"), [(0.0, 0.0), (0.8, 0.0), (0.8, 0.1)])
def test_standardised_errors_are_standard_normal(memory: float, growth: float) -> None:
    fit = regress(*(moments_of(*simulate(seed, memory=memory, growth=growth)) for seed in range(500)))
    z = (fit.estimate - TRUTH) / fit.sd
    rms = np.sqrt(np.mean(z**2, axis=0))
    assert (np.abs(np.mean(z, axis=0)) < 3.5 / np.sqrt(500)).all()
    assert ((rms > 0.9) & (rms < 1.2)).all(), rms


def test_vehicles_together_are_as_each_alone_to_the_bit() -> None:
    vehicles = [moments_of(*simulate(seed)) for seed in range(3)]
    vehicles[1] = (vehicles[1][0][:7], vehicles[1][1][:7], vehicles[1][2])
    together = regress(*vehicles)
    for j, vehicle in enumerate(vehicles):
        np.testing.assert_array_equal(together.estimate[j], regress(vehicle).estimate[0])
        np.testing.assert_array_equal(together.sd[j], regress(vehicle).sd[0])


def test_regressor_that_does_not_move_keeps_its_prior_and_a_strong_one_outweighs_it() -> None:
    gram, right, power = moments_of(*simulate(6))
    strong = regress((gram, right, power), prior_mean=2.0, precision=0.4**-2)
    np.testing.assert_allclose(strong.estimate, regress((gram, right, power)).estimate, atol=3e-3)
    gram[:, 0], gram[:, :, 0], right[:, 0] = 0.0, 0.0, 0.0
    still = regress((gram, right, power), prior_mean=1.0, precision=0.4**-2)
    assert still.estimate[0, 0] == pytest.approx(1.0)
    assert still.sd[0, 0] == pytest.approx(0.4, rel=0.01)


def test_exact_fit_and_a_single_block_are_finite() -> None:
    z, _ = simulate(8)
    exact = regress(moments_of(z, z @ TRUTH))
    np.testing.assert_allclose(exact.estimate[0], TRUTH, rtol=1e-9)
    assert (exact.sd < 1e-6).all()
    gram, right, power = moments_of(*simulate(9))
    assert np.isfinite(regress((gram[:1], right[:1], power)).sd).all()
