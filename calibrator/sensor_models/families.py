"""Families of sensor models: what a sensor that is not linear may look like, behind one interface.

Every family has one number more than the linear sensor (13) of [1]_, its excess e, and one column h of the measured
current and the temperature. With Z the current that the sensor shows at 0 A, its linear part

    i_m - e (h - reference * (i_m - Z)),    h = column(i_m - Z)

is a linear sensor again, of the same offset. So the excess is found by linear regression, and whatever calibrates
linear sensors goes on with the linear part.

    gain by sign   i_m = (1 + d+) max(i, 0) + (1 + d-) min(i, 0) + o
                   h = max(i_m - Z, 0),                   e = (d+ - d-) / (1 + d+)
    temperature    i_m = (1 + d + d_T (theta - theta_0)) i + o
                   h = (i_m - Z) (theta - 25 degC),       e = d_T / (1 + d) to first order, exact at theta_0

.. [1] "Measurement Correction for Electric Vehicles Based on Compressed Sensing".
"""

from dataclasses import dataclass
from typing import ClassVar, Protocol

import numpy as np

from calibrator.drive import Array
from calibrator.sensor_models.sections import ColumnMoments, Sections

__all__ = ["FAMILIES", "Family", "GainBySign", "SensorModel", "TemperatureDrift"]

DATA_SHEET_C = 25.0
"""Temperature at which sensors are specified; columns are written around it. [degC]"""


class SensorModel(Protocol):
    """One sensor that is not linear, apart from its offset."""

    def measured(self, i: Array, temperature_c: Array) -> Array:
        """What the sensor shows beyond its offset for true currents [A] at temperatures [degC], shapes (T,). [A]"""
        ...

    def inverse(self, i_m: Array, temperature_c: Array) -> Array:
        """True currents for what the sensor shows beyond its offset; the inverse of :meth:`measured`. [A]"""
        ...


@dataclass(frozen=True, kw_only=True)
class GainBySign:
    """Sensor whose gain differs between currents into and out of the junction.

    Attributes
    ----------
    drift_positive, drift_negative : float
        Relative gain error for currents into the junction, and out of it. [1]
    """

    drift_positive: float
    drift_negative: float

    def measured(self, i: Array, temperature_c: Array) -> Array:  # noqa: ARG002
        """What the sensor shows beyond its offset. [A]"""
        return np.asarray(i * np.where(i > 0.0, 1.0 + self.drift_positive, 1.0 + self.drift_negative))

    def inverse(self, i_m: Array, temperature_c: Array) -> Array:  # noqa: ARG002
        """True currents. [A]"""
        return np.asarray(i_m / np.where(i_m > 0.0, 1.0 + self.drift_positive, 1.0 + self.drift_negative))


@dataclass(frozen=True, kw_only=True)
class TemperatureDrift:
    """Sensor whose drift changes with temperature.

    Attributes
    ----------
    drift : float
        Relative gain error at the reference temperature. [1]
    drift_per_k : float
        Change of the drift per kelvin. [1/K]
    reference_c : float
        Reference temperature. [degC]
    """

    drift: float
    drift_per_k: float
    reference_c: float

    def measured(self, i: Array, temperature_c: Array) -> Array:
        """What the sensor shows beyond its offset. [A]"""
        return np.asarray(i * self._gain(temperature_c))

    def inverse(self, i_m: Array, temperature_c: Array) -> Array:
        """True currents. [A]"""
        return np.asarray(i_m / self._gain(temperature_c))

    def _gain(self, temperature_c: Array) -> Array:
        return 1.0 + self.drift + self.drift_per_k * (temperature_c - self.reference_c)


class Family(Protocol):
    """One kind of sensor that is not linear."""

    name: ClassVar[str]
    needs_temperature: ClassVar[bool]
    size: ClassVar[float]
    """Usual size of the excess: the standard deviation of its prior. [unit of the excess]"""

    def column(self, x: Array, temperature_c: Array) -> Array:
        """Column h of currents without their zero [A] or of inputs, x of shape (T, C), at temperatures (T,)."""
        ...

    def linear_reference(self, usual: float) -> float:
        """Reference of the linear part, where the usual ratio of column to current is known."""
        ...

    def fitted(self, excess: float, reference: float, drift: float) -> SensorModel:
        """Build the sensor of which the linear part has this drift. [1]"""
        ...

    def sections(self, moments: ColumnMoments) -> Sections:
        """Sections of a drive, for a linear part of reference 0."""
        ...

    def gain(self, excess: Array, at: Array) -> Array:
        """Gain in a section over that of the linear part, of the broadcast shape. [1]"""
        ...

    def left_in_linear_part(self, excess: float, at: Array) -> Array:
        """What the linear part shows over a linear sensor, for currents at these sections. [1]"""
        ...


