"""Trials in which each recorded trip is a vehicle with faults of its own, and in which vehicles differ by their drives.

The ideal currents are those of the trip; faults (11) and (13), an unmeasured load, the world of an attack, sensor noise
and the steps of the DBC signals are put on top of them. The model of a vehicle is imperfect here as it is in the car.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from calibrator.artificial.ground_truth import GroundTruth
from calibrator.artificial.random_fleet import draw_faults
from calibrator.drive import Array
from calibrator.drives.align import Samples
from calibrator.estimator.published_fleet import identify_vehicle
from calibrator.experiments.attacks import WORLDS, Attack, draw_attack
from calibrator.experiments.methods import Method
from calibrator.experiments.recorded_fleet import RecordedFleet
from calibrator.experiments.trial import Trial, UnseenDrive, drawn_distribution
from calibrator.faults import Faults, measured_currents, true_currents
from calibrator.published.evidence import FleetEvidence, collect_evidence, fleet_mean
from calibrator.random_streams import Purpose, random_stream
from calibrator.summaries.moments import DriveSummary
from calibrator.summaries.summariser import summarise

__all__ = [
    "NOISE",
    "RecordedCase",
    "VehicleSamples",
    "draw_vehicles",
    "joined_trial",
    "own_prior_trial",
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
    balanced : bool
        Whether half of the vehicles have no hardware fault; else any vehicle may have one.
    world : str
        What else befalls some vehicles, of :data:`~calibrator.experiments.attacks.WORLDS`; empty: nothing.
    """

    branches: int = 2
    sparsity: float = 80.0
    magnitude: tuple[float, float] = (0.05, 0.25)
    unmeasured_a: tuple[float, float] = (0.0, 0.0)
    balanced: bool = True
    world: str = ""

    @property
    def magnitudes(self) -> tuple[float, float]:
        """Range of the faults' magnitudes, which a world may change."""
        own = WORLDS[self.world].magnitude if self.world else None
        return self.magnitude if own is None else own


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
    attack : Attack or None
        What befalls some of them.
    """

    truth: Faults
    unmeasured_a: Array
    samples: Sequence[Samples]
    delay_error_s: Array | None = None
    attack: Attack | None = None

    def currents_a(self, vehicle: int, own: Array, following: Array | None = None) -> tuple[Array, Array]:
        """True and measured currents of a vehicle, without noise, each of shape (T, K). [A]

        Parameters
        ----------
        vehicle : int
            Its number.
        own : ndarray of shape (T', K)
            Ideal currents of its own trip. [A]
        following : ndarray of shape (T, K) or None
            Ideal currents of the trip on which corrections are judged; None: its own trip is wanted. [A]
        """
        i, i_m = self._linear(vehicle, own, unseen=False)
        peak_a = np.abs(i_m).max(axis=0)
        if following is not None:
            i, i_m = self._linear(vehicle, following, unseen=True)
        if self.attack is None:
            return i, i_m
        return i, self.attack.measured_a(vehicle, i_m, unseen=following is not None, peak_a=peak_a)

    def _linear(self, vehicle: int, i_s: Array, *, unseen: bool) -> tuple[Array, Array]:
        """True currents, and those that linear sensors measure."""
        faults = self.truth.take(vehicle)
        i = true_currents(i_s, faults)
        i[:, 0] += self.unmeasured_a[vehicle]
        if self.attack is not None:
            i = self.attack.true_a(vehicle, i, unseen=unseen)
        return i, measured_currents(i, faults)


def recorded_trial(fleet: RecordedFleet, case: RecordedCase, seed: int, *, truth: Faults | None = None) -> Trial:
    """Trial with samples on the time base of the trips.

    Parameters
    ----------
    fleet : RecordedFleet
        The trips, one per vehicle.
    case : RecordedCase
        What is put on top of them.
    seed : int
        Of this repetition.
    truth : Faults or None
        Faults of the vehicles; None: drawn as the case says.

    Returns
    -------
    Trial
        Of as many vehicles as there are trips.
    """
    trips = fleet.with_branches(case.branches)
    return trial_of_samples(fleet, case, trips, record_vehicles(fleet, case, trips, seed, truth=truth))


def joined_trial(fleet: RecordedFleet, case: RecordedCase, seed: int, *, vehicles: int, duration_s: float) -> Trial:
    """Trial in which each vehicle starts somewhere in a random trip, and goes on with the trips after it.

    So a short drive is of one trip, with its own weather and traffic, as it is with a real vehicle. Vehicles may share
    trips, but hardly ever their start.

    Parameters
    ----------
    fleet : RecordedFleet
        The trips; after the last comes the first.
    case : RecordedCase
        What is put on top of them.
    seed : int
        Of this repetition.
    vehicles : int
        Number of vehicles N.
    duration_s : float
        Driving of each vehicle. [s]

    Returns
    -------
    Trial
        Of N vehicles.
    """
    samples = int(duration_s / fleet.period_s)
    streams = (random_stream(Purpose.CALIBRATION_TRIP, seed, j) for j in range(vehicles))
    trips = tuple(_run(rng, fleet.trips, samples, f"run-{j}") for j, rng in enumerate(streams))
    return recorded_trial(replace(fleet, trips=trips), case, seed)


def own_prior_trial(fleet: RecordedFleet, case: RecordedCase, seed: int, *, method: Method) -> Trial:
    """Trial whose faults are drawn from the prior that a method learns of another fleet: the prior is then right.

    Parameters
    ----------
    fleet, seed
        As for :func:`recorded_trial`.
    case : RecordedCase
        Of the fleet to learn from.
    method : Method
        One that can draw from its prior.

    Returns
    -------
    Trial
        On the same trips.
    """
    redraw = method.estimate(recorded_trial(fleet, case, seed)).redraw
    assert redraw is not None
    return recorded_trial(
        fleet, case, seed, truth=redraw(random_stream(Purpose.TRAINING_FAULTS, seed), len(fleet.trips))
    )


def _run(rng: np.random.Generator, trips: Sequence[GroundTruth], samples: int, name: str) -> GroundTruth:
    """So many samples from a random start on."""
    k = int(rng.integers(len(trips)))
    parts = [trips[k].part(int(rng.integers(len(trips[k]))), len(trips[k]))]
    while sum(map(len, parts)) < samples:
        k = (k + 1) % len(trips)
        parts.append(trips[k])

    common = [key for key in trips[0].inputs if all(key in trip.inputs for trip in trips)]
    whole = GroundTruth(
        name=name,
        period_s=trips[0].period_s,
        currents_a={key: np.concatenate([part.currents_a[key] for part in parts]) for key in trips[0].currents_a},
        inputs={key: np.concatenate([part.inputs[key] for part in parts]) for key in common},
    )
    return whole.part(0, samples)


def record_vehicles(
    fleet: RecordedFleet, case: RecordedCase, trips: Sequence[GroundTruth], seed: int, *, truth: Faults | None = None
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
    truth : Faults or None
        Faults of the vehicles; None: drawn as the case says.

    Returns
    -------
    VehicleSamples
        Of the N vehicles.
    """
    N, full_scale_a = len(trips), fleet.full_scale_a
    drawn, unmeasured_a = draw_vehicles(case, N, full_scale_a=full_scale_a, seed=seed)
    faults = drawn if truth is None else truth
    attack = draw_attack(case.world, N, full_scale_a=full_scale_a, seed=seed) if case.world else None
    vehicles = VehicleSamples(
        truth=faults if attack is None else attack.truth(faults), unmeasured_a=unmeasured_a, samples=(), attack=attack
    )
    resolution_a = fleet.resolution_a(tuple(trips[0].currents_a))
    samples = []
    for j, trip in enumerate(trips):
        _, i_m = vehicles.currents_a(j, trip.matrix_a())
        noise_a = NOISE * full_scale_a * random_stream(Purpose.FRAMES, seed, j).standard_normal(i_m.shape)
        samples.append(_as_samples(fleet, trip, _in_steps(i_m + noise_a, resolution_a)))
    return replace(vehicles, samples=samples)


def draw_vehicles(case: RecordedCase, vehicles: int, *, full_scale_a: float, seed: int) -> tuple[Faults, Array]:
    """Draw faults and unmeasured loads [A] of N vehicles."""
    truth = draw_faults(
        random_stream(Purpose.FAULTS, seed),
        vehicles=vehicles,
        branches=case.branches,
        sparsity=case.sparsity,
        magnitude=case.magnitudes,
        full_scale_a=full_scale_a,
        balanced=case.balanced,
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
    N, attack = len(trips), vehicles.attack
    ideal = [trip.matrix_a() for trip in trips]
    unseen = [vehicles.currents_a(j, ideal[j], ideal[(j + 1) % N]) for j in range(N)]
    return Trial(
        smallest_fault=case.magnitudes[0],
        full_scale_a=fleet.full_scale_a,
        truth=vehicles.truth,
        unseen=UnseenDrive.of_samples(unseen),
        record=partial(_summaries, vehicles.samples, fleet),
        collect=partial(_published_evidence, vehicles.samples, fleet),
        drawn_from=drawn_distribution(case.branches, case.sparsity, case.magnitudes, balanced=case.balanced),
        delay_error_s=vehicles.delay_error_s,
        attacked=None if attack is None else attack.has,
        causes=() if attack is None else attack.world.causes,
    )


def _summaries(samples: Sequence[Samples], fleet: RecordedFleet) -> list[DriveSummary]:
    names = fleet.database.layout.fleet_inputs or fleet.database.layout.model_inputs
    return [summarise([drive.with_inputs(names)], period_s=fleet.period_s) for drive in samples]


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
