"""Whether the voltage that powers are divided by can be one: a slip of its unit would be every such branch's."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calibrator.doctor.findings import Finding, Severity
from calibrator.drive import Drive

__all__ = ["VoltageSlip", "voltage_slip", "without_slip"]

LEAST_V, GREATEST_V = 30.0, 1500.0
"""From 48 V systems to the highest that road vehicles have. [V]"""
USUAL_V = 400.0
"""Of most cars: a slip is a power of ten that leads nearest to it. [V]"""


@dataclass(frozen=True, kw_only=True)
class VoltageSlip:
    """A voltage that is impossible.

    Attributes
    ----------
    signal : str
        ``Message.Signal``.
    median_v : float
        What was seen. [V]
    factor : float
        Power of ten by which it must be multiplied to be usual. [1]
    """

    signal: str
    median_v: float
    factor: float

    def finding(self) -> Finding:
        """The slip as a finding."""
        size = f"{1.0 / self.factor:g} times too large" if self.factor < 1.0 else f"{self.factor:g} times too small"
        return Finding(
            severity=Severity.ERROR,
            kind="unit",
            subject=self.signal,
            text=f"the voltage is {self.median_v:.4g} V in the median, probably {size}",
            remedy="correct its scale or unit in the DBC, or name another signal as the voltage",
            figures={"factor": self.factor, "median_v": self.median_v},
        )


def voltage_slip(drives: Sequence[Drive], voltage: str, signal: str) -> VoltageSlip | None:
    """Look at the voltage of some drives.

    Parameters
    ----------
    drives : sequence of Drive
        Of one vehicle.
    voltage : str
        Input that is the voltage, in V; drives may lack it.
    signal : str
        Its signal.

    Returns
    -------
    VoltageSlip or None
        None if it is possible, zero (contactors open), or not recorded.
    """
    channels = [drive.inputs[voltage] for drive in drives if voltage in drive.inputs]
    value = np.concatenate([np.zeros(0), *(channel.value[channel.good] for channel in channels)])
    median_v = float(np.median(np.abs(value))) if len(value) else 0.0
    if median_v <= 0.0 or LEAST_V <= median_v <= GREATEST_V:
        return None
    factor = 10.0 ** float(np.rint(np.log10(USUAL_V / median_v)))
    return VoltageSlip(signal=signal, median_v=median_v, factor=factor)


def without_slip(drive: Drive, slip: VoltageSlip, branches: Sequence[str]) -> Drive:
    """Put the currents right that were made of powers by dividing by such a voltage."""
    right = {
        name: replace(channel, value=channel.value / slip.factor) if name in branches else channel
        for name, channel in drive.branches.items()
    }
    return replace(drive, branches=right)
