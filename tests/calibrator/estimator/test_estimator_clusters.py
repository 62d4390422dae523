"""Densest cluster: centre of the values that agree, whatever the others do."""

import numpy as np
import pytest

from calibrator.drive import Array
from calibrator.estimator.evidence import densest_clusters


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
