"""Trials in which each trip, recorded or of the built-in vehicle, is a vehicle with faults of its own.

The ideal currents are those of the trip. Put on top of them are faults, equations (11) and (13) of the paper, an
unmeasured load, the world of an attack, sensor noise and the steps of the DBC signals. The model that is identified of
a vehicle is imperfect here, as it is for a real car.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from calibrator.artificial.builtin_drives import builtin_trip
from calibrator.artificial.random_fleet import FaultSettings, Purpose, random_stream
from calibrator.artificial.simulate import branch_frame_times
from calibrator.artificial.trips import GroundTruth, balance_branch, choose_branches, read_recorded_trips, with_branches
from calibrator.drive import Array, Channel, Drive, Samples
from calibrator.drives.align import align, evaluate_formula
from calibrator.drives.delays import estimate_delays, without_delays
from calibrator.errors import FleetError
from calibrator.experiments.attacks import WORLDS, Attack, draw_attack
from calibrator.experiments.trial import ComparedMethod, Trial, drawn_distribution
from calibrator.faults import Faults, measured_currents, true_currents
from calibrator.published.evidence import FleetEvidence
from calibrator.published.state_space import evidence_of_models, identify_vehicle
from calibrator.score import UnseenDrive
from calibrator.summaries.moments import DriveSummary
from calibrator.summaries.summariser import summarise_samples
from calibrator.terminal.progress import shown
from ecu_node.database import VehicleDatabase

__all__ = [
    "NOISE", "RecordedCase", "RecordedFleet", "VehicleSamples", "builtin_fleet", "read_fleet", "record_vehicles",
    "recorded_trial",
]  # fmt: skip

NOISE = 0.001
"""Standard deviation of the sensor noise, in fractions of full scale. [1]"""
FEWEST_TRIPS = 4
"""Least number of trips, each of which is a vehicle: fewer are no fleet."""


@dataclass(frozen=True, kw_only=True)
class RecordedFleet:
    """Trips of the ideal vehicle, from which the vehicles of a fleet are made.

    Attributes
    ----------
    name : str
        Where they come from, for the record.
    trips : tuple of GroundTruth
        Trips, all with the same branches and inputs.
    database : VehicleDatabase
        DBC and layout.
    """

    name: str
    trips: tuple[GroundTruth, ...]
    database: VehicleDatabase

    def __post_init__(self) -> None:
        if len(self.trips) < FEWEST_TRIPS:
            raise FleetError(
                f"{self.name}: {len(self.trips)} usable trips, at least {FEWEST_TRIPS} are needed, as each is a "
                "vehicle; import more drives"
            )
        if not self.inputs(self.trips[0]):
            layout = self.database.layout
            raise FleetError(
                f"{layout.path}: {self.name} have none of its model inputs {', '.join(layout.model_inputs)}; they have "
                f"{', '.join(self.trips[0].inputs) or 'no inputs'}; name the layout that these trips are of"
            )

    @property
    def full_scale_a(self) -> float:
        """Full scale of the junction. [A]"""
        return self.database.layout.full_scale_a

    @property
    def period_s(self) -> float:
        """Sample period of the trips. [s]"""
        return self.trips[0].period_s

    @property
    def record(self) -> dict[str, int | float | str]:
        """Origin, number and length of the trips, full scale and noise, for the record of a result."""
        balance = balance_branch(self.database.layout, tuple(self.trips[0].currents_a))
        return {
            "drive": self.name,
            "trips": len(self.trips),
            "driving_minutes": round(sum(map(len, self.trips)) * self.period_s / 60.0, 1),
            "full_scale_a": self.full_scale_a,
            "noise_a": NOISE * self.full_scale_a,
            "balance_branch": f"{balance}, in every trip minus the sum of the others, so it depends on their sensors",
        }

    def take(self, trips: int, *, duration_s: float) -> "RecordedFleet":
        """Return the fleet with only the first ``trips`` trips, each cut to its first ``duration_s``."""
        samples = int(duration_s / self.period_s)
        taken = tuple(trip.part(0, samples) for trip in self.trips[:trips])
        return replace(self, name=f"the first {duration_s:g} s of {len(taken)} of {self.name}", trips=taken)

    def with_branches(self, count: int) -> tuple[GroundTruth, ...]:
        """Return the trips with the first ``count`` branches of the layout that they have; the rest are dropped.

        The balance branch becomes minus the sum of the other kept ones, equation (19) of the paper.

        Raises
        ------
        FleetError
            If the count is below 2, or the trips have less than ``count`` branches of the layout.
        """
        names = choose_branches(self.database.layout, tuple(self.trips[0].currents_a), count)
        return tuple(with_branches(trip, names, balance_branch(self.database.layout, names)) for trip in self.trips)

    def inputs(self, trip: GroundTruth) -> Mapping[str, Array]:
        """Return a trip's inputs of vehicle model and fleet model by name, also derived ones, each of shape (T,)."""
        layout, values = self.database.layout, dict(trip.inputs)
        for item in layout.derived:
            if layout.base_inputs([item.name]) <= values.keys():
                values[item.name] = evaluate_formula(item.formula, values)
        wanted = dict.fromkeys([*layout.model_inputs, *layout.fleet_inputs])
        return {name: values[name] for name in wanted if name in values}


