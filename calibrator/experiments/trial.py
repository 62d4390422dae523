"""One trial: a random fleet with known faults, and what its simulations say; sections IV-B to IV-D of [1]_.

.. [1] "Measurement Correction for Electric Vehicles Based on Compressed Sensing".
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from calibrator.artificial.random_fleet import draw_faults
from calibrator.drive import Array
from calibrator.experiments.common_drive import CommonDrive
from calibrator.faults import Faults, slopes_and_intercepts
from calibrator.identification.identify import choose_order, identify
from calibrator.published.evidence import FleetEvidence, collect_evidence, fleet_mean, junction_mean_square
from calibrator.random_streams import Purpose, random_stream

__all__ = ["FleetLaw", "Trial", "artificial_trial", "noise_sd_a", "state_space_trial"]

TRAINING_VEHICLES = 3000
"""Size of the artificial fleet that trees learn from, section V-B."""


@dataclass(frozen=True, kw_only=True)
class FleetLaw:
    """How the fleets of an experiment are drawn, section IV-B of [1]_.

    Attributes
    ----------
    vehicles : int
        Fleet size N, a multiple of 4 for a symmetric fleet.
    training_vehicles : int
        Size of the artificial fleet to learn from.
    sparsity : float
        Sparsity level S. [%]
    magnitude : tuple of float
        a, b: drifts [1], offsets in fractions of full scale.
    snr_db : float
        Of the artificial simulation (26). [dB]
    balanced, symmetric : bool
        See :func:`~calibrator.artificial.random_fleet.draw_faults`.
    """

    vehicles: int = 1000
    training_vehicles: int = TRAINING_VEHICLES
    sparsity: float = 60.0
    magnitude: tuple[float, float] = (0.05, 0.25)
    snr_db: float = 20.0
    balanced: bool = True
    symmetric: bool = True

    def draw(self, rng: np.random.Generator, drive: CommonDrive, vehicles: int) -> Faults:
        """Draw the faults of a fleet of this law."""
        return draw_faults(
            rng,
            vehicles=vehicles,
            branches=drive.branches,
            sparsity=self.sparsity,
            magnitude=self.magnitude,
            full_scale_a=drive.full_scale_a,
            balanced=self.balanced,
            symmetric=self.symmetric,
        )


@dataclass(frozen=True, kw_only=True)
class Trial:
    """What a method is given, and the truth it is judged by.

    Attributes
    ----------
    law : FleetLaw
        How the fleet was drawn.
    full_scale_a : float
        Full scale of the junction. [A]
    evidence : FleetEvidence
        Of N vehicles.
    truth : Faults
        Of the same; only the perfect classifier may look.
    training : callable
        Makes the evidence and truth of an artificial fleet to learn from.
    """

    law: FleetLaw
    full_scale_a: float
    evidence: FleetEvidence
    truth: Faults
    training: Callable[[], tuple[FleetEvidence, Faults]]


def noise_sd_a(drive: CommonDrive, snr_db: float) -> float:
    """Standard deviation of the artificial simulation error, (26), with the power of i_s,1 on the unity drive. [A]"""
    return float(np.sqrt(10.0 ** (-snr_db / 10.0) * np.mean(drive.unity[:, 0] ** 2)))


def artificial_trial(drive: CommonDrive, law: FleetLaw, *, seed: int) -> Trial:
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
    evidence, truth = _artificial_fleet(
        drive, law, law.vehicles, streams=(Purpose.FAULTS, Purpose.SIMULATION_ERROR), seed=seed
    )
    return _trial(drive, law, evidence, truth, seed)


def state_space_trial(drive: CommonDrive, law: FleetLaw, *, seed: int, order: int | None = None) -> Trial:
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
    truth = law.draw(random_stream(Purpose.FAULTS, seed), drive, law.vehicles)
    start = drive.unity_start
    simulated: list[Array] = []
    for measured in _measured(drive.i_s, truth):
        if order is None:
            order = choose_order(drive.inputs[:start], measured[:start])
        model = identify(drive.inputs[:start], measured[:start], order=order)
        simulated.append(model.simulate(drive.inputs, initial_state=model.x0)[start:])
    evidence = _evidence(simulated, drive, truth)
    return _trial(drive, law, evidence, truth, seed)


def _trial(drive: CommonDrive, law: FleetLaw, evidence: FleetEvidence, truth: Faults, seed: int) -> Trial:
    def training() -> tuple[FleetEvidence, Faults]:
        return _artificial_fleet(
            drive, law, law.training_vehicles, streams=(Purpose.TRAINING_FAULTS, Purpose.TRAINING_ERROR), seed=seed
        )

    return Trial(law=law, full_scale_a=drive.full_scale_a, evidence=evidence, truth=truth, training=training)


def _artificial_fleet(
    drive: CommonDrive, law: FleetLaw, vehicles: int, *, streams: tuple[Purpose, Purpose], seed: int
) -> tuple[FleetEvidence, Faults]:
    truth = law.draw(random_stream(streams[0], seed), drive, vehicles)
    simulated = _ArtificialSimulation(drive.unity, truth, noise_sd_a(drive, law.snr_db), streams[1], seed)
    return _evidence(simulated, drive, truth), truth


def _evidence(simulated: Iterable[Array], drive: CommonDrive, truth: Faults) -> FleetEvidence:
    junction = np.array([junction_mean_square(measured) for measured in _measured(drive.unity, truth)])
    return collect_evidence(simulated, fleet_mean(simulated), junction)


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
