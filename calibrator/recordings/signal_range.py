"""Ranges that the DBC gives to the layout's branches and inputs, in the units and with the signs of a drive."""

import math
from dataclasses import dataclass

import numpy as np
from cantools.database.can import Signal

from calibrator.drive import Array, Mask
from ecu_node.database import VehicleDatabase
from ecu_node.units import AMPERE, unit_factor

__all__ = ["SignalRange", "signal_range", "signal_ranges"]

SLACK = 1e-6
"""Rounding of decimal scales must not push a value out of its range. [steps of the signal]"""


@dataclass(frozen=True, kw_only=True)
class SignalRange:
    """Least and greatest value of a signal, and what rounding may add to them."""

    low: float
    high: float
    slack: float

    def holds(self, value: Array) -> Mask:
        """Which values lie inside; NaN does not."""
        return np.asarray((value >= self.low - self.slack) & (value <= self.high + self.slack))


def signal_range(signal: Signal, factor: float = 1.0) -> SignalRange:
    """Range of one signal.

    Parameters
    ----------
    signal : Signal
        A signal of the DBC.
    factor : float
        What its physical values are multiplied by.

    Returns
    -------
    SignalRange
        Infinite on a side that the DBC does not limit. 0 to 0 limits neither: DBC files give it to signals without a
        range.
    """
    low = -math.inf if signal.minimum is None else float(signal.minimum)
    high = math.inf if signal.maximum is None else float(signal.maximum)
    if not signal.minimum and not signal.maximum:
        low, high = -math.inf, math.inf
    ends = sorted((factor * low, factor * high))
    return SignalRange(low=ends[0], high=ends[1], slack=abs(factor * float(signal.scale)) * SLACK)


def signal_ranges(database: VehicleDatabase) -> dict[str, SignalRange]:
    """Ranges of branches and inputs.

    Parameters
    ----------
    database : VehicleDatabase
        DBC and layout.

    Returns
    -------
    dict of str to SignalRange
        By name: branches in A, positive into the junction; inputs in the unit of the DBC. Branches that are computed
        from a power are absent.
    """
    layout = database.layout
    ranges = {item.name: signal_range(database.signal(item.signal)[1]) for item in layout.input}
    for branch in layout.branch:
        if branch.signal is not None:
            _, signal = database.signal(branch.signal)
            factor = branch.sign * unit_factor(signal, AMPERE, f"{layout.path}: branch {branch.name}")
            ranges[branch.name] = signal_range(signal, factor)
    return ranges
