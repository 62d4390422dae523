"""Probability of harm of sensors that are not linear: against chance itself, and against that of linear sensors."""

import numpy as np
import pytest

from calibrator.drive import Array
from calibrator.posterior.decision import NORMAL_STEPS, harm_probability
from calibrator.posterior.model_harm import EXCESS_NODES, model_harm
from calibrator.posterior.states import States

Q, DRAWS = len(EXCESS_NODES), 400_000
MOMENTS = np.array([[0.55, 0.05, 0.012], [0.45, -0.03, 0.006]])
"""Shares, means and mean squares of currents into the junction and out of it, over full scale."""


def gains(excess: Array) -> Array:
    """By sign: of currents into the junction and out of it."""
    return np.column_stack([1.0 / (1.0 - excess), np.ones(len(excess))])


def errors(drift: Array, offset: Array, gain: Array, divided_by: Array, taken: float) -> Array:
    """Mean square errors, shape (draws,), of what is divided and taken off."""
    left = (1.0 + drift)[:, None] * gain / divided_by - 1.0
    away = (offset - taken)[:, None] / divided_by
    share, mean, square = MOMENTS.T
    return np.asarray((left**2 * square + 2.0 * left * away * mean + away**2 * share).sum(axis=1))


def one_state(drift: Array, offset: Array, drift_sd: float, offset_sd: float) -> tuple[Array, Array, Array]:
    """Weights, means and deviations where each node has one state."""
    mean = np.stack([drift, offset], axis=1)[:, None]
    return np.ones((Q, 1)), mean, np.broadcast_to([drift_sd, offset_sd], mean.shape).copy()


@pytest.mark.parametrize(("excess", "excess_sd"), [(0.03, 0.01), (0.05, 0.03), (-0.04, 0.02)])
@pytest.mark.parametrize(("drift_sd", "offset_sd"), [(0.01, 0.0), (0.002, 0.003), (0.0, 0.002)])
def test_it_is_the_share_of_draws_that_are_worse(
    excess: float, excess_sd: float, drift_sd: float, offset_sd: float
) -> None:
    drift, offset = 0.01, 0.002
    found = model_harm(
        *one_state(np.full(Q, drift), np.full(Q, offset), drift_sd, offset_sd),
        gain=gains(excess + excess_sd * NORMAL_STEPS[:, 0]),
        estimate=np.array([drift, offset]),
        corrected_gain=(1.0 + drift) * gains(np.array([excess]))[0],
        moments=MOMENTS,
    )
    z = np.random.default_rng(0).standard_normal((3, DRAWS))
    d, o, gain = drift + drift_sd * z[0], offset + offset_sd * z[1], gains(excess + excess_sd * z[2])
    corrected = errors(d, o, gain, (1.0 + drift) * gains(np.array([excess]))[0], offset)
    share = float(np.mean(corrected > errors(d, o, gain, np.ones(2), 0.0)))
    assert found == pytest.approx(share, abs=0.004 + 0.03 * share)


def test_without_excess_it_is_the_harm_of_a_linear_sensor() -> None:
    drift, offset, drift_sd, offset_sd = 0.02, 0.01, 0.012, 0.004
    found = model_harm(
        *one_state(np.full(Q, drift), np.full(Q, offset), drift_sd, offset_sd),
        gain=np.ones((len(NORMAL_STEPS), 2)),
        estimate=np.array([drift, offset]),
        corrected_gain=np.full(2, 1.0 + drift),
        moments=MOMENTS,
    )
    states = States(
        np.ones((1, 1)),
        np.zeros(1),
        np.array([[[0.0, drift]]]),
        np.array([[[0.0, drift_sd]]]),
        np.array([[[offset]]]),
        np.array([[[offset_sd]]]),
        np.zeros((1, 1), bool),
    )
    linear = harm_probability(
        states,
        np.array([[drift]]),
        np.array([[offset]]),
        mean=MOMENTS[None, None, :, 1].sum(axis=2)[..., None],
        mean_square=MOMENTS[None, None, :, 2].sum(axis=2)[..., None],
    )
    assert found == pytest.approx(float(linear[0, 0]), rel=1e-6)


def test_an_excess_that_moves_the_drift_against_itself_harms_less_than_one_that_leaves_it() -> None:
    excess, sd = 0.03, 0.012

    def harm(turn: float) -> float:
        return model_harm(
            *one_state(turn * sd * EXCESS_NODES, np.zeros(Q), 0.001, 0.0),
            gain=gains(excess + sd * NORMAL_STEPS[:, 0]),
            estimate=np.zeros(2),
            corrected_gain=gains(np.array([excess]))[0],
            moments=MOMENTS,
        )

    assert harm(-0.6) < harm(0.0)


def test_states_that_are_not_looked_at_count_as_harm() -> None:
    weight, mean, sd = one_state(np.full(Q, 0.05), np.zeros(Q), 1e-4, 0.0)
    harm = model_harm(
        0.9 * weight,
        mean,
        sd,
        gain=np.ones((len(NORMAL_STEPS), 2)),
        estimate=np.array([0.05, 0.0]),
        corrected_gain=np.full(2, 1.05),
        moments=MOMENTS,
    )
    assert harm == pytest.approx(0.1)
