"""The four cases of [1]_, section III-B, put together for a whole fleet.

1 nothing faulty and 2 only hardware faults: no sensor parameters. 3 only sensor faults: slopes and intercepts are the
parameters. 4 both: quadratic basis pursuit, then a refit of what it found.

.. [1] "Measurement Correction for Electric Vehicles Based on Compressed Sensing".
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from calibrator.drive import Array
from calibrator.errors import FleetError
from calibrator.faults import Faults
from calibrator.published.basis_pursuit import BasisPursuit, BasisPursuitError
from calibrator.published.classify import Classification
from calibrator.published.evidence import FleetEvidence
from calibrator.published.refit import refit_support

__all__ = ["Recovery", "recover_fleet"]

EPSILON_SHARE = 0.25
"""epsilon of (18) in sums of the variances of slopes and intercepts; the recovery is flat from 0.05 to 4. [1]"""
LEAST_DEVIATION = 1e-9
"""Stands for the deviation of noise-free slopes and intercepts when they are weighed. [1]"""


@dataclass(frozen=True, kw_only=True)
class Recovery:
    """What a method found for N vehicles.

    Attributes
    ----------
    faults : Faults
        Estimate.
    classification : Classification
        What each vehicle was held to have; ``classification.hardware`` is the hardware suspicion.
    failed : mapping of int to str
        Vehicles, by position, whose optimisation failed, and why; they have no sensor parameters (zero).
    """

    faults: Faults
    classification: Classification
    failed: Mapping[int, str]

    def __len__(self) -> int:
        return len(self.faults)


def recover_fleet(evidence: FleetEvidence, classification: Classification, *, full_scale_a: float) -> Recovery:
    """Recover the fault parameters of a fleet.

    Parameters
    ----------
    evidence : FleetEvidence
        Of N vehicles.
    classification : Classification
        Of the same vehicles.
    full_scale_a : float
        Full scale of the junction; offsets are compared with drifts in fractions of it. [A]

    Returns
    -------
    Recovery
        Estimates; a failed optimisation is named in it, the other vehicles go on.

    Raises
    ------
    FleetError
        If evidence and classification are of different fleets, or the full scale is not positive.
    """
    if not len(evidence) == len(classification.hardware) == len(classification.sensor):
        raise FleetError(f"{len(evidence)} vehicles, but {len(classification.hardware)} were classified")
    if not full_scale_a > 0.0:
        raise FleetError(f"full scale must be positive, not {full_scale_a:g} A")
    N, K = evidence.slopes.shape
    x = np.zeros((N, 3 * K))
    regressed = classification.sensor & ~classification.hardware
    x[regressed, K : 2 * K] = evidence.slopes[regressed] - 1.0
    x[regressed, 2 * K :] = evidence.intercepts_a[regressed] / full_scale_a
    failed: dict[int, str] = {}
    both = np.flatnonzero(classification.sensor & classification.hardware)
    pursuit = BasisPursuit(K) if both.size else None
    for j in both.tolist():
        assert pursuit is not None
        try:
            x[j] = _pursue(pursuit, evidence.take(j), full_scale_a)
        except BasisPursuitError as error:
            failed[j] = str(error)
    return Recovery(faults=_faults(x, full_scale_a), classification=classification, failed=failed)


def _pursue(pursuit: BasisPursuit, vehicle: FleetEvidence, full_scale_a: float) -> Array:
    """Case 4 for one vehicle: parameters of shape (3K,), offsets in fractions of full scale."""
    slopes, intercepts = vehicle.slopes, vehicle.intercepts_a / full_scale_a
    variances = np.concatenate([vehicle.slope_variances, vehicle.intercept_variances_a2 / full_scale_a**2])
    x = pursuit.solve(slopes, intercepts, epsilon=EPSILON_SHARE * float(variances.sum()))
    return refit_support(x, slopes, intercepts, np.maximum(np.sqrt(variances), LEAST_DEVIATION))


def _faults(x: Array, full_scale_a: float) -> Faults:
    """Parameters (N, 3K), offsets in fractions of full scale, as fault parameters."""
    K = x.shape[1] // 3
    free = x[:, 1:K] * full_scale_a
    return Faults(
        hardware_drift=x[:, 0],
        hardware_offset_a=np.column_stack([free, -free.sum(axis=1)]),
        drift=x[:, K : 2 * K],
        offset_a=x[:, 2 * K :] * full_scale_a,
    )
