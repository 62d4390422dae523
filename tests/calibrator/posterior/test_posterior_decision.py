from dataclasses import dataclass, fields, replace

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


@pytest.mark.parametrize("kept", [1.0, 0.9])
def test_nothing_changed_does_no_harm(kept: float) -> None:
    """Not even in a vehicle some of whose states were dropped."""
    weight, *parameters = TWO_EXPLANATIONS
    states = states_of(kept * weight, *parameters, sd=0.05)
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


SHARP = 1e-9
ROUNDED = (0.56, 0.34, 0.1)
"""Weights that add up to a little more than 1."""


def plain_estimate(states: States, least: tuple[float, float]) -> list[tuple[int, float]]:
    """Of states without spread, by plain loops: the weight within 10 % of each, and the first of the best."""
    found = []
    for weight, drift, offset in zip(states.weight, states.drift, states.offset, strict=True):
        near = np.ones((len(weight), len(weight)), bool)
        for values, smallest in zip((drift, offset), least, strict=True):
            apart = np.linalg.norm(values[:, None] - values[None], axis=2)
            near &= apart <= 0.1 * np.maximum(np.linalg.norm(values, axis=1), smallest)[:, None]
        covered = weight @ near
        state = int(np.flatnonzero(covered >= covered.max() - 0.01)[0])
        found.append((state, float(covered[state])))
    return found


def fleet_of(several: list[States]) -> States:
    """Vehicles with as many states each."""
    return States(*(np.concatenate([getattr(states, f.name) for states in several]) for f in fields(States)))


def crowded_states(seed: int) -> States:
    """Thirty states around six different explanations: many within tolerance of another, and of several."""
    rng = np.random.default_rng(seed)
    centres = rng.choice([-1.0, 1.0], size=(6, 2 * K)) * rng.uniform(0.05, 0.25, size=(6, 2 * K))
    values = centres[rng.integers(0, 6, size=30)] * rng.uniform(0.9, 1.1, size=(30, 2 * K))
    return states_of(np.sort(rng.dirichlet(np.ones(30)))[::-1], values[:, :K], values[:, K:], sd=SHARP)


def test_each_vehicles_estimate_is_that_of_plain_loops() -> None:
    fleet = fleet_of([crowded_states(seed) for seed in range(40)])
    state, confidence = best_estimate(fleet, least=LEAST)
    expected_state, expected = zip(*plain_estimate(fleet, LEAST), strict=True)
    np.testing.assert_array_equal(state, expected_state)
    np.testing.assert_allclose(confidence, expected, atol=1e-12)
    assert len(set(expected_state)) > 5


@pytest.mark.parametrize(
    ("weight", "second_drift", "expected", "confidence"),
    [
        # The second is far from all others; the third and the fourth together outweigh the first.
        ((0.35, 0.25, 0.2, 0.2), (0.1, 0.15, 0.2, 0.2004), 2, 0.4),
        # Three pairs: the first is worse than the third by more than 1 %, the second by less, and the more probable.
        (
            (0.17, 0.169, 0.168, 0.1625, 0.16, 0.15, 0.0205),
            (0.06, 0.1, 0.15, 0.1504, 0.1004, 0.0604, 0.22),
            1,
            0.329,
        ),
        # The second is near all but the last.
        ((0.3, 0.25, 0.25, 0.2), (0.1, 0.109, 0.118, 0.135), 1, 0.8),
    ],
)
def test_the_more_probable_of_equally_good_states_is_taken(
    weight: tuple[float, ...], second_drift: tuple[float, ...], expected: int, confidence: float
) -> None:
    drift = np.column_stack([np.zeros(len(weight)), second_drift])
    states = states_of(np.array(weight), drift, np.zeros_like(drift), sd=SHARP)
    state, found = best_estimate(states, least=(0.005, 0.005))
    assert state[0] == expected
    assert found[0] == pytest.approx(confidence)


def test_a_state_that_is_certain_has_all_confidence() -> None:
    states = states_of(np.array([1.0, 0.0]), np.array([[0.1, 0.0], [0.2, 0.0]]), np.zeros((2, K)), sd=SHARP)
    assert best_estimate(states, least=LEAST)[1][0] == 1.0


def test_confidence_is_a_probability_where_weights_add_up_to_more_by_rounding() -> None:
    weight = np.array(ROUNDED)
    assert np.cumsum(weight)[-1] > 1.0
    drift = np.tile([0.1, 0.0], (len(weight), 1))
    assert best_estimate(states_of(weight, drift, np.zeros_like(drift), sd=SHARP), least=LEAST)[1][0] == 1.0


