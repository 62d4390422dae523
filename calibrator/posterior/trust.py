"""Whether vehicles that are called trusted can be: their sensors must obey the junction law by themselves."""

from collections.abc import Sequence

import numpy as np

from calibrator.drive import Mask
from calibrator.evidence.readings import TRUSTED_DRIFT_SD, TRUSTED_OFFSET_SD
from calibrator.evidence.rows import FleetRows
from calibrator.posterior.unmeasured_load import MOST_UNMEASURED
from ecu_node.layout import UnmeasuredLoad

__all__ = ["broken_trust"]

SURE = 4.0
"""Standard deviations from which on a trusted vehicle contradicts itself. [1]"""
LEAST_GAIN, LEAST_OFFSET = 0.003, 0.001
"""What else than its sensors may bend a gain ratio or move the constant: in fractions of full scale. [1]"""


def broken_trust(
    rows: FleetRows,
    trusted: Mask,
    branches: Sequence[str],
    *,
    full_scale_a: float,
    load: UnmeasuredLoad | None = None,
) -> dict[int, str]:
    """Find trusted vehicles whose measured currents break the junction law: some sensor of theirs is faulty.

    Other vehicles are no measure: where most of a fleet share an offset, the trusted ones are those that differ.

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
    load : UnmeasuredLoad or None
        Load that no branch measures; None: any that such a load can be, so that an offset as small is not found.

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
    lowest, highest, spread = 0.0, MOST_UNMEASURED, 0.0
    if load is not None:
        lowest = highest = load.mean_a / full_scale_a
        spread = load.sd_a / full_scale_a
    accuracy = np.sqrt(K * TRUSTED_OFFSET_SD**2 + spread**2 + LEAST_OFFSET**2)
    constant = rows.constant[:, K]
    away = np.maximum(lowest - constant, constant - highest)
    constant_off = away > SURE * np.hypot(sd[:, 4 * K - 1], accuracy)
    found: dict[int, str] = {}
    for j in np.flatnonzero(trusted & (gain_off.any(axis=1) | constant_off)).tolist():
        if gain_off[j].any():
            k = int(np.argmax(np.where(gain_off[j], np.abs(ratio[j]), 0.0)))
            found[j] = f"the gains of its sensors {branches[k + 1]} and {branches[0]} differ by {ratio[j, k]:+.1%}"
        else:
            why = "no load without a sensor explains"
            if load is not None:
                why = f"the declared load of {load.mean_a:g} A does not explain"
            found[j] = f"its currents sum to {constant[j] * full_scale_a:+.1f} A on average, which {why}"
    return found
