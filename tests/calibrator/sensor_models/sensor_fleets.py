"""Fleets whose sensors are known: random drives, faults, temperatures, and what is put into some of the sensors."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

from calibrator.artificial.random_fleet import draw_faults
from calibrator.drive import Array
from calibrator.drives.align import Samples
from calibrator.faults import Faults, measured_currents, true_currents
from calibrator.sensor_models.families import SensorModel
from calibrator.sensor_models.summary import SensorSummary, summarise_sensors

FULL_SCALE_A = 400.0
PERIOD_S = 0.1
NOISE_A = 0.4
MISFIT_A = 1.0
"""What the currents differ by from any function of the inputs: slow, the same for all branches of a vehicle. [A]"""
TEMPERATURE = "temperature"
INPUTS = ("driving", "recuperation", "heater")

Put = Mapping[tuple[int, int], SensorModel]
"""Sensors that are not linear, by vehicle and branch."""


@dataclass(frozen=True, kw_only=True)
class SensorFleet:
    """Aligned samples of N vehicles, with the truth."""

    samples: Sequence[Samples]
    true_a: Sequence[Array]
    faults: Faults

    def summaries(self, *, temperature: str | None = TEMPERATURE) -> list[SensorSummary]:
        """Summaries with the true offsets as zeros."""
        return [
            summarise_sensors([drive], zero_a=zero_a, period_s=PERIOD_S, temperature=temperature)
            for drive, zero_a in zip(self.samples, self.faults.offset_a, strict=True)
        ]


def make_fleet(
    *,
    vehicles: int,
    branches: int = 2,
    minutes: float = 15.0,
    sparsity: float = 80.0,
    put: Put | None = None,
    seed: int,
) -> SensorFleet:
    """Make a fleet of vehicles with two or three branches (battery, motor, heater)."""
    rng = np.random.default_rng(seed)
    faults = draw_faults(
        rng,
        vehicles=vehicles,
        branches=branches,
        sparsity=sparsity,
        magnitude=(0.02, 0.1),
        full_scale_a=FULL_SCALE_A,
    )
    samples, true_a = [], []
    for j in range(vehicles):
        inputs, ideal_a, temperature_c = _drive(rng, int(60.0 * minutes / PERIOD_S), branches)
        i = true_currents(ideal_a, faults.take(j))
        i_m = measured_currents(i, faults.take(j))
        for (vehicle, k), sensor in (put or {}).items():
            if vehicle == j:
                i_m[:, k] = sensor.measured(i[:, k], temperature_c) + faults.offset_a[j, k]
        i_m += rng.normal(0.0, NOISE_A, i.shape)
        samples.append(as_samples(i_m, np.column_stack([inputs, temperature_c])))
        true_a.append(i)
    return SensorFleet(samples=samples, true_a=true_a, faults=faults)


def as_samples(currents_a: Array, inputs: Array) -> Samples:
    """Samples of one drive, all of them valid, the last input being the temperature."""
    return Samples(
        branch_names=tuple("abc"[: currents_a.shape[1]]),
        input_names=(*INPUTS, TEMPERATURE),
        time_s=PERIOD_S * np.arange(float(len(currents_a))),
        currents_a=currents_a,
        inputs=inputs,
        valid=np.ones(len(currents_a), bool),
        masked={},
    )


def _drive(rng: np.random.Generator, samples: int, branches: int) -> tuple[Array, Array, Array]:
    """Inputs (T, 3), ideal currents (T, K) and temperature (T,) of one drive."""
    torque = 30.0 * _slow(rng, samples, 5.0) + 8.0
    heater = 6.0 * (_slow(rng, samples, 40.0) > 0.0)
    motor_a = torque + MISFIT_A * _slow(rng, samples, 20.0)
    heater_a = np.asarray(lfilter([0.05], [1.0, -0.95], heater)) if branches > 2 else np.zeros(samples)
    temperature_c = rng.uniform(0.0, 30.0) + 10.0 * _slow(rng, samples, 100.0)
    ideal_a = np.column_stack([motor_a + heater_a, -motor_a, -heater_a])[:, :branches]
    inputs = np.column_stack([np.maximum(torque, 0.0), np.minimum(torque, 0.0), heater])
    return inputs, ideal_a, temperature_c


def _slow(rng: np.random.Generator, samples: int, time_constant_s: float) -> Array:
    """Low-pass noise of variance 1."""
    pole = np.exp(-PERIOD_S / time_constant_s)
    white = rng.normal(0.0, np.sqrt(1.0 - pole**2), samples)
    return np.asarray(lfilter([1.0], [1.0, -pole], white, zi=[pole * rng.normal()])[0])
