"""Randomness of artificial fleets: independent random streams from one seed, and random faults, section IV-B of [1]_.

.. [1] "Measurement Correction for Electric Vehicles Based on Compressed Sensing".
"""

from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from calibrator.drive import Array
from calibrator.errors import FleetError
from calibrator.faults import Faults

__all__ = ["FaultSettings", "Purpose", "nonzero_count", "random_stream"]


class Purpose(IntEnum):
    """What a random stream is used for.

    numpy pads seeds with zeros, so [7], [7, 0] and [7, 0, 0] give the same numbers. :func:`random_stream` puts purpose
    and length in front, so that different purposes or numbers never share a stream.
    """

    FAULTS = 1
    CALIBRATION_TRIP = 2
    UNSEEN_TRIP = 3
    FRAMES = 4
    SIMULATION_ERROR = 5
    TRAINING_FAULTS = 6
    TRAINING_ERROR = 7
    COMMON_DRIVE = 8
    ATTACK = 9
    START_OF_RUN = 10


def random_stream(purpose: Purpose, *numbers: int) -> np.random.Generator:
    """Return the random generator of one purpose, seed and, for example, vehicle.

    Parameters
    ----------
    purpose : Purpose
        What the stream is used for.
    *numbers : int
        Seed, and numbers that distinguish the streams of one purpose, such as that of the vehicle; not negative.

    Returns
    -------
    numpy.random.Generator
        Equal for equal arguments, and independent of all other streams.
    """
    return np.random.default_rng([int(purpose), len(numbers), *numbers])


def nonzero_count(branches: int, sparsity: float) -> int:
    """Return how many of the fault parameters of one vehicle are not zero.

    This is the share 1 - S / 100 of 3K parameters, rounded: K = 3, S = 60 gives 4 of 9, K = 2 gives 2 of 6. The paper's
    example takes the share of 3K + 1 (4 of 10), but it draws only the 3K of its footnote 1. With K = 2 a share of
    3K + 1 would give 3: that fits its share of hardware faults, but not its recovery (docs/published_method.md).

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


@dataclass(frozen=True, kw_only=True)
class FaultSettings:
    """How the faults of a fleet are drawn, equations (20) and (22) of [1]_.

    Attributes
    ----------
    sparsity : float
        Sparsity level S. [%]
    magnitude : tuple of float
        a, b: magnitudes are U(a, b) with random sign; gain errors [1], offsets in fractions of full scale.
    balanced : bool
        No hardware faults in half of the vehicles; else any vehicle may have one.
    symmetric : bool
        Vehicles come in fours whose measured currents have the ideal current as their mean, equation (22) of [1]_.
    sign_bias : float
        0 to 0.5: faults are positive with probability 0.5 + sign_bias, as a cause common to the fleet would do. [1]
    """

    sparsity: float
    magnitude: tuple[float, float] = (0.05, 0.25)
    balanced: bool = False
    symmetric: bool = False
    sign_bias: float = 0.0

    def draw(self, rng: np.random.Generator, *, vehicles: int, branches: int, full_scale_a: float) -> Faults:
        """Draw the fault parameters of a fleet, its vehicles in random order.

        Parameters
        ----------
        rng : numpy.random.Generator
            Source of chance.
        vehicles : int
            Fleet size N; a multiple of 4 for a symmetric fleet.
        branches : int
            Number of branches K.
        full_scale_a : float
            Full scale of the junction. [A]

        Raises
        ------
        FleetError
            If the size of a symmetric fleet is no multiple of 4 or its sign bias not 0, or if any sign bias is not
            between 0 and 0.5.
        """
        if not 0.0 <= self.sign_bias <= 0.5 or (self.symmetric and self.sign_bias):
            raise FleetError(f"a sign bias of {self.sign_bias:g}: expected 0 to 0.5, and 0 for a symmetric fleet")
        if self.symmetric and vehicles % 4:
            raise FleetError(f"a symmetric fleet needs a multiple of 4 vehicles, not {vehicles}")
        n = vehicles // 4 if self.symmetric else vehicles
        values = _sparse_values(rng, n, 3 * branches, nonzero_count(branches, self.sparsity), self.magnitude)
        if self.sign_bias:
            values = np.where(rng.random(values.shape) < 2.0 * self.sign_bias, np.abs(values), values)
        if self.balanced:
            values[rng.permutation(n) < n // 2, :branches] = 0.0
        faults = Faults.of_parameters(values, full_scale_a)
        if self.symmetric:  # each vehicle with three others, so that the mean of (21) is the ideal current
            signs = dict.fromkeys(("hardware_drift", "hardware_offset_a", "offset_a"), (1, -1, 1, -1))
            signs["drift"] = (1, -1, -1, 1)
            faults = Faults(**{k: np.concatenate([s * getattr(faults, k) for s in own]) for k, own in signs.items()})
        return faults.take(rng.permutation(vehicles))


def _sparse_values(
    rng: np.random.Generator, vehicles: int, parameters: int, nonzero: int, magnitude: tuple[float, float]
) -> Array:
    """Return rows of 0 but for ``nonzero`` random entries: U(a, b) with random sign, equation (20) of [1]_."""
    rank = np.argsort(np.argsort(rng.random((vehicles, parameters)), axis=1), axis=1)
    sign = rng.choice([-1.0, 1.0], size=(vehicles, parameters))
    return np.where(rank < nonzero, sign * rng.uniform(*magnitude, size=(vehicles, parameters)), 0.0)
