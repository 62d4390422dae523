"""What is said of a vehicle: confidence and harm are the probabilities that plain draws give."""

import numpy as np
import pytest

from calibrator.drive import Array
from calibrator.estimator.decision import Points, best_estimate, harm_probability
from calibrator.faults import Faults
from calibrator.score import recovered

K = 2
LEAST = np.array([0.05, 0.05])
TWO_EXPLANATIONS = [(0.7, [0.12, 0.0, 0.0, 0.0]), (0.3, [0.0, -0.11, 0.1, 0.1])]


def points(explanations: list[tuple[float, list[float]]], *, sd: float = 0.0, draws: int = 4000) -> Points:
    """Posterior of explanations (probability, faults), each nonzero fault with this standard deviation."""
    rng, count = np.random.default_rng(0), len(explanations)
    faults = np.concatenate(
        [
            np.array(values) + sd * rng.normal(size=(draws, 2 * K)) * (np.array(values) != 0.0)
            for _, values in explanations
        ]
    )
    weight = np.repeat([share / draws for share, _ in explanations], draws)
    number = np.repeat(np.arange(count), draws)
    return Points(faults, weight, number, np.zeros(count, np.int64), np.arange(count))


def as_faults(values: Array) -> Faults:
    none = np.zeros((len(values), K))
    return Faults(hardware_drift=none[:, 0], hardware_offset_a=none, drift=values[:, :K], offset_a=values[:, K:])


@pytest.mark.parametrize("sd", [1e-4, 0.001, 0.005, 0.01, 0.03])
def test_confidence_is_the_probability_to_be_recovered(sd: float) -> None:
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


def test_of_equally_good_estimates_the_more_probable_explanation_is_taken_whatever_its_place() -> None:
    found = points([(0.499, [0.1, 0, 0, 0]), (0.501, [0, 0.1, 0, 0])], sd=1e-6, draws=50)
    reverse = Points(found.faults[::-1], found.weight[::-1], 1 - found.explanation[::-1], found.model, found.fit)
    for each in (found, reverse):
        np.testing.assert_allclose(best_estimate(each, LEAST)[0], [0, 0.1, 0, 0], atol=1e-5)


def test_harm_is_that_of_simulated_currents() -> None:
    """(25) on drawn true currents, against the moments of (M19)."""
    rng = np.random.default_rng(1)
    found, estimate = (
        points([(1.0, [0.1, -0.08, 0.03, -0.02])], sd=0.03, draws=400),
        np.array([0.1, -0.08, 0.03, -0.02]),
    )
    true = rng.normal([0.1, -0.1], 0.2, size=(2000, K))
    mean, square = true.mean(axis=0)[None], (true**2).mean(axis=0)[None]
    d, o = found.faults[:, None, :K], found.faults[:, None, K:]
    measured = (1.0 + d) * true + o
    corrected = (measured - estimate[K:]) / (1.0 + estimate[:K])
    worse = ((corrected - true) ** 2).mean(axis=1) > ((measured - true) ** 2).mean(axis=1)
    np.testing.assert_allclose(harm_probability(found, estimate, mean, square), worse.mean(axis=0), atol=1e-9)
    assert 0.0 < worse.mean() < 1.0
