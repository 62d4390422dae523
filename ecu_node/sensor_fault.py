"""Fault of one sensor, and the true current behind what it shows, in floating point.

A sensor shows i_m = (1 + d) i + o, positive into the junction; its true current is i = (i_m - o) / (1 + d), (25)
in [1]_. How the node computes it, in integers, is in :mod:`ecu_node.correction`.

.. [1] "Measurement Correction for Electric Vehicles Based on Compressed Sensing".
"""

from dataclasses import dataclass

__all__ = ["NO_FAULT", "SensorFault"]


@dataclass(frozen=True, kw_only=True)
class SensorFault:
    """What is corrected on one branch.

    Attributes
    ----------
    drift : float
        d. [1]
    offset_a : float
        o, positive into the junction. [A]
    """

    drift: float = 0.0
    offset_a: float = 0.0

    @property
    def applied(self) -> bool:
        """Whether there is anything to correct."""
        return bool(self.drift or self.offset_a)

    def true_current(self, i_m: float) -> float:
        """Correct one current, (25) in [1]_; both are positive into the junction. [A]"""
        return (i_m - self.offset_a) / (1.0 + self.drift)


NO_FAULT = SensorFault()
"""Nothing is corrected."""
