from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
import pytest

from calibrator.artificial.random_fleet import FaultSettings, Purpose, random_stream
from calibrator.drive import Array
from calibrator.errors import FleetError
from calibrator.faults import Faults, measured_currents, true_currents


def draw(*, vehicles: int = 2000, branches: int = 2, **changes: Any) -> Faults:
    settings = replace(FaultSettings(sparsity=60.0), **changes)
    return settings.draw(np.random.default_rng(0), vehicles=vehicles, branches=branches, full_scale_a=400.0)


def free_parameters(faults: Faults) -> Array:
    """The 3K parameters of footnote 1, offsets in fractions of full scale."""
    hardware_offset, offset = faults.hardware_offset_a[:, :-1] / 400.0, faults.offset_a / 400.0
    return np.column_stack([faults.hardware_drift, hardware_offset, faults.drift, offset])


@pytest.mark.parametrize(("branches", "sparsity", "count"), [(3, 60.0, 4), (2, 60.0, 2), (5, 20.0, 12)])
def test_every_vehicle_has_as_many_faults_as_the_paper_counts(branches: int, sparsity: float, count: int) -> None:
    faults = draw(branches=branches, sparsity=sparsity)
    assert np.all(np.count_nonzero(free_parameters(faults), axis=1) == count)


def test_balanced_fleet_has_hardware_faults_in_half_of_those_that_drew_any() -> None:
    assert np.mean(draw(balanced=True, vehicles=20_000).has_hardware_fault) == pytest.approx(0.30, abs=0.01)


def test_mean_of_a_symmetric_fleet_is_the_ideal_current() -> None:
    faults = draw(symmetric=True, balanced=True, vehicles=400)
    i_s = np.array([[100.0, -100.0], [3.0, -3.0]])
    measured = [measured_currents(true_currents(i_s, faults.take(j)), faults.take(j)) for j in range(len(faults))]
    np.testing.assert_allclose(np.mean(measured, axis=0), i_s, atol=1e-10)


@pytest.mark.parametrize(("bias", "positive"), [(0.0, 0.5), (0.2, 0.7), (0.5, 1.0)])
def test_sizes_lie_in_their_range_and_sign_bias_is_the_excess_of_positive_faults(bias: float, positive: float) -> None:
    faults = draw(vehicles=4000, sparsity=40.0, sign_bias=bias)
    values = free_parameters(faults)
    values = values[values != 0.0]
    assert np.mean(values > 0.0) == pytest.approx(positive, abs=0.02)
    sizes = np.abs(values)
    assert (sizes.min(), sizes.mean(), sizes.max()) == pytest.approx((0.05, 0.15, 0.25), abs=0.002)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"sign_bias": 0.6}, "expected 0 to 0.5"),
        ({"sign_bias": float("nan")}, "expected 0 to 0.5"),
        ({"sign_bias": 0.2, "symmetric": True}, "and 0 for a symmetric fleet"),
        ({"vehicles": 6, "symmetric": True}, "needs a multiple of 4 vehicles, not 6"),
    ],
)
def test_fleet_that_cannot_be_drawn_is_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(FleetError, match=message):
        draw(**{"vehicles": 4} | changes)


def test_stream_is_decided_by_its_purpose_and_numbers_and_differs_from_all_others() -> None:
    numbers = [(), (0,), (7,), (7, 0), (7, 0, 0), (0, 7)]
    first, again = ([random_stream(p, *n).random() for p, n in product(Purpose, numbers)] for _ in range(2))
    assert first == again
    assert len(set(first)) == len(first)
