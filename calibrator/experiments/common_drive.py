"""Trials in which all vehicles make one drive, sections IV-A to IV-D of [1]_.

The evidence rows of the default come from simulations over the fleet reference, and from the junction law. The
reference is not the fleet mean r, equation (3) of [1]_, which an asymmetric fleet shifts, but c_0 r + c_1, where c_0
and c_1 are the centres of the densest clusters of slopes and of intercepts, branch by branch. Slopes a and intercepts
b over r become

    a' = a / c_0,    b' = b - a c_1 / c_0

The measured currents hold no noise here, so the junction law on their second moments is exact: with (.)_1 the first
branch, (.)_r the others and M the covariance of the measured currents, g = M_rr^-1 M_r1 and c = mean_1 - g^T mean_r.

.. [1] "Measurement Correction for Electric Vehicles Based on Compressed Sensing".
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from calibrator.artificial.builtin_drives import BUILTIN_BRANCHES, builtin_trip
from calibrator.artificial.random_fleet import FaultSettings, Purpose, random_stream
from calibrator.artificial.trips import with_branches
from calibrator.drive import Array
from calibrator.errors import FleetError
from calibrator.estimator.evidence import UNKNOWN_VARIANCE, EvidenceRows, densest_clusters
from calibrator.experiments.trial import CommonEvidence, Trial, drawn_distribution
from calibrator.faults import Faults, slopes_and_intercepts
from calibrator.published.classify import TRAINING_VEHICLES
from calibrator.published.evidence import FleetEvidence, collect_evidence, fleet_mean
from calibrator.published.state_space import choose_order, identify_model
from calibrator.score import UnseenDrive

__all__ = ["CommonCase", "CommonDrive", "builtin_common_drive", "common_rows", "common_trial", "measured_moments"]

TRAIN_SHARE = 0.8
"""Share of the drive on which models are trained; the rest is the unity drive, section IV-C. [1]"""
FULL_SCALE_A = 400.0
"""Nominal maximum current of the built-in vehicle's junction, as in its layout. [A]"""
GAIN_VARIANCE, CONSTANT_VARIANCE = 1e-10, 1e-12
"""Variances given to the exact junction law: above rounding, far below any fault. [1]"""
ROUNDS = 3
"""Rounds in which the reference is improved: over a better one vehicles agree better; more rounds do nothing. [1]"""
LEAST_SD = 1e-6
"""Least standard deviation of slopes [1] and intercepts [A], for simulations without noise."""


@dataclass(frozen=True, kw_only=True)
class CommonDrive:
    """Ideal currents and inputs of the drive that all vehicles make.

    Attributes
    ----------
    name : str
        Description, for the record.
    i_s : ndarray of shape (T, K)
        Ideal currents, positive into the junction; each row sums to zero. [A]
    inputs : ndarray of shape (T, M)
        Inputs of the vehicle model.
    full_scale_a : float
        Full scale of the junction. [A]
    unseen : ndarray of shape (T', K)
        Ideal currents of another drive, on which corrections are judged. [A]
    """

    name: str
    i_s: Array
    inputs: Array
    full_scale_a: float
    unseen: Array

    @property
    def unity_start(self) -> int:
        """Index of the first sample of the unity drive, T_1 of section IV-C."""
        return int(TRAIN_SHARE * len(self.i_s))

    @property
    def unity(self) -> Array:
        """Ideal currents on the unity drive, shape (T - T_1, K). [A]"""
        return self.i_s[self.unity_start :]

    @property
    def record(self) -> dict[str, int | float | str]:
        """Name of the drive, numbers of its samples, and full scale [A], which a result records."""
        return {
            "drive": self.name,
            "samples": len(self.i_s),
            "unity_samples": len(self.unity),
            "full_scale_a": self.full_scale_a,
        }


def builtin_common_drive(duration_s: float, branches: int = 2) -> CommonDrive:
    """Make the common drive with the built-in vehicle and the model inputs of ``dbc/hv_powertrain.toml``.

    Parameters
    ----------
    duration_s : float
        Least duration. [s]
    branches : int
        Number of branches K, 2 to 5; the second, the motor, is minus the sum of the others.

    Raises
    ------
    FleetError
        If the number of branches is not 2 to 5, or fastsim is not installed.
    """
    if not 2 <= branches <= len(BUILTIN_BRANCHES):
        raise FleetError(f"{branches} branches: the built-in vehicle has 2 to {len(BUILTIN_BRANCHES)}")
    trip, unseen = (
        with_branches(
            builtin_trip(random_stream(purpose, 0), duration_s=duration_s, name="builtin-0"),
            BUILTIN_BRANCHES[:branches],
            "motor",
        )
        for purpose in (Purpose.COMMON_DRIVE, Purpose.UNSEEN_TRIP)
    )
    x = trip.inputs
    power, demands = x["torque"] * x["speed"], [x[f"{name}_demand"] for name in ("heater", "aircon", "low_voltage")]
    inputs = [np.maximum(power, 0.0), np.minimum(power, 0.0), x["torque"] ** 2, *demands]
    return CommonDrive(
        name=trip.name,
        i_s=trip.matrix_a(),
        inputs=np.stack(inputs, axis=1) / x["voltage"][:, None],
        full_scale_a=FULL_SCALE_A,
        unseen=unseen.matrix_a(),
    )


