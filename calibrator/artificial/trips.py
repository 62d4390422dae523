"""Where the trips of an artificial fleet come from: the built-in vehicle, or recorded drives."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, Protocol

import numpy as np

from calibrator.artificial.builtin_drives import BUILTIN_BRANCHES, BUILTIN_INPUTS, builtin_trip
from calibrator.artificial.ground_truth import GroundTruth, cut_and_rejoin, ground_truth_from_drive
from calibrator.drives.align import choose_inputs
from calibrator.drives.store import iterate_drives
from calibrator.errors import FleetError
from calibrator.random_streams import Purpose, random_stream
from ecu_node.layout import Layout

__all__ = [
    "BuiltinTrips",
    "CommonTrips",
    "RecordedTrips",
    "TripPurpose",
    "TripSource",
    "choose_trips",
    "read_recorded_trips",
]

TripPurpose = Literal["calibration", "unseen"]
"""A trip to learn from, or one to test on."""

_STREAM: dict[TripPurpose, Purpose] = {"calibration": Purpose.CALIBRATION_TRIP, "unseen": Purpose.UNSEEN_TRIP}


LEARNT_SHARE = 0.75
"""Share of a single recording that trips to learn from are made of; the rest is for unseen ones. [1]"""


class TripSource(Protocol):
    """Gives every vehicle its trips; the same number and purpose give the same trip."""

    @property
    def branches(self) -> tuple[str, ...]:
        """Branches that the trips have."""
        ...

    @property
    def notices(self) -> tuple[str, ...]:
        """What a user should know about the trips."""
        ...

    def trip(self, number: int, purpose: TripPurpose) -> GroundTruth:
        """Trip of vehicle ``number``."""
        ...


@dataclass(frozen=True, kw_only=True)
class BuiltinTrips:
    """A different trip of the built-in vehicle for every vehicle and purpose."""

    seed: int
    duration_s: float
    unseen_s: float
    branches: tuple[str, ...] = BUILTIN_BRANCHES
    notices: tuple[str, ...] = ()

    def trip(self, number: int, purpose: TripPurpose) -> GroundTruth:
        """Trip of vehicle ``number``."""
        rng = random_stream(_STREAM[purpose], self.seed, number)
        duration_s = self.duration_s if purpose == "calibration" else self.unseen_s
        return builtin_trip(rng, duration_s=duration_s, name=f"builtin-{number}-{purpose}")


@dataclass(frozen=True, kw_only=True)
class RecordedTrips:
    """Recorded trips: one each while they last, then pieces of them joined anew; unseen trips are joined anew.

    No piece of a recording is in both trips of a vehicle; a single recording is cut in time.
    """

    seed: int
    recorded: Sequence[GroundTruth]
    vehicles: int
    unseen_s: float
    notices: tuple[str, ...] = ()

    @property
    def branches(self) -> tuple[str, ...]:
        """Branches that all recordings have."""
        return tuple(b for b in self.recorded[0].currents_a if all(b in trip.currents_a for trip in self.recorded))

    def trip(self, number: int, purpose: TripPurpose) -> GroundTruth:
        """Trip of vehicle ``number``."""
        one_each = self.vehicles <= len(self.recorded)
        if purpose == "calibration" and one_each and len(self.recorded) > 1:
            return self.recorded[number]
        pool = self._pool(number, purpose)
        duration_s = self.unseen_s
        if purpose == "calibration":
            duration_s = float(np.median([len(trip) * trip.period_s for trip in pool]))
        rng = random_stream(_STREAM[purpose], self.seed, number)
        joined = cut_and_rejoin(rng, pool, duration_s=duration_s, name=f"recorded-{number}-{purpose}")
        return joined.part(0, int(duration_s / joined.period_s))

    def _pool(self, number: int, purpose: TripPurpose) -> list[GroundTruth]:
        """Recordings that a trip may be made of; none serves both purposes of one vehicle."""
        if len(self.recorded) == 1:
            (only,) = self.recorded
            cut = int(LEARNT_SHARE * len(only))
            return [only.part(0, cut) if purpose == "calibration" else only.part(cut, len(only))]
        if self.vehicles <= len(self.recorded):
            return [trip for k, trip in enumerate(self.recorded) if k != number]
        half = len(self.recorded) // 2
        return list(self.recorded[:-half] if purpose == "calibration" else self.recorded[-half:])


@dataclass(frozen=True, kw_only=True)
class CommonTrips:
    """Every vehicle drives the trips of vehicle 0, as in the experiments of the paper."""

    source: TripSource

    @property
    def branches(self) -> tuple[str, ...]:
        """Branches that the trips have."""
        return self.source.branches

    @property
    def notices(self) -> tuple[str, ...]:
        """What a user should know about the trips."""
        return self.source.notices

    def trip(self, number: int, purpose: TripPurpose) -> GroundTruth:  # noqa: ARG002
        """Trip of every vehicle."""
        return replace(self.source.trip(0, purpose), name=f"common-{purpose}")


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
        In the order of the store.
    unusable : list of str
        Names of the drives that lack good samples of some channel.

    Raises
    ------
    FleetError
        If no drive is usable.
    """
    trips: list[GroundTruth] = []
    unusable: list[str] = []
    for drive in iterate_drives(store, layout):
        trip = ground_truth_from_drive(drive, layout.period_s)
        if trip is None:
            unusable.append(f"{drive.vehicle}/{drive.name}")
        else:
            trips.append(trip)
    if not trips:
        raise FleetError(f"{store}: no drive with usable samples; import drives with 'calibrator import'")
    return trips, unusable


def choose_trips(
    drives: str, layout: Layout, *, vehicles: int, seed: int, duration_s: float, unseen_s: float, common: bool
) -> TripSource:
    """Choose where trips come from.

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
        Length of each built-in trip to learn from, and of each trip to test on. [s]
    common : bool
        One trip for all vehicles.

    Returns
    -------
    TripSource
        The trips.

    Raises
    ------
    FleetError
        If no drive of the store is usable, or the built-in vehicle has not what the layout names.
    """
    source: TripSource
    if drives == "builtin":
        notices = _builtin_notices(layout)
        source = BuiltinTrips(seed=seed, duration_s=duration_s, unseen_s=unseen_s, notices=notices)
    else:
        recorded, unusable = read_recorded_trips(Path(drives), layout)
        notice = f"{len(unusable)} drives lack good samples of some channel and are left out: {', '.join(unusable)}"
        source = RecordedTrips(
            seed=seed,
            recorded=recorded,
            vehicles=1 if common else vehicles,
            unseen_s=unseen_s,
            notices=(notice,) if unusable else (),
        )
    return CommonTrips(source=source) if common else source


def _builtin_notices(layout: Layout) -> tuple[str, ...]:
    """What the built-in vehicle lacks of the layout's model inputs; refused if it lacks all, or has no junction."""
    inputs, missing = choose_inputs(layout, BUILTIN_INPUTS)
    common = [name for name in layout.branch_names if name in BUILTIN_BRANCHES]
    if len(common) < 2 or not inputs:
        raise FleetError(
            f"{layout.path}: the built-in vehicle needs two or more branches named {', '.join(BUILTIN_BRANCHES)} and "
            f"model inputs made of {', '.join(BUILTIN_INPUTS)}; name them so, use dbc/hv_powertrain.toml, or give "
            "--drives a store made with this layout"
        )
    return (f"model inputs that the built-in vehicle has not: {', '.join(missing)}",) if missing else ()
