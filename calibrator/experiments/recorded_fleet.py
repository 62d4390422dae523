"""Trips of recordings, or of the built-in vehicle, each of which an experiment gives to a vehicle of its own."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from calibrator.artificial.builtin_drives import builtin_trip
from calibrator.artificial.ground_truth import GroundTruth, choose_branches, with_branches
from calibrator.artificial.trips import read_recorded_trips
from calibrator.drive import Array
from calibrator.drives.align import base_inputs, choose_inputs
from calibrator.errors import FleetError
from calibrator.files.formulas import evaluate_formula, parse_formula
from calibrator.random_streams import Purpose, random_stream
from calibrator.terminal.progress import shown
from ecu_node.database import VehicleDatabase
from ecu_node.layout import Layout

__all__ = ["RecordedFleet", "builtin_fleet", "read_fleet"]

BUILTIN_TRIPS = 27
"""As many as a summer of recordings has. [1]"""
BUILTIN_DURATION_S = 1500.0
"""As long as recorded trips are in the median. [s]"""
FEWEST_TRIPS = 4
"""Fewer vehicles are no fleet."""


@dataclass(frozen=True, kw_only=True)
class RecordedFleet:
    """Trips of the ideal vehicle.

    Attributes
    ----------
    name : str
        Where they come from, for the record.
    trips : tuple of GroundTruth
        All with the same branches and inputs.
    database : VehicleDatabase
        DBC and layout.
    recorded : bool
        Whether they were recorded in a car, or come from the built-in vehicle.
    """

    name: str
    trips: tuple[GroundTruth, ...]
    database: VehicleDatabase
    recorded: bool = True

    def __post_init__(self) -> None:
        if len(self.trips) < FEWEST_TRIPS:
            raise FleetError(
                f"{self.name}: {len(self.trips)} usable trips, at least {FEWEST_TRIPS} are needed, as each is a "
                "vehicle; import more drives"
            )

    @property
    def full_scale_a(self) -> float:
        """Full scale of the junction. [A]"""
        return self.database.layout.full_scale_a

    @property
    def period_s(self) -> float:
        """Sample period of the trips. [s]"""
        return self.trips[0].period_s

    def take(self, trips: int, *, duration_s: float) -> "RecordedFleet":
        """First trips, cut to their beginnings."""
        samples = int(duration_s / self.period_s)
        taken = tuple(trip.part(0, samples) for trip in self.trips[:trips])
        return replace(self, name=f"the first {duration_s:g} s of {len(taken)} of {self.name}", trips=taken)

    def with_branches(self, count: int) -> tuple[GroundTruth, ...]:
        """Trips of a fleet of K currents, of which one takes the balance (19).

        Parameters
        ----------
        count : int
            Number of branches K.

        Returns
        -------
        tuple of GroundTruth
            Whose currents sum to zero.

        Raises
        ------
        FleetError
            If the trips have fewer branches.
        """
        names = choose_branches(self.database.layout, tuple(self.trips[0].currents_a), count)
        return tuple(with_branches(trip, names, self._balance_of(names)) for trip in self.trips)

    @property
    def balance_branch(self) -> str:
        """The branch whose current is minus the sum of the others."""
        return self._balance_of(tuple(self.trips[0].currents_a))

    def _balance_of(self, names: tuple[str, ...]) -> str:
        layout = self.database.layout
        return next((branch.name for branch in layout.branch if branch.balance and branch.name in names), names[-1])

    def resolution_a(self, branches: tuple[str, ...]) -> Array:
        """Steps of the signals of some branches, shape (K,); 0 where a branch has none. [A]"""
        return np.array([self.database.current_step_a(name) for name in branches])

    def inputs(self, trip: GroundTruth) -> Mapping[str, Array]:
        """Inputs of the vehicles' and of the fleet's model that a trip has, by name, each of shape (T,)."""
        layout = self.database.layout
        names, _ = choose_inputs(layout, tuple(trip.inputs), names=all_inputs(layout))
        values = dict(trip.inputs)
        for item in layout.derived:
            if base_inputs(layout, [item.name]) <= values.keys():
                values[item.name] = evaluate_formula(parse_formula(item.formula), values)
        return {name: values[name] for name in names}


def all_inputs(layout: Layout) -> tuple[str, ...]:
    """Inputs of the vehicles' and of the fleet's model, each once."""
    return tuple(dict.fromkeys([*layout.model_inputs, *layout.fleet_inputs]))


def read_fleet(store: Path, database: VehicleDatabase) -> RecordedFleet:
    """Trips of a drive store; drives without good samples of some channel are left out.

    Parameters
    ----------
    store : Path
        A drive store.
    database : VehicleDatabase
        DBC and the layout that the store was made with.

    Returns
    -------
    RecordedFleet
        One trip per drive.

    Raises
    ------
    UserError
        If the store cannot be read or has too few usable drives.
    """
    trips, unusable = read_recorded_trips(store, database.layout)
    name = f"{len(trips)} drives of {store.name}" + (f" ({len(unusable)} left out)" if unusable else "")
    return RecordedFleet(name=name, trips=tuple(trips), database=database)


def builtin_fleet(
    database: VehicleDatabase, *, trips: int = BUILTIN_TRIPS, duration_s: float = BUILTIN_DURATION_S
) -> RecordedFleet:
    """Trips of the built-in vehicle, for where there are no recordings.

    Parameters
    ----------
    database : VehicleDatabase
        DBC and a layout with the names of the built-in vehicle.
    trips : int
        How many.
    duration_s : float
        Least duration of each. [s]

    Returns
    -------
    RecordedFleet
        The trips.
    """
    made = (
        builtin_trip(random_stream(Purpose.CALIBRATION_TRIP, 0, k), duration_s=duration_s, name=f"builtin-{k}")
        for k in shown(range(trips), "make trips", trips, "trips")
    )
    return RecordedFleet(
        name=f"{trips} built-in trips, no recordings", trips=tuple(made), database=database, recorded=False
    )
