"""Evidence rows of fleets whose faults are known, in fractions of full scale: fault offsets [A] at 1 A full scale.

Rows and residuals are computed here from the equations, independently of the code
that they are compared with: :func:`rows_of` and :func:`plain_residual`.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np

from calibrator.artificial.random_fleet import FaultSettings
from calibrator.drive import Array
from calibrator.estimator.evidence import UNKNOWN_VARIANCE, EvidenceRows
from calibrator.estimator.posterior import WIDE_SD, Evidence, FaultModel, Spread, evidence_of
from calibrator.estimator.prior import first_prior
from calibrator.faults import Faults

SCALE_A = 1.0


@dataclass(frozen=True, kw_only=True)
class Errors:
    """Standard deviations of slopes, gain ratios, constants at the means, gain and offset readings; inf: unread. [1]"""

    slope: float = 0.002
    ratio: float = 0.0005
    intercept: float = 0.001
    junction: float = 0.0005
    gain_read: float = np.inf
    offset_read: float = np.inf

    def of_rows(self, K: int) -> Array:
        """Standard deviation of each row, constants taken at the means, shape (5K,)."""
        relative = [self.slope] * K + [self.ratio] * (K - 1) + [self.gain_read] * K
        sd = np.array([*relative, *[self.intercept] * K, self.junction, *[self.offset_read] * K])
        return np.asarray(np.minimum(sd, np.sqrt(UNKNOWN_VARIANCE)))


def usual_currents(K: int) -> Array:
    """Mean currents of a vehicle without faults, shape (K,): the first branch feeds the others."""
    share = np.arange(K - 1, 0.0, -1.0)
    return np.append(0.1, -0.1 * share / share.sum())


def rows_of(
    faults: Faults,
    *,
    seed: int = 0,
    errors: Errors | None = None,
    noise: float = 1.0,
    load: Array | float = 0.0,
    currents: Array | None = None,
) -> EvidenceRows:
    """Rows of a fleet, as lines through noisy means: an error of a slope or ratio also changes its constant.

    Parameters
    ----------
    faults : Faults
        Faults of N vehicles, offsets in fractions of full scale.
    seed : int
        Seed of the errors.
    errors : Errors or None
        Standard deviations that are stated; None: those of a good drive.
    noise : float
        Size of the actual errors over the stated standard deviations. [1]
    load : ndarray of shape (N,) or float
        Load that no branch measures; the first branch carries it.
    currents : ndarray of shape (K,) or None
        Mean ideal currents; None: :func:`usual_currents`.
    """
    N, K = faults.drift.shape
    sd = (errors or Errors()).of_rows(K)
    read = sd**2 < UNKNOWN_VARIANCE
    error = noise * np.random.default_rng(seed).normal(size=(N, 5 * K)) * np.where(read, sd, 0.0)
    ideal = np.tile(usual_currents(K) if currents is None else currents, (N, 1))
    gain, c = 1.0 + faults.drift, 3 * K - 1
    true = (1.0 + faults.hardware_drift[:, None]) * ideal + faults.hardware_offset_a
    true[:, 0] += load
    measured = gain * true + faults.offset_a
    slope, ratio = gain * (1.0 + faults.hardware_drift[:, None]), gain[:, :1] / gain[:, 1:]
    relative = np.log(np.column_stack([slope, ratio, gain])) + error[:, :c]
    b = measured - np.exp(relative[:, :K]) * ideal + gain * error[:, c : c + K]
    junction = measured[:, 0] + np.sum(np.exp(relative[:, K : 2 * K - 1]) * measured[:, 1:], axis=1)
    junction += gain[:, 0] * error[:, c + K]
    values = np.column_stack([relative, b, junction, faults.offset_a + gain * error[:, c + K + 1 :]]) * read
    turn = np.tile(np.eye(5 * K), (N, 1, 1))
    turn[:, range(c, c + K), range(K)] = -ideal
    turn[:, c + K, K : 2 * K - 1] = measured[:, 1:] * np.exp(-relative[:, 1:K])
    return EvidenceRows(
        values=values,
        covariance=turn @ np.diag(sd**2) @ np.swapaxes(turn, 1, 2),
        means=np.stack([ideal, measured], axis=1),
    )


def parameters_of(faults: Faults, load: Array | float = 0.0) -> Array:
    """Parameters (N, 3K + 1) of the explanations that are true."""
    relative = np.log1p(np.column_stack([faults.hardware_drift, faults.drift]))
    loads = np.broadcast_to(load, len(faults))
    return np.column_stack([relative, faults.hardware_offset_a[:, :-1], faults.offset_a / (1.0 + faults.drift), loads])


def random_faults(
    seed: int | np.random.Generator,
    *,
    vehicles: int,
    branches: int,
    sparsity: float = 80.0,
    magnitude: tuple[float, float] = (0.05, 0.25),
    full_scale_a: float = SCALE_A,
    **more: Any,
) -> Faults:
    """Faults as in the paper; no hardware faults in half of the vehicles."""
    settings = replace(FaultSettings(sparsity=sparsity, magnitude=magnitude, balanced=True), **more)
    return settings.draw(np.random.default_rng(seed), vehicles=vehicles, branches=branches, full_scale_a=full_scale_a)


def plain_evidence(rows: EvidenceRows, *, centre: Array | None = None, shared: Array | None = None) -> Evidence:
    """Evidence of a fleet whose vehicles are alike but for their faults; the first branch feeds."""
    K = rows.branches
    return evidence_of(
        rows.values,
        rows.covariance,
        rows.means,
        centre=np.zeros(5 * K) if centre is None else centre,
        shared=np.zeros(2 * K + 1) if shared is None else shared,
        feed=0,
    )


def model_of_equals(K: int, shared: Array | None = None) -> FaultModel:
    """Model of vehicles that are alike but for their faults, and for errors that they share: offsets and gains."""
    shared, mean = np.zeros(2 * K + 1) if shared is None else shared, np.zeros(5 * K)
    mean[3 * K - 1 : 4 * K - 1], mean[4 * K - 1] = shared[:K], shared[:K].sum()
    spread = Spread(mean=mean, covariance=1e-10 * np.eye(5 * K), dispersion=np.ones(K), shared=shared)
    return FaultModel(spread=spread, priors=((1.0, first_prior(K)),))


def plain_residual(rows: EvidenceRows, theta: Array) -> Array:
    """Rows (S, 5K) of a vehicle (N = 1) less what parameters (S, 3K + 1) make of them, by the equations of the rows.

    The first branch feeds. Every line is turned about its mean from the measured ratio to that of the parameters; the
    part of this that is linear in the logarithm is left in, as the covariance holds it (M10).
    """
    K = rows.branches
    log_a, log_g, gain_read, b, c, offset_read = np.split(rows.values[0], np.cumsum([K, K - 1, K, K, 1]))
    model, measured = rows.means[0]
    eta, log_gain, hardware, omega, load = np.split(theta, np.cumsum([1, K, K - 1, K]), axis=1)
    hardware = np.column_stack([hardware, -hardware.sum(axis=1)])
    gain = np.exp(log_gain)
    slope, ratio = np.exp(eta) * gain, gain[:, :1] / gain[:, 1:]
    slope_error, ratio_error = log_a - np.log(slope), log_g - np.log(ratio)
    intercept = (b + (np.exp(log_a) - slope) * model) / gain - model * slope_error
    intercept -= hardware + omega
    intercept[:, :1] -= load
    turned = np.sum((np.exp(log_g) - ratio) * measured[1:], axis=1, keepdims=True)
    junction = (c - turned) / gain[:, :1] + (ratio_error @ (measured[1:] / np.exp(log_a[1:])))[:, None]
    junction -= omega.sum(axis=1, keepdims=True) + load
    errors = [slope_error, ratio_error, gain_read - log_gain, intercept, junction, offset_read - omega * gain]
    return np.column_stack(errors)


def all_supports(branches: int) -> Iterator[tuple[int, ...]]:
    """Every choice of parameters that are not zero, without those that hold both a feeding offset and a load."""
    for chosen in product([False, True], repeat=3 * branches + 1):
        if not (chosen[2 * branches] and chosen[-1]):
            yield tuple(np.flatnonzero(chosen).tolist())


def dense_fit(rows: EvidenceRows, support: tuple[int, ...]) -> tuple[Array, Array, float]:
    """Most probable parameters of a vehicle, their covariance and the log evidence under the wide Gaussian prior."""
    P, n, chosen = 3 * rows.branches + 1, len(support), list(support)
    precision = np.linalg.inv(rows.covariance[0])
    theta, step = np.zeros(P), 1e-6
    H = np.zeros((n, n))
    for _ in range(30 * bool(n)):
        around = theta + step * np.concatenate([np.eye(P)[chosen], -np.eye(P)[chosen]])
        e, near = plain_residual(rows, theta[None])[0], plain_residual(rows, around)
        J = (near[n:] - near[:n]).T / (2.0 * step)  # of what is explained
        H = J.T @ precision @ J + np.eye(n) / WIDE_SD**2
        change = np.linalg.solve(H, J.T @ precision @ e - theta[chosen] / WIDE_SD**2)
        theta[chosen] += np.clip(change, -0.5, 0.5)
        if np.abs(change).max() < 1e-9:
            break
    e = plain_residual(rows, theta[None])[0]
    fit = -0.5 * (e @ precision @ e + np.linalg.slogdet(2.0 * np.pi * rows.covariance[0])[1])
    prior = -0.5 * np.sum((theta / WIDE_SD) ** 2) - n * np.log(WIDE_SD) - 0.5 * np.linalg.slogdet(H)[1]
    return theta, np.linalg.inv(H), float(fit + prior)
