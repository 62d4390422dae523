"""Random fault parameters of an artificial fleet, section IV-B of [1]_.

.. [1] "Measurement Correction for Electric Vehicles Based on Compressed Sensing".
"""

import numpy as np

from calibrator.drive import Array
from calibrator.errors import FleetError
from calibrator.faults import Faults

__all__ = ["draw_faults", "nonzero_count"]


def nonzero_count(branches: int, sparsity: float) -> int:
    """How many of the fault parameters of one vehicle are not zero.

    The paper counts 3K + 1 parameters in its example (K = 3, S = 60: 4 of 10) but draws the 3K that its footnote 1
    keeps; a share of these 3K gives the same 4. With K = 2, S = 60 these are 2 of 6. The 3 of 6 that a share of
    3K + 1 would give fit the paper's share of hardware faults, but not its recovery (docs/published_method.md).

    Parameters
    ----------
    branches : int
        Number of branches K.
    sparsity : float
        Sparsity level S: share of zero parameters. [%]

    Returns
    -------
    int
        Number of nonzero parameters, 0 to 3K.
    """
    return round((1.0 - sparsity / 100.0) * 3 * branches)


def draw_faults(
    rng: np.random.Generator,
    *,
    vehicles: int,
    branches: int,
    sparsity: float,
    magnitude: tuple[float, float],
    full_scale_a: float,
    balanced: bool = False,
    symmetric: bool = False,
    sign_bias: float = 0.0,
) -> Faults:
    """Draw the fault parameters of a fleet, (20) and (22) in [1]_.

    Parameters
    ----------
    rng : numpy.random.Generator
        Source of chance.
    vehicles : int
        Fleet size N; a multiple of 4 for a symmetric fleet.
    branches : int
        Number of branches K.
    sparsity : float
        Sparsity level S. [%]
    magnitude : tuple of float
        a, b: magnitudes are U(a, b) with random sign; drifts [1], offsets in fractions of full scale.
    full_scale_a : float
        Full scale of the junction. [A]
    balanced : bool
        No hardware faults in half of the vehicles.
    symmetric : bool
        Vehicles come in groups of four whose measured currents have the ideal current as their mean (22).
    sign_bias : float
        Faults are positive with probability 0.5 + sign_bias, 0 to 0.5: what a common cause does to a fleet. [1]

    Returns
    -------
    Faults
        Of N vehicles, in random order.

    Raises
    ------
    FleetError
        If a symmetric fleet is wanted whose size is no multiple of 4, or whose faults have a preferred sign; or if no
        probability belongs to the bias.
    """
    if not 0.0 <= sign_bias <= 0.5 or (symmetric and sign_bias):
        raise FleetError(f"a sign bias of {sign_bias:g}: expected 0 to 0.5, and 0 for a symmetric fleet")
    if symmetric and vehicles % 4:
        raise FleetError(f"a symmetric fleet needs a multiple of 4 vehicles, not {vehicles}")
    n = vehicles // 4 if symmetric else vehicles
    values = _sparse_values(rng, n, 3 * branches, nonzero_count(branches, sparsity), magnitude)
    if sign_bias:
        values = np.where(rng.random(values.shape) < 2.0 * sign_bias, np.abs(values), values)
    if balanced:
        values[rng.permutation(n) < n // 2, :branches] = 0.0
    faults = Faults.of_parameters(values, full_scale_a)
    if symmetric:  # each vehicle with three others, so that the mean of (21) is the ideal current
        signs = {
            "hardware_drift": (1, -1, 1, -1),
            "hardware_offset_a": (1, -1, 1, -1),
            "drift": (1, -1, -1, 1),
            "offset_a": (1, -1, 1, -1),
        }
        group = {name: np.concatenate([s * getattr(faults, name) for s in own]) for name, own in signs.items()}
        faults = Faults(**group)
    return faults.take(rng.permutation(vehicles))


def _sparse_values(
    rng: np.random.Generator, vehicles: int, parameters: int, nonzero: int, magnitude: tuple[float, float]
) -> Array:
    """Rows with a random support of the given size and values (2B - 1) U(a, b), (20) in [1]_."""
    rank = np.argsort(np.argsort(rng.random((vehicles, parameters)), axis=1), axis=1)
    sign = rng.choice([-1.0, 1.0], size=(vehicles, parameters))
    return np.where(rank < nonzero, sign * rng.uniform(*magnitude, size=(vehicles, parameters)), 0.0)
