"""Drive: one recording of one vehicle, every signal at its own instants.

A drive keeps the times of its frames; :mod:`calibrator.drives.align` puts them on one time base. Bad samples stay
in place and are labelled, so that what was left out can always be counted.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = [
    "LARGEST",
    "Array",
    "Channel",
    "Complex",
    "Drive",
    "DriveFile",
    "Equipment",
    "FleetSource",
    "Mask",
    "Samples",
    "good_samples",
    "good_values",
]

Array = NDArray[np.floating[Any]]
"""Real numbers; always double precision in practice."""
Mask = NDArray[np.bool_]
Complex = NDArray[np.complex128]
LARGEST = 1e60
"""Largest magnitude that is a good value, in any unit: sums of squares of larger ones overflow."""


@dataclass(frozen=True, kw_only=True)
class Channel:
    """One signal as it was recorded.

    Attributes
    ----------
    time_s : ndarray of shape (n,)
        Times of the samples since the start of the drive, not decreasing. [s]
    value : ndarray of shape (n,)
        Values; branch currents positive into the junction [A], inputs in the unit of the DBC.
    good : ndarray of bool of shape (n,)
        False where the sample must not be used: not available, not finite, outside the DBC's range, or of a frame that
        fails its end-to-end check.
    """

    time_s: Array
    value: Array
    good: Mask


@dataclass(frozen=True, kw_only=True)
class Drive:
    """One recording of one vehicle.

    Attributes
    ----------
    vehicle, name : str
        Name of the vehicle, and name of the drive, which is unique within the vehicle.
    branches : mapping of str to Channel
        Measured branch currents, positive into the junction, by branch name. [A]
    inputs : mapping of str to Channel
        Recorded inputs by name, in the unit of the DBC; not those that the layout derives by a formula.
    """

    vehicle: str
    name: str
    branches: Mapping[str, Channel]
    inputs: Mapping[str, Channel]

    @property
    def duration_s(self) -> float:
        """Time from the first to the last sample of any channel. [s]"""
        channels = [c for c in (*self.branches.values(), *self.inputs.values()) if c.time_s.size]
        if not channels:
            return 0.0
        return float(max(c.time_s[-1] for c in channels) - min(c.time_s[0] for c in channels))


def good_samples(channel: Channel) -> tuple[Array, Array]:
    """Return the instants [s] of a channel's good samples, strictly increasing, and their values, shape (n,) each.

    Of several samples at one instant the last counts.
    """
    time_s, value = channel.time_s, channel.value
    if not channel.good.all():
        time_s, value = time_s[channel.good], value[channel.good]
    last = np.diff(time_s, append=np.inf) > 0.0
    return (time_s, value) if last.all() else (time_s[last], value[last])


def good_values(drives: Iterable[Drive], name: str) -> Array:
    """Return the good values of a branch [A] or an input [its unit] from all drives that have it, shape (n,)."""
    channels = [{**drive.inputs, **drive.branches}.get(name) for drive in drives]
    return np.concatenate([np.zeros(0), *(each.value[each.good] for each in channels if each is not None)])


@dataclass(frozen=True, kw_only=True)
class Samples:
    """Samples of one drive, with all channels at the same instants.

    Attributes
    ----------
    branch_names, input_names : tuple of str
        Names of the K branches, and of the M inputs; these include derived inputs.
    time_s : ndarray of shape (T,)
        Instants since the start of the drive, equally spaced. [s]
    currents_a : ndarray of shape (T, K)
        Measured branch currents, positive into the junction; NaN where not valid. [A]
    inputs : ndarray of shape (T, M)
        Inputs in the unit of the DBC; NaN where not valid.
    valid : ndarray of bool, shape (T,)
        Whether the instant may be used.
    """

    branch_names: tuple[str, ...]
    input_names: tuple[str, ...]
    time_s: Array
    currents_a: Array
    inputs: Array
    valid: Mask

    def with_inputs(self, names: Sequence[str]) -> "Samples":
        """Return the samples with only the inputs in `names`, in that order; unknown names are ignored."""
        kept = [self.input_names.index(name) for name in names if name in self.input_names]
        chosen = tuple(self.input_names[i] for i in kept)
        return replace(self, input_names=chosen, inputs=np.ascontiguousarray(self.inputs[:, kept]))


@dataclass(frozen=True, kw_only=True, slots=True)
class DriveFile:
    """One file that holds a drive (a log, or a file of a drive store) and its vehicle; its content is not read yet.

    Attributes
    ----------
    vehicle, name : str
        Names of the vehicle and of the drive.
    place : str
        Path of the file, possibly inside an archive, or its URL.
    size : int
        Size of the file; 0 where it is not known, as in an archive. [byte]
    version : str
        Text that changes when the file changes; empty where it is not known.
    """

    vehicle: str
    name: str
    place: str
    size: int = 0
    version: str = ""


@dataclass(frozen=True, kw_only=True)
class Equipment:
    """Branches and inputs of the layout with which a fleet is calibrated, and those that are not used.

    Attributes
    ----------
    branches, inputs, fleet_inputs : tuple of str
        Names of the branches, of the inputs for a model of each single vehicle, and of those for the fleet model.
    notices : tuple of str
        What is not used, and why, such as ``model inputs not recorded, left out: heater``.
    """

    branches: tuple[str, ...]
    inputs: tuple[str, ...]
    fleet_inputs: tuple[str, ...]
    notices: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class FleetSource:
    """The files of a fleet's drives, found but not read yet.

    Attributes
    ----------
    place : str
        Path or URL, as the user named it.
    vehicles : mapping of str to tuple of DriveFile
        Files of the drives by name of the vehicle; vehicles and drives are sorted by name.
    left_out : mapping of str to str
        Why something was left out: a vehicle under its name; a file or folder under ``problem 1``, ``problem 2`` ...
    sizes : mapping of str to int
        Size of all drives together, by name of the vehicle. [byte]
    """

    place: str
    vehicles: Mapping[str, tuple[DriveFile, ...]]
    left_out: Mapping[str, str] = field(default_factory=dict)
    sizes: Mapping[str, int] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """Name of the fleet: the last part of its path or URL."""
        return self.place.rstrip("/").rpartition("/")[2] if "://" in self.place else Path(self.place).resolve().name
