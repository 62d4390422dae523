"""Posterior of a vehicle: residuals, fits and weights of its explanations equal a direct computation."""

from dataclasses import replace
from math import comb

import numpy as np
import pytest
from scipy.special import logsumexp

from calibrator.drive import Array
from calibrator.estimator import posterior
from calibrator.estimator.evidence import EvidenceRows
from calibrator.estimator.prior import GRID, LOAD_DENSITY, Prior, Slab, first_prior, known_prior
from calibrator.faults import Faults
from tests.calibrator.estimator.simulated_drives import no_faults
from tests.calibrator.estimator.simulated_rows import (
    Errors,
    all_supports,
    dense_fit,
    model_of_equals,
    parameters_of,
    plain_evidence,
    plain_residual,
    random_faults,
    rows_of,
)

BRANCHES = pytest.mark.parametrize("K", [2, 3, 4])
LOG_LOAD = -4.0
READ = Errors(gain_read=0.01, offset_read=0.001)
"""Errors with which every row is known, those of bench readings included."""


def fitted(evidence: posterior.Evidence) -> posterior.Fits:
    K = evidence.values.shape[1] // 5
    return posterior.fit_explanations(evidence, first_prior(K).log_supports, LOG_LOAD)


def supports(fits: posterior.Fits, vehicle: int) -> list[tuple[int, ...]]:
    return [tuple(np.flatnonzero(row).tolist()) for row in fits.support[vehicle, : fits.number[vehicle]]]


def test_fits_of_two_branches_equal_separate_fits_of_all_supports() -> None:
    rows = rows_of(random_faults(4, vehicles=8, branches=2, sparsity=60.0), seed=4, errors=READ)
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
            atol = 2e-3 * np.sqrt(covariance.max(initial=1e-6)) + 1e-7
            np.testing.assert_allclose(fits.theta[j, q], theta, atol=atol)
            np.testing.assert_allclose((fits.root[j, q] @ fits.root[j, q].T)[np.ix_(on, on)], covariance, rtol=0.02)
        missed = [value for on, value in score.items() if on not in found]
        assert np.exp(np.array(missed) - max(score.values())).sum() < 1e-3


@pytest.mark.parametrize("of_sensor", [False, True])
@BRANCHES
def test_residuals_are_zero_for_true_faults_beside_shared_errors(K: int, of_sensor: bool) -> None:
    """Offset and gain of every sensor of a branch beside the vehicle's own; what a group shares is offset or load."""
    own = random_faults(K, vehicles=20, branches=K, sparsity=50.0)
    group = np.where(np.arange(20) % 2 == 0, 0.02, 0.0)
    shared = np.zeros(2 * K + 1)
    shared[0], shared[K - 1], shared[K], shared[2 * K - 1], shared[-1] = 0.03, -0.01, 0.05, -0.04, of_sensor
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
    rows = rows_of(both, errors=READ, noise=0.0, load=0.0 if of_sensor else group)
    evidence = plain_evidence(rows, centre=model_of_equals(K, shared).spread.mean, shared=shared)
    left = posterior.row_residuals(evidence, theta[:, None])[:, 0]
    np.testing.assert_allclose(left[rows.known], 0.0, atol=1e-12)


def test_contradicting_and_uninformative_rows_are_fitted_without_failure() -> None:
    rows = rows_of(random_faults(10, vehicles=3, branches=2))
    rows.relative[0, :2], rows.constant[1, :2] = 3.0, -40.0
    rows.covariance[2] = 100.0 * np.eye(10)
    fits = fitted(plain_evidence(rows))
    assert (fits.number > 0).all()
    for j in range(3):
        for found in (fits.log_evidence, fits.theta, fits.root):
            assert np.isfinite(found[j, : fits.number[j]]).all()
    assert () in supports(fits, 2)
    np.testing.assert_allclose(fits.theta[2], 0.0, atol=0.05)
    assert np.einsum("qpp->p", fits.root[2, : fits.number[2]] ** 2).max() > 0.1


# Weights of the draws

MAGNITUDE = (0.05, 0.25)
VAGUE = Errors(slope=0.02, ratio=0.02, intercept=0.01, junction=0.01)


def paper_prior(K: int, *totals: int) -> Prior:
    """Prior where each of ``totals`` is an equally likely number of faults; half the vehicles have sound hardware."""
    counts = np.zeros((K + 1, 2 * K + 1))
    for n in totals:
        chosen = np.array([on for on in all_supports(K) if 3 * K not in on and len(on) == n], dtype=int)
        sensor = ((chosen > 0) & (chosen <= K)) | (chosen >= 2 * K)
        for s in sensor.sum(axis=1):
            counts[n - s, s] += 0.5 / len(chosen) / len(totals)
            counts[0, s] += 0.5 / len(chosen) / len(totals)
    return known_prior(counts, MAGNITUDE)


