"""Vehicles with slow and oscillating currents, each a little different: what identification is tested on.

Four lags and one resonance (order 6) couple three inputs to four branches whose currents sum to zero. The couplings are
those of the fleet; time constants, frequency and damping differ between vehicles. Inputs are steps and low-pass noise,
as of pedal, heater and air conditioning. Everything is told by the number of the vehicle.
"""

from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

from calibrator.drive import Array
from calibrator.drives.align import Samples
from calibrator.estimator.fleet_identification import held_out_snr_db, read_outs
from calibrator.published.state_space import StateSpaceModel
from calibrator.summaries.filter_bank import FilterBank
from calibrator.summaries.summariser import summarise_samples

PERIOD_S = 0.1
"""Distance of the samples. [s]"""
SAMPLES = 12_000
"""Of a drive: 20 minutes."""
INPUT_NAMES = ("driving", "heater", "cooling")
BRANCHES = 4
LAGS_S = np.array([0.3, 1.0, 4.0, 15.0])
"""From the filter of an inverter to the warming up of a heater. [s]"""
RESONANCE_HZ, DAMPING = 0.5, 0.35
"""Of a power train that a step of torque shakes. [Hz], [1]"""
POLE_SPREAD = 0.15
"""Largest relative difference of a vehicle's time constants, frequency and damping from the fleet's. [1]"""
OFFSET_A = 3.0
"""Standard deviation of the constant parts of the currents. [A]"""
CURRENT_A = 20.0
"""Size of the couplings: currents per unit of an input. [A]"""
STEP_S, RAMP_S, WANDER_S = 5.0, 0.3, 2.0
"""Of the inputs: distance of the steps, their time constant, that of the noise. [s]"""
WARM_UP = 600
"""Samples before a drive is recorded, so that its states are not those of rest."""
ALL_BRANCHES = ("battery", "motor", "auxiliaries", "dcdc")


@dataclass(frozen=True, kw_only=True)
class DynamicVehicle:
    """One drive of a vehicle that is known.

    Attributes
    ----------
    model : StateSpaceModel
        The vehicle.
    samples : Samples
        Inputs and measured currents, noise included.
    """

    model: StateSpaceModel
    samples: Samples


def dynamic_vehicle(number: int) -> StateSpaceModel:
    """Make a vehicle of the fleet, of order 6 with 3 inputs and 4 branches."""
    rng = np.random.default_rng(0)  # the couplings are the fleet's
    B = rng.normal(size=(len(LAGS_S) + 2, len(INPUT_NAMES)))
    C, D, offset = (
        scale * _on_junction_law(rng.normal(size=(BRANCHES, width)))
        for scale, width in ((CURRENT_A, len(B)), (CURRENT_A, B.shape[1]), (OFFSET_A, 1))
    )
    factors = 1.0 + POLE_SPREAD * np.random.default_rng([1, number]).uniform(-1.0, 1.0, len(B))
    A, gains = _modes(LAGS_S * factors[:-2], RESONANCE_HZ * factors[-2], DAMPING * factors[-1])
    return StateSpaceModel(
        A=A, B=gains @ B, C=C, D=D, x0=np.zeros(len(A)), offset_a=offset[:, 0], snr_db=np.full(BRANCHES, np.inf)
    )


def drive_inputs(number: int, *, samples: int = SAMPLES) -> Array:
    """Inputs of a drive, shape (T, 3): steps and low-pass noise, of a size of one."""
    rng, M = np.random.default_rng([2, number]), len(INPUT_NAMES)
    held = round(STEP_S / PERIOD_S)
    steps = rng.normal(size=(samples // held + 1, M)).repeat(held, axis=0)[:samples]
    noise = rng.normal(size=(samples, M)) * np.sqrt(2.0 * WANDER_S / PERIOD_S)
    return 0.5 + _low_pass(steps, RAMP_S) + _low_pass(noise, WANDER_S)


def recorded(
    number: int, *, snr_db: float, samples: int = SAMPLES, model: StateSpaceModel | None = None
) -> DynamicVehicle:
    """Record a drive, with the power of each current about its mean over that of its sensor's white noise in dB."""
    vehicle = dynamic_vehicle(number) if model is None else model
    inputs = drive_inputs(number, samples=samples + WARM_UP)
    clean = vehicle.simulate(inputs)[WARM_UP:]
    noise = np.random.default_rng([3, number]).normal(size=clean.shape) * clean.std(axis=0) * 10.0 ** (-snr_db / 20.0)
    return DynamicVehicle(
        model=vehicle,
        samples=Samples(
            branch_names=ALL_BRANCHES,
            input_names=INPUT_NAMES,
            time_s=PERIOD_S * np.arange(samples),
            currents_a=clean + noise,
            inputs=inputs[WARM_UP:],
            valid=np.ones(samples, bool),
        ),
    )


def bank_model(bank: FilterBank, drive: Samples) -> StateSpaceModel:
    """Identify a vehicle with the poles of a bank; its initial state is that of its mean inputs."""
    summary = summarise_samples([drive], period_s=PERIOD_S, bank=bank)
    (coefficients,), (offset_a,) = read_outs(summary.total[None], summary.branches)
    (A, B), M = bank.system(), len(bank.input_names)
    mean_inputs = summary.total[-1, :M] / summary.total[-1, -1]
    return StateSpaceModel(
        A=A,
        B=B,
        C=coefficients[M:].T,
        D=coefficients[:M].T,
        x0=np.linalg.solve(np.eye(len(A)) - A, B @ mean_inputs),
        offset_a=offset_a,
        snr_db=held_out_snr_db([summary])[0],
    )


def _modes(lags_s: Array, frequency_hz: float, damping: float) -> tuple[Array, Array]:
    """A and gains (6, 6) of states that follow a constant input 1 to 1."""
    swing = 2.0 * np.pi * frequency_hz * complex(-damping, np.sqrt(1.0 - damping**2))
    pole = np.exp(PERIOD_S * swing)
    A = np.diag([*np.exp(-PERIOD_S / lags_s), pole.real, pole.real])
    A[-2, -1], A[-1, -2] = -pole.imag, pole.imag
    return A, np.eye(len(A)) - A


def _on_junction_law(values: Array) -> Array:
    """The same, with rows that sum to zero over the branches."""
    return np.asarray(values - values.mean(axis=0))


def _low_pass(values: Array, time_constant_s: float) -> Array:
    pole = np.exp(-PERIOD_S / time_constant_s)
    return np.asarray(lfilter([1.0 - pole], [1.0, -pole], values, axis=0))
