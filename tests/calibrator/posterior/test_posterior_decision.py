from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.stats import norm

from calibrator.drive import Array
from calibrator.faults import Faults
from calibrator.posterior.decision import best_estimate, harm_probability
from calibrator.posterior.states import States, enumerate_states
from calibrator.score import correction_error_rms
from tests.calibrator.posterior.simulated_rows import faults_of, no_spread, prior_of, rows_of

K = 2
DRAWS = 100_000
LEAST = (0.05, 0.05)


def no_faults(vehicles: int) -> Faults:
    return faults_of(np.zeros((vehicles, K + 1)), np.zeros((vehicles, 2 * K - 1)))


def states_of(weight: Array, drift: Array, offset: Array, *, sd: float) -> States:
    """One vehicle whose states have these weights (S,), drifts and offsets (S, K); each nonzero one has this sd."""
    relative = np.concatenate([np.zeros((len(weight), 1)), drift], axis=1)[None]
    constant = np.concatenate([np.zeros((len(weight), K - 1)), offset], axis=1)[None]
    some = enumerate_states(rows_of(no_faults(1)), prior_of(K), no_spread(K))
    return replace(
        some,
        weight=weight[None],
        relative=relative,
        relative_sd=sd * (relative != 0.0),
        constant=constant,
        constant_sd=sd * (constant != 0.0),
    )


@dataclass(frozen=True)
class Points:
    """Draws from the posterior of one vehicle: weights (P,), drifts and offsets (P, K)."""

    weight: Array
    drift: Array
    offset: Array


TWO_EXPLANATIONS = (
    np.array([0.7, 0.3]),
    np.array([[0.12, 0.0], [0.0, -0.11]]),
    np.array([[0.0, 0.1], [0.0, 0.1]]),
)


def drawn(states: States, seed: int = 0) -> Points:
    """Plain draws from the same posterior."""
    rng = np.random.default_rng(seed)
    chosen = rng.choice(states.weight.shape[1], p=states.weight[0], size=DRAWS)
    drift = states.drift[0, chosen] + states.relative_sd[0, chosen, 1:] * rng.normal(size=(DRAWS, K))
    offset = states.offset[0, chosen] + states.constant_sd[0, chosen, K - 1 :] * rng.normal(size=(DRAWS, K))
    return Points(np.full(DRAWS, 1.0 / DRAWS), drift, offset)


@pytest.mark.parametrize("sd", [0.001, 0.004, 0.006, 0.01, 0.03])
def test_confidence_is_the_probability_to_be_within_tolerance(sd: float) -> None:
    states = states_of(*TWO_EXPLANATIONS, sd=sd)
    state, confidence = (found[0] for found in best_estimate(states, least=LEAST))
    points, near = drawn(states), np.ones(DRAWS, bool)
    for values, mean, least in zip(
        (points.drift, points.offset), (states.drift[0, 0], states.offset[0, 0]), LEAST, strict=True
    ):
        norms = np.maximum(np.linalg.norm(values, axis=1), least)
        near &= np.linalg.norm(values - mean, axis=1) <= 0.1 * norms
    assert state == 0
    assert confidence == pytest.approx(near.mean(), abs=0.15)


def test_sharp_states_give_their_own_weight() -> None:
    states = states_of(*TWO_EXPLANATIONS, sd=1e-6)
    state, confidence = (found[0] for found in best_estimate(states, least=LEAST))
    assert state == 0
    assert confidence == pytest.approx(0.7)


def test_states_within_tolerance_of_each_other_count_together() -> None:
    weight = np.array([0.4, 0.3, 0.3])
    drift = np.array([[0.2, 0.0], [0.0, 0.1], [0.0, 0.1004]])
    states = states_of(weight, drift, np.zeros((3, K)), sd=1e-6)
    state, confidence = (found[0] for found in best_estimate(states, least=LEAST))
    assert state in {1, 2}
    assert confidence == pytest.approx(0.6)


def test_small_faults_are_counted_with_the_fleets_smallest() -> None:
    states = states_of(np.array([0.5, 0.5]), np.array([[0.0, 0.0], [0.004, 0.0]]), np.zeros((2, K)), sd=1e-7)
    assert best_estimate(states, least=(0.05, 0.05))[1] == pytest.approx(1.0)
    assert best_estimate(states, least=(0.005, 0.05))[1] == pytest.approx(0.5)


MEAN, SQUARE = np.array([[0.1, -0.1]]), np.array([[0.05, 0.05]])


def harm(states: States, drift: Array, offset: Array, *, mean: Array = MEAN, square: Array = SQUARE) -> Array:
    found = harm_probability(states, drift[None], offset[None], mean=mean[None], mean_square=square[None])
    return np.asarray(found[0])


def plain_harm(points: Points, drift: Array, offset: Array) -> Array:
    """Share of points for which the corrected current is farther from the true one; one drive."""
    nothing = np.zeros(K)
    corrected, measured = (
        correction_error_rms(
            true_drift=points.drift,
            true_offset_a=points.offset,
            drift=with_drift,
            offset_a=with_offset,
            mean_a=MEAN[0],
            mean_square_a2=SQUARE[0],
        )
        for with_drift, with_offset in ((drift, offset), (nothing, nothing))
    )
    return np.asarray(points.weight @ (corrected > measured))


@pytest.mark.parametrize("sd", [0.001, 0.05, 0.1])
def test_harm_is_the_probability_that_correction_makes_it_worse(sd: float) -> None:
    states = states_of(*TWO_EXPLANATIONS, sd=sd)
    for chosen in (0, 1):
        estimate = states.drift[0, chosen], states.offset[0, chosen]
        np.testing.assert_allclose(harm(states, *estimate), plain_harm(drawn(states), *estimate), atol=0.005)


