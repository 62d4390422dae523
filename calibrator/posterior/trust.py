"""Whether vehicles that are called trusted can be: their sensors must obey the junction law by themselves."""

from collections.abc import Sequence

import numpy as np

from calibrator.drive import Mask
from calibrator.evidence.readings import TRUSTED_DRIFT_SD, TRUSTED_OFFSET_SD
from calibrator.evidence.rows import FleetRows
from calibrator.posterior.model_spread import unmeasured_load

__all__ = ["broken_trust"]

SURE = 4.0
"""Standard deviations from which on a trusted vehicle contradicts itself. [1]"""
LEAST_GAIN, LEAST_OFFSET = 0.003, 0.001
"""Smallest contradiction that matters: gain ratios, constants in fractions of full scale. [1]"""


def broken_trust(rows: FleetRows, trusted: Mask, branches: Sequence[str], *, full_scale_a: float) -> dict[int, str]:
    """Find trusted vehicles whose measured currents break the junction law: some sensor of theirs is faulty.

    Parameters
    ----------
    rows : FleetRows
        Evidence of N vehicles, without readings.
    trusted : ndarray of bool of shape (N,)
        Which are trusted.
    branches : sequence of str
        Names of the K branches in the order of the rows.
    full_scale_a : float
        Full scale of the junction. [A]

    Returns
    -------
    dict of int to str
        How each such vehicle breaks it.
    """
    K = rows.branches
    sd = np.sqrt(np.diagonal(rows.covariance, axis1=1, axis2=2))
    ratio = rows.relative[:, K : 2 * K - 1]
    accuracy = np.sqrt(2.0 * TRUSTED_DRIFT_SD**2 + LEAST_GAIN**2)
    gain_off = np.abs(ratio) > SURE * np.hypot(sd[:, K : 2 * K - 1], accuracy)
    load = unmeasured_load(rows.constant[:, K], sd[:, 4 * K - 1])
    accuracy = np.sqrt(K * TRUSTED_OFFSET_SD**2 + load.spread**2 + LEAST_OFFSET**2)
    constant_off = np.abs(rows.constant[:, K] - load.centre) > SURE * np.hypot(sd[:, 4 * K - 1], accuracy)
    found: dict[int, str] = {}
    for j in np.flatnonzero(trusted & (gain_off.any(axis=1) | constant_off)).tolist():
        if gain_off[j].any():
            k = int(np.argmax(np.where(gain_off[j], np.abs(ratio[j]), 0.0)))
            found[j] = f"the gains of its sensors {branches[k + 1]} and {branches[0]} differ by {ratio[j, k]:+.1%}"
        else:
            sum_a, usual_a = np.round(full_scale_a * np.array([rows.constant[j, K], load.centre]), 1) + 0.0
            found[j] = f"its currents sum to {sum_a:+.1f} A on average, {usual_a:+.1f} A being usual"
    return found
