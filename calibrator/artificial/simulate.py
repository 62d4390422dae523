"""Artificial fleet: CAN logs that vehicles with known faults would write, and the truth beside them.

Per vehicle a trip of the ideal vehicle becomes true currents, equation (11) of [1]_, then measured ones, equation (13),
each branch with its own delay and noise, sampled by its own message at its own instants, quantised by the DBC.

.. [1] "Measurement Correction for Electric Vehicles Based on Compressed Sensing".
"""

from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from calibrator.artificial.random_fleet import FaultSettings, Purpose, random_stream
from calibrator.artificial.trips import (
    GroundTruth,
    TripPurpose,
    TripSource,
    balance_branch,
    choose_branches,
    with_branches,
)
from calibrator.drive import Array
from calibrator.errors import FleetError
from calibrator.faults import Faults, measured_currents, true_currents
from calibrator.files.folders import whole_folder
from calibrator.fleet_truth import TRUTH_FILE, FleetTruth, VehicleTruth, write_truth
from calibrator.processes.run_many import Workers, run_many
from calibrator.recordings.write_logs import FrameSeries, encode_message, write_candump
from calibrator.terminal.progress import shown
from ecu_node.core.signals import AMPERE, unit_factor
from ecu_node.database import VehicleDatabase
from ecu_node.layout import Branch, Layout, split_signal

__all__ = ["FleetPlan", "Vehicle", "branch_frame_times", "simulate_fleet", "vehicle_frames"]

WRITTEN_DOWN = ("seed", "sparsity", "magnitude", "balanced", "symmetric", "common_drive", "noise")
"""Fields of the plan that are also written into the truth."""
JITTER = 0.02
"""Standard deviation of how early or late a frame is sent, in cycle times: as on a lightly loaded bus. [1]"""
DEFAULT_CYCLE_MS = 100
LOG_NAME = "drive.log.gz"


@dataclass(frozen=True, kw_only=True)
class Vehicle:
    """One artificial vehicle: its faults, and what else makes its frames differ from ideal currents.

    Attributes
    ----------
    name : str
        Its name.
    branches : tuple of str
        K branches.
    faults : Faults
        Faults of this vehicle alone (no leading N).
    noise_a : float
        Standard deviation of the noise of each sensor sample. [A]
    delay_s : ndarray of shape (K,)
        Delay of each sensor: how long ago the current flowed that it shows. [s]
    unmeasured_a : float
        Load that no branch measures; the first branch, which feeds the others, carries it. [A]
    """

    name: str
    branches: tuple[str, ...]
    faults: Faults
    noise_a: float
    delay_s: Array
    unmeasured_a: float


def vehicle_frames(
    rng: np.random.Generator, database: VehicleDatabase, vehicle: Vehicle, trip: GroundTruth
) -> list[FrameSeries]:
    """Make the frames that a vehicle sends on one trip.

    Parameters
    ----------
    rng : numpy.random.Generator
        Source of chance for phases, jitter and noise.
    database : VehicleDatabase
        DBC and layout.
    vehicle : Vehicle
        The vehicle.
    trip : GroundTruth
        Ideal currents of the vehicle's branches, and inputs.

    Returns
    -------
    list of FrameSeries
        One series per message of the DBC that carries a branch of the vehicle or an input.

    Raises
    ------
    FleetError
        If the layout makes a branch of the vehicle from power and voltage, not from a current signal.
    DatabaseError
        If a signal of these messages is a float in the DBC.
    """
    i, layout = _true_currents(vehicle, trip), database.layout
    messages: dict[str, list[tuple[str, str]]] = {}
    names = [(_current_signal(layout.find_branch(name)), name) for name in vehicle.branches]
    names += [(item.signal, item.name) for item in layout.input if item.name in trip.inputs]
    for place, name in names:
        messages.setdefault(split_signal(place)[0], []).append((split_signal(place)[1], name))
    series = []
    for message, own in messages.items():
        time_s, values = _frame_times(rng, database, message, trip), {}
        for signal, name in own:
            if name in vehicle.branches:
                k, definition = vehicle.branches.index(name), database.signal(f"{message}.{signal}")[1]
                unit = layout.find_branch(name).sign * unit_factor(definition, AMPERE, f"branch {name}")
                seen = np.interp(time_s - vehicle.delay_s[k], trip.time_s, i[:, k])
                value = measured_currents(seen[:, None], vehicle.faults)[:, k]
                values[signal] = (value + rng.normal(0.0, vehicle.noise_a, size=len(time_s))) / unit
            else:
                values[signal] = np.interp(time_s, trip.time_s, trip.inputs[name])
        series.append(encode_message(database, message, time_s, values))
    return series


def _write_vehicle(
    numbered: tuple[int, Vehicle], *, folder: Path, database: VehicleDatabase, trips: TripSource, seed: int
) -> VehicleTruth:
    """Write ``logs/NAME/drive.log.gz`` and ``unseen/NAME/drive.log.gz`` of one vehicle, and return its truth."""
    number, vehicle = numbered
    rng = random_stream(Purpose.FRAMES, seed, number)
    calibration = _trip_of(trips, vehicle, number, "calibration", database.layout)
    unseen = _trip_of(trips, vehicle, number, "unseen", database.layout)
    for kind, trip in (("logs", calibration), ("unseen", unseen)):
        target = folder / kind / vehicle.name
        target.mkdir(parents=True, exist_ok=True)
        write_candump(target / LOG_NAME, vehicle_frames(rng, database, vehicle, trip))
    i, faults = _true_currents(vehicle, unseen), vehicle.faults
    by_branch = {
        "hardware_offset_a": faults.hardware_offset_a,
        "drift": faults.drift,
        "offset_a": faults.offset_a,
        "delay_s": vehicle.delay_s,
        "unseen_mean_a": np.mean(i, axis=0),
        "unseen_mean_square_a2": np.mean(i**2, axis=0),
    }
    return VehicleTruth(
        hardware_drift=float(faults.hardware_drift),
        unmeasured_a=vehicle.unmeasured_a,
        **{key: dict(zip(vehicle.branches, values.tolist(), strict=True)) for key, values in by_branch.items()},
    )


