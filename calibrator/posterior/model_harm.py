"""How probable it is that correcting a sensor that is not linear makes its branch worse.

The definition is that of linear sensors (:mod:`.decision`): the root mean square error of the current is larger with
the correction than without. The sensor is linear in each section c of a drive, with a gain (1 + d) g_c(e) that follows
from the drift d of its linear part and its excess e. It is corrected with estimates d_hat, e_hat, o_hat. With the gain
u_c = (1 + d_hat) g_c(e_hat) that is divided by, and the moments P, S1, S2 of the true currents of a section,

    sum_c a_c^2 S2 + 2 a_c b_c S1 + b_c^2 P  >  sum_c D_c^2 S2 + 2 D_c o S1 + o^2 P,
    a_c = (1 + d) g_c(e) / u_c - 1,   b_c = (o - o_hat) / u_c,   D_c = (1 + d) g_c(e) - 1.

For one e that is quadratic in d and in o. What drift and offset are depends on the excess that was taken out of the
current before: so they are estimated anew for several excesses, and the posterior of e is summed over.
"""

import math

import numpy as np
from numpy.typing import NDArray

from calibrator.compiled import compiled, inner
from calibrator.drive import Array
from calibrator.posterior.decision import NORMAL_STEPS
from calibrator.posterior.slab import NEVER
from calibrator.posterior.small_matrices import positive_quadratic

__all__ = ["EXCESS_NODES", "NODE_OF_STEP", "model_harm"]

EXCESS_NODES = np.arange(-3.0, 4.0)
"""Deviations of the excess for which drift and offset are estimated anew. [standard deviations]"""
NODE_OF_STEP: NDArray[np.int64] = np.argmin(np.abs(NORMAL_STEPS[:, :1] - EXCESS_NODES), axis=1)
"""The node nearest to each of the steps over which the excess is summed."""
LEAST_WEIGHT = 1e-6
"""States of a smaller weight are not looked at: they count as harm. [1]"""


def model_harm(
    weight: Array, mean: Array, sd: Array, *, gain: Array, estimate: Array, corrected_gain: Array, moments: Array
) -> float:
    """Probability that the correction makes a branch worse on a drive, if its sensor is of the family that was found.

    Parameters
    ----------
    weight : ndarray of shape (Q, S)
        Of the states of each node of :data:`EXCESS_NODES`.
    mean, sd : ndarray of shape (Q, S, 2)
        Drift of the linear part [1] and offset in fractions of full scale [1] in each state, and their deviations.
    gain : ndarray of shape (E, 2)
        g_c for each step of :data:`NORMAL_STEPS` of the excess, by section. [1]
    estimate : ndarray of shape (2,)
        d_hat [1] and o_hat in fractions of full scale [1].
    corrected_gain : ndarray of shape (2,)
        u_c. [1]
    moments : ndarray of shape (2, 3)
        P, S1, S2 of the drive by section, in fractions of full scale and their squares. [1]

    Returns
    -------
    float
        With the weight of all states that were not looked at.
    """
    kept = np.where(weight >= LEAST_WEIGHT, weight, 0.0)
    correction = np.concatenate([estimate, corrected_gain])
    harm = _sum_harm(kept, mean, sd, NODE_OF_STEP, gain, correction, moments, NORMAL_STEPS)
    dropped = 1.0 - float(NORMAL_STEPS[:, 1] @ kept.sum(axis=1)[NODE_OF_STEP])
    return float(np.clip(harm + dropped, 0.0, 1.0))


@compiled
def _sum_harm(
    weight: Array,
    mean: Array,
    sd: Array,
    node: NDArray[np.int64],
    gain: Array,
    correction: Array,
    moments: Array,
    steps: Array,
) -> float:
    """Weight of what is made worse; ``correction`` is d_hat, o_hat, u_1, u_2."""
    harm = 0.0
    for e in range(len(gain)):
        q = node[e]
        for s in range(weight.shape[1]):
            if weight[q, s] > 0.0:
                worse = _harm_of(mean[q, s], sd[q, s], gain[e], correction, moments, steps)
                harm += steps[e, 1] * weight[q, s] * worse
    return harm


@inner
def _harm_of(mean: Array, sd: Array, gain: Array, correction: Array, moments: Array, steps: Array) -> float:
    """Probability that correction makes it worse under one state, for one excess."""
    surely = _surely_worse(mean, sd, gain, correction, moments)
    if surely >= 0:
        return float(surely)
    in_drift = sd[0] * math.sqrt(moments[0, 2] + moments[1, 2]) > sd[1]
    if (sd[1] if in_drift else sd[0]) == 0.0:
        return _worse(mean[0], mean[1], in_drift, sd, gain, correction, moments)
    total = 0.0
    for step in range(len(steps)):
        d = mean[0] if in_drift else mean[0] + sd[0] * steps[step, 0]
        o = mean[1] + sd[1] * steps[step, 0] if in_drift else mean[1]
        total += steps[step, 1] * _worse(d, o, in_drift, sd, gain, correction, moments)
    return total


@inner
def _surely_worse(mean: Array, sd: Array, gain: Array, correction: Array, moments: Array) -> int:
    """Whether correction makes it worse all over a state: 1 if so, 0 if nowhere, -1 if it depends on the point."""
    with_it, without, power, most, divided = 0.0, 0.0, 0.0, 0.0, 0.0
    for c in range(2):
        P, S1, S2 = moments[c, 0], moments[c, 1], moments[c, 2]
        away, drift = (mean[1] - correction[1]) / correction[2 + c], (1.0 + mean[0]) * gain[c] - 1.0
        left = (1.0 + drift) / correction[2 + c] - 1.0
        with_it += (left * S2 + 2.0 * away * S1) * left + away**2 * P
        without += (drift * S2 + 2.0 * mean[1] * S1) * drift + mean[1] ** 2 * P
        power, most, divided = power + S2, max(most, gain[c]), max(divided, 1.0 / correction[2 + c])
    widest = NEVER * (sd[0] * most * math.sqrt(power) + sd[1])
    with_rms, without_rms = math.sqrt(max(with_it, 0.0)), math.sqrt(max(without, 0.0))
    if with_rms + widest * divided < without_rms - widest:
        return 0
    if with_rms - widest * divided > without_rms + widest:
        return 1
    return -1


@inner
def _worse(d: float, o: float, in_drift: bool, sd: Array, gain: Array, correction: Array, moments: Array) -> float:
    """Probability that correction makes it worse if one of drift and offset is known, and the other has its spread."""
    square, linear, constant = 0.0, 0.0, 0.0
    for c in range(2):
        P, S1, S2, g, u = moments[c, 0], moments[c, 1], moments[c, 2], gain[c], correction[2 + c]
        if in_drift:
            slope, level, away = g / u, g / u - 1.0, (o - correction[1]) / u
            square += S2 * (slope**2 - g**2)
            linear += 2.0 * S2 * (level * slope - (g - 1.0) * g) + 2.0 * S1 * (slope * away - g * o)
            constant += S2 * (level**2 - (g - 1.0) ** 2) + 2.0 * S1 * (level * away - (g - 1.0) * o)
            constant += P * (away**2 - o**2)
        else:
            drift = (1.0 + d) * g - 1.0
            left, level = (1.0 + drift) / u - 1.0, -correction[1] / u
            square += P * (1.0 / u**2 - 1.0)
            linear += 2.0 * S1 * (left / u - drift) + 2.0 * P * level / u
            constant += S2 * (left**2 - drift**2) + 2.0 * S1 * left * level + P * level**2
    return positive_quadratic(square, linear, constant, d if in_drift else o, sd[0] if in_drift else sd[1])
