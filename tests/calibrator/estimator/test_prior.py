"""Prior of the faults: densities, numbers of faults, and the law that they follow."""

from math import comb

import numpy as np
import pytest

from calibrator.drive import Array
from calibrator.estimator.prior import GRID, TAIL_DENSITY, Slab, first_prior, known_prior, sparse_counts
from tests.calibrator.estimator.simulated_rows import random_faults

BRANCHES = pytest.mark.parametrize("K", [2, 3, 5])


def counted(K: int, sparsity: float, vehicles: int = 4000) -> Array:
    """Numbers of vehicles with so many hardware and sensor faults, as the paper draws them."""
    faults, tally = random_faults(1, vehicles=vehicles, branches=K, sparsity=sparsity), np.zeros((K + 1, 2 * K + 1))
    hardware = (faults.hardware_drift != 0.0) + np.count_nonzero(faults.hardware_offset_a[:, :-1], axis=1)
    np.add.at(tally, (hardware, np.count_nonzero(np.hstack([faults.drift, faults.offset_a]), axis=1)), 1.0)
    return tally


@BRANCHES
@pytest.mark.parametrize("sparsity", [80.0, 60.0])
def test_law_of_sparse_faults_is_that_of_the_fleet(K: int, sparsity: float) -> None:
    tally = counted(K, sparsity)
    np.testing.assert_allclose(sparse_counts(tally), tally / tally.sum(), atol=0.02)


def mass(density: Array, low: float = 0.0, high: float = np.inf) -> float:
    return float(np.trapezoid(np.where((low < GRID) & (high > GRID), density, 0.0), GRID))


@pytest.mark.parametrize(("low", "high"), [(0.05, 0.25), (0.004, 1.0), (0.1, 0.12)])
@pytest.mark.parametrize("tail", [0.001, 0.1])
def test_slab_is_uniform_between_its_bounds_and_has_its_tail_beyond(low: float, high: float, tail: float) -> None:
    density = Slab(low=low, high=high, tail=tail).density
    assert mass(density) == pytest.approx(1.0, abs=1e-9)
    assert mass(density - tail * TAIL_DENSITY, 0.85 * low, 1.15 * high) == pytest.approx(1.0 - tail, abs=0.02)
    middle = np.interp(np.linspace(1.1 * low, 0.9 * high, 9), GRID, density - tail * TAIL_DENSITY)
    if low < 0.1:
        np.testing.assert_allclose(middle, middle.mean(), rtol=0.06)
    assert (density[(GRID > 0.002) & (GRID < 1.5)] > 0.0).all(), "no size is impossible"


@BRANCHES
def test_supports_of_every_prior_sum_to_one(K: int) -> None:
    for prior in (first_prior(K), known_prior(counted(K, 70.0) / 4000.0, (0.05, 0.25))):
        ways = [[comb(K, h) * comb(2 * K, s) for s in range(2 * K + 1)] for h in range(K + 1)]
        assert prior.counts.sum() == pytest.approx(1.0, abs=1e-6)
        assert np.sum(ways * np.exp(prior.log_supports)) == pytest.approx(1.0, abs=1e-6)
        assert prior.branches == K
