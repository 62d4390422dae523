"""Explanations of a vehicle: residuals follow the equations of the rows, fits those of dense linear algebra."""

import numpy as np
import pytest

from calibrator.drive import Array
from calibrator.estimator.posterior import Evidence, Fits, fit_explanations, row_residuals
from calibrator.estimator.prior import first_prior
from calibrator.faults import Faults
from tests.calibrator.estimator.simulated_rows import (
    Errors,
    all_supports,
    dense_fit,
    parameters_of,
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
    for j in range(len(rows)):  # none has both a load and an offset of the feeding sensor
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


@pytest.mark.parametrize("of_sensor", [False, True])
@BRANCHES
def test_what_all_sensors_share_leaves_nothing_either(K: int, of_sensor: bool) -> None:
    """Offset and gain of every sensor of a branch beside the vehicle's own; what a group shares is offset or load."""
    own = random_faults(K, vehicles=20, branches=K, sparsity=50.0)
    group = np.where(np.arange(20) % 2 == 0, 0.02, 0.0)
    shared, centre = np.zeros(2 * K + 1), np.zeros(5 * K)
    shared[0], shared[K - 1], shared[K], shared[2 * K - 1], shared[-1] = 0.03, -0.01, 0.05, -0.04, of_sensor
    centre[3 * K - 1 : 4 * K - 1], centre[4 * K - 1] = shared[:K], shared[:K].sum()
    offset = own.offset_a + shared[:K]
    offset[:, 0] += group * of_sensor
    both = Faults(
        hardware_drift=own.hardware_drift,
        hardware_offset_a=own.hardware_offset_a,
        drift=(1.0 + own.drift) * np.exp(shared[K : 2 * K]) - 1.0,
        offset_a=offset,
    )
    theta = parameters_of(own, group)
    theta[:, 2 * K : 3 * K] = own.offset_a / (1.0 + both.drift)
    rows = rows_of(both, noise=0.0, load=0.0 if of_sensor else group)
    left = row_residuals(plain_evidence(rows, centre=centre, shared=shared), theta[:, None])[:, 0]
    np.testing.assert_allclose(left[rows.known], 0.0, atol=1e-12)


def test_rows_that_nothing_explains_and_rows_that_say_nothing_are_fitted_without_failing() -> None:
    rows = rows_of(random_faults(10, vehicles=3, branches=2))
    rows.relative[0, :2], rows.constant[1, :2] = 3.0, -40.0
    rows.covariance[2] = 100.0 * np.eye(10)
    fits = fitted(plain_evidence(rows))
    assert (fits.number > 0).all()
    for j in range(3):
        n = fits.number[j]
        assert np.isfinite(fits.log_evidence[j, :n]).all()
        assert np.isfinite(fits.theta[j, :n]).all()
        assert np.isfinite(fits.root[j, :n]).all()
    assert () in supports(fits, 2)
    np.testing.assert_allclose(fits.theta[2], 0.0, atol=0.05)
    np.testing.assert_allclose(np.einsum("qpp->p", fits.root[2, : fits.number[2]] ** 2).max() > 0.1, True)
