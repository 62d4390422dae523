from itertools import product

import numpy as np
import pytest
from scipy.special import logsumexp

from calibrator.drive import Array
from calibrator.evidence.rows import constant_design, relative_design
from calibrator.posterior.supports import (
    Support,
    constant_support,
    constant_supports,
    grown_supports,
    log_support_counts,
    relative_supports,
)

BRANCHES = pytest.mark.parametrize("branches", [2, 3, 4])


def told_rows(design: Array, branches: int) -> Array:
    """The rows without bench readings, which are the last K of each design."""
    return design[:-branches]


def support_and_designs(branches: int) -> list[tuple[Support, Array]]:
    relative, constant = told_rows(relative_design(branches), branches), told_rows(constant_design(branches), branches)
    return [(s, relative) for s in relative_supports(branches)] + [(s, constant) for s in constant_supports(branches)]


@BRANCHES
def test_pivots_are_as_many_as_the_directions_that_the_rows_leave_open(branches: int) -> None:
    for support, design in support_and_designs(branches):
        rank = np.linalg.matrix_rank(design[:, list(support.active)]) if support.active else 0
        assert len(support.pivots) == len(support.active) - rank, support


@BRANCHES
def test_the_rows_determine_what_is_not_a_pivot(branches: int) -> None:
    for support, design in support_and_designs(branches):
        fitted = design[:, list(support.fitted)]
        assert not support.fitted or np.linalg.matrix_rank(fitted) == len(support.fitted), support


@BRANCHES
def test_pivots_are_the_same_for_rows_of_any_covariance(branches: int) -> None:
    rng = np.random.default_rng(branches)
    for support, design in support_and_designs(branches):
        if support.active:
            mixed = rng.normal(size=(len(design), len(design))) @ design[:, list(support.active)]
            assert len(support.pivots) == len(support.active) - np.linalg.matrix_rank(mixed)


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


def test_grown_supports_have_one_parameter_more_and_its_pivots() -> None:
    grown = grown_supports(4, (0, 3))
    assert [support.active for support in grown] == [(0, 1, 3), (0, 2, 3), (0, 3, 4), (0, 3, 5), (0, 3, 6)]
    assert all(support == constant_support(4, support.active) for support in grown)
    assert grown[-1].pivots == (0,)


def test_fitted_and_pivots_make_up_the_active() -> None:
    support = constant_support(3, [4, 0, 2])
    assert support.active == (0, 2, 4)
    assert support.pivots == (0,)
    assert support.fitted == (2, 4)
