"""Fault of one sensor, and the true current behind what it shows, in floating point.

A sensor shows i_m = (1 + d) i + o, positive into the junction; its true current is i = (i_m - o) / (1 + d), (25)
in [1]_. How the node computes it, in integers, is in :mod:`ecu_node.correction`.

.. [1] "Measurement Correction for Electric Vehicles Based on Compressed Sensing".
"""

from dataclasses import dataclass

from ecu_node.sensor_models import GainBySign, SensorModel

__all__ = ["NO_FAULT", "SensorFault"]


@dataclass(frozen=True, kw_only=True)
class SensorFault:
    """What is corrected on one branch.

    Attributes
    ----------
    drift : float
        d; where a model is given, what it says takes its place or adds to it. [1]
    offset_a : float
        o, positive into the junction. [A]
    model : GainBySign, TemperatureDrift or None
        None: the sensor is linear.
    largest_drift : float
        Limit of the layout; where the drift at a temperature is beyond it, nothing is corrected. [1]
    """

    drift: float = 0.0
    offset_a: float = 0.0
    model: SensorModel | None = None
    largest_drift: float = 0.99

    @property
    def applied(self) -> bool:
        """Whether there is anything to correct."""
        return bool(self.drift or self.offset_a) or self.model is not None

    def drift_at(self, current_a: float, temperature_c: float | None) -> float | None:
        """Drift at a current, of which only the sign matters, and a temperature; None if that must be known and is not.

        Parameters
        ----------
        current_a : float
            Positive into the junction. [A]
        temperature_c : float or None
            Of the sensor. [degC]
        """
        match self.model:
            case None:
                return self.drift
            case GainBySign():
                return self.model.drift_positive if current_a >= 0.0 else self.model.drift_negative
            case model:
                if temperature_c is None:
                    return None
                drift = self.drift + model.drift_per_k * (temperature_c - model.reference_c)
                return drift if abs(drift) <= self.largest_drift else None

    def true_current(self, i_m: float, temperature_c: float | None = None) -> float | None:
        """Invert the sensor model for one current, (25) in [1]_.

        Parameters
        ----------
        i_m : float
            Measured current, positive into the junction. [A]
        temperature_c : float or None
            Of the sensor. [degC]

        Returns
        -------
        float or None
            Corrected current [A]; None if the temperature must be known and is not, or if the drift
            is beyond its limit.
        """
        drift = self.drift_at(i_m - self.offset_a, temperature_c)
        return None if drift is None else (i_m - self.offset_a) / (1.0 + drift)


NO_FAULT = SensorFault()
"""Nothing is corrected."""
