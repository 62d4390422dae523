from itertools import product

import numpy as np
import pytest
from scipy.special import logsumexp

from calibrator.posterior.supports import (
    constant_support,
    constant_supports,
    grown_supports,
    log_support_counts,
    relative_supports,
)

BRANCHES = pytest.mark.parametrize("branches", [2, 3, 4])


@BRANCHES
def test_every_support_is_there_once(branches: int) -> None:
    for supports, size in (
        (relative_supports(branches), branches + 1),
        (constant_supports(branches), 2 * branches - 1),
    ):
        assert len({support.active for support in supports}) == len(supports) == 2**size


@BRANCHES
def test_hardware_is_said_where_a_hardware_parameter_is_present(branches: int) -> None:
    assert all(support.hardware == (0 in support.active) for support in relative_supports(branches))
    assert all(
        support.hardware == (min(support.active, default=99) < branches - 1) for support in constant_supports(branches)
    )


@BRANCHES
def test_support_counts_are_those_of_all_pairs(branches: int) -> None:
    counts = np.zeros((branches + 1, 2 * branches + 1))
    for first, second in product(relative_supports(branches), constant_supports(branches)):
        hardware = int(first.hardware) + sum(i < branches - 1 for i in second.active)
        counts[hardware, len(first.active) + len(second.active) - hardware] += 1
    np.testing.assert_allclose(np.exp(log_support_counts(branches)), counts, rtol=1e-12)


def test_support_counts_of_eight_branches_sum_to_all_supports() -> None:
    assert logsumexp(log_support_counts(8)) == pytest.approx(24 * np.log(2.0))


def test_limited_supports_have_few_parameters_or_no_hardware_offsets() -> None:
    limited = constant_supports(5, most=2)
    assert len(set(limited)) == len(limited)
    assert set(limited) == {s for s in constant_supports(5) if len(s.active) <= 2 or not s.hardware}


def test_grown_supports_have_one_parameter_more() -> None:
    grown = grown_supports(4, (0, 3))
    assert [support.active for support in grown] == [(0, 1, 3), (0, 2, 3), (0, 3, 4), (0, 3, 5), (0, 3, 6)]
    assert all(support == constant_support(4, support.active) for support in grown)


def test_active_parameters_are_in_rising_order() -> None:
    assert constant_support(3, [4, 0, 2]).active == (0, 2, 4)
