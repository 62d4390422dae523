"""Zero-current windows: while the contactors are open no current flows, so every sensor shows its offset."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from calibrator.drive import Array, Channel, Drive
from ecu_node.database import VehicleDatabase
from ecu_node.layout import Contactor, Layout
from ecu_node.summary import FEWEST_ZERO_SAMPLES, ZERO_PIECE_S, ZERO_RESOLUTION_A, ZERO_SETTLING_S

__all__ = ["ZeroCurrent", "weighted_mean", "zero_current_offsets"]


@dataclass(frozen=True, kw_only=True)
class ZeroCurrent:
    """Offsets that K branches of one vehicle showed; NaN where there was no window.

    Attributes
    ----------
    offset_a, sd_a : ndarray of shape (K,)
        Mean of the windows' medians and its standard deviation. [A]
    """

    offset_a: Array
    sd_a: Array


def zero_current_offsets(drives: Sequence[Drive], branches: Sequence[str], database: VehicleDatabase) -> ZeroCurrent:
    """Read the offsets in all windows of a vehicle's drives.

    Parameters
    ----------
    drives : sequence of Drive
        Of one vehicle.
    branches : sequence of str
        Names of the K branches.
    database : VehicleDatabase
        Its layout says which input tells that the contactors are open; if none does, no window is known.

    Returns
    -------
    ZeroCurrent
        Of the branches. How far pieces of windows differ counts once per window: pieces of one wander together.
    """
    offset, sd = np.full(len(branches), np.nan), np.full(len(branches), np.nan)
    for k, name in enumerate(branches):
        windows = [window for drive in drives for window in _shown(drive, name, database.layout)]
        if sum(len(current.value) for current in windows) >= FEWEST_ZERO_SAMPLES:
            medians = [np.median(current.value) for current in windows]
            pieces = np.concatenate([_medians_of_pieces(current) for current in windows])
            noise = np.concatenate([current.value - middle for current, middle in zip(windows, medians, strict=True)])
            white = np.sqrt(np.pi / 2.0) * noise.std() / np.sqrt(len(noise))
            wander = pieces.std(ddof=1) / np.sqrt(len(windows)) if len(pieces) > 1 else 0.0
            step_a = database.current_step_a(name) / np.sqrt(12.0)
            offset[k], sd[k] = np.mean(medians), np.sqrt(ZERO_RESOLUTION_A**2 + step_a**2 + max(white, wander) ** 2)
    return ZeroCurrent(offset_a=offset, sd_a=sd)


def _medians_of_pieces(current: Channel) -> Array:
    number = ((current.time_s - current.time_s[0]) / ZERO_PIECE_S).astype(np.int64)
    return np.array([np.median(current.value[number == piece]) for piece in np.unique(number)])


def _shown(drive: Drive, branch: str, layout: Layout) -> Iterator[Channel]:
    """Good samples of a branch well inside each window of one drive; a gap in the state ends a window."""
    if layout.contactor is None:
        return
    state, current = drive.inputs.get(layout.contactor.input), drive.branches.get(branch)
    if state is None or current is None:
        return
    number = np.cumsum(np.diff(state.time_s, prepend=state.time_s[:1]) > layout.max_age_s)
    number = np.where(_is_open(state, layout.contactor), 2 * number + 1, 0)
    edges = np.append(np.flatnonzero(np.diff(number, prepend=0)), len(number))
    for start, stop in pairwise(edges.tolist()):
        first, last = state.time_s[start] + ZERO_SETTLING_S, state.time_s[stop - 1] - ZERO_SETTLING_S
        inside = (current.time_s >= first) & (current.time_s <= last) & current.good
        if number[start] and inside.any():
            yield Channel(time_s=current.time_s[inside], value=current.value[inside], good=current.good[inside])


def _is_open(state: Channel, contactor: Contactor) -> Array:
    is_open = np.isclose(state.value[:, None], np.array(contactor.open)[None, :], rtol=1e-9, atol=1e-9).any(axis=1)
    return np.asarray(state.good & is_open)


def weighted_mean(*readings: tuple[Array, Array]) -> tuple[Array, Array]:
    """Mean by precision of values with standard deviations, NaN where neither tells, and its standard deviation."""
    told = [np.isfinite(value) & np.isfinite(sd) for value, sd in readings]
    precision = [np.where(there, 1.0 / np.square(sd), 0.0) for there, (_, sd) in zip(told, readings, strict=True)]
    total = np.sum(precision, axis=0)
    parts = zip(told, precision, readings, strict=True)
    moment = np.sum([np.where(there, weight * value, 0.0) for there, weight, (value, _) in parts], axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(total > 0.0, moment / total, np.nan), np.where(total > 0.0, 1.0 / np.sqrt(total), np.nan)
