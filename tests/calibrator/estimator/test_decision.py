"""Decisions on a vehicle: confidence and harm are the probabilities that plain draws give."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from calibrator.drive import Array, Mask
from calibrator.estimator.decision import (
    Points,
    RowsEstimate,
    best_estimate,
    estimate_rows,
    harm_probability,
    posterior_points,
)
from calibrator.estimator.evidence import UNKNOWN_VARIANCE, EvidenceRows
from calibrator.estimator.fleet_estimate import HARM_LIMIT
from calibrator.estimator.learning import learn_fault_models
from calibrator.estimator.posterior import Draws, FaultModel, Spread, draw_explanations, fit_explanations, weigh
from calibrator.estimator.prior import Prior, Slab, first_prior
from calibrator.faults import Faults
from calibrator.score import harmed, recovered
from tests.calibrator.estimator.simulated_drives import no_faults
from tests.calibrator.estimator.simulated_rows import Errors, model_of_equals, plain_evidence, random_faults, rows_of

K = 2
LEAST = np.array([0.05, 0.05])
TWO_EXPLANATIONS = [(0.7, [0.12, 0.0, 0.0, 0.0]), (0.3, [0.0, -0.11, 0.1, 0.1])]


def points(explanations: list[tuple[float, list[float]]], *, sd: float = 0.0, draws: int = 4000) -> Points:
    """Posterior of explanations (probability, faults), each nonzero fault with this standard deviation."""
    rng = np.random.default_rng(0)
    faults = np.concatenate(
        [
            np.array(values) + sd * rng.normal(size=(draws, 2 * K)) * (np.array(values) != 0.0)
            for _, values in explanations
        ]
    )
    weight = np.repeat([share / draws for share, _ in explanations], draws)
    number = np.repeat(np.arange(len(explanations)), draws)
    return Points(faults, weight, number)


def as_faults(values: Array) -> Faults:
    none = np.zeros((len(values), K))
    return Faults(hardware_drift=none[:, 0], hardware_offset_a=none, drift=values[:, :K], offset_a=values[:, K:])


@pytest.mark.parametrize("sd", [1e-4, 0.005, 0.03])
def test_confidence_is_the_probability_of_being_recovered(sd: float) -> None:
    found = points(TWO_EXPLANATIONS, sd=sd)
    estimate, confidence = best_estimate(found, LEAST)
    near = recovered(
        as_faults(np.tile(estimate, (len(found.faults), 1))),
        as_faults(found.faults),
        full_scale_a=1.0,
        smallest_fault=0.05,
    )
    assert confidence == pytest.approx(found.weight @ near, abs=1e-9)
    assert confidence <= 0.7 + 1e-9


def test_harm_probability_equals_that_of_simulated_currents() -> None:
    """Equation (25) of the paper on drawn true currents, against (M19) of docs/method.md, which uses their moments."""
    rng = np.random.default_rng(1)
    estimate = np.array([0.1, -0.08, 0.03, -0.02])
    found = points([(1.0, estimate.tolist())], sd=0.03, draws=400)
    true = rng.normal([0.1, -0.1], 0.2, size=(2000, K))
    mean, square = true.mean(axis=0)[None], (true**2).mean(axis=0)[None]
    d, o = found.faults[:, None, :K], found.faults[:, None, K:]
    measured = (1.0 + d) * true + o
    corrected = (measured - estimate[K:]) / (1.0 + estimate[:K])
    worse = ((corrected - true) ** 2).mean(axis=1) > ((measured - true) ** 2).mean(axis=1)
    np.testing.assert_allclose(harm_probability(found, estimate, mean, square), worse.mean(axis=0), atol=1e-9)
    assert 0.0 < worse.mean() < 1.0


def test_confidence_adds_up_explanations_within_tolerance() -> None:
    found = points([(0.4, [0.2, 0, 0, 0]), (0.3, [0, 0.1, 0, 0]), (0.3, [0, 0.1004, 0, 0])], sd=1e-6)
    estimate, confidence = best_estimate(found, LEAST)
    assert estimate[1] == pytest.approx(0.1, abs=1e-3)
    assert confidence == pytest.approx(0.6)


def test_harm_on_two_drives_is_at_most_the_sum_of_both_and_0_without_a_correction() -> None:
    found, estimate = points(TWO_EXPLANATIONS, sd=0.05), np.array([0.12, 0.0, 0.0, 0.0])
    one, other = (np.array([[0.1, -0.1]]), np.full((1, K), 0.05)), (np.zeros((1, K)), np.full((1, K), 1e-4))
    apart = [harm_probability(found, estimate, *drive)[0] for drive in (one, other)]
    for drives in ((one, other), (other, one)):
        both = harm_probability(found, estimate, *map(np.concatenate, zip(*drives, strict=True)))
        assert max(apart) <= both[0] <= min(sum(apart), 1.0)
        assert both[1] == 0.0


def explained(
    truth: Faults, prior: Prior, *, shared: Array | None = None, load: Array | float = 0.0, probability: float = 1.0
) -> tuple[FaultModel, Draws, Array]:
    """One model with its draws of a fleet, and their weights."""
    shared = np.zeros(2 * K + 1) if shared is None else shared
    centre = np.zeros(5 * K)
    centre[3 * K - 1 : 4 * K - 1], centre[4 * K - 1] = shared[:K], shared[:K].sum()
    evidence = plain_evidence(rows_of(truth, seed=2, load=load), centre=centre, shared=shared)
    log_load = float(np.log(prior.load_share + prior.group_share.sum())) + 2.0
    draws = draw_explanations(fit_explanations(evidence, prior.log_supports + 1.0, log_load), evidence)
    spread = Spread(mean=centre, covariance=np.zeros((5 * K, 5 * K)), dispersion=np.ones(K), shared=shared)
    model = FaultModel(probability=probability, spread=spread, priors=((1.0, prior),))
    return model, draws, weigh(draws, prior)[0]


def test_posterior_mean_is_averaged_over_fault_models_by_their_probabilities() -> None:
    truth = random_faults(3, vehicles=2, branches=K)
    shared = np.array([0.0, 0.01, 0.0, 0.02, 0.0])

    def models(first: float, second: float) -> list[tuple[FaultModel, Draws, Array]]:
        prior = first_prior(K)
        return [explained(truth, prior, probability=first), explained(truth, prior, shared=shared, probability=second)]

    mean, of_first, of_second = (
        found.weight @ found.faults
        for found in (
            posterior_points(models(0.7, 0.3))[0],
            posterior_points(models(1.0, 0.0)[:1])[0],
            posterior_points(models(0.0, 1.0)[1:])[0],
        )
    )
    np.testing.assert_allclose(mean, 0.7 * of_first + 0.3 * of_second, atol=1e-12)


def group_prior() -> Prior:
    slab = Slab(low=0.02, high=0.3, tail=0.01)
    share, centre, sd = np.array([[0.4], [0.03], [0.001]])
    counts = first_prior(K).counts
    return Prior(counts=counts, gain=slab, offset=slab, group_share=share, group_centre=centre, group_sd=sd)


@pytest.mark.parametrize("of_sensor", [False, True])
def test_estimated_offset_includes_the_group_constant_only_if_it_is_an_offset_of_sensors(of_sensor: bool) -> None:
    truth = no_faults(1, K)
    truth.offset_a[0, 0], truth.drift[0, 0] = (0.18 if of_sensor else 0.15), 0.1
    prior, shared = group_prior(), np.append(np.zeros(4), of_sensor)
    model, draws, weight = explained(truth, prior, shared=shared, load=0.0 if of_sensor else 0.03)
    weight[..., 0] = 0.0  # only draws in which the vehicle belongs to the group
    found = posterior_points([(model, draws, weight / weight.sum())])[0]
    np.testing.assert_allclose(found.weight @ found.faults, [0.1, 0.0, truth.offset_a[0, 0], 0.0], atol=0.004)


def test_shared_offset_is_no_more_certain_than_sensor_resolution() -> None:
    shared = np.array([0.03, 0.0, 0.0, 0.0, 0.0])
    truth, model, moments = no_faults(3, K), model_of_equals(K, shared), np.full((3, K), 0.1)
    truth.offset_a[:, 0] = 0.03
    found = estimate_rows(rows_of(truth), [model], feed=0, mean=moments, mean_square=moments, usual=moments[:2])
    np.testing.assert_allclose(found.offset_a[:, 0], 0.03)
    assert (found.offset_sd_a[:, 0] > 1e-4).all()
    assert not found.offset_sd_a[:, 1].any()


# From rows to estimates: correct where confident, and harmless


VARIANCE = 0.04
"""Variance of the currents, in squares of full scale."""


def moments(rows: EvidenceRows) -> dict[str, Any]:
    mean, ideal = rows.means[:, 1], rows.means[0, 0]
    return {"mean": mean, "mean_square": mean**2 + VARIANCE, "usual": np.stack([ideal, ideal**2 + VARIANCE])}


def estimated(faults: Faults, *, seed: int, load: Array | float = 0.0) -> tuple[RowsEstimate, Faults]:
    """Estimate, and the part of it that would be deployed."""
    rows = rows_of(faults, seed=seed, load=load)
    found = estimate_rows(rows, learn_fault_models(rows, feed=0), feed=0, **moments(rows))
    deployed = found.identifiable & (found.harm_probability < HARM_LIMIT)
    none = no_faults(*faults.drift.shape)
    return found, replace(none, drift=found.drift * deployed, offset_a=found.offset_a * deployed)


def worse(deployed: Faults, faults: Faults) -> Mask:
    """Whether correction by ``deployed`` makes any branch of a vehicle worse on another drive, shape (N,)."""
    mean = np.full(faults.drift.shape, 0.05)
    return harmed(deployed, faults, mean_a=mean, mean_square_a2=mean**2 + VARIANCE)


@pytest.mark.parametrize("magnitude", [(0.01, 0.05), (0.3, 0.6), pytest.param((0.05, 0.25), marks=pytest.mark.long)])
@pytest.mark.parametrize("K", [2, pytest.param(3, marks=pytest.mark.long)])
def test_nine_in_ten_are_recovered_for_any_fault_size_and_none_harmed(K: int, magnitude: tuple[float, float]) -> None:
    faults = random_faults(1, vehicles=40, branches=K, magnitude=magnitude)
    found, deployed = estimated(faults, seed=1)
    estimate = replace(no_faults(40, K), drift=found.drift, offset_a=found.offset_a)
    right = recovered(estimate, faults, full_scale_a=1.0, smallest_fault=magnitude[0])
    assert right.mean() >= 0.9
    assert not worse(deployed, faults).any()
    faulty = (faults.drift != 0.0) | (faults.offset_a != 0.0)
    assert ((deployed.drift != 0.0) | (deployed.offset_a != 0.0))[faulty].mean() > 0.8
    spread = np.sqrt(np.sum(found.confidence * (1.0 - found.confidence)))
    assert abs(right.sum() - found.confidence.sum()) < 3.0 * spread + 1.0


@pytest.mark.parametrize(("shared", "size", "share"), [
    ("offset", 0.05, 0.6), ("load", 0.025, 0.15), ("gain", 0.04, 1.0),
    pytest.param("offset", 0.0125, 1.0, marks=pytest.mark.long),
    pytest.param("load", 0.0125, 1.0, marks=pytest.mark.long),
])  # fmt: skip
def test_corrections_harm_no_vehicle_despite_a_batch_fault_or_a_load(shared: str, size: float, share: float) -> None:
    faults, some = random_faults(2, vehicles=24, branches=2), np.arange(24) < 24 * share
    if shared == "offset":
        faults.offset_a[some, 0] += size
    elif shared == "gain":
        faults.drift[some, 1] = (1.0 + size) * (1.0 + faults.drift[some, 1]) - 1.0
    found, deployed = estimated(faults, seed=2, load=size * some * (shared == "load"))
    assert not worse(deployed, faults).any()
    assert shared == "gain" or np.abs(found.offset_a[:, 1] - faults.offset_a[:, 1]).max() < 0.01


def test_harm_probability_uses_the_true_currents_that_each_explanation_implies() -> None:
    """On the vehicle's own drives the measured currents are known, and on the usual one the ideal ones."""
    faults = random_faults(5, vehicles=12, branches=3, magnitude=(0.1, 0.3))
    rows = rows_of(faults, seed=5)
    about = moments(rows)
    found = estimate_rows(rows, learn_fault_models(rows, feed=0), feed=0, **about)

    def two(mean: Array, square: Array) -> Array:
        """Currents of two instants, with this mean and mean square."""
        return np.stack([mean - (sd := np.sqrt(square - mean**2)), mean + sd])[:, None]

    def gets_worse(true: Array, measured: Array, estimate: Array) -> Mask:
        corrected = (measured - estimate[3:]) / (1.0 + estimate[:3])
        before, after = (((shown - true) ** 2).mean(axis=0) for shown in (measured, corrected))
        return np.asarray(after > before + 1e-12)

    for j, posterior in enumerate(found.points):
        d, o = posterior.faults[:, :3], posterior.faults[:, 3:]
        estimate = np.concatenate([found.drift[j], found.offset_a[j]])
        measured = two(about["mean"][j], about["mean_square"][j])
        usual = (1.0 + posterior.hardware[:, :1]) * two(*about["usual"]) + posterior.hardware[:, 1:]
        worse_on = gets_worse((measured - o) / (1.0 + d), measured, estimate)
        worse_on |= gets_worse(usual, (1.0 + d) * usual + o, estimate)
        corrected = (estimate[:3] != 0.0) | (estimate[3:] != 0.0)
        expected = posterior.weight @ (worse_on & corrected)
        np.testing.assert_allclose(found.harm_probability[j], expected, atol=1e-6)
    assert found.harm_probability.max() > 0.01