@dataclass(frozen=True, kw_only=True)
class CommonCase(FaultSettings):
    """How a fleet on the common drive is simulated, beside how its faults are drawn, section IV-B of [1]_.

    Attributes
    ----------
    vehicles : int
        Fleet size N, a multiple of 4 for a symmetric fleet.
    snr_db : float
        Signal-to-noise ratio of the artificial simulation, equation (26) of [1]_. [dB]
    state_space : bool
        Whether vehicles are simulated by state-space models, equation (2) of [1]_, trained on 80 % of the drive; else
        artificially, as measured currents with white noise, equation (23).
    """

    vehicles: int = 1000
    sparsity: float = 60.0
    snr_db: float = 20.0
    balanced: bool = True
    symmetric: bool = True
    state_space: bool = False


def common_trial(drive: CommonDrive, case: CommonCase, seed: int) -> Trial:
    """Make the trial of the ``case.vehicles`` vehicles on the unity part of the common drive; a seed gives one trial.

    Corrections are judged on ``drive.unseen``.

    Raises
    ------
    FleetError
        If a fleet of mirrored pairs has no multiple of 4 vehicles, or its sign bias does not fit.
    """
    junction: dict[str, Any] = {"branches": drive.i_s.shape[1], "full_scale_a": drive.full_scale_a}
    truth = case.draw(random_stream(Purpose.FAULTS, seed), vehicles=case.vehicles, **junction)
    simulate = _simulation(drive, truth, case, Purpose.SIMULATION_ERROR, seed)
    if case.state_space:
        simulate = list(_state_space_simulations(drive, truth)).copy
    reference = fleet_mean(simulate())
    evidence = collect_evidence(simulate(), reference, _junction_a2(drive, truth))

    def record() -> CommonEvidence:
        mean_a, covariance_a2 = measured_moments(drive.unity, truth)
        rows = common_rows(evidence, reference.mean(axis=0), mean_a, covariance_a2, full_scale_a=drive.full_scale_a)
        return CommonEvidence(rows=rows, mean_a=mean_a, covariance_a2=covariance_a2)

    def training() -> tuple[FleetEvidence, Faults]:
        """Return evidence and true faults of another fleet, from which the trees learn."""
        other = case.draw(random_stream(Purpose.TRAINING_FAULTS, seed), vehicles=TRAINING_VEHICLES, **junction)
        simulate_other = _simulation(drive, other, case, Purpose.TRAINING_ERROR, seed)
        return collect_evidence(simulate_other(), fleet_mean(simulate_other()), _junction_a2(drive, other)), other

    return Trial(
        smallest_fault=case.magnitude[0],
        full_scale_a=drive.full_scale_a,
        truth=truth,
        unseen=_unseen(drive.unseen, truth),
        record=record,
        collect=lambda: evidence,
        drawn_from=drawn_distribution(case, drive.i_s.shape[1]),
        training=training,
    )


def _simulation(
    drive: CommonDrive, truth: Faults, case: CommonCase, purpose: Purpose, seed: int
) -> Callable[[], Iterable[Array]]:
    """Return a function that yields each vehicle's artificial simulation, the same at each call.

    It is the measured currents with white noise, equation (23) of [1]_, each of shape (T - T_1, K). [A]
    """
    noise_a = np.sqrt(10.0 ** (-case.snr_db / 10.0) * np.mean(drive.unity[:, 0] ** 2))  # (26) of [1], power of i_s,1

    def simulate() -> Iterator[Array]:
        for j, measured in enumerate(_measured(drive.unity, truth)):
            yield measured + noise_a * random_stream(purpose, seed, j).standard_normal(measured.shape)

    return simulate