@pytest.mark.parametrize("ratio", [0.01, 1.0, 100.0])
def test_harm_of_drift_and_offset_together_is_that_of_plain_draws(ratio: float) -> None:
    """Whichever of both is the less certain."""
    states = states_of(np.array([1.0]), np.array([[0.1, -0.08]]), np.array([[0.03, -0.02]]), sd=0.02)
    states = replace(
        states, constant_sd=states.constant_sd * np.sqrt(ratio), relative_sd=states.relative_sd / np.sqrt(ratio)
    )
    estimate = states.drift[0, 0], states.offset[0, 0]
    np.testing.assert_allclose(harm(states, *estimate), plain_harm(drawn(states), *estimate), atol=0.006)


@pytest.mark.parametrize("deviations", [1.0, 2.0, 3.0, 3.7])
@pytest.mark.parametrize("estimate", [0.1, -0.1, 0.02])
def test_harm_in_the_tails_of_a_drift_is_exact(estimate: float, deviations: float) -> None:
    """Without a mean current: |d - estimate| / (1 + estimate) > |d| between -1 and estimate / (2 + estimate), or so."""
    edge = estimate / (2.0 + estimate)
    sd = abs(estimate - edge) / deviations
    states = states_of(np.array([1.0]), np.array([[estimate, 0.0]]), np.zeros((1, K)), sd=sd)
    result = harm(states, np.array([estimate, 0.0]), np.zeros(K), mean=np.zeros((1, K)))
    inside = norm.cdf(edge, estimate, sd) - norm.cdf(-1.0, estimate, sd)
    outside = norm.sf(edge, estimate, sd) + norm.cdf(-1.0, estimate, sd)
    assert result[0] == pytest.approx(inside if estimate > 0.0 else outside, rel=1e-6)


@pytest.mark.parametrize("deviations", [1.0, 3.0, 3.7])
@pytest.mark.parametrize("estimate", [0.05, -0.05])
def test_harm_in_the_tails_of_an_offset_is_exact(estimate: float, deviations: float) -> None:
    """|o - estimate| > |o| if o lies on the other side of half the estimate."""
    sd = abs(estimate) / 2.0 / deviations
    states = states_of(np.array([1.0]), np.zeros((1, K)), np.array([[estimate, 0.0]]), sd=sd)
    result = harm(states, np.zeros(K), np.array([estimate, 0.0]))
    assert result[0] == pytest.approx(norm.sf(deviations), rel=1e-6)


def test_weight_of_states_that_were_dropped_counts_as_harmful() -> None:
    states = states_of(np.array([0.99, 0.008]), np.full((2, K), 0.1), np.zeros((2, K)), sd=1e-6)
    np.testing.assert_allclose(harm(states, np.full(K, 0.1), np.zeros(K)), 0.002, rtol=1e-6)


def test_harm_of_a_wrong_explanation_is_the_weight_of_the_others() -> None:
    states = states_of(*TWO_EXPLANATIONS, sd=1e-6)
    result = harm(states, states.drift[0, 0], np.zeros(K))
    np.testing.assert_allclose(result, [0.3, 0.0], atol=1e-9)


def test_harm_is_counted_by_the_errors_of_the_currents_themselves() -> None:
    rng = np.random.default_rng(1)
    i = rng.normal(0.1, 0.2, size=(20_000, K))
    truth, estimate = (np.array([0.1, 0.0]), np.array([0.02, 0.0])), (np.array([0.05, 0.02]), np.array([0.0, 0.01]))
    measured = (1.0 + truth[0]) * i + truth[1]
    corrected = (measured - estimate[1]) / (1.0 + estimate[0])
    worse = np.mean((corrected - i) ** 2, axis=0) > np.mean((measured - i) ** 2, axis=0)
    states = states_of(np.ones(1), truth[0][None], truth[1][None], sd=0.0)
    result = harm(states, *estimate, mean=i.mean(axis=0)[None], square=np.mean(i**2, axis=0)[None])
    np.testing.assert_array_equal(result > 0.5, worse)
    rms = correction_error_rms(
        true_drift=truth[0],
        true_offset_a=truth[1],
        drift=estimate[0],
        offset_a=estimate[1],
        mean_a=i.mean(axis=0),
        mean_square_a2=np.mean(i**2, axis=0),
    )
    np.testing.assert_allclose(rms, np.sqrt(np.mean((corrected - i) ** 2, axis=0)))


def test_nothing_changed_does_no_harm() -> None:
    states = states_of(*TWO_EXPLANATIONS, sd=0.05)
    np.testing.assert_array_equal(harm(states, np.zeros(K), np.zeros(K)), 0.0)


def test_harm_is_that_of_the_worst_drive() -> None:
    states = states_of(np.ones(1), np.array([[0.1, 0.0]]), np.array([[-0.02, 0.0]]), sd=0.0)
    estimate = np.array([0.1, 0.0]), np.array([0.01, 0.0])
    large, small = np.array([[0.9, 0.9]]), np.array([[1e-6, 1e-6]])
    none = np.zeros((1, K))
    alone = [harm(states, *estimate, mean=none, square=square)[0] for square in (large, small)]
    both = harm(states, *estimate, mean=np.zeros((2, K)), square=np.concatenate([large, small]))[0]
    assert alone == pytest.approx([0.0, 1.0], abs=1e-12)
    assert both == pytest.approx(1.0)