def drawn(rows: EvidenceRows, prior: Prior, shared: Array | None = None) -> posterior.Draws:
    evidence = plain_evidence(rows, shared=shared)
    log_load = float(np.log(prior.load_share + prior.group_share.sum())) + 2.0
    fits = posterior.fit_explanations(evidence, prior.log_supports + 1.0, log_load)
    return posterior.draw_explanations(fits, evidence)


def log_prior(prior: Prior, theta: Array, on: tuple[int, ...]) -> Array:
    """Logarithm of the prior density of parameters (S, 3K + 1) with this support, without any group."""
    K = prior.branches
    hardware, sensor = sum(p == 0 or K < p < 2 * K for p in on), sum(1 <= p <= K or 2 * K <= p < 3 * K for p in on)
    load = prior.load_share if 3 * K in on else 1.0 - prior.load_share
    density = np.full(len(theta), prior.log_supports[hardware, sensor] + np.log(load))
    for p in on:
        table, size, change = prior.offset.density, np.abs(theta[:, p]), 0.0 * theta[:, p]
        if p <= K:  # d = e^x - 1
            table, size, change = prior.gain.density, np.abs(np.expm1(theta[:, p])), theta[:, p]
        elif 2 * K <= p < 3 * K:  # o = (1 + d) omega
            change = theta[:, p - 2 * K + 1]
            size = size * np.exp(change)
        elif p == 3 * K:
            table = LOAD_DENSITY
        density += np.log(np.interp(size, GRID, table)) + change - np.log(2.0)
        if p == 3 * K:
            density += np.where(theta[:, p] > 0.0, np.log(2.0), -1e3)
    return density