def _state_space_simulations(drive: CommonDrive, truth: Faults) -> Iterator[Array]:
    """Yield each vehicle's simulation on the unity drive by its state-space model, all of the same order. [A]"""
    start, order = drive.unity_start, None
    for measured in _measured(drive.i_s, truth):
        if order is None:
            order = choose_order(drive.inputs[:start], measured[:start])
        model = identify_model(drive.inputs[:start], measured[:start], order=order)
        yield model.simulate(drive.inputs, initial_state=model.x0)[start:]


def _measured(i_s: Array, truth: Faults) -> Iterator[Array]:
    """Yield each vehicle's measured currents, equation (21) of [1]_, shape (T, K). [A]"""
    for slope, intercept in zip(*slopes_and_intercepts(truth), strict=True):
        yield slope * i_s + intercept


def _junction_a2(drive: CommonDrive, truth: Faults) -> Array:
    """Return the mean square of each vehicle's junction sum, equation (6) of [1]_, shape (N,). [A^2]"""
    return np.array([np.mean(measured.sum(axis=1) ** 2) for measured in _measured(drive.unity, truth)])


def _unseen(ideal_a: Array, truth: Faults) -> UnseenDrive:
    """Return the unseen drive of N vehicles with the same ideal currents (T, K); true ones by equation (11) of [1]_."""
    gain, constant = 1.0 + truth.hardware_drift[:, None], truth.hardware_offset_a
    mean_a, mean_square_a2 = ideal_a.mean(axis=0), np.mean(ideal_a**2, axis=0)
    i2 = gain**2 * mean_square_a2 + 2.0 * gain * constant * mean_a + constant**2
    return UnseenDrive.of_linear_sensors(gain * mean_a + constant, i2, truth)


def measured_moments(i_s: Array, truth: Faults) -> tuple[Array, Array]:
    """Return mean (N, K) [A] and covariance (N, K, K) [A^2] of the measured currents that faults make of i_s (T, K).

    The measured currents are those of equation (14) of [1]_.
    """
    slope, intercept = slopes_and_intercepts(truth)
    centred = i_s - i_s.mean(axis=0)
    covariance = centred.T @ centred / len(i_s)
    return slope * i_s.mean(axis=0) + intercept, slope[:, :, None] * covariance * slope[:, None, :]


def common_rows(
    evidence: FleetEvidence, reference_mean_a: Array, mean_a: Array, covariance_a2: Array, *, full_scale_a: float
) -> EvidenceRows:
    """Make the evidence rows of a fleet on its common drive, without bench readings.

    Parameters
    ----------
    evidence : FleetEvidence
        Slopes and intercepts of the simulations over the fleet mean, with white residuals.
    reference_mean_a : ndarray of shape (K,)
        Mean over time of the fleet mean on the unity drive. [A]
    mean_a, covariance_a2 : ndarray of shape (N, K) and (N, K, K)
        Moments of the measured currents of the same vehicles. [A], [A^2]
    full_scale_a : float
        Full scale of the junction. [A]
    """
    N, K = evidence.slopes.shape
    slope, intercept_a, of_line = _over_cluster(evidence, reference_mean_a)
    # junction law: gains of the other branches (N, K - 1) and constant (N, 1) in the first branch's measured current
    gain = np.linalg.solve(covariance_a2[:, 1:, 1:], covariance_a2[:, 1:, :1])[:, :, 0]
    constant_a = mean_a[:, :1] - np.sum(gain * mean_a[:, 1:], axis=1, keepdims=True)
    nothing = np.zeros((N, K))
    variance = np.full(5 * K, UNKNOWN_VARIANCE)
    variance[K : 2 * K - 1], variance[4 * K - 1] = GAIN_VARIANCE, CONSTANT_VARIANCE
    covariance = np.tile(np.diag(variance), (N, 1, 1))
    for k in range(K):
        unit = np.array([np.ones(N), np.full(N, 1.0 / full_scale_a)]).T / slope[:, k, None]
        place = np.array([k, 3 * K - 1 + k])
        covariance[:, place[:, None], place] = of_line[:, k] * unit[:, :, None] * unit[:, None, :]
    constants_a = np.concatenate([intercept_a, constant_a], axis=1)
    return EvidenceRows(
        values=np.concatenate([np.log(slope), np.log(-gain), nothing, constants_a / full_scale_a, nothing], axis=1),
        covariance=covariance,
        means=np.zeros((N, 2, K)),
    )


def _over_cluster(evidence: FleetEvidence, reference_mean_a: Array) -> tuple[Array, Array, Array]:
    """Return a' (N, K) and b' (N, K) [A] of the module's docstring, and the covariance of each pair (N, K, 2, 2)."""
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
