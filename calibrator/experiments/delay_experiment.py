"""Delays between the branches: how well they are found, and what they cost if they are left in.

The branches of each vehicle are seen later than they flow, in frames of their own at 100 Hz.
"""

from collections.abc import Sequence
from functools import partial

import numpy as np

from calibrator.artificial.ground_truth import GroundTruth
from calibrator.artificial.vehicle import Disturbances, Vehicle, vehicle_drive
from calibrator.drive import Array
from calibrator.drives.align import Samples, align, choose_inputs
from calibrator.drives.delays import estimate_delays, without_delays
from calibrator.experiments.judging import Effort, Setting
from calibrator.experiments.methods import LEFT_IN, PERFECT, POSTERIOR, Method
from calibrator.experiments.recorded_experiments import recorded_result
from calibrator.experiments.recorded_fleet import RecordedFleet, all_inputs
from calibrator.experiments.recorded_trial import NOISE, RecordedCase, VehicleSamples, draw_vehicles, trial_of_samples
from calibrator.experiments.result import ExperimentResult
from calibrator.experiments.trial import Trial
from calibrator.random_streams import Purpose, random_stream

__all__ = ["delay_experiment", "delayed_trial"]

DELAYS_MS = (0.0, 100.0, 200.0, 300.0)
METHODS: Sequence[Method] = (PERFECT, POSTERIOR)
DEFAULT_EFFORT = Effort()


def delay_experiment(
    *,
    fleet: RecordedFleet,
    delays_ms: Sequence[float] = DELAYS_MS,
    methods: Sequence[Method] = METHODS,
    effort: Effort = DEFAULT_EFFORT,
) -> ExperimentResult:
    """Delays between the branches, through asynchronous frames at 100 Hz; K = 2, S = 80.

    Parameters
    ----------
    fleet : RecordedFleet
        The trips, one per vehicle.
    delays_ms : sequence of float
        Each branch is late by a uniform delay of 0 to this. [ms]
    methods : sequence of Method
        What to compare, with delays estimated and taken out; the default is also run with delays left in.
    effort : Effort
        Repetitions, seed, processes.

    Returns
    -------
    ExperimentResult
        Rows by delay and method.
    """
    settings = []
    for x in delays_ms:
        trial = partial(delayed_trial, fleet, RecordedCase(), delay_max_s=x / 1e3)
        settings.append(Setting(x=x, make_trial=partial(trial, compensate=True)))
        settings.append(Setting(x=x, make_trial=partial(trial, compensate=False), methods=(LEFT_IN,)))
    title, labels = "Delays between the branches", ("largest delay [ms]", "")
    return recorded_result(fleet, settings, methods, effort, name="delay", title=title, labels=labels)


def delayed_trial(
    fleet: RecordedFleet, case: RecordedCase, seed: int, *, delay_max_s: float, compensate: bool
) -> Trial:
    """Trial through asynchronous frames with delays.

    Parameters
    ----------
    fleet : RecordedFleet
        The trips, one per vehicle.
    case : RecordedCase
        What is put on top of them.
    seed : int
        Of this repetition.
    delay_max_s : float
        Delays are uniform from 0 to this, per branch. [s]
    compensate : bool
        Whether delays are estimated and taken out.

    Returns
    -------
    Trial
        Of as many vehicles as there are trips.
    """
    trips = fleet.with_branches(case.branches)
    truth, unmeasured_a = draw_vehicles(case, len(trips), full_scale_a=fleet.full_scale_a, seed=seed)
    samples: list[Samples] = []
    errors: list[Array] = []
    for j, trip in enumerate(trips):
        rng = random_stream(Purpose.FRAMES, seed, j)
        disturbances = Disturbances(
            noise_a=NOISE * fleet.full_scale_a,
            delay_s=rng.uniform(0.0, 1.0, size=case.branches) * delay_max_s,
            unmeasured_a=float(unmeasured_a[j]),
        )
        vehicle = Vehicle(
            name=trip.name, branches=tuple(trip.currents_a), faults=truth.take(j), disturbances=disturbances
        )
        aligned, error_s = _record(rng, fleet, vehicle, trip, compensate=compensate)
        samples.append(aligned)
        errors.append(error_s)
    vehicles = VehicleSamples(
        truth=truth,
        unmeasured_a=unmeasured_a,
        samples=samples,
        delay_error_s=np.stack(errors) if compensate else None,
    )
    return trial_of_samples(fleet, case, trips, vehicles)


def _record(
    rng: np.random.Generator, fleet: RecordedFleet, vehicle: Vehicle, trip: GroundTruth, *, compensate: bool
) -> tuple[Samples, Array]:
    """Aligned samples of one vehicle, and the error of its delays, shape (K - 1,). [s]"""
    drive = vehicle_drive(rng, fleet.database, vehicle, trip)
    delay_s = vehicle.disturbances.delay_s
    found_s: Array = np.zeros(len(delay_s))
    if compensate:
        delays = estimate_delays([drive], vehicle.branches)
        drive = without_delays(drive, delays.by_branch())
        found_s = delays.delay_s
    layout = fleet.database.layout
    inputs, _ = choose_inputs(layout, tuple(drive.inputs), names=all_inputs(layout))
    return align(drive, layout, vehicle.branches, inputs=inputs), (found_s - delay_s + delay_s[0])[1:]