def read_fleet(store: Path, database: VehicleDatabase) -> RecordedFleet:
    """Read the trips of a drive store; drives without good samples of some channel are left out.

    Parameters
    ----------
    store : Path
        A drive store.
    database : VehicleDatabase
        DBC and the layout that the store was made with.

    Raises
    ------
    UserError
        If the store cannot be read or has too few usable drives.
    """
    trips, unusable = read_recorded_trips(store, database.layout)
    name = f"{len(trips)} drives of {store.name}" + (f" ({len(unusable)} left out)" if unusable else "")
    return RecordedFleet(name=name, trips=tuple(trips), database=database)


def builtin_fleet(database: VehicleDatabase, *, trips: int, duration_s: float) -> RecordedFleet:
    """Make trips of the built-in vehicle, in place of recordings; the layout must name branches and inputs as it does.

    Parameters
    ----------
    database : VehicleDatabase
        DBC and layout.
    trips : int
        Number of trips.
    duration_s : float
        Least duration of each. [s]

    Raises
    ------
    FleetError
        If there are less than four trips, they have no model input of the layout, or fastsim is not installed.
    """
    made = tuple(
        builtin_trip(random_stream(Purpose.CALIBRATION_TRIP, 0, k), duration_s=duration_s, name=f"builtin-{k}")
        for k in shown(range(trips), "make trips", trips, "trips")
    )
    return RecordedFleet(name=f"{trips} built-in trips, no recordings", trips=made, database=database)


@dataclass(frozen=True, kw_only=True)
class RecordedCase(FaultSettings):
    """How vehicles are made from trips, besides how their faults are drawn.

    Attributes
    ----------
    branches : int
        Number of branches K.
    unmeasured_a : tuple of float
        Mean and standard deviation over vehicles of a load that no branch measures, never negative. [A]
    world : str
        World that affects some vehicles, of :data:`~calibrator.experiments.attacks.WORLDS`; empty: none.
    own_prior : ComparedMethod or None
        Method that first learns its prior from this fleet; the faults of the trial are then drawn from that prior, so
        that the method's assumption is right. None: faults are drawn as the settings say.
    vehicles, minutes : int or None, float or None
        Number of vehicles and length of their drives, each of which starts at a random instant of the trips and goes
        on from trip to trip. Without minutes each trip is a vehicle; without vehicles there are as many as trips.
    delay_max_s : float or None
        Largest delay: each branch is late by a uniform delay of 0 to this, and is sampled at instants of its own. None:
        all branches are sampled at the same instants, without delay. [s]
    delays_left_in : bool
        Whether these delays stay; else they are estimated and taken out.
    """

    branches: int = 2
    sparsity: float = 80.0
    unmeasured_a: tuple[float, float] = (0.0, 0.0)
    balanced: bool = True
    world: str = ""
    own_prior: ComparedMethod | None = None
    vehicles: int | None = None
    minutes: float | None = None
    delay_max_s: float | None = None
    delays_left_in: bool = False

    def __post_init__(self) -> None:
        if self.vehicles is not None and self.minutes is None:
            raise FleetError(f"a case with {self.vehicles} vehicles, and each trip is one: give minutes as well")

    @property
    def faults(self) -> FaultSettings:
        """How the faults are drawn: as this case says, with the magnitudes of its world if that has some."""
        own = WORLDS[self.world].magnitude if self.world else None
        return self if own is None else replace(self, magnitude=own)


