"""Unity window of a result, and the ideal currents of the fleet on it."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calibrator.drive import Array
from calibrator.estimator.results import RunRecord
from calibrator.summaries.unity import UNITY_FILE, UnityWindow, decode_window

__all__ = ["IdealWindow", "ideal_window", "read_out_of", "read_unity"]


@dataclass(frozen=True, kw_only=True)
class IdealWindow:
    """Unity window with the ideal currents of the fleet.

    Attributes
    ----------
    vehicle : str
        Whose inputs they are.
    time_s : ndarray of shape (T,)
        Instants. [s]
    ideal_a : ndarray of shape (T, K)
        Currents of a vehicle without faults; NaN where the inputs are not known. [A]
    """

    vehicle: str
    time_s: Array
    ideal_a: Array


def read_unity(result: Path) -> UnityWindow | None:
    """Unity window of a result; None if it has none, FleetError if it is damaged."""
    path = result / UNITY_FILE
    try:
        return decode_window(path.read_bytes(), str(path))
    except FileNotFoundError:
        return None


def read_out_of(run: RunRecord) -> Array:
    """Read-out of the fleet model of a run, shape (W + 1, K); without rows if it has none. [A]"""
    found = run.details.get("reference", {}).get("read_out", {})
    if set(found) != set(run.branches):
        return np.zeros((0, len(run.branches)))
    return np.array([found[name] for name in run.branches]).T


def ideal_window(unity: UnityWindow | None, run: RunRecord) -> IdealWindow | None:
    """Ideal currents on a unity window.

    Parameters
    ----------
    unity : UnityWindow or None
        The window.
    run : RunRecord
        Of the same result.

    Returns
    -------
    IdealWindow or None
        None if there is no window, or the run has no read-out of its columns.
    """
    read_out = read_out_of(run)
    if unity is None or len(read_out) != unity.columns.shape[1] + 1:
        return None
    ideal_a = np.column_stack([unity.columns, np.ones(len(unity.columns))]) @ read_out
    return IdealWindow(vehicle=unity.vehicle, time_s=unity.time_s, ideal_a=ideal_a)
