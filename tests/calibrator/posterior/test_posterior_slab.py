import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import norm

from calibrator.posterior.slab import Slab

SLAB = Slab(0.05, 0.25)


@pytest.mark.parametrize(
    ("mean", "sd"), [(0.1, 0.02), (-0.1, 0.02), (0.05, 0.001), (0.0, 0.1), (0.3, 0.03), (-0.02, 1.0)]
)
def test_mass_is_the_integral_of_slab_times_gaussian(mean: float, sd: float) -> None:
    mass = sum(
        quad(lambda x: SLAB.density * norm.pdf(x, mean, sd), a, b, points=[mean] if a < mean < b else None)[0]
        for a, b in ((-0.25, -0.05), (0.05, 0.25))
    )
    assert SLAB.log_mass(np.array(mean), np.array(sd)) == pytest.approx(np.log(mass), abs=1e-6)


def test_density_integrates_to_one() -> None:
    assert 2.0 * (SLAB.high - SLAB.low) * SLAB.density == pytest.approx(1.0)


@pytest.mark.parametrize(("mean", "sd"), [(0.1, 0.02), (0.05, 0.001), (0.0, 0.1), (0.01, 0.002), (-0.02, 1e-6)])
def test_a_share_of_smaller_faults_lies_evenly_below_the_slab(mean: float, sd: float) -> None:
    slab = Slab(0.05, 0.25, smaller=0.01)
    below = norm.cdf(0.05, mean, sd) - norm.cdf(-0.05, mean, sd)
    expected = 0.99 * np.exp(SLAB.log_mass(np.array(mean), np.array(sd))) + 0.01 * below / 0.1
    assert slab.log_mass(np.array(mean), np.array(sd)) == pytest.approx(np.log(expected), abs=1e-9)
    assert 2.0 * (0.2 * slab.density + 0.05 * slab.density_below) == pytest.approx(1.0)


def test_sign_does_not_matter_and_a_common_unit_only_shifts() -> None:
    mean, sd = np.linspace(-0.4, 0.4, 17), np.full(17, 0.03)
    plain = SLAB.log_mass(mean, sd)
    np.testing.assert_allclose(SLAB.log_mass(-mean, sd), plain)
    np.testing.assert_allclose(Slab(50.0, 250.0).log_mass(1e3 * mean, 1e3 * sd), plain - np.log(1e3))


def test_a_sharp_value_has_the_density_inside_and_next_to_nothing_outside() -> None:
    inside, outside = SLAB.log_mass(np.array([0.15, 0.0]), np.array([1e-6, 1e-6]))
    assert inside == pytest.approx(np.log(SLAB.density))
    assert outside < -500.0


@pytest.mark.parametrize("side", [0.05, 0.25])
def test_far_tails_keep_their_order_and_stay_finite(side: float) -> None:
    sd = 0.001
    distances = sd * np.array([7.0, 9.0, 12.0, 20.0, 30.0])
    tails = SLAB.log_mass(side + np.where(side == 0.05, -1.0, 1.0) * distances, np.full(5, sd))
    expected = norm.logsf(distances / sd) + np.log(SLAB.density)
    np.testing.assert_allclose(tails, expected, atol=1e-6)
    assert np.isfinite(SLAB.log_mass(np.array(1e6), np.array(0.0)))


@pytest.mark.parametrize("dimensions", [1, 2, 3])
def test_nodes_lie_in_the_slab_and_are_balanced(dimensions: int) -> None:
    nodes = SLAB.nodes(dimensions)
    assert nodes.shape[1] == dimensions
    assert (np.abs(nodes) > SLAB.low).all()
    assert (np.abs(nodes) < SLAB.high).all()
    np.testing.assert_allclose(nodes.mean(axis=0), 0.0, atol=1e-12)
    np.testing.assert_allclose(np.abs(nodes).mean(axis=0), 0.15, atol=1e-3)
    np.testing.assert_array_equal((nodes > 0.0).mean(axis=0), 0.5)


def test_no_open_direction_has_one_node() -> None:
    assert SLAB.nodes(0).shape == (1, 0)


@pytest.mark.parametrize(("dimensions", "count"), [(1, 16), (2, 64), (3, 64), (5, 64)])
def test_each_node_stands_for_its_share_of_the_slab(dimensions: int, count: int) -> None:
    """A cube of as many equal cells has that edge, and a uniform distribution over an edge that deviation."""
    assert len(SLAB.nodes(dimensions)) == count
    assert SLAB.spacing(dimensions) ** dimensions * count == pytest.approx(0.4**dimensions)
    edge = np.linspace(-0.5, 0.5, 100_001) * SLAB.spacing(dimensions)
    assert SLAB.cell_sd(dimensions) == pytest.approx(edge.std(), rel=1e-4)


def test_nodes_along_one_direction_lie_equally_far_apart() -> None:
    nodes = np.sort(SLAB.nodes(1)[:, 0])
    np.testing.assert_allclose(nodes[8:], 0.05 + 0.2 * (np.arange(8) + 0.5) / 8)
    np.testing.assert_allclose(nodes[:8], -nodes[:7:-1])


def test_shares_of_the_prior_run_from_the_largest_negative_value_to_the_largest() -> None:
    np.testing.assert_allclose(
        SLAB.at(np.array([0.0, 0.25, 0.4999, 0.5001, 0.75, 1.0])), [-0.25, -0.15, -0.05004, 0.05004, 0.15, 0.25]
    )


@pytest.mark.parametrize("dimensions", [2, 3])
def test_nodes_in_space_fill_the_cube_evenly(dimensions: int) -> None:
    """Each 64th of each direction has one of them, in its middle."""
    unit = Slab.unit_nodes(dimensions)
    assert unit.min() > 0.0
    assert unit.max() < 1.0
    for values in unit.T:
        np.testing.assert_allclose(np.sort(values), (np.arange(64) + 0.5) / 64)


def test_without_an_open_direction_nodes_would_lie_apart_as_along_one() -> None:
    assert SLAB.spacing(0) == SLAB.spacing(1)


def test_no_values_have_no_masses() -> None:
    assert SLAB.log_mass(np.zeros((3, 0)), np.zeros((3, 0))).shape == (3, 0)
