"""Trials in which all vehicles make one drive, sections IV-A to IV-D of [1]_.

The evidence rows of the default are made of simulations over the fleet reference, and of the junction law. The
reference is not the mean r of the fleet (3), which a fleet without symmetry shifts, but c_0 r + c_1 with the densest
cluster of slopes and of intercepts as c_0 and c_1, branch by branch: vehicles that agree with each other. Slopes and
intercepts a, b over r become

    a' = a / c_0,    b' = b - a c_1 / c_0

The measured currents of these experiments hold no noise, so the junction law on their second moments is exact: with
(.)_1 the first branch and (.)_r the others, g = M_rr^-1 M_r1 and c = mean_1 - g^T mean_r, M the covariance of the
measured currents.

.. [1] "Measurement Correction for Electric Vehicles Based on Compressed Sensing".
"""

from collections.abc import Iterable, Iterator
from functools import partial

import numpy as np

from calibrator.drive import Array
from calibrator.estimator.fleet_model import densest_clusters
from calibrator.estimator.rows import UNKNOWN_VARIANCE, EvidenceRows
from calibrator.estimator.state_space import choose_order, identify
from calibrator.experiments.common_drive import CommonDrive
from calibrator.experiments.trial import CommonEvidence, FleetLaw, Trial, unseen_drive
from calibrator.faults import Faults, slopes_and_intercepts
from calibrator.published.evidence import FleetEvidence, collect_evidence, fleet_mean, junction_mean_square
from calibrator.random_streams import Purpose, random_stream

__all__ = ["artificial_trial", "common_rows", "measured_moments", "noise_sd_a", "state_space_trial"]

GAIN_VARIANCE, CONSTANT_VARIANCE = 1e-10, 1e-12
"""Of the exact junction law: above rounding, far below any fault. [1]"""
ROUNDS = 3
"""Over a better reference, vehicles agree more closely; more rounds change nothing. [1]"""
LEAST_SD = 1e-6
"""Of slopes [1] and intercepts [A] of simulations without noise."""


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
        record=partial(_record, drive, evidence, reference.mean(axis=0), truth),
        collect=lambda: evidence,
        training=partial(_training, drive, law, seed),
    )


def _record(drive: CommonDrive, evidence: FleetEvidence, reference_mean_a: Array, truth: Faults) -> CommonEvidence:
    """Rows of the simulations, and the moments of what the vehicles measured on the unity drive."""
    mean_a, covariance_a2 = measured_moments(drive.unity, truth)
    rows = common_rows(evidence, reference_mean_a, mean_a, covariance_a2, full_scale_a=drive.full_scale_a)
    return CommonEvidence(rows=rows, mean_a=mean_a, covariance_a2=covariance_a2)


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


def measured_moments(i_s: Array, truth: Faults) -> tuple[Array, Array]:
    """Moments of what the vehicles measure on a drive, (14) and (15).

    Parameters
    ----------
    i_s : ndarray of shape (T, K)
        Ideal currents. [A]
    truth : Faults
        Of N vehicles.

    Returns
    -------
    mean_a : ndarray of shape (N, K)
        [A]
    covariance_a2 : ndarray of shape (N, K, K)
        [A^2]
    """
    slope, intercept = slopes_and_intercepts(truth)
    centred = i_s - i_s.mean(axis=0)
    covariance = centred.T @ centred / len(i_s)
    return slope * i_s.mean(axis=0) + intercept, slope[:, :, None] * covariance * slope[:, None, :]


def common_rows(
    evidence: FleetEvidence, reference_mean_a: Array, mean_a: Array, covariance_a2: Array, *, full_scale_a: float
) -> EvidenceRows:
    """Evidence rows of a fleet on its common drive.

    Parameters
    ----------
    evidence : FleetEvidence
        Slopes and intercepts of the simulations over the fleet mean, with white residuals.
    reference_mean_a : ndarray of shape (K,)
        Mean of the fleet mean on the unity drive. [A]
    mean_a, covariance_a2 : ndarray of shape (N, K) and (N, K, K)
        Moments of the measured currents of the same vehicles. [A], [A^2]
    full_scale_a : float
        Full scale of the junction. [A]

    Returns
    -------
    EvidenceRows
        Without bench readings.
    """
    N, K = evidence.slopes.shape
    slope, intercept_a, of_line = _over_cluster(evidence, reference_mean_a)
    # junction law: gains of the other branches (N, K - 1) and constant (N, 1) in the first branch's measured current
    gain = np.linalg.solve(covariance_a2[:, 1:, 1:], covariance_a2[:, 1:, :1])[:, :, 0]
    constant_a = mean_a[:, :1] - np.sum(gain * mean_a[:, 1:], axis=1, keepdims=True)
    nothing = np.zeros((N, K))
    covariance = np.tile(np.diag(np.full(5 * K, UNKNOWN_VARIANCE)), (N, 1, 1))
    for k in range(K):
        unit = np.array([np.ones(N), np.full(N, 1.0 / full_scale_a)]).T / slope[:, k, None]
        place = np.array([k, 3 * K - 1 + k])
        covariance[:, place[:, None], place] = of_line[:, k] * unit[:, :, None] * unit[:, None, :]
    for row in range(K, 2 * K - 1):
        covariance[:, row, row] = GAIN_VARIANCE
    covariance[:, 4 * K - 1, 4 * K - 1] = CONSTANT_VARIANCE
    return EvidenceRows(
        relative=np.concatenate([np.log(slope), np.log(-gain), nothing], axis=1),
        constant=np.concatenate([intercept_a / full_scale_a, constant_a / full_scale_a, nothing], axis=1),
        covariance=covariance,
        means=np.zeros((N, 2, K)),
    )


def _over_cluster(evidence: FleetEvidence, reference_mean_a: Array) -> tuple[Array, Array, Array]:
    """Slopes (N, K), intercepts (N, K) [A] over the densest cluster, and the covariance of both (N, K, 2, 2)."""
    slope, intercept_a = evidence.slopes, evidence.intercepts_a
    covariance = np.empty((*slope.shape, 2, 2))
    covariance[..., 0, 0] = np.maximum(evidence.slope_variances, LEAST_SD**2)
    covariance[..., 1, 1] = np.maximum(evidence.intercept_variances_a2, LEAST_SD**2)
    covariance[..., 0, 1] = covariance[..., 1, 0] = -reference_mean_a * evidence.slope_variances
    for _ in range(ROUNDS):
        sd = np.sqrt(np.einsum("nkii->nki", covariance))
        scale, zero = (
            np.array([densest_clusters(values[:, k], sd[:, k, i])[0].centre for k in range(values.shape[1])])
            for i, values in enumerate((slope, intercept_a))
        )
        jacobian = np.zeros((len(scale), 2, 2))
        jacobian[:, 0, 0], jacobian[:, 1, 0], jacobian[:, 1, 1] = 1.0 / scale, -zero / scale, 1.0
        slope, intercept_a = slope / scale, intercept_a - slope * zero / scale
        covariance = jacobian @ covariance @ np.swapaxes(jacobian, 1, 2)
    return slope, intercept_a, covariance