@dataclass(frozen=True)
class GainBySignFamily:
    """Gain differs by the sign of the current: charging and discharging, driving and recuperating."""

    name: ClassVar[str] = "gain by sign"
    needs_temperature: ClassVar[bool] = False
    size: ClassVar[float] = 0.1

    def column(self, x: Array, temperature_c: Array) -> Array:  # noqa: ARG002
        """Positive part, shape (T, C)."""
        return np.maximum(x, 0.0)

    def linear_reference(self, usual: float) -> float:  # noqa: ARG002
        """Of no use: the linear part is the sensor as it is for negative currents."""
        return 0.0

    def fitted(self, excess: float, reference: float, drift: float) -> GainBySign:  # noqa: ARG002
        """Build the sensor that has this drift for negative currents."""
        return GainBySign(drift_positive=(1.0 + drift) / (1.0 - excess) - 1.0, drift_negative=drift)

    def sections(self, moments: ColumnMoments) -> Sections:
        """Currents into the junction, and out of it.

        How many samples each has is not among the moments. It lies between what the mean and the mean square of each
        allow; the middle is taken, as the share only weighs the offset's error over gains that hardly differ.
        """
        sum_a = np.array([moments.h, moments.x - moments.h])
        sum_a2 = np.maximum([moments.hh, moments.xx - moments.hh], 0.0)
        least = sum_a**2 / np.maximum(sum_a2, np.finfo(float).tiny)
        positive = float(np.clip(0.5 * (least[0] + 1.0 - least[1]), 0.0, 1.0))
        return Sections(at=np.array([1.0, 0.0]), share=np.array([positive, 1.0 - positive]), sum_a=sum_a, sum_a2=sum_a2)

    def gain(self, excess: Array, at: Array) -> Array:
        """Gain at positive currents (at = 1) and at negative ones (at = 0)."""
        return np.asarray(1.0 / (1.0 - excess * at))

    def left_in_linear_part(self, excess: float, at: Array) -> Array:  # noqa: ARG002
        """The linear part is a linear sensor."""
        return np.ones(at.shape)


@dataclass(frozen=True)
class TemperatureFamily:
    """Drift changes with the temperature of the sensor."""

    name: ClassVar[str] = "temperature"
    needs_temperature: ClassVar[bool] = True
    size: ClassVar[float] = 0.003

    def column(self, x: Array, temperature_c: Array) -> Array:
        """Product with the temperature above that of data sheets, shape (T, C)."""
        return np.asarray(x * (temperature_c - DATA_SHEET_C)[:, None])

    def linear_reference(self, usual: float) -> float:
        """Temperature above that of data sheets at which most current flowed: there the first order is exact. [K]"""
        return usual

    def fitted(self, excess: float, reference: float, drift: float) -> TemperatureDrift:
        """Build the sensor that has this drift at the reference temperature."""
        return TemperatureDrift(drift=drift, drift_per_k=excess * (1.0 + drift), reference_c=DATA_SHEET_C + reference)

    def sections(self, moments: ColumnMoments) -> Sections:
        """Temperatures above that of data sheets; half of the current flows at each. [K]"""
        mean, sd = moments.ratio
        half = np.full(2, 0.5)
        return Sections(
            at=np.array([mean - sd, mean + sd]), share=half, sum_a=half * moments.x, sum_a2=half * moments.xx
        )

    def gain(self, excess: Array, at: Array) -> Array:
        """Gain at temperatures above the reference. [K]"""
        return np.asarray(1.0 + excess * at)

    def left_in_linear_part(self, excess: float, at: Array) -> Array:
        """The linear part is one to first order."""
        return np.asarray(1.0 - (excess * at) ** 2)


FAMILIES: tuple[Family, ...] = (GainBySignFamily(), TemperatureFamily())
"""All families, in the order of their columns in a summary."""
