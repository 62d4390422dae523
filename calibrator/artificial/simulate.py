"""Write an artificial fleet: a folder of CAN logs per vehicle, and the truth beside them."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from calibrator.artificial.ground_truth import GroundTruth, choose_branches, with_branches
from calibrator.artificial.random_fleet import draw_faults
from calibrator.artificial.trips import TripPurpose, TripSource
from calibrator.artificial.vehicle import Vehicle, draw_disturbances, write_vehicle
from calibrator.drives.fleet_id import write_fleet_ids
from calibrator.files.folders import whole_folder
from calibrator.fleet_truth import TRUTH_FILE, FleetTruth, VehicleTruth, with_fleet_id, write_truth
from calibrator.processes.run_many import Workers, run_many
from calibrator.random_streams import Purpose, random_stream
from ecu_node.database import VehicleDatabase
from ecu_node.layout import Layout

__all__ = ["FleetPlan", "draw_vehicles", "simulate_fleet", "trip_of"]


@dataclass(frozen=True, kw_only=True)
class FleetPlan:
    """What an artificial fleet is like.

    Attributes
    ----------
    vehicles, currents : int
        Fleet size N and number of branches K.
    sparsity : float
        Sparsity level S. [%]
    magnitude : tuple of float
        Range of fault magnitudes: drifts [1], offsets in fractions of full scale.
    balanced, symmetric : bool
        As in section IV-B of the paper.
    common_drive : bool
        Whether all vehicles drive the same trip. Only written down here; the trip source decides.
    noise : float
        Standard deviation of the sensor noise in fractions of full scale.
    delay_max_s : float
        Largest delay of a branch. [s]
    unmeasured_a : tuple of float
        Mean and standard deviation over vehicles of the load that no branch measures. [A]
    seed : int
        Seed of everything.
    """

    vehicles: int
    currents: int
    sparsity: float
    magnitude: tuple[float, float]
    balanced: bool = False
    symmetric: bool = False
    common_drive: bool = False
    noise: float = 0.001
    delay_max_s: float = 0.0
    unmeasured_a: tuple[float, float] = (0.0, 0.0)
    seed: int = 0


def simulate_fleet(
    plan: FleetPlan,
    trips: TripSource,
    database: VehicleDatabase,
    out: Path,
    *,
    workers: int,
    progress: Callable[[int], None] = lambda _: None,
) -> FleetTruth:
    """Draw a fleet and write its logs and its truth.

    Parameters
    ----------
    plan : FleetPlan
        What to draw.
    trips : TripSource
        What the vehicles drive.
    database : VehicleDatabase
        DBC and layout.
    out : Path
        New or empty folder. It appears only when it is complete.
    workers : int
        Number of processes.
    progress : callable
        Called with the number of vehicles written so far.

    Returns
    -------
    FleetTruth
        What stands in ``truth.json``.

    Raises
    ------
    FleetError
        If the folder is not empty or the plan does not fit the trips.
    """
    layout = database.layout
    branches = choose_branches(layout, trips.branches, plan.currents)
    vehicles = draw_vehicles(plan, layout, branches)
    with whole_folder(out) as folder:
        write = partial(_write, folder=folder, database=database, trips=trips, seed=plan.seed)
        written = run_many(write, enumerate(vehicles), Workers(processes=workers))
        truths: dict[str, VehicleTruth] = {}
        for vehicle, truth in zip(vehicles, written, strict=True):
            truths[vehicle.name] = truth
            progress(len(truths))
        fleet = with_fleet_id(_fleet_truth(plan, layout, branches, truths))
        write_truth(folder / TRUTH_FILE, fleet)
        for kind in ("logs", "unseen"):
            write_fleet_ids(folder / kind, {fleet.fleet_id})
    return fleet


def draw_vehicles(plan: FleetPlan, layout: Layout, branches: tuple[str, ...]) -> list[Vehicle]:
    """Draw the vehicles of a fleet, each with what is wrong with it; of a plan, a layout, and the names of branches."""
    rng = random_stream(Purpose.FAULTS, plan.seed)
    faults = draw_faults(
        rng,
        vehicles=plan.vehicles,
        branches=len(branches),
        sparsity=plan.sparsity,
        magnitude=plan.magnitude,
        full_scale_a=layout.full_scale_a,
        balanced=plan.balanced,
        symmetric=plan.symmetric,
    )
    digits = max(3, len(str(plan.vehicles)))
    return [
        Vehicle(
            name=f"V{number + 1:0{digits}d}",
            branches=branches,
            faults=faults.take(number),
            disturbances=draw_disturbances(
                rng,
                branches=len(branches),
                noise_a=plan.noise * layout.full_scale_a,
                delay_max_s=plan.delay_max_s,
                unmeasured_a=plan.unmeasured_a,
            ),
        )
        for number in range(plan.vehicles)
    ]


def _write(
    numbered: tuple[int, Vehicle], *, folder: Path, database: VehicleDatabase, trips: TripSource, seed: int
) -> VehicleTruth:
    number, vehicle = numbered
    return write_vehicle(
        folder,
        database,
        vehicle,
        calibration=trip_of(trips, vehicle, number, "calibration", database.layout),
        unseen=trip_of(trips, vehicle, number, "unseen", database.layout),
        seed=(seed, number),
    )


def trip_of(trips: TripSource, vehicle: Vehicle, number: int, purpose: TripPurpose, layout: Layout) -> GroundTruth:
    """Trip of vehicle ``number``, with its branches alone; the layout says which of them takes the balance."""
    balance = _balance_branch(layout, vehicle.branches)
    return with_branches(trips.trip(number, purpose), vehicle.branches, balance)


def _balance_branch(layout: Layout, branches: tuple[str, ...]) -> str:
    """The branch that is minus the sum of the others: the layout's, or the last one as in (19) of the paper."""
    marked = [branch.name for branch in layout.branch if branch.balance and branch.name in branches]
    return marked[0] if marked else branches[-1]


def _fleet_truth(
    plan: FleetPlan, layout: Layout, branches: tuple[str, ...], vehicles: dict[str, VehicleTruth]
) -> FleetTruth:
    return FleetTruth(
        fleet_id="",
        layout=layout.name,
        branches=list(branches),
        full_scale_a=layout.full_scale_a,
        seed=plan.seed,
        sparsity=plan.sparsity,
        magnitude=plan.magnitude,
        balanced=plan.balanced,
        symmetric=plan.symmetric,
        common_drive=plan.common_drive,
        noise=plan.noise,
        vehicles=vehicles,
    )
