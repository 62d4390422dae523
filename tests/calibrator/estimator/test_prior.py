"""Prior of the faults: densities, numbers of faults, and the law that they follow."""

import numpy as np
import pytest

from calibrator.drive import Array
from calibrator.estimator.prior import (
    sparse_counts,
)
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
