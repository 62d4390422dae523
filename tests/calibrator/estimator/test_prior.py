"""Prior of the faults: densities, numbers of faults, and the law that they follow."""

from math import comb

import numpy as np
import pytest

from calibrator.drive import Array
from calibrator.estimator.prior import (
    GRID,
    LOAD_DENSITY,
    TAIL_DENSITY,
    Prior,
    Slab,
    first_prior,
    known_prior,
    sparse_counts,
    uniform_density,
    with_slabs,
)
from tests.calibrator.estimator.simulated_rows import random_faults

BRANCHES = pytest.mark.parametrize("K", [2, 3, 5])


def mass(density: Array, low: float = 0.0, high: float = np.inf) -> float:
    return float(np.trapezoid(np.where((low < GRID) & (high > GRID), density, 0.0), GRID))


def counted(K: int, sparsity: float, vehicles: int = 4000) -> Array:
    """Numbers of vehicles with so many hardware and sensor faults, as the paper draws them."""
    faults, tally = random_faults(1, vehicles=vehicles, branches=K, sparsity=sparsity), np.zeros((K + 1, 2 * K + 1))
    hardware = (faults.hardware_drift != 0.0) + np.count_nonzero(faults.hardware_offset_a[:, :-1], axis=1)
    np.add.at(tally, (hardware, np.count_nonzero(np.hstack([faults.drift, faults.offset_a]), axis=1)), 1.0)
    return tally


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


def test_densities_of_several_bounds_are_those_of_each() -> None:
    low, high = np.array([0.01, 0.05]), np.array([0.4, 0.25])
    both = uniform_density(low, high)
    for s in range(2):
        np.testing.assert_allclose(both[:, s], uniform_density(low[s : s + 1], high[s : s + 1])[:, 0])
    assert mass(LOAD_DENSITY) == pytest.approx(1.0)


def test_smallest_fault_is_near_the_lower_bound_unless_the_tail_is_heavy() -> None:
    assert Slab(low=0.05, high=0.25, tail=0.001).smallest == pytest.approx(0.054, rel=0.1)
    assert Slab(low=0.05, high=0.25, tail=0.1).smallest < 0.02


@BRANCHES
def test_supports_of_every_prior_sum_to_one(K: int) -> None:
    for prior in (first_prior(K), known_prior(counted(K, 70.0) / 4000.0, (0.05, 0.25))):
        ways = [[comb(K, h) * comb(2 * K, s) for s in range(2 * K + 1)] for h in range(K + 1)]
        assert prior.counts.sum() == pytest.approx(1.0, abs=1e-6)
        assert np.sum(ways * np.exp(prior.log_supports)) == pytest.approx(1.0, abs=1e-6)
        assert prior.branches == K


def test_first_prior_expects_few_faults_and_hardware_faults_in_some_vehicles() -> None:
    counts = first_prior(3).counts
    total = np.add.outer(np.arange(4), np.arange(7))
    assert counts[total <= 3].sum() > 0.85
    assert counts[1:].sum() == pytest.approx(0.5 * (1.0 - 0.8**3), abs=1e-12)  # half may have hardware faults


@BRANCHES
@pytest.mark.parametrize("sparsity", [80.0, 60.0])
def test_law_of_sparse_faults_is_that_of_the_fleet(K: int, sparsity: float) -> None:
    tally = counted(K, sparsity)
    np.testing.assert_allclose(sparse_counts(tally), tally / tally.sum(), atol=0.02)


@BRANCHES
def test_law_of_a_fleet_without_faults_has_next_to_none_and_of_no_fleet_is_a_law_all_the_same(K: int) -> None:
    tally = np.zeros((K + 1, 2 * K + 1))
    assert sparse_counts(tally).sum() == pytest.approx(1.0)
    tally[0, 0] = 100.0
    law = sparse_counts(tally)
    assert law.sum() == pytest.approx(1.0)
    assert law[0, 0] > 0.98
    assert (law > 0.0).all(), "nothing is impossible"


def test_many_vehicles_change_the_law_more_than_few() -> None:
    share = counted(3, 80.0) / 4000.0
    apart = [float(np.abs(sparse_counts(vehicles * share) - share).sum()) for vehicles in (1.0, 5.0, 50.0, 500.0)]
    assert apart == sorted(apart, reverse=True)
    assert apart[0] > 10.0 * apart[3]


def test_other_sizes_leave_numbers_loads_and_groups() -> None:
    slab = Slab(low=0.05, high=0.25, tail=0.01)
    prior = Prior(counts=first_prior(2).counts, gain=slab, offset=slab, load_share=0.2, group_share=np.array([0.3]))
    other = with_slabs(prior, Slab(low=0.3, high=0.6, tail=0.01), slab)
    assert other.gain.low == 0.3
    assert {name for name in vars(prior) if vars(prior)[name] is not vars(other)[name]} == {"gain"}
    assert other.log_density.shape == (3, len(GRID))
