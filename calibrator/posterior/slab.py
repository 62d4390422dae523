"""Slab: the prior of a fault that is there, uniform in magnitude between two bounds, either sign, as in (20) of [1]_.

Where the bounds are learnt, a few of the sensors' faults are smaller than the lower one. Without a place of their own
they would pass for large ones that cancel, with a hardware fault among them. Small hardware faults need none: they are
in the model spread.

.. [1] "Measurement Correction for Electric Vehicles Based on Compressed Sensing".
"""

from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr
from scipy.stats import qmc

from calibrator.drive import Array

__all__ = ["FAULTS_RANGE", "WIDEST", "Slab"]

POINTS_PER_SIGN = 8
"""Nodes of the midpoint rule along one direction that the evidence leaves open. [1]"""
POINTS_IN_SPACE = 64
"""Nodes of the quasi-random rule where the evidence leaves more directions open. [1]"""
LEAST_DEVIATION = 1e-12
NEVER = 9.0
"""Deviations from a half of the slab at which there is nothing of it. [1]"""


@dataclass(frozen=True)
class Slab:
    """Uniform magnitudes with random sign.

    Attributes
    ----------
    low, high : float
        Bounds of the magnitude: drifts, or offsets in fractions of full scale. [1]
    smaller : float
        Share of the faults that are smaller, evenly down to zero. [1]
    """

    low: float
    high: float
    smaller: float = 0.0

    @property
    def density(self) -> float:
        """Prior density inside the slab."""
        return 0.5 * (1.0 - self.smaller) / (self.high - self.low)

    @property
    def density_below(self) -> float:
        """Prior density between the slab's halves."""
        return 0.5 * self.smaller / self.low

    def log_mass(self, mean: Array, sd: Array) -> Array:
        """Logarithm of the integral of prior density times N(mean, sd^2), elementwise; never minus infinity.

        Each half of the slab is seen from its centre, so that the difference is one of small numbers in the tails.
        """
        spread = np.maximum(sd, LEAST_DEVIATION)
        half, centre, magnitude = (self.high - self.low) / 2.0, (self.high + self.low) / 2.0, np.abs(mean)
        near, far = np.abs(magnitude - centre), magnitude + centre
        mass = ndtr((half - near) / spread) - ndtr(-(half + near) / spread)
        if spread.size and spread.max() * NEVER > self.low:
            mass += ndtr((half - far) / spread) - ndtr(-(half + far) / spread)
        density = np.maximum(mass, np.finfo(float).tiny) * self.density
        if self.smaller:
            below = ndtr((self.low - magnitude) / spread) - ndtr(-(self.low + magnitude) / spread)
            density += below * self.density_below
        return np.asarray(np.log(density))

    def spacing(self, dimensions: int) -> float:
        """Distance between neighbouring nodes. [1]"""
        count = 2 * POINTS_PER_SIGN if dimensions <= 1 else POINTS_IN_SPACE
        return float(2.0 * (self.high - self.low) / count ** (1.0 / max(dimensions, 1)))

    def cell_sd(self, dimensions: int) -> float:
        """Standard deviation of what one node stands for: a uniform distribution as wide as nodes lie apart. [1]"""
        return float(self.spacing(dimensions) / np.sqrt(12.0))

    def nodes(self, dimensions: int) -> Array:
        """Equally weighted points of the prior, shape (Q, dimensions); one point without coordinates for 0."""
        return self.at(self.unit_nodes(dimensions))

    @staticmethod
    def unit_nodes(dimensions: int) -> Array:
        """Equally weighted points of the unit cube, shape (Q, dimensions)."""
        if dimensions == 0:
            return np.zeros((1, 0))
        if dimensions == 1:
            return (np.arange(2 * POINTS_PER_SIGN)[:, None] + 0.5) / (2 * POINTS_PER_SIGN)
        points = qmc.Sobol(dimensions, scramble=False).random(POINTS_IN_SPACE)
        return np.asarray(points + 0.5 / POINTS_IN_SPACE)

    def at(self, unit: Array) -> Array:
        """Points of the slab at shares of the prior between 0 and 1."""
        centred = 2.0 * unit - 1.0
        magnitude = self.low + (self.high - self.low) * np.abs(centred)
        return np.asarray(np.where(centred < 0.0, -magnitude, magnitude))


WIDEST = Slab(0.002, 0.45, smaller=0.01)
"""Any fault that a sensor of a running vehicle can have. [1]"""
FAULTS_RANGE = 2.0 * WIDEST.high
"""From the lowest to the highest drift or offset that a sensor can have. [1]"""
