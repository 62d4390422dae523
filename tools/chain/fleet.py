"""An artificial fleet whose drives go straight into a store, without logs, and what its vehicles drive later."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from calibrator.artificial.simulate import FleetPlan, Vehicle, draw_vehicles, trip_of, vehicle_drive
from calibrator.artificial.trips import GroundTruth, TripPurpose, TripSource, choose_branches
from calibrator.drives.store import write_drive
from calibrator.processes.run_many import Workers, run_many
from calibrator.random_streams import Purpose, random_stream
from calibrator.terminal.progress import shown
from ecu_node.database import VehicleDatabase

__all__ = ["ChainFleet", "draw_fleet"]


@dataclass(frozen=True, kw_only=True)
class ChainFleet:
    """A fleet and its trips.

    Attributes
    ----------
    database : VehicleDatabase
        DBC and layout.
    trips : TripSource
        What the vehicles drive.
    vehicles : sequence of Vehicle
        With what is wrong with each.
    unseen_s : float
        Length of an unseen trip. [s]
    seed : int
        Of everything.
    """

    database: VehicleDatabase
    trips: TripSource
    vehicles: Sequence[Vehicle]
    unseen_s: float
    seed: int

    def trip(self, number: int, purpose: TripPurpose) -> GroundTruth:
        """Trip of a vehicle, with its branches alone; an unseen one ends when it is long enough."""
        whole = trip_of(self.trips, self.vehicles[number], number, purpose, self.database.layout)
        return whole.part(0, round(self.unseen_s / whole.period_s)) if purpose == "unseen" else whole

    def write_drives(self, store: Path, *, workers: int) -> None:
        """Write the drives to learn from into a store."""
        count = len(self.vehicles)
        written = run_many(partial(self.write_drive, store), range(count), Workers(processes=workers))
        for _ in shown(written, "drive, to learn from", count, "vehicles"):
            pass

    def write_drive(self, store: Path, number: int) -> None:
        """Write the drive of one vehicle."""
        rng = random_stream(Purpose.FRAMES, self.seed, number)
        drive = vehicle_drive(rng, self.database, self.vehicles[number], self.trip(number, "calibration"))
        write_drive(store, drive, self.database.layout)


def draw_fleet(plan: FleetPlan, trips: TripSource, database: VehicleDatabase, *, unseen_s: float) -> ChainFleet:
    """Draw the vehicles of a fleet.

    Parameters
    ----------
    plan : FleetPlan
        What to draw.
    trips : TripSource
        What the vehicles drive.
    database : VehicleDatabase
        DBC and layout.
    unseen_s : float
        Length of an unseen trip. [s]

    Returns
    -------
    ChainFleet
        The fleet; nothing is written yet.
    """
    branches = choose_branches(database.layout, trips.branches, plan.currents)
    vehicles = draw_vehicles(plan, database.layout, branches)
    return ChainFleet(database=database, trips=trips, vehicles=vehicles, unseen_s=unseen_s, seed=plan.seed)
