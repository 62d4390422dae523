"""Zero-current windows: while the contactors are open no current flows, so every sensor shows its offset."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calibrator.drive import Array, Channel, Drive
from ecu_node.layout import Contactor

__all__ = ["ZeroCurrent", "zero_current_offsets"]

SETTLING_S = 2.0
"""After the contactors open and before they close, capacitors still charge and discharge. [s]"""
FEWEST_SAMPLES = 10
"""Of a branch, for its reading to count."""
RESOLUTION_A = 0.02
"""Least standard deviation of a reading: sensors drift within a window by about so much. [A]"""


@dataclass(frozen=True, kw_only=True)
class ZeroCurrent:
    """Offsets that K branches of one vehicle showed; NaN where there was no window.

    Attributes
    ----------
    offset_a, sd_a : ndarray of shape (K,)
        Mean and its standard deviation. [A]
    """

    offset_a: Array
    sd_a: Array


def zero_current_offsets(drives: Sequence[Drive], branches: Sequence[str], contactor: Contactor | None) -> ZeroCurrent:
    """Read the offsets in all windows of a vehicle's drives.

    Parameters
    ----------
    drives : sequence of Drive
        Of one vehicle.
    branches : sequence of str
        Names of the K branches.
    contactor : Contactor or None
        Which input tells that the contactors are open; None: no window is known.

    Returns
    -------
    ZeroCurrent
        Of the branches.
    """
    offset, sd = np.full(len(branches), np.nan), np.full(len(branches), np.nan)
    for k, name in enumerate(branches):
        shown = [_shown(drive, name, contactor) for drive in drives] if contactor is not None else []
        values = np.concatenate([np.zeros(0), *shown])
        if len(values) >= FEWEST_SAMPLES:
            offset[k] = np.median(values)
            sd[k] = np.hypot(RESOLUTION_A, np.sqrt(np.pi / 2.0) * values.std() / np.sqrt(len(values)))
    return ZeroCurrent(offset_a=offset, sd_a=sd)


def _shown(drive: Drive, branch: str, contactor: Contactor) -> Array:
    """Good samples of a branch well inside the windows of one drive. [A]"""
    state, current = drive.inputs.get(contactor.input), drive.branches.get(branch)
    if state is None or current is None:
        return np.zeros(0)
    open_, time_s = _is_open(state, contactor), current.time_s
    edges = np.flatnonzero(np.diff(np.concatenate([[False], open_, [False]]).astype(np.int8)))
    inside = np.zeros(len(time_s), bool)
    for start, stop in zip(edges[::2], edges[1::2], strict=True):
        first, last = state.time_s[start] + SETTLING_S, state.time_s[stop - 1] - SETTLING_S
        inside |= (time_s >= first) & (time_s <= last)
    return np.asarray(current.value[inside & current.good])


def _is_open(state: Channel, contactor: Contactor) -> Array:
    return np.asarray(state.good & np.isin(state.value, contactor.open))
