"""Trials in which all vehicles make one drive, sections IV-A to IV-D of [1]_.

.. [1] "Measurement Correction for Electric Vehicles Based on Compressed Sensing".
"""

from collections.abc import Iterable, Iterator
from functools import partial

import numpy as np

from calibrator.drive import Array
from calibrator.experiments.common_drive import CommonDrive
from calibrator.experiments.common_rows import common_rows, measured_moments
from calibrator.experiments.trial import FleetLaw, Trial, unseen_drive
from calibrator.faults import Faults, slopes_and_intercepts
from calibrator.identification.identify import choose_order, identify
from calibrator.posterior.estimate import FleetPosterior, Moments, estimate_fleet
from calibrator.posterior.fault_prior import FaultPrior
from calibrator.published.evidence import FleetEvidence, collect_evidence, fleet_mean, junction_mean_square
from calibrator.random_streams import Purpose, random_stream

__all__ = ["artificial_trial", "noise_sd_a", "state_space_trial"]


def noise_sd_a(drive: CommonDrive, snr_db: float) -> float:
    """Standard deviation of the artificial simulation error, (26), with the power of i_s,1 on the unity drive. [A]"""
    return float(np.sqrt(10.0 ** (-snr_db / 10.0) * np.mean(drive.unity[:, 0] ** 2)))


def artificial_trial(drive: CommonDrive, law: FleetLaw, seed: int) -> Trial:
    """Trial with the artificial simulation (23).

    Parameters
    ----------
    drive : CommonDrive
        The drive all vehicles make.
    law : FleetLaw
        How the fleet is drawn.
    seed : int
        Of this repetition.

    Returns
    -------
    Trial
        Evidence of N vehicles on the unity drive.
    """
    streams = (Purpose.FAULTS, Purpose.SIMULATION_ERROR)
    simulated, truth = _artificial_fleet(drive, law, law.vehicles, streams=streams, seed=seed)
    return _trial(drive, law, simulated, truth, seed)


def state_space_trial(drive: CommonDrive, law: FleetLaw, seed: int, *, order: int | None = None) -> Trial:
    """Trial with state-space models, trained on 80 % of the drive and simulated on the rest (2).

    Parameters
    ----------
    drive, law, seed
        As in :func:`artificial_trial`; the law's SNR is that of the fleet to learn from.
    order : int or None
        Order of the models; None: chosen on the first vehicle, as identical vehicles have the same dynamics.

    Returns
    -------
    Trial
        Evidence of N vehicles on the unity drive.
    """
    truth = _draw(drive, law, law.vehicles, Purpose.FAULTS, seed)
    start = drive.unity_start
    simulated: list[Array] = []
    for measured in _measured(drive.i_s, truth):
        if order is None:
            order = choose_order(drive.inputs[:start], measured[:start])
        model = identify(drive.inputs[:start], measured[:start], order=order)
        simulated.append(model.simulate(drive.inputs, initial_state=model.x0)[start:])
    return _trial(drive, law, simulated, truth, seed)


def _trial(drive: CommonDrive, law: FleetLaw, simulated: Iterable[Array], truth: Faults, seed: int) -> Trial:
    reference = fleet_mean(simulated)
    evidence = _evidence(simulated, reference, drive, truth)
    return Trial(
        smallest_fault=law.magnitude[0],
        full_scale_a=drive.full_scale_a,
        truth=truth,
        unseen=unseen_drive(drive.unseen.mean(axis=0), np.mean(drive.unseen**2, axis=0), truth),
        posterior=partial(_posterior, drive, evidence, reference.mean(axis=0), truth),
        collect=lambda: evidence,
        training=partial(_training, drive, law, seed),
    )


def _posterior(
    drive: CommonDrive, evidence: FleetEvidence, reference_mean_a: Array, truth: Faults, given: FaultPrior | None
) -> FleetPosterior:
    """Default method on the simulations, and on the moments of what the vehicles measured on the unity drive."""
    measured = measured_moments(drive.unity, truth)
    rows = common_rows(evidence, reference_mean_a, measured, full_scale_a=drive.full_scale_a)
    moments = Moments(mean_a=measured.mean_a, mean_square_a2=measured.mean_square_a2)
    return estimate_fleet(rows, moments, full_scale_a=drive.full_scale_a, given=given)


def _artificial_fleet(
    drive: CommonDrive, law: FleetLaw, vehicles: int, *, streams: tuple[Purpose, Purpose], seed: int
) -> tuple[Iterable[Array], Faults]:
    truth = _draw(drive, law, vehicles, streams[0], seed)
    return _ArtificialSimulation(drive.unity, truth, noise_sd_a(drive, law.snr_db), streams[1], seed), truth


def _training(drive: CommonDrive, law: FleetLaw, seed: int) -> tuple[FleetEvidence, Faults]:
    streams = (Purpose.TRAINING_FAULTS, Purpose.TRAINING_ERROR)
    simulated, truth = _artificial_fleet(drive, law, law.training_vehicles, streams=streams, seed=seed)
    return _evidence(simulated, fleet_mean(simulated), drive, truth), truth


def _draw(drive: CommonDrive, law: FleetLaw, vehicles: int, stream: Purpose, seed: int) -> Faults:
    return law.draw(
        random_stream(stream, seed), vehicles=vehicles, branches=drive.branches, full_scale_a=drive.full_scale_a
    )


def _evidence(simulated: Iterable[Array], reference: Array, drive: CommonDrive, truth: Faults) -> FleetEvidence:
    junction = np.array([junction_mean_square(measured) for measured in _measured(drive.unity, truth)])
    return collect_evidence(simulated, reference, junction)


def _measured(i_s: Array, truth: Faults) -> Iterator[Array]:
    """Measured currents (21) of one vehicle after the other."""
    for slope, intercept in zip(*slopes_and_intercepts(truth), strict=True):
        yield slope * i_s + intercept


class _ArtificialSimulation:
    """Measured currents with white noise (23), made anew in each pass instead of kept in memory."""

    def __init__(self, unity: Array, truth: Faults, noise_a: float, stream: Purpose, seed: int) -> None:
        self._unity, self._truth, self._noise_a = unity, truth, noise_a
        self._stream, self._seed = stream, seed

    def __iter__(self) -> Iterator[Array]:
        for j, measured in enumerate(_measured(self._unity, self._truth)):
            noise = random_stream(self._stream, self._seed, j).standard_normal(measured.shape)
            yield measured + self._noise_a * noise
