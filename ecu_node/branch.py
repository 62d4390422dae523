"""One branch as the node sees it live: its last measured and corrected current, and what may be published of it.

Currents are positive into the junction. Times are those of one steady clock, passed in. [s]
"""

from dataclasses import dataclass
from typing import Protocol

from ecu_node.bits import BitPlace
from ecu_node.codes import Codes
from ecu_node.correction import IntegerPlan, corrected_current
from ecu_node.status import Quality

__all__ = ["CurrentSensor", "LiveBranch", "PowerSensor", "Reading", "Republished", "SensorFault", "VoltageSensor"]

_LEAST_VOLTAGE_V = 10.0
"""Below this the HV net is switched off, and power / voltage says nothing of the current. [V]"""


@dataclass(frozen=True, kw_only=True)
class SensorFault:
    """What is corrected: drift [1] and offset, positive into the junction [A]; None of it where passed through."""

    drift: float = 0.0
    offset_a: float = 0.0
    applied: bool = False


@dataclass(frozen=True, kw_only=True)
class Reading:
    """What one frame says of a branch: the current [A], and the code of a current signal; None where it is no value."""

    quality: Quality
    current_a: float | None = None
    code: int | None = None


class _Sensor(Protocol):
    def read(self, payload: bytes | bytearray, now_s: float) -> Reading: ...


def _read_value(codes: Codes, payload: bytes | bytearray) -> tuple[Quality | None, int]:
    """Code of a signal, and why it is no value: None where it is one."""
    code = codes.place.extract(payload)
    if code is None:
        return Quality.INVALID, 0
    if codes.is_value(code):
        return None, code
    return Quality.NOT_AVAILABLE if code in codes.named else Quality.INVALID, code


class CurrentSensor:
    """A branch published as a current.

    Parameters
    ----------
    codes : Codes
        Of the measured signal. [A]
    sign : int
        +1 if the signal is positive into the junction.
    """

    def __init__(self, codes: Codes, sign: int) -> None:
        self._codes = codes
        self._scale = float(sign * codes.scale)
        self._offset = float(sign * codes.offset)

    def read(self, payload: bytes | bytearray, now_s: float) -> Reading:  # noqa: ARG002  # a current needs no clock
        """Read the current from a frame."""
        bad, code = _read_value(self._codes, payload)
        if bad is not None:
            return Reading(quality=bad)
        return Reading(quality=Quality.PASSED_THROUGH, current_a=self._scale * code + self._offset, code=code)


class VoltageSensor:
    """The voltage that turns powers into currents; its last value and when it came."""

    def __init__(self, codes: Codes) -> None:
        self._codes = codes
        self._value_v: float | None = None
        self._time_s = 0.0

    def update(self, payload: bytes | bytearray, now_s: float) -> None:
        """Take the voltage of a new frame."""
        bad, code = _read_value(self._codes, payload)
        self._value_v = None if bad is not None else float(self._codes.scale * code + self._codes.offset)
        self._time_s = now_s

    def value_v(self, now_s: float, max_age_s: float) -> float | None:
        """Voltage [V]; None if there is none, or it is too old or too small to divide by."""
        if self._value_v is None or now_s - self._time_s > max_age_s or self._value_v < _LEAST_VOLTAGE_V:
            return None
        return self._value_v


class PowerSensor:
    """A branch published as a power; its current is power over voltage.

    Parameters
    ----------
    codes : Codes
        Of the power signal. [W]
    sign : int
        +1 if the power is positive into the junction.
    voltage : VoltageSensor
        Shared by all branches that name the same signal.
    max_age_s : float
        Oldest voltage to divide by. [s]
    """

    def __init__(self, codes: Codes, sign: int, voltage: VoltageSensor, max_age_s: float) -> None:
        self._codes = codes
        self._scale = float(sign * codes.scale)
        self._offset = float(sign * codes.offset)
        self._voltage = voltage
        self._max_age_s = max_age_s

    def read(self, payload: bytes | bytearray, now_s: float) -> Reading:
        """Read the power from a frame and divide it by the last voltage."""
        bad, code = _read_value(self._codes, payload)
        if bad is not None:
            return Reading(quality=bad)
        voltage = self._voltage.value_v(now_s, self._max_age_s)
        if voltage is None:
            return Reading(quality=Quality.NOT_AVAILABLE)
        return Reading(quality=Quality.PASSED_THROUGH, current_a=(self._scale * code + self._offset) / voltage)


@dataclass(frozen=True, kw_only=True)
class Republished:
    """Where the corrected current of a branch goes."""

    plan: IntegerPlan
    place: BitPlace
    """Of the corrected signal."""
    not_available: int
    """Its code for "no value"."""
    quality: BitPlace | None


class LiveBranch:
    """One branch: state of its sensor, and its output.

    Parameters
    ----------
    name : str
        As in the layout.
    sensor : CurrentSensor or PowerSensor
        Where its current comes from.
    fault : SensorFault
        What is corrected.
    timeout_s : float
        Without a frame for this long the branch is stale. [s]
    expected_since_s : float or None
        Since when its frames are waited for; None: not before the first one (a vehicle may lack the branch).
    republished : Republished or None
        Output, if the layout names one.
    """

    def __init__(
        self,
        *,
        name: str,
        sensor: _Sensor,
        fault: SensorFault,
        timeout_s: float,
        expected_since_s: float | None,
        republished: Republished | None,
    ) -> None:
        self.name = name
        self.fault = fault
        self.seen = False
        self._sensor = sensor
        self._timeout_s = timeout_s
        self._last_s = expected_since_s
        self._republished = republished
        self._reading = Reading(quality=Quality.NOT_AVAILABLE)

    @property
    def is_fitted(self) -> bool:
        """Whether the vehicle has this branch: it was seen, or the parameters name it."""
        return self._last_s is not None

    def update(self, payload: bytes | bytearray, now_s: float) -> None:
        """Take an intact frame of the branch's source."""
        self._reading = self._sensor.read(payload, now_s)
        self._last_s = now_s
        self.seen = True

    def is_stale(self, now_s: float) -> bool:
        """Whether a fitted branch has been silent for longer than its timeout."""
        return self._last_s is not None and now_s - self._last_s > self._timeout_s

    def measured_a(self, now_s: float) -> float | None:
        """Last measured current [A]; None if stale or not available."""
        return None if self.is_stale(now_s) else self._reading.current_a

    def corrected_a(self, now_s: float) -> float | None:
        """Last current as corrected by (25) [A]; None if stale or not available."""
        measured = self.measured_a(now_s)
        if measured is None:
            return None
        return corrected_current(measured, drift=self.fault.drift, offset_a=self.fault.offset_a)

    def write(self, payload: bytearray, now_s: float) -> bool:
        """Write corrected code and quality into the payload of the target message; True if the code saturated."""
        if self._republished is None:
            return False
        out, reading = self._republished, self._reading
        quality, code, saturated = reading.quality, out.not_available, False
        if self.is_stale(now_s) or not self.seen:
            quality = Quality.NOT_AVAILABLE
        elif reading.code is not None:
            code, saturated = out.plan.apply(reading.code), out.plan.saturates(reading.code)
            quality = Quality.CORRECTED if self.fault.applied else Quality.PASSED_THROUGH
        out.place.put(payload, code)
        if out.quality is not None:
            out.quality.put(payload, quality)
        return saturated
