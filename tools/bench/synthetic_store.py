"""A store of summaries of an artificial fleet of any size, made without any drive being read.

Some trips of the built-in vehicle are recorded without faults and summarised; every vehicle of the fleet takes one of
them. What its faults do to the currents, (11) and (13) of the paper, is linear, so it is done to the moments.
"""

import argparse
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np

from calibrator.artificial.random_fleet import draw_faults
from calibrator.drive import Array
from calibrator.drives.delays import BranchDelays
from calibrator.experiments.recorded_trips import RecordedCase, builtin_fleet, record_vehicles
from calibrator.faults import Faults
from calibrator.files.storage import open_storage
from calibrator.processes.run_many import Workers, run_many
from calibrator.sources.fleet_source import Equipment
from calibrator.summaries.identity import store_identity, write_identity
from calibrator.summaries.moments import DriveSummary
from calibrator.summaries.record import Record
from calibrator.summaries.store import SummaryStore
from calibrator.summaries.summariser import summarise_samples
from calibrator.summaries.vehicle_summary import VehicleSummary
from calibrator.summaries.zero_current import ZeroCurrent
from calibrator.terminal.progress import progress_bar
from ecu_node.database import VehicleDatabase, read_database
from ecu_node.layout import read_layout

LAYOUT = Path(__file__).parents[2] / "dbc" / "hv_powertrain.toml"
TRIPS = 64
MINUTES = 6.0
MAGNITUDE = (0.05, 0.25)


def make_store(
    folder: Path,
    *,
    vehicles: int,
    branches: int = 2,
    sparsity: float = 80.0,
    minutes: float = MINUTES,
    workers: int = 2,
) -> SummaryStore:
    """Write a store of so many vehicles with known kinds of faults.

    Parameters
    ----------
    folder : Path
        Where to.
    vehicles, branches : int
        N and K.
    sparsity : float
        Of the faults, 5 to 25 %, as in the paper. [%]
    minutes : float
        Least length of each vehicle's trip. [min]
    workers : int
        Number of processes.

    Returns
    -------
    SummaryStore
        The store.
    """
    database = read_database(read_layout(LAYOUT))
    trips, equipment = _trips(database, branches, minutes)
    identity = store_identity(equipment, database, vehicles=vehicles, fleet="synthetic", fleet_ids=frozenset())
    store = SummaryStore(storage=open_storage(folder), identity=identity)
    write_identity(store.storage, identity)
    by_bucket = store.by_bucket(f"V{number:08d}" for number in range(vehicles))
    write = partial(_write, store=store, trips=trips, sparsity=sparsity, full_scale_a=database.layout.full_scale_a)
    with progress_bar("write summaries", vehicles, "vehicles") as progress:
        done = 0
        for count in run_many(write, by_bucket.items(), Workers(processes=workers)):
            done += count
            progress(done)
    return store


def _trips(database: VehicleDatabase, branches: int, minutes: float) -> tuple[list[DriveSummary], Equipment]:
    """Summaries of trips of the vehicle without faults."""
    layout = database.layout
    fleet = builtin_fleet(database, trips=TRIPS, duration_s=60.0 * minutes)
    trips = fleet.with_branches(branches)
    case = RecordedCase(branches=branches, sparsity=100.0, magnitude=MAGNITUDE)
    inputs = layout.fleet_inputs or layout.model_inputs
    samples = [item.with_inputs(inputs) for item in record_vehicles(fleet, case, trips, 0).samples]
    equipment = Equipment(
        branches=samples[0].branch_names,
        inputs=tuple(layout.model_inputs),
        fleet_inputs=samples[0].input_names,
        notices=(),
    )
    return [summarise_samples([item], period_s=layout.period_s) for item in samples], equipment


def _write(
    bucket: tuple[int, Sequence[str]],
    *,
    store: SummaryStore,
    trips: Sequence[DriveSummary],
    sparsity: float,
    full_scale_a: float,
) -> int:
    number, names = bucket
    faults = draw_faults(
        np.random.default_rng(number),
        vehicles=len(names),
        branches=trips[0].branches,
        sparsity=sparsity,
        magnitude=MAGNITUDE,
        full_scale_a=full_scale_a,
        balanced=True,
    )
    records = {
        name: [_record(name, trips[int(name[1:]) % TRIPS], faults.take(j), store.identity.branches)]
        for j, name in enumerate(names)
    }
    store.append(number, records)
    return len(names)


def _record(name: str, trip: DriveSummary, faults: Faults, branches: tuple[str, ...]) -> Record:
    K, zeros = len(branches), np.zeros(len(branches))
    nothing = np.full(K, np.nan)
    return Record(
        vehicle=name,
        drives=("trip",),
        sources=("",),
        found=VehicleSummary(
            vehicle=name,
            drives=("trip",),
            summary=_measured(trip, faults),
            delays=BranchDelays(branches=branches, delay_s=zeros, sd_s=zeros, known=np.ones(K, bool)),
            zero_current=ZeroCurrent(offset_a=nothing, sd_a=nothing),
        ),
    )


def _measured(trip: DriveSummary, faults: Faults) -> DriveSummary:
    """The trip's summary as a vehicle with these faults measures it."""
    M = trip.inputs
    gain = (1.0 + faults.drift) * (1.0 + faults.hardware_drift)
    turn: Array = np.eye(trip.moments.shape[1])
    turn[range(M, M + trip.branches), range(M, M + trip.branches)] = gain
    turn[M:-1, -1] = (1.0 + faults.drift) * faults.hardware_offset_a + faults.offset_a
    return DriveSummary(
        moments=turn @ trip.moments @ turn.T,
        noise_a2=trip.noise_a2 * gain**2,
        branches=trip.branches,
        period_s=trip.period_s,
        bank=trip.bank,
    )


def main() -> None:
    """Write a store."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--vehicles", type=int, default=1000)
    parser.add_argument("--currents", type=int, default=2)
    parser.add_argument("--minutes", type=float, default=MINUTES)
    parser.add_argument("--workers", type=int, default=2)
    arguments = parser.parse_args()
    make_store(
        arguments.folder,
        vehicles=arguments.vehicles,
        branches=arguments.currents,
        minutes=arguments.minutes,
        workers=arguments.workers,
    )


if __name__ == "__main__":
    main()