def integrated(rows: EvidenceRows, prior: Prior, on: tuple[int, ...], points: int) -> tuple[float, Array]:
    """Log evidence of one support of a vehicle, and its mean parameters, by sums over a grid."""
    centre, covariance, _ = dense_fit(rows, on)
    sd, steps = np.sqrt(np.diag(covariance)), np.linspace(-7.0, 7.0, points)
    theta = np.zeros((points ** len(on), 3 * prior.branches + 1))
    for i, p in enumerate(on):
        theta[:, p] = centre[p] + sd[i] * steps[np.arange(len(theta)) // points**i % points]
    e, cell = plain_residual(rows, theta), np.sum(np.log(sd * (steps[1] - steps[0])))
    precision, log_det = np.linalg.inv(rows.covariance[0]), np.linalg.slogdet(2.0 * np.pi * rows.covariance[0])[1]
    value = log_prior(prior, theta, on) - 0.5 * (np.einsum("sa,ab,sb->s", e, precision, e) + log_det)
    total = float(logsumexp(value))
    return total + float(cell), np.exp(value - total) @ theta


def of_supports(draws: posterior.Draws, weight: Array, vehicle: int) -> dict[tuple[int, ...], tuple[float, Array]]:
    """Weight of each support of a vehicle and its mean parameters."""
    found = {}
    for q in range(draws.fits.number[vehicle]):
        w = weight[vehicle, q].sum(axis=1)
        mean = w @ draws.values[vehicle, q] / max(w.sum(), 1e-300)
        found[tuple(np.flatnonzero(draws.fits.support[vehicle, q]).tolist())] = (float(w.sum()), mean)
    return found


def test_posterior_weights_equal_integration_on_a_grid() -> None:
    """Vague rows: the posterior is cut by the bounds of the sizes, and offsets depend on gains."""
    prior = paper_prior(2, 0, 1)
    truth = random_faults(2, vehicles=6, branches=2, sparsity=100.0 * (1.0 - 1.0 / 6.0))
    rows = rows_of(truth, seed=2, errors=VAGUE)
    draws = drawn(rows, prior)
    weight, log_evidence = posterior.weigh(draws, prior)
    for j in range(len(rows)):
        one = rows.take(slice(j, j + 1))
        supports = [on for on in all_supports(2) if len(on) <= 1 and 6 not in on]
        grid = {on: integrated(one, prior, on, 1001) for on in supports}
        total = logsumexp([value for value, _ in grid.values()])
        assert log_evidence[j] == pytest.approx(total, abs=0.08)
        found = of_supports(draws, weight, j)
        for on, (value, mean) in grid.items():
            share = float(np.exp(value - total))
            if share > 0.01:
                assert found[on][0] == pytest.approx(share, abs=0.04)
                np.testing.assert_allclose(found[on][1], mean, atol=0.004)


@pytest.mark.parametrize("kind", [posterior.GAIN, posterior.OFFSET])
@pytest.mark.parametrize("every", [1, 4])
def test_evidence_for_another_slab_equals_that_of_weighing_all_draws_again(kind: int, every: int) -> None:
    prior = paper_prior(2, 0, 1, 2)
    draws = drawn(rows_of(random_faults(9, vehicles=20, branches=2, sparsity=70.0), seed=9), prior)
    slabs = [Slab(low=low, high=high, tail=0.02) for low, high in ((0.02, 0.3), (0.05, 0.25), (0.1, 0.5))]
    found = posterior.fault_sizes(draws, prior, kind, every=every).evidence(np.stack([slab.density for slab in slabs]))
    of = [replace(prior, gain=slab) if kind == posterior.GAIN else replace(prior, offset=slab) for slab in slabs]
    exact = np.array([posterior.weigh(draws, each)[1].sum() for each in of])
    np.testing.assert_allclose(found - found[0], exact - exact[0], atol=1e-6 if every == 1 else 3.0)
    assert np.argmax(found) == np.argmax(exact) == 1


def test_probability_of_a_load_equals_integration_on_a_grid_and_negative_loads_have_no_weight() -> None:
    prior = Prior(
        counts=paper_prior(2, 0, 1).counts,
        gain=Slab(low=0.05, high=0.25, tail=1e-6),
        offset=Slab(low=0.01, high=0.25, tail=1e-6),
        load_share=0.3,
    )
    rows = rows_of(no_faults(3, 2), errors=Errors(intercept=0.003, junction=0.003), load=np.array([0.01, 0.004, -0.02]))
    draws = drawn(rows, prior)
    weight, _ = posterior.weigh(draws, prior)
    supports = [on for on in all_supports(2) if len(on) <= 1]
    for j in range(3):
        grid = {on: integrated(rows.take(slice(j, j + 1)), prior, on, 2001)[0] for on in supports}
        share = np.exp(grid[6,] - logsumexp(list(grid.values())))
        assert of_supports(draws, weight, j)[6,][0] == pytest.approx(share, abs=0.04)
    loads = draws.values[..., 6] * draws.fits.support[:, :, None, 6]
    assert weight[loads < 0.0].max() < 1e-30
    assert [of_supports(draws, weight, j)[6,][0] > 0.5 for j in range(3)] == [True, False, False]


def test_other_parameters_fit_best_beside_a_current_that_the_hardware_moves() -> None:
    faults = no_faults(1, 4)
    faults.hardware_offset_a[0, :2], faults.offset_a[0, 2] = (0.08, -0.08), 0.15
    rows = rows_of(faults, seed=2, errors=Errors(intercept=0.004, junction=0.0003))
    model = model_of_equals(4)
    draws = posterior.explain(rows, model, feed=0)
    best = int(posterior.weigh(draws, model.prior)[0].sum(axis=(2, 3))[0].argmax())
    assert (draws.fits.hardware[0, best], draws.fits.sensor[0, best]) == (1, 1)
    theta = draws.fits.theta[:, [best]]
    np.testing.assert_allclose(theta[0, 0, 4 + 1 : 2 * 4], [0.08, -0.08, 0.0], atol=0.01)
    assert theta[0, 0, 2 * 4 + 2] == pytest.approx(0.15, abs=5e-4)
    junction = posterior.row_residuals(plain_evidence(rows), theta)[0, 0, rows.places.junction]
    assert abs(junction) < 0.0003


def test_moved_currents_are_as_many_as_are_kept_and_none_where_no_two_sensors_have_offsets() -> None:
    faults = no_faults(2, 5)
    faults.offset_a[0] = 0.11, -0.05, 0.08, 0.19, 0.0
    model = model_of_equals(5)
    number = posterior.explain(rows_of(faults, seed=1), model, feed=0).fits.number
    assert posterior.MOST_MOVED < number[0] <= posterior.MOST_FITTED + posterior.MOST_MOVED
    assert number[1] < posterior.MOST_FITTED


# Prior of the faults


@BRANCHES
def test_prior_probabilities_of_all_supports_sum_to_one(K: int) -> None:
    for prior in (first_prior(K), paper_prior(K, 0, 1, 2)):
        ways = [[comb(K, h) * comb(2 * K, s) for s in range(2 * K + 1)] for h in range(K + 1)]
        assert prior.counts.sum() == pytest.approx(1.0, abs=1e-6)
        assert np.sum(ways * np.exp(prior.log_supports)) == pytest.approx(1.0, abs=1e-6)