def test_standard_deviations_match_the_actual_errors() -> None:
    faults = random_faults(6, vehicles=80, branches=2)
    found, _ = estimated(faults, seed=6)
    truth = np.hstack([faults.drift, faults.offset_a])
    error, sd = np.hstack([found.drift, found.offset_a]) - truth, np.hstack([found.drift_sd, found.offset_sd_a])
    sure = (found.confidence > 0.95)[:, None] & (truth != 0.0)
    within = np.abs(error[sure]) / sd[sure]
    assert 0.55 < (within < 1.0).mean() < 0.95
    assert (within > 3.5).mean() < 0.02


def test_vehicle_of_which_no_row_is_known_has_a_confidence_of_0() -> None:
    """As with drives of a minute: the prior alone is no evidence."""
    rows = rows_of(no_faults(2, K), seed=1)
    covariance = rows.covariance.copy()
    covariance[1] = UNKNOWN_VARIANCE * np.eye(5 * K)
    rows, moments = replace(rows, covariance=covariance), np.full((2, K), 0.1)
    found = estimate_rows(rows, [model_of_equals(K)], feed=0, mean=moments, mean_square=moments, usual=moments[:2])
    assert found.confidence[0] > 0.9
    assert found.confidence[1] == 0.0


SLABS = (Slab(low=low, high=high, tail=1e-3) for low, high in ((0.005, 0.2), (0.05, 0.6)))
NARROW, WIDE = (replace(first_prior(3), offset=slab) for slab in SLABS)


