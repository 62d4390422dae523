"""States of a sensor that is not linear: its drift is free, all else is as the law of the fleet's faults says."""

import numpy as np
import pytest

from calibrator.posterior.fault_prior import FaultPrior
from calibrator.posterior.model_decision import with_free_drift
from calibrator.posterior.slab import Slab
from calibrator.posterior.states import States

PRIOR = FaultPrior(
    counts=np.array([[0.5, 0.2, 0.05, 0.02, 0.01], [0.12, 0.05, 0.03, 0.005, 0.005], [0.002] * 5]),
    relative=Slab(low=0.02, high=0.1),
    constant=Slab(low=0.02, high=0.1),
)
HIDDEN = [(0.0, -0.06, 0.0), (-0.06, 0.0, 0.06)]
"""d_h, d_1, d_2: a drift of the first sensor, or a hardware drift that hides one of the second."""


def states(relative: list[tuple[float, float, float]], weight: list[float]) -> States:
    S = len(weight)
    return States(
        np.array([weight]),
        np.zeros(1),
        np.array([relative]),
        np.zeros((1, S, 3)),
        np.zeros((1, S, 3)),
        np.zeros((1, S, 3)),
        np.zeros((1, S), bool),
    )


def test_a_drift_that_a_hardware_drift_hides_is_as_likely_as_the_law_makes_the_hardware_drift() -> None:
    weight = with_free_drift(states(HIDDEN, [0.9, 0.1]), PRIOR, 1)[0]
    log_support = PRIOR.log_supports()
    gained = np.exp(log_support[1, 0] - log_support[1, 1])
    assert weight[1] / weight[0] == pytest.approx(0.1 / 0.9 * gained)
    assert gained > 5.0


def test_of_a_sensor_without_drift_in_any_state_nothing_changes() -> None:
    before = states([(0.0, 0.05, 0.0), (0.05, 0.0, 0.0)], [0.7, 0.3])
    np.testing.assert_allclose(with_free_drift(before, PRIOR, 1), before.weight)


def test_the_weight_of_states_that_were_dropped_stays_dropped() -> None:
    weight = with_free_drift(states([*HIDDEN, (0.0, 0.0, 0.0)], [0.6, 0.3, 0.0]), PRIOR, 1)
    assert weight.sum() == pytest.approx(0.9)
    assert weight[0, 2] == 0.0