def _true_currents(vehicle: Vehicle, trip: GroundTruth) -> Array:
    """Return the true currents of the vehicle's branches, (T, K); the first also supplies the unmeasured load. [A]"""
    i = true_currents(trip.matrix_a(), vehicle.faults)
    i[:, 0] += vehicle.unmeasured_a
    return i


def branch_frame_times(rng: np.random.Generator, database: VehicleDatabase, branch: str, trip: GroundTruth) -> Array:
    """Return the instants on a trip at which the message with a branch's current is sent, shape (n,). [s]

    FleetError if the branch is made from power and voltage.
    """
    return _frame_times(rng, database, split_signal(_current_signal(database.layout.find_branch(branch)))[0], trip)


def _frame_times(rng: np.random.Generator, database: VehicleDatabase, message_name: str, trip: GroundTruth) -> Array:
    """Return the instants of one message: a random first one, then one per cycle time, each with jitter. [s]"""
    cycle_s = (database.message(message_name).cycle_time or DEFAULT_CYCLE_MS) / 1e3
    nominal = np.arange(rng.uniform(0.0, cycle_s), trip.time_s[-1], cycle_s)
    jitter = np.clip(rng.normal(0.0, JITTER, size=len(nominal)), -0.4, 0.4) * cycle_s
    return np.maximum(nominal + jitter, 0.0)


def _current_signal(branch: Branch) -> str:
    if branch.signal is None:
        raise FleetError(
            f"branch {branch.name} is a power divided by a voltage; fleets are made from current signals only"
        )
    return branch.signal


@dataclass(frozen=True, kw_only=True)
class FleetPlan(FaultSettings):
    """Size, drives and sensors of an artificial fleet, besides how its faults are drawn.

    Attributes
    ----------
    vehicles, currents : int
        Fleet size N and number of branches K.
    common_drive : bool
        Whether all vehicles drive the same trip. It is only written into the truth; the trip source decides.
    noise : float
        Standard deviation of the sensor noise in fractions of full scale. [1]
    delay_max_s : float
        Largest delay of a branch. [s]
    unmeasured_a : tuple of float
        Mean and standard deviation over vehicles of the load that no branch measures. [A]
    seed : int
        Seed of everything that is random.
    """

    vehicles: int
    currents: int
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

    Returns
    -------
    FleetTruth
        Content of ``truth.json``.

    Raises
    ------
    FleetError
        If the folder is not empty, the trips have fewer branches than the plan, the faults cannot be drawn as planned
        (see ``FaultSettings.draw``), or a branch is made from power and voltage.
    """
    layout = database.layout
    branches = choose_branches(layout, trips.branches, plan.currents)
    vehicles = _draw_vehicles(plan, layout, branches)
    with whole_folder(out) as folder:
        write = partial(_write_vehicle, folder=folder, database=database, trips=trips, seed=plan.seed)
        written = run_many(write, enumerate(vehicles), Workers(processes=workers))
        finished = shown(written, "simulate", len(vehicles), "vehicles")
        truths = {vehicle.name: truth for vehicle, truth in zip(vehicles, finished, strict=True)}
        fleet = FleetTruth(
            layout=layout.name,
            branches=list(branches),
            full_scale_a=layout.full_scale_a,
            vehicles=truths,
            **{field: getattr(plan, field) for field in WRITTEN_DOWN},
        )
        write_truth(folder / TRUTH_FILE, fleet)
    return fleet


def _draw_vehicles(plan: FleetPlan, layout: Layout, branches: tuple[str, ...]) -> list[Vehicle]:
    """Draw the vehicles of a fleet, each with its faults, delays and unmeasured load."""
    rng = random_stream(Purpose.FAULTS, plan.seed)
    faults = plan.draw(rng, vehicles=plan.vehicles, branches=len(branches), full_scale_a=layout.full_scale_a)
    digits = max(3, len(str(plan.vehicles)))
    return [
        Vehicle(
            name=f"V{number + 1:0{digits}d}",
            branches=branches,
            faults=faults.take(number),
            noise_a=plan.noise * layout.full_scale_a,
            delay_s=rng.uniform(0.0, plan.delay_max_s, size=len(branches)),
            unmeasured_a=max(0.0, float(rng.normal(*plan.unmeasured_a))),
        )
        for number in range(plan.vehicles)
    ]


def _trip_of(trips: TripSource, vehicle: Vehicle, number: int, purpose: TripPurpose, layout: Layout) -> GroundTruth:
    """Return the trip of vehicle ``number``, its balance branch minus the sum of the others, equation (19) of [1]_."""
    branches = vehicle.branches
    return with_branches(trips.trip(number, purpose), branches, balance_branch(layout, branches))
