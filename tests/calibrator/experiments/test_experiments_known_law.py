"""The law of an experiment as a prior equals what its fleets show."""

import numpy as np
import pytest

from calibrator.artificial.random_fleet import draw_faults
from calibrator.experiments.known_law import balanced_law


@pytest.mark.parametrize(("branches", "sparsity"), [(2, 20.0), (2, 60.0), (2, 80.0), (3, 60.0), (3, 80.0)])
def test_counts_are_those_of_drawn_fleets(branches: int, sparsity: float) -> None:
    vehicles = 40_000
    faults = draw_faults(
        np.random.default_rng(1),
        vehicles=vehicles,
        branches=branches,
        sparsity=sparsity,
        magnitude=(0.05, 0.25),
        full_scale_a=400.0,
        balanced=True,
    )
    free = faults.hardware_offset_a[:, :-1]
    hardware = (faults.hardware_drift != 0.0) + np.count_nonzero(free, axis=1)
    sensor = np.count_nonzero(faults.drift, axis=1) + np.count_nonzero(faults.offset_a, axis=1)
    drawn = np.zeros((branches + 1, 2 * branches + 1))
    np.add.at(drawn, (hardware, sensor), 1.0 / vehicles)
    law = balanced_law(branches, sparsity, (0.05, 0.25))
    assert law.counts.sum() == pytest.approx(1.0)
    np.testing.assert_allclose(law.counts, drawn, atol=0.01)
