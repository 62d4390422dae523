"""Artificial fleet: what vehicles with known faults would write into their CAN logs.

Per vehicle a trip of the ideal vehicle becomes true currents (11), then measured ones (13), each branch with its own
delay and noise, sampled by its own message at its own instants, quantised by the DBC. Equations are those of [1]_.

.. [1] "Measurement Correction for Electric Vehicles Based on Compressed Sensing".
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calibrator.artificial.ground_truth import GroundTruth
from calibrator.drive import Array, Channel, Drive
from calibrator.errors import FleetError
from calibrator.faults import Faults, measured_currents, true_currents
from calibrator.fleet_truth import VehicleTruth
from calibrator.random_streams import Purpose, random_stream
from calibrator.recordings.canlog import FrameSeries, encode_message, sent_values, write_candump
from ecu_node.core.signals import AMPERE, unit_factor
from ecu_node.database import VehicleDatabase
from ecu_node.layout import Branch, split_signal

__all__ = [
    "Disturbances",
    "Vehicle",
    "draw_disturbances",
    "vehicle_currents",
    "vehicle_drive",
    "vehicle_frames",
    "write_vehicle",
]

JITTER = 0.02
"""Standard deviation of a frame's instant in cycle times: a lightly loaded bus. [1]"""
DEFAULT_CYCLE_MS = 100
LOG_NAME = "drive.log.gz"


@dataclass(frozen=True, kw_only=True)
class Disturbances:
    """What lies between the currents of one vehicle and its frames, besides faults.

    Attributes
    ----------
    noise_a : float
        Standard deviation of each sensor sample. [A]
    delay_s : ndarray of shape (K,)
        How much later than it flowed each current is seen. [s]
    unmeasured_a : float
        Load that no branch measures; the first branch (the source) carries it. [A]
    """

    noise_a: float
    delay_s: Array
    unmeasured_a: float


@dataclass(frozen=True, kw_only=True)
class Vehicle:
    """One artificial vehicle."""

    name: str
    branches: tuple[str, ...]
    faults: Faults
    """Of this vehicle alone (no leading N)."""
    disturbances: Disturbances


def draw_disturbances(
    rng: np.random.Generator,
    *,
    branches: int,
    noise_a: float,
    delay_max_s: float,
    unmeasured_a: tuple[float, float],
) -> Disturbances:
    """Draw the disturbances of one vehicle.

    Parameters
    ----------
    rng : numpy.random.Generator
        Source of chance.
    branches : int
        Number of branches K.
    noise_a : float
        Standard deviation of the sensor noise. [A]
    delay_max_s : float
        Delays are uniform from 0 to this, per branch. [s]
    unmeasured_a : tuple of float
        Mean and standard deviation over vehicles of the unmeasured load, never negative. [A]

    Returns
    -------
    Disturbances
        Of one vehicle.
    """
    return Disturbances(
        noise_a=noise_a,
        delay_s=rng.uniform(0.0, delay_max_s, size=branches),
        unmeasured_a=max(0.0, float(rng.normal(*unmeasured_a))),
    )


def vehicle_frames(
    rng: np.random.Generator, database: VehicleDatabase, vehicle: Vehicle, trip: GroundTruth
) -> list[FrameSeries]:
    """Frames that a vehicle sends on one trip.

    Parameters
    ----------
    rng : numpy.random.Generator
        Source of chance for phases, jitter and noise.
    database : VehicleDatabase
        DBC and layout.
    vehicle : Vehicle
        Faults and disturbances.
    trip : GroundTruth
        Ideal currents of the vehicle's branches, and inputs.

    Returns
    -------
    list of FrameSeries
        One series per message of the DBC that carries a branch of the vehicle or an input.
    """
    return [
        encode_message(database, sent.message, sent.time_s, sent.values)
        for sent in _sent_messages(rng, database, vehicle, trip)
    ]


def vehicle_drive(rng: np.random.Generator, database: VehicleDatabase, vehicle: Vehicle, trip: GroundTruth) -> Drive:
    """Drive that the frames of a vehicle would be read as, without making the frames.

    Parameters
    ----------
    rng, database, vehicle, trip
        As in :func:`vehicle_frames`; with the same chance the values are the same.

    Returns
    -------
    Drive
        Channels at the instants of their frames, in steps of their signals; named after vehicle and trip.
    """
    branches: dict[str, Channel] = {}
    inputs: dict[str, Channel] = {}
    for sent in _sent_messages(rng, database, vehicle, trip):
        for signal_name, (kind, name) in sent.signals.items():
            _, signal = database.signal(f"{sent.message}.{signal_name}")
            unit = _signed_unit(database, name) if kind == "branch" else 1.0
            value = sent_values(signal, sent.values[signal_name]) * unit
            channel = Channel(time_s=sent.time_s, value=value, good=np.isfinite(value))
            (branches if kind == "branch" else inputs)[name] = channel
    return Drive(
        vehicle=vehicle.name,
        name=trip.name,
        branches={name: branches[name] for name in vehicle.branches},
        inputs=inputs,
    )


@dataclass(frozen=True, kw_only=True)
class _Sent:
    """What a vehicle puts into one message on one trip: values by signal, and what each signal is."""

    message: str
    signals: Mapping[str, tuple[str, str]]
    time_s: Array
    values: Mapping[str, Array]


