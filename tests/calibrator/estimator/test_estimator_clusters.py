"""Densest cluster: centre of the values that agree, whatever the others do."""

import numpy as np
import pytest

from calibrator.drive import Array
from calibrator.estimator.fleet_model import densest_clusters


def one_sided(seed: int, *, good: int, faulty: int, sd: float = 0.002) -> Array:
    """Agreeing values at 1, and faults that are all positive."""
    rng = np.random.default_rng(seed)
    return np.concatenate([rng.normal(1.0, sd, size=good), 1.0 + rng.uniform(0.05, 0.25, size=faulty)])


@pytest.mark.parametrize(("good", "faulty"), [(20, 80), (300, 700), (12, 8)])
def test_centre_is_that_of_agreeing_values_however_many_are_faulty(good: int, faulty: int) -> None:
    values = one_sided(1, good=good, faulty=faulty)
    cluster = densest_clusters(values, np.full(len(values), 0.002))[0]
    assert cluster.centre == pytest.approx(1.0, abs=4.0 * 0.002 / np.sqrt(good) + 2e-4)
    assert abs(values.mean() - 1.0) > 0.03


def test_share_and_spread_are_those_of_the_cluster() -> None:
    rng = np.random.default_rng(2)
    spread, sd = 0.01, np.full(1000, 0.004)
    members = rng.normal(0.0, np.hypot(spread, 0.004), size=600)
    cluster = densest_clusters(np.concatenate([members, rng.uniform(-0.3, 0.3, size=400)]), sd)[0]
    assert cluster.share == pytest.approx(0.6, abs=0.06)
    assert cluster.spread == pytest.approx(spread, rel=0.5)


def test_scale_shift_order_and_copies_pass_through() -> None:
    values, sd = one_sided(3, good=40, faulty=60), np.linspace(0.001, 0.003, 100)
    plain, scaled = densest_clusters(values, sd)[0], densest_clusters(5.0 - 100.0 * values, 100.0 * sd)[0]
    assert scaled.centre == pytest.approx(5.0 - 100.0 * plain.centre)
    assert scaled.spread == pytest.approx(100.0 * plain.spread)
    assert scaled.share == pytest.approx(plain.share)
    order = np.random.default_rng(4).permutation(100)
    assert densest_clusters(values[order], sd[order])[0].centre == pytest.approx(plain.centre, rel=1e-12)
    twice = densest_clusters(np.tile(values, 2), np.tile(sd, 2))[0]
    assert twice.centre == pytest.approx(plain.centre, abs=2e-4)
    assert twice.share == pytest.approx(plain.share, rel=0.01)


def test_two_variants_give_two_clusters_the_larger_first() -> None:
    rng = np.random.default_rng(6)
    values = np.concatenate([rng.normal(1.0, 0.002, 60), rng.normal(1.15, 0.002, 30), rng.uniform(0.8, 1.3, 20)])
    sd = np.full(len(values), 0.002)
    first, second = densest_clusters(values, sd, most=2)
    assert first.centre == pytest.approx(1.0, abs=0.002)
    assert second.centre == pytest.approx(1.15, abs=0.002)
    assert first.share > second.share
    assert densest_clusters(values, sd, farthest=0.5) == []


def test_values_that_agree_within_their_errors_are_one_cluster() -> None:
    (cluster,) = densest_clusters(np.array([0.5, 0.5001, 0.4999]), np.full(3, 0.01), most=2)
    assert (cluster.centre, cluster.share) == (0.5, 1.0)
    assert densest_clusters(np.array([1.3]), np.array([0.1]))[0].centre == 1.3
