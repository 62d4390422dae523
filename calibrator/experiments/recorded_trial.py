"""Trials in which each recorded trip is a vehicle with faults of its own, and in which vehicles differ by their drives.

The ideal currents are those of the trip; faults (11) and (13), an unmeasured load, sensor noise and the steps of the
DBC signals are put on top of them. The model of a vehicle is imperfect here as it is in the car.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from calibrator.artificial.ground_truth import GroundTruth
from calibrator.artificial.random_fleet import draw_faults
from calibrator.drive import Array
from calibrator.drives.align import Samples
from calibrator.experiments.known_law import balanced_law
from calibrator.experiments.recorded_fleet import RecordedFleet
from calibrator.experiments.trial import Trial, UnseenDrive, unseen_drive
from calibrator.faults import Faults, measured_currents, true_currents
from calibrator.identification.vehicle_model import identify_vehicle
from calibrator.posterior.calibration import calibrate_posterior
from calibrator.posterior.estimate import FleetPosterior
from calibrator.posterior.fault_prior import FaultPrior
from calibrator.published.evidence import FleetEvidence, collect_evidence, fleet_mean
from calibrator.random_streams import Purpose, random_stream
from calibrator.summaries.summariser import summarise

__all__ = [
    "NOISE",
    "RecordedCase",
    "VehicleSamples",
    "draw_vehicles",
    "record_vehicles",
    "recorded_trial",
    "trial_of_samples",
]

NOISE = 0.001
"""Standard deviation of the sensor noise, in fractions of full scale. [1]"""


@dataclass(frozen=True, kw_only=True)
class RecordedCase:
    """How vehicles are made of trips.

    Attributes
    ----------
    branches : int
        Number of branches K.
    sparsity : float
        Sparsity level S. [%]
    magnitude : tuple of float
        Drifts [1], offsets in fractions of full scale.
    unmeasured_a : tuple of float
        Mean and standard deviation over vehicles of a load that no branch measures, never negative. [A]
    """

    branches: int = 2
    sparsity: float = 80.0
    magnitude: tuple[float, float] = (0.05, 0.25)
    unmeasured_a: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True, kw_only=True)
class VehicleSamples:
    """What the vehicles of a trial are and record.

    Attributes
    ----------
    truth : Faults
        Of N vehicles.
    unmeasured_a : ndarray of shape (N,)
        Load that no branch measures. [A]
    samples : sequence of N Samples
        One drive of each.
    delay_error_s : ndarray of shape (N, K - 1) or None
        Error of the delays that were taken out, if they were. [s]
    """

    truth: Faults
    unmeasured_a: Array
    samples: Sequence[Samples]
    delay_error_s: Array | None = None


def recorded_trial(fleet: RecordedFleet, case: RecordedCase, seed: int) -> Trial:
    """Trial with samples on the time base of the trips.

    Parameters
    ----------
    fleet : RecordedFleet
        The trips, one per vehicle.
    case : RecordedCase
        What is put on top of them.
    seed : int
        Of this repetition.

    Returns
    -------
    Trial
        Of as many vehicles as there are trips.
    """
    trips = fleet.with_branches(case.branches)
    return trial_of_samples(fleet, case, trips, record_vehicles(fleet, case, trips, seed))


def record_vehicles(
    fleet: RecordedFleet, case: RecordedCase, trips: Sequence[GroundTruth], seed: int
) -> VehicleSamples:
    """Draw vehicles and let each record its trip, sample by sample.

    Parameters
    ----------
    fleet : RecordedFleet
        Says full scale and signals.
    case : RecordedCase
        What is put on top of the trips.
    trips : sequence of N GroundTruth
        Ideal currents of each vehicle.
    seed : int
        Of this repetition.

    Returns
    -------
    VehicleSamples
        Of the N vehicles.
    """
    truth, unmeasured_a = draw_vehicles(case, len(trips), full_scale_a=fleet.full_scale_a, seed=seed)
    resolution_a = fleet.resolution_a(tuple(trips[0].currents_a))
    samples = []
    for j, trip in enumerate(trips):
        i = true_currents(trip.matrix_a(), truth.take(j))
        i[:, 0] += unmeasured_a[j]
        noise_a = NOISE * fleet.full_scale_a * random_stream(Purpose.FRAMES, seed, j).standard_normal(i.shape)
        measured = _in_steps(measured_currents(i, truth.take(j)) + noise_a, resolution_a)
        samples.append(_as_samples(fleet, trip, measured))
    return VehicleSamples(truth=truth, unmeasured_a=unmeasured_a, samples=samples)


def draw_vehicles(case: RecordedCase, vehicles: int, *, full_scale_a: float, seed: int) -> tuple[Faults, Array]:
    """Draw faults and unmeasured loads [A] of N vehicles."""
    truth = draw_faults(
        random_stream(Purpose.FAULTS, seed),
        vehicles=vehicles,
        branches=case.branches,
        sparsity=case.sparsity,
        magnitude=case.magnitude,
        full_scale_a=full_scale_a,
        balanced=True,
    )
    loads = random_stream(Purpose.FRAMES, seed).normal(*case.unmeasured_a, size=vehicles)
    return truth, np.maximum(loads, 0.0)


def trial_of_samples(
    fleet: RecordedFleet, case: RecordedCase, trips: Sequence[GroundTruth], vehicles: VehicleSamples
) -> Trial:
    """Trial of vehicles whose samples are at hand.

    Parameters
    ----------
    fleet : RecordedFleet
        Says period and full scale.
    case : RecordedCase
        How the vehicles were made.
    trips : sequence of N GroundTruth
        Ideal currents of each vehicle; corrections are judged on the trip of the next one.
    vehicles : VehicleSamples
        Of the N vehicles.

    Returns
    -------
    Trial
        Of the N vehicles.
    """
    return Trial(
        smallest_fault=case.magnitude[0],
        full_scale_a=fleet.full_scale_a,
        truth=vehicles.truth,
        unseen=_next_trips(trips, vehicles),
        posterior=partial(_posterior, vehicles.samples, fleet),
        collect=partial(_published_evidence, vehicles.samples, fleet),
        law=balanced_law(case.branches, case.sparsity, case.magnitude),
        delay_error_s=vehicles.delay_error_s,
    )


def _posterior(samples: Sequence[Samples], fleet: RecordedFleet, given: FaultPrior | None) -> FleetPosterior:
    names = fleet.database.layout.fleet_inputs or fleet.database.layout.model_inputs
    summaries = [summarise([drive.with_inputs(names)], period_s=fleet.period_s) for drive in samples]
    return calibrate_posterior(summaries, full_scale_a=fleet.full_scale_a, given=given)


def _published_evidence(samples: Sequence[Samples], fleet: RecordedFleet) -> FleetEvidence:
    """A model per vehicle, simulated on the longest held-out drive (2)."""
    drives = [drive.with_inputs(fleet.database.layout.model_inputs) for drive in samples]
    vehicles = [
        identify_vehicle([drive], period_s=fleet.period_s, vehicle=str(j), names=(str(j),))
        for j, drive in enumerate(drives)
    ]
    unity = max(vehicles, key=lambda vehicle: len(vehicle.held_out_inputs) - vehicle.lead_in)
    simulated = [vehicle.model.simulate(unity.held_out_inputs)[unity.lead_in :] for vehicle in vehicles]
    junction_a2 = np.array([float(np.sum(vehicle.moment_a2)) for vehicle in vehicles])
    return collect_evidence(simulated, fleet_mean(simulated), junction_a2)


def _next_trips(trips: Sequence[GroundTruth], vehicles: VehicleSamples) -> UnseenDrive:
    """Moments of each vehicle's true currents on the trip of the next one."""
    currents = [trips[(j + 1) % len(trips)].matrix_a() for j in range(len(trips))]
    mean, square = (np.stack([np.mean(i_s**power, axis=0) for i_s in currents]) for power in (1, 2))
    return unseen_drive(mean, square, vehicles.truth, unmeasured_a=vehicles.unmeasured_a)


def _in_steps(values: Array, steps: Array) -> Array:
    """Values in steps of their signals; a step of 0 is none."""
    safe = np.where(steps > 0.0, steps, 1.0)
    return np.asarray(np.where(steps > 0.0, np.rint(values / safe) * safe, values))


def _as_samples(fleet: RecordedFleet, trip: GroundTruth, measured: Array) -> Samples:
    inputs = fleet.inputs(trip)
    return Samples(
        branch_names=tuple(trip.currents_a),
        input_names=tuple(inputs),
        time_s=trip.time_s,
        currents_a=measured,
        inputs=np.column_stack(list(inputs.values())),
        valid=np.ones(len(trip), dtype=bool),
        masked={},
    )