@pytest.mark.parametrize("sd", [SHARP, 0.0006])
def test_drifts_and_offsets_must_both_be_recovered(sd: float) -> None:
    """A large drift that is told exactly does not excuse an offset that is not."""
    states = states_of(np.array([0.6, 0.4]), np.full((2, K), 0.2), np.array([[0.02, 0.0], [0.025, 0.0]]), sd=sd)
    assert best_estimate(states, least=(0.005, 0.005))[1][0] == pytest.approx(0.6)


@pytest.mark.parametrize("place", range(2 * K))
def test_confidence_of_one_state_is_the_share_of_its_spread_that_is_recovered(place: int) -> None:
    """Of one drift or offset x, told as 0.1: |x - 0.1| <= 0.1 |x|."""
    values, sd = np.zeros((1, 2 * K)), 0.01
    values[0, place] = 0.1
    states = states_of(np.ones(1), values[:, :K], values[:, K:], sd=sd)
    confidence = best_estimate(states, least=(0.005, 0.005))[1][0]
    assert confidence == pytest.approx(norm.cdf(0.1 / 0.9, 0.1, sd) - norm.cdf(0.1 / 1.1, 0.1, sd), abs=0.03)


def test_a_spread_state_five_deviations_away_adds_nothing() -> None:
    states = states_of(np.array([0.5, 0.5]), np.array([[0.1, 0.0], [0.15, 0.0]]), np.zeros((2, K)), sd=0.0075)
    states = replace(states, relative_sd=states.relative_sd * [[[0.0], [1.0]]])
    assert best_estimate(states, least=LEAST)[1][0] == 0.5


def vague(seed: int) -> States:
    """Two states with both drifts and offsets, each with a spread of its own."""
    rng = np.random.default_rng(seed)
    values, sd = rng.uniform(-0.2, 0.2, size=(2, 2 * K)), rng.uniform(0.001, 0.03, size=(1, 2, 2 * K))
    states = states_of(np.array([0.6, 0.4]), values[:, :K], values[:, K:], sd=1.0)
    relative_sd, constant_sd = states.relative_sd.copy(), states.constant_sd.copy()
    relative_sd[:, :, 1:], constant_sd[:, :, K - 1 :] = sd[:, :, :K], sd[:, :, K:]
    return replace(states, relative_sd=relative_sd, constant_sd=constant_sd)


def test_harm_of_a_fleet_is_that_of_each_vehicle_and_the_worst_drive() -> None:
    """Some branches are not corrected, whichever vehicle or branch comes first."""
    rng = np.random.default_rng(5)
    several = [vague(seed) for seed in range(6)]
    fleet = fleet_of(several)
    drift, offset = fleet.drift[:, 0].copy(), fleet.offset[:, 0].copy()
    drift[[0, 1]], offset[0], offset[[2, 3], 0], drift[[2, 4], 0] = 0.0, 0.0, 0.0, 0.0
    mean = rng.uniform(-0.2, 0.2, size=(6, 4, K))
    square = mean**2 + rng.uniform(0.001, 0.3, size=mean.shape)
    found = harm_probability(fleet, drift, offset, mean=mean, mean_square=square)
    for j, states in enumerate(several):
        alone = [harm(states, drift[j], offset[j], mean=mean[j, [m]], square=square[j, [m]]) for m in range(4)]
        np.testing.assert_allclose(found[j], np.max(alone, axis=0), atol=1e-15)
    assert not found[0].any()
    assert found[2, 0] == 0.0
    assert ((found > 0.01) & (found < 0.99)).sum() > 5


EVEN = norm.ppf((np.arange(40_000) + 0.5) / 40_000)
"""Equally probable values of a standard normal variable."""