def _sent_messages(
    rng: np.random.Generator, database: VehicleDatabase, vehicle: Vehicle, trip: GroundTruth
) -> Iterator[_Sent]:
    """Values of each message before they are encoded."""
    i = vehicle_currents(vehicle, trip)
    for message_name, signals in _signals_by_message(database, vehicle.branches, trip).items():
        time_s = _frame_times(rng, database, message_name, trip)
        values: dict[str, Array] = {}
        for signal_name, (kind, name) in signals.items():
            if kind == "branch":
                k = vehicle.branches.index(name)
                seen = np.interp(time_s - vehicle.disturbances.delay_s[k], trip.time_s, i[:, k])
                measured = measured_currents(seen[:, None], vehicle.faults)[:, k]
                measured += rng.normal(0.0, vehicle.disturbances.noise_a, size=len(time_s))
                values[signal_name] = measured / _signed_unit(database, name)
            else:
                values[signal_name] = np.interp(time_s, trip.time_s, trip.inputs[name])
        yield _Sent(message=message_name, signals=signals, time_s=time_s, values=values)


def write_vehicle(
    folder: Path,
    database: VehicleDatabase,
    vehicle: Vehicle,
    *,
    calibration: GroundTruth,
    unseen: GroundTruth,
    seed: Sequence[int],
) -> VehicleTruth:
    """Write the logs of one vehicle: ``logs/NAME/drive.log.gz`` and ``unseen/NAME/drive.log.gz``.

    Parameters
    ----------
    folder : Path
        Folder of the fleet.
    database : VehicleDatabase
        DBC and layout.
    vehicle : Vehicle
        Who.
    calibration, unseen : GroundTruth
        Trip to learn from, and trip to test on.
    seed : sequence of int
        Seed of the frames' chance.

    Returns
    -------
    VehicleTruth
        What was put in, with the moments of the true currents on the unseen trip.
    """
    rng = random_stream(Purpose.FRAMES, *seed)
    for kind, trip in (("logs", calibration), ("unseen", unseen)):
        target = folder / kind / vehicle.name
        target.mkdir(parents=True, exist_ok=True)
        write_candump(target / LOG_NAME, vehicle_frames(rng, database, vehicle, trip))
    i = vehicle_currents(vehicle, unseen)
    faults, disturbances = vehicle.faults, vehicle.disturbances

    def by_branch(values: Array) -> dict[str, float]:
        return dict(zip(vehicle.branches, values.tolist(), strict=True))

    return VehicleTruth(
        hardware_drift=float(faults.hardware_drift),
        hardware_offset_a=by_branch(faults.hardware_offset_a),
        drift=by_branch(faults.drift),
        offset_a=by_branch(faults.offset_a),
        delay_s=by_branch(disturbances.delay_s),
        unmeasured_a=disturbances.unmeasured_a,
        unseen_mean_a=by_branch(np.mean(i, axis=0)),
        unseen_mean_square_a2=by_branch(np.mean(i**2, axis=0)),
    )


def vehicle_currents(vehicle: Vehicle, trip: GroundTruth) -> Array:
    """True currents of the vehicle's branches, with what the unmeasured load draws from the first. [A]"""
    i = true_currents(trip.matrix_a(), vehicle.faults)
    i[:, 0] += vehicle.disturbances.unmeasured_a
    return i


def _frame_times(rng: np.random.Generator, database: VehicleDatabase, message_name: str, trip: GroundTruth) -> Array:
    """Instants of one message: its cycle time from a random phase, with jitter. [s]"""
    cycle_s = (database.message(message_name).cycle_time or DEFAULT_CYCLE_MS) / 1e3
    nominal = np.arange(rng.uniform(0.0, cycle_s), trip.time_s[-1], cycle_s)
    jitter = np.clip(rng.normal(0.0, JITTER, size=len(nominal)), -0.4, 0.4) * cycle_s
    return np.maximum(nominal + jitter, 0.0)


def _signals_by_message(
    database: VehicleDatabase, branches: Sequence[str], trip: GroundTruth
) -> Mapping[str, dict[str, tuple[str, str]]]:
    """Signals to fill, by message: ('branch' or 'input', name in the layout)."""
    found: dict[str, dict[str, tuple[str, str]]] = {}
    for name in branches:
        message, signal = split_signal(_current_signal(database.layout.find_branch(name)))
        found.setdefault(message, {})[signal] = ("branch", name)
    for item in database.layout.input:
        if item.name in trip.inputs:
            message, signal = split_signal(item.signal)
            found.setdefault(message, {})[signal] = ("input", item.name)
    return found


def _current_signal(branch: Branch) -> str:
    if branch.signal is None:
        raise FleetError(
            f"branch {branch.name} is a power divided by a voltage; fleets are made from current signals only"
        )
    return branch.signal


def _signed_unit(database: VehicleDatabase, name: str) -> float:
    """Factor from the DBC's value to ampere into the junction."""
    branch = database.layout.find_branch(name)
    _, signal = database.signal(_current_signal(branch))
    return branch.sign * unit_factor(signal, AMPERE, f"branch {name}")
