"""Explanations of a vehicle: residuals follow the equations of the rows, fits those of dense linear algebra."""

import numpy as np
import pytest

from calibrator.drive import Array
from calibrator.estimator.posterior import Evidence, Fits, fit_explanations, row_residuals
from calibrator.estimator.prior import first_prior
from tests.calibrator.estimator.simulated_rows import (
    Errors,
    all_supports,
    dense_fit,
    plain_evidence,
    plain_residual,
    random_faults,
    rows_of,
)

BRANCHES = pytest.mark.parametrize("K", [2, 3, 4])
LOG_LOAD = -4.0
READ = Errors(gain_read=0.01, offset_read=0.001)
"""Every row says something."""


def fitted(evidence: Evidence) -> Fits:
    K = evidence.values.shape[1] // 5
    return fit_explanations(evidence, first_prior(K).log_supports, LOG_LOAD)


def supports(fits: Fits, vehicle: int) -> list[tuple[int, ...]]:
    return [tuple(np.flatnonzero(row).tolist()) for row in fits.support[vehicle, : fits.number[vehicle]]]


def random_parameters(seed: int, shape: tuple[int, ...], K: int) -> Array:
    return np.random.default_rng(seed).uniform(-0.3, 0.3, (*shape, 3 * K + 1))


@BRANCHES
def test_residuals_are_those_of_the_equations_of_the_rows(K: int) -> None:
    rows = rows_of(random_faults(K, vehicles=8, branches=K, sparsity=50.0), seed=K, errors=READ)
    theta = random_parameters(K, (8, 5), K)
    left = row_residuals(plain_evidence(rows), theta)
    for j in range(len(rows)):
        np.testing.assert_allclose(left[j], plain_residual(rows.take(slice(j, j + 1)), theta[j]), atol=1e-13)


@pytest.mark.parametrize(
    "errors",
    [
        pytest.param(Errors(), marks=pytest.mark.long),
        pytest.param(Errors(slope=0.02, ratio=0.01, intercept=0.01, junction=0.01), marks=pytest.mark.long),
        READ,
    ],
)
def test_fits_of_two_branches_are_those_of_all_supports_one_by_one(errors: Errors) -> None:
    rows = rows_of(random_faults(4, vehicles=8, branches=2, sparsity=60.0), seed=4, errors=errors)
    fits, log_prior = fitted(plain_evidence(rows)), first_prior(2).log_supports
    for j in range(len(rows)):
        dense = {on: dense_fit(rows.take(slice(j, j + 1)), on) for on in all_supports(2) if len(on) <= 6}
        prior = {
            on: log_prior[sum(p in {0, 3} for p in on), sum(p in {1, 2, 4, 5} for p in on)] + LOG_LOAD * (6 in on)
            for on in dense
        }
        score = {on: value + prior[on] for on, (_, _, value) in dense.items()}
        found = supports(fits, j)
        assert len(set(found)) == len(found)
        for q, on in enumerate(found):
            theta, covariance, log_evidence = dense[on]
            if log_evidence + prior[on] < max(score.values()) - 8.0:
                continue  # has next to no weight, and need not be at its optimum
            assert fits.log_evidence[j, q] == pytest.approx(log_evidence, abs=0.01)
            np.testing.assert_allclose(
                fits.theta[j, q], theta, atol=2e-3 * np.sqrt(covariance.max(initial=1e-6)) + 1e-7
            )
            np.testing.assert_allclose((fits.root[j, q] @ fits.root[j, q].T)[np.ix_(on, on)], covariance, rtol=0.02)
        missed = [value for on, value in score.items() if on not in found]
        assert np.exp(np.array(missed) - max(score.values())).sum() < 1e-3
