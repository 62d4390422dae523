"""Trips of the ideal vehicle, from which artificial vehicles are made: of the built-in vehicle, or recorded drives.

Recorded currents do not sum to zero, so one, the balance branch, is set to minus the sum of the others, equation (19)
of [1]_. Results for that branch therefore depend on the other sensors of the recording.

.. [1] "Measurement Correction for Electric Vehicles Based on Compressed Sensing".
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Literal

import numpy as np

from calibrator.artificial.builtin_drives import BUILTIN_BRANCHES, BUILTIN_INPUTS, GroundTruth, builtin_trip
from calibrator.artificial.random_fleet import Purpose, random_stream
from calibrator.drive import Drive
from calibrator.drives.align import choose_inputs
from calibrator.drives.store import iterate_drives
from calibrator.errors import FleetError
from ecu_node.layout import Layout

__all__ = [
    "BuiltinTrips", "GroundTruth", "RecordedTrips", "TripPurpose", "TripSource", "balance_branch", "choose_branches",
    "choose_trips", "cut_and_rejoin", "ground_truth_from_drive", "read_recorded_trips", "with_branches",
]  # fmt: skip

STANDSTILL_KMH = 0.5
"""Below this speed trips may be cut and joined: the power train is at rest, so no current jumps. [km/h]"""


def choose_branches(layout: Layout, available: Sequence[str], count: int) -> tuple[str, ...]:
    """Return the first ``count`` branches of a layout that the recordings have.

    Parameters
    ----------
    layout : Layout
        Names the branches in order.
    available : sequence of str
        Branches that the recordings have.
    count : int
        Number of branches K.

    Returns
    -------
    tuple of str
        K names, in the order of the layout.

    Raises
    ------
    FleetError
        If the recordings have less than two or less than ``count`` branches of the layout, or the count is below 2.
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
    """Return the trip with these branches only; ``balance`` becomes minus the sum of the others.

    That is equation (19) of [1]_.
    """
    kept = {name: trip.currents_a[name] for name in branches}
    kept[balance] = -np.sum([kept[name] for name in branches if name != balance], axis=0)
    return GroundTruth(name=trip.name, period_s=trip.period_s, currents_a=kept, inputs=trip.inputs)