@pytest.mark.parametrize("offset", [0.0, 0.12])
@pytest.mark.parametrize("priors", [((1.0, first_prior(3)),), ((0.5, NARROW), (0.5, WIDE))], ids=["one prior", "two"])
def test_hardware_offset_between_two_branches_is_equally_probable_for_every_pair(
    priors: tuple[tuple[float, Prior], ...], offset: float
) -> None:
    """The parameters express it as a single fault only if one of the two branches is the last."""
    pairs = [(0, 1), (1, 2), (0, 2)]
    faults = no_faults(len(pairs), 3)
    for j, (p, r) in enumerate(pairs):
        faults.hardware_offset_a[j, [p, r]], faults.offset_a[j, p] = (0.08, -0.08), offset
    rows = rows_of(faults, noise=0.0)
    found = estimate_rows(rows, [replace(model_of_equals(3), priors=priors)], feed=1, **moments(rows))
    assert found.hardware_probability.min() > (0.3 if offset else 0.99)
    np.testing.assert_allclose(found.hardware_probability, found.hardware_probability[1], atol=0.05)
    np.testing.assert_allclose(found.confidence, found.confidence[1], atol=0.05)
    for points in found.points:
        assert points.weight.sum() == pytest.approx(1.0, abs=1e-4)
        np.testing.assert_allclose(points.hardware[:, 1:].sum(axis=1), 0.0, atol=1e-12)


def test_sensor_offsets_known_from_readings_are_not_taken_for_hardware_offsets() -> None:
    faults = no_faults(1, 3)
    faults.offset_a[0] = 0.1, 0.05, 0.0
    rows = rows_of(faults, errors=Errors(offset_read=0.001), noise=0.0)
    found = estimate_rows(rows, [model_of_equals(3)], feed=0, **moments(rows))
    assert found.hardware_probability[0] < 0.01
    np.testing.assert_allclose(found.offset_a, faults.offset_a, atol=0.001)
