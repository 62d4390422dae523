"""How sensor faults and hardware faults relate the measured, true and ideal currents of a vehicle.

Symbols: i_s ideal, i true, i_m measured currents (T samples, K branches, N vehicles), d drift, o offset; index h
hardware, m measurement (sensor). Currents are positive into the junction. Equations are those of [1]_.

    i   = (1 + d_h) i_s + o_h,        sum of o_h = 0      (11)
    i_m = (I + D_m) i + o_m                               (13)

.. [1] "Measurement Correction for Electric Vehicles Based on Compressed Sensing".
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibrator.drive import Array, Mask

__all__ = ["Faults", "measured_currents", "slopes_and_intercepts", "true_currents"]


Index = int | slice | NDArray[np.int64] | Mask


@dataclass(frozen=True, kw_only=True)
class Faults:
    """Fault parameters of N vehicles.

    Attributes
    ----------
    hardware_drift : ndarray of shape (N,)
        d_h: common relative change of all currents. [1]
    hardware_offset_a : ndarray of shape (N, K)
        o_h: change of each current; each row sums to zero. [A]
    drift : ndarray of shape (N, K)
        Diagonal of D_m: relative gain error of each sensor. [1]
    offset_a : ndarray of shape (N, K)
        o_m: offset of each sensor, positive into the junction. [A]
    """

    hardware_drift: Array
    hardware_offset_a: Array
    drift: Array
    offset_a: Array

    def __len__(self) -> int:
        return len(self.hardware_drift)

    @classmethod
    def of_parameters(cls, x: Array, full_scale_a: float) -> "Faults":
        """Make faults from the 3K free parameters of each of N vehicles, as footnote 1 of [1]_ defines them.

        Parameters
        ----------
        x : ndarray of shape (N, 3K)
            (d_h, o_h,1 .. o_h,K-1, D_m, o_m), offsets in fractions of full scale; o_h,K is minus the sum
            of the other o_h.
        full_scale_a : float
            Full scale of the junction. [A]
        """
        K = x.shape[1] // 3
        free = x[:, 1:K] * full_scale_a
        return cls(
            hardware_drift=x[:, 0],
            hardware_offset_a=np.column_stack([free, -free.sum(axis=1)]),
            drift=x[:, K : 2 * K],
            offset_a=x[:, 2 * K :] * full_scale_a,
        )

    def take(self, index: Index) -> "Faults":
        """Return the faults of some of the vehicles; an integer gives arrays without the leading axis of length N."""
        return Faults(**{name: values[index] for name, values in vars(self).items()})

    @property
    def has_hardware_fault(self) -> Mask:
        """Whether each vehicle itself differs from the ideal one, shape (N,)."""
        return np.asarray((self.hardware_drift != 0.0) | np.any(self.hardware_offset_a != 0.0, axis=-1))

    @property
    def has_sensor_fault(self) -> Mask:
        """Whether any sensor of each vehicle is faulty, shape (N,)."""
        return np.asarray(np.any((self.drift != 0.0) | (self.offset_a != 0.0), axis=-1))


def true_currents(i_s: Array, faults: Faults) -> Array:
    """Return the currents that flow in one vehicle, equation (11) of [1]_.

    Parameters
    ----------
    i_s : ndarray of shape (T, K)
        Ideal currents. [A]
    faults : Faults
        Of one vehicle: ``faults.take(j)``.

    Returns
    -------
    ndarray of shape (T, K)
        True currents. [A]
    """
    return (1.0 + faults.hardware_drift) * i_s + faults.hardware_offset_a


def measured_currents(i: Array, faults: Faults) -> Array:
    """Return what the sensors of one vehicle show for its true currents i, equation (13) of [1]_; both (T, K). [A]"""
    return (1.0 + faults.drift) * i + faults.offset_a


def slopes_and_intercepts(faults: Faults) -> tuple[Array, Array]:
    """Return slopes a and intercepts b of the measured over the ideal currents, equation (15) of [1]_.

    Parameters
    ----------
    faults : Faults
        Of N vehicles.

    Returns
    -------
    a, b : ndarray of shape (N, K)
        a_k = (1 + d_k)(1 + d_h) [1]; b_k = (1 + d_k) o_h,k + o_k [A].
    """
    a = (1.0 + faults.drift) * (1.0 + faults.hardware_drift[:, None])
    b = (1.0 + faults.drift) * faults.hardware_offset_a + faults.offset_a
    return a, b
