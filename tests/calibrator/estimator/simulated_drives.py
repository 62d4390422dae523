"""Drive summaries of fleets whose faults, inputs and noise are known."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

from calibrator.drive import Array, Samples
from calibrator.faults import Faults, measured_currents, true_currents
from calibrator.summaries.moments import DriveSummary
from calibrator.summaries.summariser import summarise_samples

PERIOD_S = 1.0
INPUTS = 3
READ_OUT_A = np.array([[-60.0, 40.0, 15.0], [50.0, -35.0, -10.0], [10.0, -5.0, -5.0]])
"""Ideal currents of battery, motor and auxiliaries per unit of each input: rows sum to zero over the branches."""


@dataclass(frozen=True, kw_only=True)
class Conditions:
    """Length, noise and errors of simulated drives.

    Attributes
    ----------
    samples : int
        Number of samples of a drive, one a second.
    memory : float
        Correlation of neighbouring samples of the inputs, and of the model error. [1]
    noise_a : float
        White noise of each sensor. [A]
    model_error_a : float
        By how much true currents differ from what the inputs tell. [A]
    unmeasured_a : float
        Load that no branch measures; the first branch carries it. [A]
    """

    samples: int = 1800
    memory: float = 0.9
    noise_a: float = 0.3
    model_error_a: float = 0.0
    unmeasured_a: float = 0.0


def read_out_of(branches: int) -> Array:
    """Ideal currents per unit of each input, shape (3, K); of two branches the second balances the first."""
    K = branches
    W = READ_OUT_A.T[:, : min(K, 3)].copy()
    if K == 2:
        W[:, 1] = -W[:, 0]
    return W


def coloured(rng: np.random.Generator, samples: int, columns: int, memory: float) -> Array:
    """Columns of first-order noise of variance 1, shape (T, columns)."""
    white = rng.normal(size=(samples, columns))
    white[0] /= np.sqrt(1.0 - memory**2)
    return np.asarray(lfilter([np.sqrt(1.0 - memory**2)], [1.0, -memory], white, axis=0))


def drive_of(rng: np.random.Generator, faults: Faults, conditions: Conditions) -> Samples:
    """One drive of one vehicle, whose ``faults`` are arrays of shape (K,) or ()."""
    K, T = len(faults.drift), conditions.samples
    u = coloured(rng, T, INPUTS, conditions.memory) + np.array([0.5, 0.2, 0.0])
    error = conditions.model_error_a * coloured(rng, T, K, conditions.memory)
    i = true_currents(u @ read_out_of(K), faults) + error - error.mean(axis=1, keepdims=True)
    i[:, 0] += conditions.unmeasured_a
    i_m = measured_currents(i, faults) + conditions.noise_a * rng.normal(size=(T, K))
    return samples_of(u, i_m)


def samples_of(inputs: Array, currents_a: Array) -> Samples:
    """Aligned samples, all valid."""
    T = len(inputs)
    return Samples(
        branch_names=tuple(f"branch {k}" for k in range(currents_a.shape[1])),
        input_names=tuple(f"input {m}" for m in range(inputs.shape[1])),
        time_s=PERIOD_S * np.arange(T),
        currents_a=currents_a,
        inputs=inputs,
        valid=np.ones(T, bool),
    )


def summaries_of(faults: Faults, conditions: Conditions | None = None, *, seed: int = 0) -> Sequence[DriveSummary]:
    """One drive of each vehicle of a fleet, summarised."""
    rng, conditions = np.random.default_rng(seed), conditions or Conditions()
    drives = [drive_of(rng, faults.take(j), conditions) for j in range(len(faults))]
    return [summarise_samples([drive], period_s=PERIOD_S) for drive in drives]


def no_faults(vehicles: int, branches: int) -> Faults:
    """Faults of a fleet that has none."""
    none = np.zeros((vehicles, branches))
    return Faults(hardware_drift=np.zeros(vehicles), hardware_offset_a=none, drift=none.copy(), offset_a=none.copy())
