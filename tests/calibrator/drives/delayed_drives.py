"""Small vehicles for the tests of delays: smooth currents that sum to zero, seen late, with faults and noise."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from calibrator.drive import Array, Channel, Drive

PERIOD_S = {"battery": 0.02, "motor": 0.01, "auxiliary": 0.05, "dcdc": 0.2, "motor_rear": 0.01}
JITTER = 0.02
"""Standard deviation of the frame times about even spacing, in periods. [1]"""
RATES_HZ = (0.02, 0.6)
"""Range of the sinusoids that a current is made of."""
SINUSOIDS = 12
STEP_TIME_S = 0.05


@dataclass(frozen=True, kw_only=True)
class MadeUp:
    """What a vehicle is like. The battery feeds all consumers; each is a sum of sinusoids, or of steps, of its size.

    Consumers made of sinusoids share this part of their shape: ``alike`` is the correlation of any two.
    """

    size_a: Mapping[str, float]
    delay_s: Mapping[str, float]
    gain: Mapping[str, float] = field(default_factory=dict)
    offset_a: Mapping[str, float] = field(default_factory=dict)
    noise_a: float = 0.0
    alike: float = 0.0
    stepping: frozenset[str] = frozenset()
    duration_s: float = 300.0


def made_up_drive(seed: int, vehicle: MadeUp, *, name: str = "d") -> Drive:
    """One drive of the vehicle; the same seed gives the same currents, phases and noise."""
    rng = np.random.default_rng(seed)
    common = _Waves(rng)
    consumers = {key: _Consumer(rng, vehicle, key, common) for key in vehicle.size_a}
    channels = {}
    for branch in ("battery", *consumers):
        time_s = frame_times(rng, PERIOD_S[branch], vehicle.duration_s)
        true_s = time_s - vehicle.delay_s.get(branch, 0.0)
        i = consumers[branch].current_a(true_s) if branch in consumers else _balance_a(consumers, true_s)
        seen = vehicle.gain.get(branch, 1.0) * i + vehicle.offset_a.get(branch, 0.0)
        seen += vehicle.noise_a * rng.normal(size=len(time_s))
        channels[branch] = Channel(time_s=time_s, value=seen, good=np.ones(len(time_s), np.bool_))
    return Drive(vehicle="V1", name=name, branches=channels, inputs={})


def frame_times(rng: np.random.Generator, period_s: float, duration_s: float) -> Array:
    """Instants of the frames of one message, with random phase and jitter. [s]"""
    nominal = np.arange(rng.uniform(0.0, period_s), duration_s, period_s)
    return nominal + np.clip(rng.normal(0.0, JITTER, len(nominal)), -0.4, 0.4) * period_s


def _balance_a(consumers: "Mapping[str, _Consumer]", time_s: Array) -> Array:
    return np.asarray(-np.sum([consumer.current_a(time_s) for consumer in consumers.values()], axis=0))


class _Waves:
    """A sum of sinusoids with unit variance."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._rate = rng.uniform(*RATES_HZ, SINUSOIDS) * 2.0 * np.pi
        self._phase = rng.uniform(0.0, 2.0 * np.pi, SINUSOIDS)

    def at(self, time_s: Array) -> Array:
        waves = np.sin(time_s[:, None] * self._rate + self._phase)
        return np.asarray(np.sqrt(2.0 / SINUSOIDS) * waves.sum(axis=1))


class _Consumer:
    """Current of one consumer, which can be computed for any instant."""

    def __init__(self, rng: np.random.Generator, vehicle: MadeUp, branch: str, common: _Waves) -> None:
        self._size_a, self._alike = vehicle.size_a[branch], vehicle.alike
        self._common, self._own = common, _Waves(rng)
        self._steps_s = np.sort(rng.uniform(0.0, vehicle.duration_s, int(vehicle.duration_s / 10.0)))
        self._is_stepping = branch in vehicle.stepping

    def current_a(self, time_s: Array) -> Array:
        """Current into the junction. [A]"""
        if self._is_stepping:
            sign = (-1.0) ** np.arange(len(self._steps_s))
            return -self._size_a * np.clip((time_s[:, None] - self._steps_s) / STEP_TIME_S, 0.0, 1.0) @ sign
        shape = np.sqrt(self._alike) * self._common.at(time_s) + np.sqrt(1.0 - self._alike) * self._own.at(time_s)
        return np.asarray(-self._size_a * shape)