@dataclass(frozen=True, kw_only=True)
class VehicleSamples:
    """Vehicles of a trial: their faults, and the samples that they record.

    Attributes
    ----------
    truth : Faults
        Faults of N vehicles.
    unmeasured_a : ndarray of shape (N,)
        Load of each vehicle that no branch measures. [A]
    attack : Attack or None
        World that affects some of them.
    samples : sequence of N Samples
        One drive of each.
    delay_error_s : ndarray of shape (N, K - 1) or None
        Estimated minus true delay of each branch but the first, to which delays are relative; None: not estimated. [s]
    """

    truth: Faults
    unmeasured_a: Array
    attack: Attack | None
    samples: Sequence[Samples] = ()
    delay_error_s: Array | None = None

    def currents_a(self, vehicle: int, own: Array, following: Array | None = None) -> tuple[Array, Array]:
        """Return true and measured currents of a vehicle, without noise, each of shape (T, K). [A]

        Parameters
        ----------
        vehicle : int
            Its number.
        own : ndarray of shape (T', K)
            Ideal currents of the trip that it records. [A]
        following : ndarray of shape (T, K) or None
            Ideal currents of the trip on which corrections are judged; None: return those of its own trip. [A]
        """
        faults, attack = self.truth.take(vehicle), self.attack

        def linear(i_s: Array, *, unseen: bool) -> tuple[Array, Array]:
            i = true_currents(i_s, faults)
            i[:, 0] += self.unmeasured_a[vehicle]
            i = i if attack is None else attack.true_a(vehicle, i, unseen=unseen)
            return i, measured_currents(i, faults)

        i, i_m = linear(own, unseen=False)
        peak_a = np.abs(i_m).max(axis=0)
        if following is not None:
            i, i_m = linear(following, unseen=True)
        if attack is not None:
            i_m = attack.measured_a(vehicle, i_m, unseen=following is not None, peak_a=peak_a)
        return i, i_m


def recorded_trial(fleet: RecordedFleet, case: RecordedCase, seed: int) -> Trial:
    """Make the trial of one vehicle per trip, or of as many as the case says; the same seed gives the same trial.

    Corrections are judged on the trip of the next vehicle.
    """
    if case.minutes is not None:
        fleet = replace(fleet, trips=_runs(fleet, case.minutes, case.vehicles or len(fleet.trips), seed))
    trips, truth, N = fleet.with_branches(case.branches), None, len(fleet.trips)
    drawn = drawn_distribution(case.faults, case.branches)
    if case.own_prior is not None:
        learnt = case.own_prior.estimate(recorded_trial(fleet, replace(case, own_prior=None), seed)).learnt
        if learnt is None:
            raise FleetError(f"method '{case.own_prior.name}': learns no prior that faults could be drawn from")
        drawn, truth = learnt, learnt.draw(random_stream(Purpose.TRAINING_FAULTS, seed), N, fleet.full_scale_a)
    vehicles = record_vehicles(fleet, case, trips, seed, truth=truth)
    attack, ideal = vehicles.attack, [trip.matrix_a() for trip in trips]
    return Trial(
        smallest_fault=case.faults.magnitude[0],
        full_scale_a=fleet.full_scale_a,
        truth=vehicles.truth,
        unseen=UnseenDrive.of_samples([vehicles.currents_a(j, ideal[j], ideal[(j + 1) % N]) for j in range(N)]),
        record=partial(_summaries, vehicles.samples, fleet),
        collect=partial(_published_evidence, vehicles.samples, fleet),
        drawn_from=drawn,
        delay_error_s=vehicles.delay_error_s,
        attacked=None if attack is None else attack.has,
        causes=() if attack is None else attack.world.causes,
    )


def _runs(fleet: RecordedFleet, minutes: float, vehicles: int, seed: int) -> tuple[GroundTruth, ...]:
    """Make a drive of ``minutes`` for each vehicle, from a random start on; vehicles may share parts of trips."""
    trips, samples, runs = fleet.trips, int(60.0 * minutes / fleet.period_s), []
    for number in range(vehicles):
        rng = random_stream(Purpose.START_OF_RUN, seed, number)
        k = int(rng.integers(len(trips)))
        parts = [trips[k].part(int(rng.integers(len(trips[k]))), len(trips[k]))]
        while sum(map(len, parts)) < samples:
            k = (k + 1) % len(trips)
            parts.append(trips[k])
        runs.append(GroundTruth.joined(parts, f"run-{number}").part(0, samples))
    return tuple(runs)


