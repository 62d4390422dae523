"""Trials of any number of vehicles with any length of driving, from pieces of recorded trips."""

from dataclasses import replace

from calibrator.artificial.ground_truth import cut_and_rejoin
from calibrator.experiments.recorded_fleet import RecordedFleet
from calibrator.experiments.recorded_trial import RecordedCase, recorded_trial
from calibrator.experiments.trial import Trial
from calibrator.random_streams import Purpose, random_stream

__all__ = ["joined_trial"]


def joined_trial(fleet: RecordedFleet, case: RecordedCase, seed: int, *, vehicles: int, duration_s: float) -> Trial:
    """Trial in which each vehicle drives random pieces of the trips.

    Pieces are cut at standstill and joined anew. Vehicles may share pieces, but not the order of all of them.

    Parameters
    ----------
    fleet : RecordedFleet
        The trips that pieces are taken from.
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
    trips = []
    for j in range(vehicles):
        rng = random_stream(Purpose.CALIBRATION_TRIP, seed, j)
        trips.append(cut_and_rejoin(rng, fleet.trips, duration_s=duration_s, name=f"joined-{j}").part(0, samples))
    return recorded_trial(replace(fleet, trips=tuple(trips)), case, seed)
