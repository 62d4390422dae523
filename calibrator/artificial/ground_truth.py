"""Ground truth: the ideal currents i_s and inputs of one trip, from which artificial vehicles are made.

Recorded currents do not sum to zero, so one branch is set to minus the sum of the others, (19) of [1]_. What is
said about that branch afterwards is therefore not independent of the other sensors of the recording.

.. [1] "Measurement Correction for Electric Vehicles Based on Compressed Sensing".
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from calibrator.drive import Array, Drive, Mask
from calibrator.errors import FleetError
from ecu_node.layout import Layout

__all__ = ["GroundTruth", "choose_branches", "cut_and_rejoin", "ground_truth_from_drive", "with_branches"]

STANDSTILL_KMH = 0.5
"""Below this speed trips may be cut and joined: the power train is at rest, so no current jumps. [km/h]"""


@dataclass(frozen=True, kw_only=True)
class GroundTruth:
    """One trip of the ideal vehicle.

    Attributes
    ----------
    name : str
        Name of the trip.
    period_s : float
        Sample period. [s]
    currents_a : mapping of str to ndarray of shape (T,)
        Ideal current of each branch, positive into the junction; they sum to zero. [A]
    inputs : mapping of str to ndarray of shape (T,)
        Inputs by the names of the layout, in the units of its DBC.
    """

    name: str
    period_s: float
    currents_a: Mapping[str, Array]
    inputs: Mapping[str, Array]

    def __len__(self) -> int:
        return len(next(iter(self.currents_a.values())))

    @property
    def time_s(self) -> Array:
        """Instants of the samples since the start, shape (T,). [s]"""
        return self.period_s * np.arange(float(len(self)))

    def matrix_a(self) -> Array:
        """Currents as an array of shape (T, K). [A]"""
        return np.stack(list(self.currents_a.values()), axis=1)

    @classmethod
    def joined(cls, trips: Sequence["GroundTruth"], name: str) -> "GroundTruth":
        """Trips one after the other, with the inputs that all of them have."""
        first = trips[0]
        common = [key for key in first.inputs if all(key in trip.inputs for trip in trips)]
        return cls(
            name=name,
            period_s=first.period_s,
            currents_a={key: np.concatenate([trip.currents_a[key] for trip in trips]) for key in first.currents_a},
            inputs={key: np.concatenate([trip.inputs[key] for trip in trips]) for key in common},
        )

    def part(self, start: int, stop: int) -> "GroundTruth":
        """Samples start to stop (excluded) as a trip of its own."""
        return GroundTruth(
            name=self.name,
            period_s=self.period_s,
            currents_a={name: x[start:stop] for name, x in self.currents_a.items()},
            inputs={name: x[start:stop] for name, x in self.inputs.items()},
        )


def choose_branches(layout: Layout, available: Sequence[str], count: int) -> tuple[str, ...]:
    """Choose which branches a fleet of K currents has: the first K of the layout that the recordings have.

    Parameters
    ----------
    layout : Layout
        Names the branches in order, and the one that takes the balance (19).
    available : sequence of str
        Branches that the recordings have.
    count : int
        Number of branches K.

    Returns
    -------
    tuple of str
        K names, in the order of the layout, with the balancing branch among them.

    Raises
    ------
    FleetError
        If the recordings have fewer branches.
    """
    names = [name for name in layout.branch_names if name in available]
    if len(names) < 2:
        raise FleetError(
            f"{layout.path}: has the branches {', '.join(layout.branch_names)}, these drives have "
            f"{', '.join(available)}; at least two must be common; give --drives a store made with this layout"
        )
    if not 2 <= count <= len(names):
        raise FleetError(
            f"{count} currents asked for; these drives have {len(names)} of the branches of {layout.path} "
            f"({', '.join(names)}), so 2 to {len(names)} are possible"
        )
    return tuple(names[:count])


def with_branches(trip: GroundTruth, branches: Sequence[str], balance: str) -> GroundTruth:
    """Keep some branches and let one of them take minus the sum of the others, (19) in [1]_."""
    kept = {name: trip.currents_a[name] for name in branches}
    kept[balance] = -np.sum([kept[name] for name in branches if name != balance], axis=0)
    return GroundTruth(name=trip.name, period_s=trip.period_s, currents_a=kept, inputs=trip.inputs)


def ground_truth_from_drive(drive: Drive, period_s: float) -> GroundTruth | None:
    """Turn a recorded drive into a trip of the ideal vehicle.

    Bad samples are bridged by interpolation between their good neighbours: what counts here is a realistic trip,
    not the recording itself.

    Parameters
    ----------
    drive : Drive
        A recording.
    period_s : float
        Sample period of the trip. [s]

    Returns
    -------
    GroundTruth or None
        The trip over the span that all channels cover; None if it is empty or a channel has no good sample.
    """
    channels = {**drive.branches, **drive.inputs}
    if not drive.branches or any(not channel.good.any() for channel in channels.values()):
        return None
    start = max(float(channel.time_s[channel.good][0]) for channel in channels.values())
    stop = min(float(channel.time_s[channel.good][-1]) for channel in channels.values())
    time_s = np.arange(start, stop, period_s)
    if not time_s.size:
        return None
    values = {
        name: np.interp(time_s, channel.time_s[channel.good], channel.value[channel.good])
        for name, channel in channels.items()
    }
    return GroundTruth(
        name=drive.name,
        period_s=period_s,
        currents_a={name: values[name] for name in drive.branches},
        inputs={name: values[name] for name in drive.inputs},
    )


def cut_and_rejoin(
    rng: np.random.Generator, trips: Sequence[GroundTruth], *, duration_s: float, name: str
) -> GroundTruth:
    """Make a different trip from pieces of several, cut at standstill.

    Parameters
    ----------
    rng : numpy.random.Generator
        Source of chance.
    trips : sequence of GroundTruth
        Trips of one period, with the same branches; inputs that not all of them have are left out. Without an
        input named 'speed' each trip is one piece.
    duration_s : float
        Least duration of the new trip. [s]
    name : str
        Name of the new trip.

    Returns
    -------
    GroundTruth
        Random pieces one after the other.
    """
    pieces = [piece for trip in trips for piece in _pieces(trip)]
    samples = int(duration_s / trips[0].period_s)
    chosen: list[GroundTruth] = []
    while sum(len(piece) for piece in chosen) < samples:
        chosen += [pieces[k] for k in rng.permutation(len(pieces))]
    count = int(np.searchsorted(np.cumsum([len(piece) for piece in chosen]), samples)) + 1
    return GroundTruth.joined(chosen[:count], name)


def _pieces(trip: GroundTruth) -> list[GroundTruth]:
    """Cut a trip in the middle of every standstill."""
    if "speed" not in trip.inputs:
        return [trip]
    middles = [(start + stop) // 2 for start, stop in _runs(trip.inputs["speed"] < STANDSTILL_KMH)]
    cuts = [0, *(m for m in middles if 0 < m < len(trip)), len(trip)]
    return [trip.part(a, b) for a, b in pairwise(cuts) if b > a]


def _runs(mask: Mask) -> list[tuple[int, int]]:
    """Start and stop (excluded) of each run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]])))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))