@pytest.mark.parametrize("in_drift", [True, False])
@pytest.mark.parametrize("mean", [-0.15, 0.0, 0.1])
@pytest.mark.parametrize(
    ("drift", "offset", "drift_hat", "offset_hat"),
    [
        (0.1, 0.03, 0.12, 0.02),
        (0.1, 0.03, -0.05, 0.06),
        (-0.12, 0.02, -0.1, -0.03),
        (0.05, -0.03, 0.1, -0.06),
        (0.02, 0.03, 0.0, 0.07),
        (-0.05, 0.04, -0.11, 0.0),
    ],
)
def test_harm_where_either_drift_or_offset_is_known_is_that_of_plain_points(
    in_drift: bool, mean: float, drift: float, offset: float, drift_hat: float, offset_hat: float
) -> None:
    """The error of a correction is a quadratic of the other."""
    square, sd = 0.06, 0.04 if in_drift else 0.02
    states = states_of(np.ones(1), np.array([[drift, 0.0]]), np.array([[offset, 0.0]]), sd=sd)
    d, o = drift + sd * EVEN * in_drift, offset + sd * EVEN * (not in_drift)
    states = replace(states, relative_sd=states.relative_sd * in_drift, constant_sd=states.constant_sd * (not in_drift))
    left, shift = (d - drift_hat) / (1.0 + drift_hat), (o - offset_hat) / (1.0 + drift_hat)
    corrected = left**2 * square + 2.0 * left * shift * mean + shift**2
    worse = np.mean(corrected > d**2 * square + 2.0 * d * o * mean + o**2)
    moments = {"mean": np.full((1, K), mean), "square": np.full((1, K), square)}
    found = harm(states, np.array([drift_hat, 0.0]), np.array([offset_hat, 0.0]), **moments)
    assert found[0] == pytest.approx(worse, abs=1e-4)


@pytest.mark.parametrize("seed", range(6))
def test_harm_of_states_with_several_spreads_is_that_of_plain_draws(seed: int) -> None:
    states = vague(seed)
    estimate = states.drift[0, 0] + 0.02, states.offset[0, 0] - 0.01
    np.testing.assert_allclose(harm(states, *estimate), plain_harm(drawn(states), *estimate), atol=0.006)


def test_harm_is_a_probability_where_weights_add_up_to_more_by_rounding() -> None:
    weight = np.array(ROUNDED)
    nothing = np.zeros((len(weight), K))
    assert harm(states_of(weight, nothing, nothing, sd=0.0), np.array([0.1, 0.0]), np.zeros(K))[0] == 1.0


def test_harm_of_what_is_known_exactly_is_certain_or_none() -> None:
    """Of many drifts, offsets, estimates and currents: whether the corrected error is the larger one."""
    rng = np.random.default_rng(8)
    certain = []
    for _ in range(300):
        d, d_hat = rng.uniform(-0.25, 0.25, 2)
        o, o_hat, mean = rng.uniform(-0.1, 0.1, 3)
        square = mean**2 + rng.uniform(0.0, 0.1)
        left, shift = (d - d_hat) / (1.0 + d_hat), (o - o_hat) / (1.0 + d_hat)
        corrected = left**2 * square + 2.0 * left * shift * mean + shift**2
        states = states_of(np.ones(1), np.array([[d, 0.0]]), np.array([[o, 0.0]]), sd=SHARP)
        moments = {"mean": np.full((1, K), mean), "square": np.full((1, K), square)}
        found = harm(states, np.array([d_hat, 0.0]), np.array([o_hat, 0.0]), **moments)
        certain.append(found[0])
        worse = corrected > d**2 * square + 2.0 * d * o * mean + o**2
        assert found[0] == pytest.approx(1.0 if worse else 0.0, abs=1e-9)
    assert 0.2 < np.mean(certain) < 0.8


@pytest.mark.parametrize("mean", [-0.1, 0.0, 0.1])
@pytest.mark.parametrize(("drift_sd", "offset_sd"), [(0.04, 0.008), (0.02, 0.015)])
def test_harm_where_drift_and_offset_are_as_uncertain_as_each_other_is_that_of_plain_points(
    mean: float, drift_sd: float, offset_sd: float
) -> None:
    few = norm.ppf((np.arange(600) + 0.5) / 600)
    drift, offset, square = 0.05, 0.015, 0.06
    d, o = np.meshgrid(drift + drift_sd * few, offset + offset_sd * few)
    left, shift = (d - drift) / (1.0 + drift), (o - offset) / (1.0 + drift)
    corrected = left**2 * square + 2.0 * left * shift * mean + shift**2
    worse = np.mean(corrected > d**2 * square + 2.0 * d * o * mean + o**2)
    states = states_of(np.ones(1), np.array([[drift, 0.0]]), np.array([[offset, 0.0]]), sd=1.0)
    states = replace(states, relative_sd=drift_sd * states.relative_sd, constant_sd=offset_sd * states.constant_sd)
    moments = {"mean": np.full((1, K), mean), "square": np.full((1, K), square)}
    found = harm(states, np.array([drift, 0.0]), np.array([offset, 0.0]), **moments)
    assert found[0] == pytest.approx(worse, abs=0.002)