def record_vehicles(
    fleet: RecordedFleet, case: RecordedCase, trips: Sequence[GroundTruth], seed: int, *, truth: Faults | None = None
) -> VehicleSamples:
    """Draw vehicles and let each record its trip.

    Parameters
    ----------
    fleet : RecordedFleet
        Gives full scale and signals.
    case : RecordedCase
        What is put on top of the trips.
    trips : sequence of N GroundTruth
        Ideal currents of each vehicle.
    seed : int
        Seed of this repetition.
    truth : Faults or None
        Faults of the vehicles; None: drawn as the case says.
    """
    N, full_scale_a, rng = len(trips), fleet.full_scale_a, random_stream(Purpose.FAULTS, seed)
    faults = truth or case.faults.draw(rng, vehicles=N, branches=case.branches, full_scale_a=full_scale_a)
    attack = draw_attack(case.world, N, full_scale_a=full_scale_a, seed=seed) if case.world else None
    vehicles = VehicleSamples(
        truth=faults if attack is None else attack.truth(faults),
        unmeasured_a=np.maximum(random_stream(Purpose.FRAMES, seed).normal(*case.unmeasured_a, size=N), 0.0),
        attack=attack,
    )
    measured = [
        (trip, vehicles.currents_a(j, trip.matrix_a())[1], random_stream(Purpose.FRAMES, seed, j))
        for j, trip in enumerate(trips)
    ]
    if case.delay_max_s is None:
        return replace(vehicles, samples=[_sampled(fleet, *each) for each in measured])
    samples, errors_s = zip(*(_delayed(fleet, case, *each) for each in measured), strict=True)
    return replace(vehicles, samples=samples, delay_error_s=None if case.delays_left_in else np.stack(errors_s))


def _sampled(fleet: RecordedFleet, trip: GroundTruth, i_m: Array, rng: np.random.Generator) -> Samples:
    """Return what a vehicle with measured currents i_m (T, K) records at the instants of its trip."""
    names, inputs = tuple(trip.currents_a), fleet.inputs(trip)
    return Samples(
        branch_names=names,
        input_names=tuple(inputs),
        time_s=trip.time_s,
        currents_a=_shown_a(fleet, names, i_m, rng),
        inputs=np.column_stack(list(inputs.values())),
        valid=np.ones(len(trip), dtype=bool),
    )


def _delayed(
    fleet: RecordedFleet, case: RecordedCase, trip: GroundTruth, i_m: Array, rng: np.random.Generator
) -> tuple[Samples, Array]:
    """Return aligned samples of a vehicle whose branches are late, and the errors of its delays, (K - 1,). [s]

    The errors are a row of :attr:`VehicleSamples.delay_error_s`.
    """
    names, layout = tuple(trip.currents_a), fleet.database.layout
    delay_s = rng.uniform(0.0, case.delay_max_s or 0.0, size=len(names))
    inputs = {name: _channel(trip.time_s, x) for name, x in trip.inputs.items()}
    branches: dict[str, Channel] = {}
    found_s: Array = np.zeros(len(names))
    for k, name in enumerate(names):
        time_s = branch_frame_times(rng, fleet.database, name, trip)
        late_a = np.interp(time_s - delay_s[k], trip.time_s, i_m[:, k])
        branches[name] = _channel(time_s, _shown_a(fleet, (name,), late_a[:, None], rng)[:, 0])
    drive = Drive(vehicle=trip.name, name=trip.name, branches=branches, inputs=inputs)
    if not case.delays_left_in:
        delays = estimate_delays([drive], names)
        drive, found_s = without_delays(drive, delays.by_branch()), delays.delay_s
    return align(drive, layout, names, inputs=tuple(fleet.inputs(trip))), (found_s - delay_s + delay_s[0])[1:]


def _channel(time_s: Array, value: Array) -> Channel:
    return Channel(time_s=time_s, value=value, good=np.isfinite(value))


def _shown_a(fleet: RecordedFleet, names: Sequence[str], i_m: Array, rng: np.random.Generator) -> Array:
    """Return measured currents (T, K) with sensor noise, rounded to the steps of their signals in the DBC. [A]"""
    seen = i_m + NOISE * fleet.full_scale_a * rng.standard_normal(i_m.shape)
    steps_a = np.array([fleet.database.current_step_a(name) for name in names])  # 0: no step
    safe = np.where(steps_a > 0.0, steps_a, 1.0)
    return np.where(steps_a > 0.0, np.rint(seen / safe) * safe, seen)


def _summaries(samples: Sequence[Samples], fleet: RecordedFleet) -> list[DriveSummary]:
    names = fleet.database.layout.fleet_inputs or fleet.database.layout.model_inputs
    return [summarise_samples([drive.with_inputs(names)], period_s=fleet.period_s) for drive in samples]


def _published_evidence(samples: Sequence[Samples], fleet: RecordedFleet) -> FleetEvidence:
    """Identify a state-space model of each vehicle; return the evidence of simulations on the longest held-out drive.

    The models are those of equation (2) of the paper.
    """
    vehicles = [
        identify_vehicle(
            [drive.with_inputs(fleet.database.layout.model_inputs)],
            period_s=fleet.period_s,
            vehicle=str(j),
            names=(str(j),),
        )
        for j, drive in enumerate(samples)
    ]
    return evidence_of_models(vehicles, [True] * len(vehicles))[0]
