"""Sections: the currents of one branch in two parts, in each of which its sensor is linear.

What a sensor that is not linear does wrong on a drive follows from these few numbers: of a gain by sign the currents
into the junction and those out of it; of a drift with temperature two temperatures, one deviation below and above the
mean, which have the same mean and spread as those at which the current flowed.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calibrator.drive import Array

__all__ = ["ColumnMoments", "Sections", "usual_moments"]


@dataclass(frozen=True, kw_only=True)
class ColumnMoments:
    """Means over a drive of a current x without its zero, and of the column h of a family.

    Attributes
    ----------
    x, xx : float
        Mean and mean square of the current. [A], [A^2]
    h, hx, hh : float
        Mean of the column, of its product with the current, and of its square; units of the column times A and A^2.
    """

    x: float
    xx: float
    h: float
    hx: float
    hh: float

    @property
    def ratio(self) -> tuple[float, float]:
        """Mean and standard deviation of h / x, weighed by the square of the current; 0 without current."""
        if self.xx <= 0.0:
            return 0.0, 0.0
        mean = self.hx / self.xx
        return mean, float(np.sqrt(max(self.hh / self.xx - mean**2, 0.0)))


@dataclass(frozen=True, kw_only=True)
class Sections:
    """Two parts of a drive; the moments are of measured currents without their zero.

    Attributes
    ----------
    at : ndarray of shape (2,)
        Where each is, see :meth:`~calibrator.sensor_models.families.Family.gain`.
    share : ndarray of shape (2,)
        Of the samples; the sum is 1. [1]
    sum_a, sum_a2 : ndarray of shape (2,)
        Means over all samples of the currents, and of their squares, that belong to the section. [A], [A^2]
    """

    at: Array
    share: Array
    sum_a: Array
    sum_a2: Array

    def beside(self, reference: float) -> "Sections":
        """Return the same for a sensor whose linear part has this reference."""
        return replace(self, at=self.at - reference)


def usual_moments(vehicles: Sequence[ColumnMoments]) -> ColumnMoments:
    """Moments of a fleet's usual drive: all drives together, each at the usual strength of the current.

    Parameters
    ----------
    vehicles : sequence of ColumnMoments
        At least one; those without current take no part.

    Returns
    -------
    ColumnMoments
        Of the mean drive, which holds what differs between the vehicles, such as their temperatures.
    """
    moving = [each for each in vehicles if each.xx > 0.0]
    if not moving:
        return vehicles[0]
    table = np.array([[each.x, each.xx, each.h, each.hx, each.hh] for each in moving])
    relative = table / np.sqrt(table[:, 1:2]) ** np.array([1.0, 2.0, 1.0, 2.0, 2.0])
    usual_a = float(np.sqrt(np.median(table[:, 1])))
    x, xx, h, hx, hh = (relative.mean(axis=0) * usual_a ** np.array([1.0, 2.0, 1.0, 2.0, 2.0])).tolist()
    return ColumnMoments(x=x, xx=xx, h=h, hx=hx, hh=hh)