def balance_branch(layout: Layout, branches: Sequence[str]) -> str:
    """Return which branch becomes minus the sum of the others, equation (19) of [1]_.

    It is the one that the layout marks with ``balance``, if it is among the branches, else the last of them.
    """
    return next((branch.name for branch in layout.branch if branch.balance and branch.name in branches), branches[-1])


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
        The trip over the span that all channels cover; None if that span is empty, a channel has no good sample, or
        the drive has no branch.
    """
    channels = {**drive.branches, **drive.inputs}
    if not drive.branches or any(not channel.good.any() for channel in channels.values()):
        return None
    known = {name: (channel.time_s[channel.good], channel.value[channel.good]) for name, channel in channels.items()}
    start, stop = max(float(t[0]) for t, _ in known.values()), min(float(t[-1]) for t, _ in known.values())
    time_s = np.arange(start, stop, period_s)
    if not time_s.size:
        return None
    values = {name: np.interp(time_s, *pair) for name, pair in known.items()}
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
    edges = np.flatnonzero(np.diff(np.pad(trip.inputs["speed"] < STANDSTILL_KMH, 1)))  # starts and stops by turns
    middles = (edges[::2] + edges[1::2]) // 2
    cuts = [0, *(m for m in middles.tolist() if 0 < m < len(trip)), len(trip)]
    return [trip.part(a, b) for a, b in pairwise(cuts) if b > a]


TripPurpose = Literal["calibration", "unseen"]
"""A trip to learn from, or one to test on."""
_STREAM: dict[TripPurpose, Purpose] = {"calibration": Purpose.CALIBRATION_TRIP, "unseen": Purpose.UNSEEN_TRIP}
LEARNT_SHARE = 0.75
"""Share of a single recording from which trips to learn from are made; unseen trips are made from the rest. [1]"""


@dataclass(frozen=True, kw_only=True)
class BuiltinTrips:
    """A different trip of the built-in vehicle for every vehicle and purpose; the same arguments give the same trip.

    Attributes
    ----------
    seed : int
        Seed of the trips.
    duration_s, unseen_s : float
        Least length of each trip to learn from, and of each trip to test on. [s]
    common : bool
        Whether every vehicle drives the trips of the first one, as in the experiments of the paper.
    notices : tuple of str
        What a user should know about the trips.
    """

    seed: int
    duration_s: float
    unseen_s: float
    common: bool = False
    notices: tuple[str, ...] = ()

    @property
    def branches(self) -> tuple[str, ...]:
        """Branches of the built-in vehicle."""
        return BUILTIN_BRANCHES

    def trip(self, number: int, purpose: TripPurpose) -> GroundTruth:
        """Return the ideal currents and inputs of the trip of vehicle ``number``, to learn from or to test on."""
        number = 0 if self.common else number
        rng = random_stream(_STREAM[purpose], self.seed, number)
        duration_s = self.duration_s if purpose == "calibration" else self.unseen_s
        return builtin_trip(rng, duration_s=duration_s, name=f"builtin-{number}-{purpose}")


@dataclass(frozen=True, kw_only=True)
class RecordedTrips:
    """Recorded trips. Each vehicle learns from a recording of its own if there are enough, else from joined pieces.

    Trips to test on are always joined pieces. No piece is in both trips of a vehicle: a single recording is cut in two.

    Attributes
    ----------
    seed : int
        Seed of the trips.
    recorded : sequence of GroundTruth
        The recordings, all with the same branches.
    vehicles : int
        How many vehicles need trips of their own; 1: all drive those of the first one.
    unseen_s : float
        Length of each trip to test on. [s]
    notices : tuple of str
        What a user should know about the trips.
    """

    seed: int
    recorded: Sequence[GroundTruth]
    vehicles: int
    unseen_s: float
    notices: tuple[str, ...] = ()

    @property
    def branches(self) -> tuple[str, ...]:
        """Branches of the recordings."""
        return tuple(self.recorded[0].currents_a)

    def trip(self, number: int, purpose: TripPurpose) -> GroundTruth:
        """Return the recorded or joined trip of vehicle ``number``, to learn from or to test on."""
        number = 0 if self.vehicles == 1 else number
        count, learnt, half = len(self.recorded), purpose == "calibration", len(self.recorded) // 2
        if learnt and count > 1 and self.vehicles <= count:
            return self.recorded[number]
        if count == 1:
            (only,) = self.recorded
            cut = int(LEARNT_SHARE * len(only))
            pool = [only.part(0, cut) if learnt else only.part(cut, len(only))]
        elif self.vehicles <= count:
            pool = [trip for k, trip in enumerate(self.recorded) if k != number]
        else:
            pool = list(self.recorded[:-half] if learnt else self.recorded[-half:])
        median_s = float(np.median([len(trip) * trip.period_s for trip in pool]))
        duration_s = median_s if learnt else self.unseen_s
        rng = random_stream(_STREAM[purpose], self.seed, number)
        joined = cut_and_rejoin(rng, pool, duration_s=duration_s, name=f"recorded-{number}-{purpose}")
        return joined.part(0, int(duration_s / joined.period_s))


TripSource = BuiltinTrips | RecordedTrips
"""Where the trips of the vehicles come from."""


def read_recorded_trips(store: Path, layout: Layout) -> tuple[list[GroundTruth], list[str]]:
    """Read the drives of a store as trips of the ideal vehicle.

    Parameters
    ----------
    store : Path
        A drive store.
    layout : Layout
        The layout it was made with.

    Returns
    -------
    trips : list of GroundTruth
        In the order of the store, with the branches and inputs that all of them have.
    unusable : list of str
        Names of the drives that lack good samples of some channel.

    Raises
    ------
    FleetError
        If no drive is usable.
    """
    made = [
        (f"{drive.vehicle}/{drive.name}", ground_truth_from_drive(drive, layout.period_s))
        for drive in iterate_drives(store, layout)
    ]
    trips = [trip for _, trip in made if trip is not None]
    if not trips:
        raise FleetError(f"{store}: no drive with usable samples; import drives with 'calibrator import'")
    branches, inputs = (
        [name for name in getattr(trips[0], group) if all(name in getattr(trip, group) for trip in trips)]
        for group in ("currents_a", "inputs")
    )
    alike = [
        replace(
            trip,
            currents_a={name: trip.currents_a[name] for name in branches},
            inputs={name: trip.inputs[name] for name in inputs},
        )
        for trip in trips
    ]
    return alike, [name for name, trip in made if trip is None]


def choose_trips(
    drives: str, layout: Layout, *, vehicles: int, seed: int, duration_s: float, unseen_s: float, common: bool
) -> TripSource:
    """Return the source of the trips: the built-in vehicle, or a drive store.

    Parameters
    ----------
    drives : str
        ``builtin``, or the path of a drive store.
    layout : Layout
        The layout.
    vehicles : int
        Fleet size.
    seed : int
        Seed of the trips.
    duration_s, unseen_s : float
        Least length of each built-in trip to learn from, and length of each trip to test on (a built-in one may be
        longer). [s]
    common : bool
        Whether all vehicles drive the same trip.

    Returns
    -------
    TripSource
        The trips.

    Raises
    ------
    FleetError
        If no drive of the store is usable, or if the built-in vehicle has less than two branches or no model input of
        the layout.
    """
    if drives == "builtin":
        notices = _builtin_notices(layout)
        return BuiltinTrips(seed=seed, duration_s=duration_s, unseen_s=unseen_s, common=common, notices=notices)
    recorded, unusable = read_recorded_trips(Path(drives), layout)
    text = f"{len(unusable)} drives lack good samples of some channel and are left out: {', '.join(unusable)}"
    count, notices = 1 if common else vehicles, (text,) if unusable else ()
    return RecordedTrips(seed=seed, recorded=recorded, vehicles=count, unseen_s=unseen_s, notices=notices)


def _builtin_notices(layout: Layout) -> tuple[str, ...]:
    """Return a notice that names the layout's model inputs that the built-in vehicle lacks; empty if it has them all.

    FleetError if the vehicle has none of them, or less than two branches of the layout.
    """
    inputs, missing = choose_inputs(layout, BUILTIN_INPUTS)
    common = [name for name in layout.branch_names if name in BUILTIN_BRANCHES]
    if len(common) < 2 or not inputs:
        raise FleetError(
            f"{layout.path}: the built-in vehicle needs two or more branches named {', '.join(BUILTIN_BRANCHES)} and "
            f"model inputs made of {', '.join(BUILTIN_INPUTS)}; name them so, use dbc/hv_powertrain.toml, or give "
            "--drives a store made with this layout"
        )
    return (f"model inputs that the built-in vehicle has not: {', '.join(missing)}",) if missing else ()
