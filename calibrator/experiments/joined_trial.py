"""Trials of any number of vehicles with any length of driving, from runs of recorded trips."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from calibrator.artificial.ground_truth import GroundTruth
from calibrator.experiments.recorded_fleet import RecordedFleet
from calibrator.experiments.recorded_trial import RecordedCase, recorded_trial
from calibrator.experiments.trial import Trial
from calibrator.random_streams import Purpose, random_stream

__all__ = ["joined_trial", "joined_trips"]


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
    trips = joined_trips(fleet.trips, Purpose.CALIBRATION_TRIP, seed, vehicles=vehicles, duration_s=duration_s)
    return recorded_trial(replace(fleet, trips=tuple(trips)), case, seed)


def joined_trips(
    trips: Sequence[GroundTruth], purpose: Purpose, seed: int, *, vehicles: int, duration_s: float
) -> list[GroundTruth]:
    """Trips of many vehicles, each from a random start on.

    Parameters
    ----------
    trips : sequence of GroundTruth
        The recorded ones; after the last comes the first.
    purpose : Purpose
        What they are for.
    seed : int
        Of this repetition.
    vehicles : int
        Number of vehicles N.
    duration_s : float
        Driving of each. [s]

    Returns
    -------
    list of N GroundTruth
        All of this duration.
    """
    samples = int(duration_s / trips[0].period_s)
    return [_run(random_stream(purpose, seed, j), trips, samples, f"run-{j}") for j in range(vehicles)]


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
