"""Discrete linear state-space model of one vehicle's currents, (2) of [1]_.

    x(t+1) = A x(t) + B u(t)
    y(t)   = C x(t) + D u(t) + offset

Symbols: u inputs (T samples, M inputs), y currents (K branches, positive into the junction), x state (order n).

.. [1] "Measurement Correction for Electric Vehicles Based on Compressed Sensing".
"""

from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

from calibrator.drive import Array, Mask
from calibrator.errors import DriveError

__all__ = ["StateSpaceModel", "simulation_snr_db", "snr_from_power", "valid_or_all"]

WORST_EIGENVECTORS = 1e8
"""Condition number of the eigenvectors of A from which on modes are not separated any more: 8 digits remain. [1]"""


@dataclass(frozen=True, kw_only=True)
class StateSpaceModel:
    """State-space model with constant offset.

    Attributes
    ----------
    A, B, C, D : ndarray of shapes (n, n), (n, M), (K, n), (K, M)
        System matrices; inputs in their own units, currents in A.
    x0 : ndarray of shape (n,)
        State at the first sample of the drive that the model was identified from.
    offset_a : ndarray of shape (K,)
        Constant part of the currents. [A]
    snr_db : ndarray of shape (K,)
        Simulation signal-to-noise ratio on that drive, see :func:`simulation_snr_db`. [dB]
    """

    A: Array
    B: Array
    C: Array
    D: Array
    x0: Array
    offset_a: Array
    snr_db: Array

    @property
    def order(self) -> int:
        """Number of states n."""
        return len(self.A)

    def steady_state(self, u: Array) -> Array:
        """State of shape (n,) that a constant input u of shape (M,) leads to."""
        return np.asarray(np.linalg.solve(np.eye(self.order) - self.A, self.B @ u))

    def simulate(self, inputs: Array, *, initial_state: Array | None = None) -> Array:
        """Currents for given inputs, (2) in [1]_.

        Parameters
        ----------
        inputs : ndarray of shape (T, M)
            Inputs in the units of the identification.
        initial_state : ndarray of shape (n,) or None
            State at the first sample; None: the steady state of the first input.

        Returns
        -------
        ndarray of shape (T, K)
            Simulated currents, positive into the junction. [A]

        Raises
        ------
        DriveError
            If the inputs are of another number, or not finite.
        """
        if inputs.ndim != 2 or inputs.shape[1] != self.D.shape[1]:
            raise DriveError(f"the model has {self.D.shape[1]} inputs, the drive to simulate has shape {inputs.shape}")
        bad = ~np.isfinite(inputs).all(axis=1)
        if bad.any():
            raise DriveError(
                f"inputs to simulate: {bad.sum()} of {len(inputs)} samples are not finite, the first is sample "
                f"{bad.argmax()}; bridge or cut them"
            )
        if not len(inputs):
            return np.empty((0, len(self.C)))
        x0 = self.steady_state(inputs[0]) if initial_state is None else initial_state
        return _states(self.A, inputs @ self.B.T, x0) @ self.C.T + inputs @ self.D.T + self.offset_a


def simulation_snr_db(measured: Array, simulated: Array) -> Array:
    """Power of the measured signal about its mean over the power of the simulation error.

    Parameters
    ----------
    measured, simulated : ndarray of shape (T, K)
        Currents. [A]

    Returns
    -------
    ndarray of shape (K,)
        Signal-to-noise ratio; infinite where the simulation is exact, NaN for a constant channel. [dB]
    """
    return snr_from_power(measured.var(axis=0), np.mean((measured - simulated) ** 2, axis=0))


def snr_from_power(signal: Array, error: Array) -> Array:
    """Ratio of two powers in dB; NaN where there is no signal."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.where(signal > 0.0, 10.0 * np.log10(signal / error), np.nan))


def _states(A: Array, forcing: Array, x0: Array) -> Array:
    """States (T, n) of x(t+1) = A x(t) + forcing(t): mode by mode, or step by step if A has no modes."""
    poles, vectors = np.linalg.eig(A)
    if not len(A) or np.linalg.cond(vectors) > WORST_EIGENVECTORS:
        return _states_step_by_step(A, forcing, x0)
    delayed = np.vstack([x0, forcing[:-1]]) @ np.linalg.inv(vectors).T
    modes = np.stack([lfilter([1.0], [1.0, -pole], delayed[:, k]) for k, pole in enumerate(poles)], axis=1)
    return np.asarray((modes @ vectors.T).real)


def _states_step_by_step(A: Array, forcing: Array, x0: Array) -> Array:
    x = np.empty_like(forcing)
    x[0] = x0
    for t in range(len(forcing) - 1):
        x[t + 1] = A @ x[t] + forcing[t]
    return x


def valid_or_all(valid: Mask | None, samples: int) -> Mask:
    """The mask, or all samples where there is none."""
    return np.ones(samples, bool) if valid is None else valid
