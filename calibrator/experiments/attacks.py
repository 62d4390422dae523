"""Worlds of an attack: effects that the estimator does not expect, in some vehicles of a fleet of recorded trips.

A world is a row of :data:`WORLDS`. In the vehicles that it affects it may change the true faults (sensors stay linear),
the true currents (loads without a sensor), or the measured current of one sensor. That is the sensor of the battery or
the motor: the other branches of a recorded trip hardly move, so the effect would not show there. Disturbances (spikes,
interference) appear only in the recording, not on the unseen drive, on which corrections are judged. What belongs to a
sensor or a vehicle is on both drives; on the unseen one a step or ramp is complete, and the temperature is another one.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d
from scipy.signal import lfilter

from calibrator.artificial.random_fleet import Purpose, random_stream
from calibrator.drive import Array, Mask
from calibrator.faults import Faults

__all__ = ["WORLDS", "Attack", "World", "draw_attack"]

MOVING = 2
"""Number of branches whose current varies much: battery and motor, the first two of the layout."""
HZ = 10.0
"""Samples per second of recorded trips; lengths of bursts and switching loads are counted in them. [1/s]"""
REFERENCE_C = 25.0
"""Temperature at which sensors whose gain depends on it have their usual gain. [degC]"""


@dataclass(frozen=True, kw_only=True)
class Scene:
    """What a world may look at besides the currents of one vehicle.

    Attributes
    ----------
    size : float
        Size of the effect, in the unit that its world needs; of either sign for effects on sensors.
    full_scale_a, peak_a : float
        Full scale of the junction; greatest magnitude of the affected sensor in the recording (0 for loads). [A]
    progress, temperature_c : ndarray of shape (T,)
        Time since the start over the drive's length [1], 1 on the unseen drive; temperature of the sensors [degC].
    rng : numpy.random.Generator
        Random generator of this vehicle and drive.
    """

    size: float
    full_scale_a: float
    peak_a: float
    progress: Array
    temperature_c: Array
    rng: np.random.Generator


@dataclass(frozen=True, kw_only=True)
class World:
    """One effect that the estimator does not expect; its callables say how it changes a vehicle or a sensor.

    Attributes
    ----------
    share : float
        Share of the vehicles that it affects. [1]
    size : tuple of float
        Range of its size over vehicles, in the unit that its callables need: A or [1].
    causes : tuple of str
        A finding is right if it names one of these causes; empty: findings are not judged.
    magnitude : tuple of float or None
        Range of the fault magnitudes of all vehicles [1]; None: as the case of the experiment says.
    truth : callable or None
        From drift, offset [A] and size of n affected sensors, each (n,), to their new drift and offset, still linear.
    hardware : callable or None
        From hardware drift and size of all vehicles, each (N,), to the hardware drift that affected ones have.
    load : callable or None
        From true currents (T, K) and scene to what the first branch (the source) gives in addition, (T,). [A]
    sensor : callable or None
        From what the affected sensor measures (T,) and scene to what it measures in this world (T,). [A]
    disturbance : callable or None
        From scene and T to what is added to the affected sensor, in the recording only, (T,). [A]
    battery : bool
        Whether the affected sensor is always the battery's; else it is the battery's or the motor's.
    """

    share: float = 0.3
    size: tuple[float, float] = (0.0, 0.0)
    causes: tuple[str, ...] = ()
    magnitude: tuple[float, float] | None = None
    truth: Callable[[Array, Array, Array], tuple[Array, Array]] | None = None
    hardware: Callable[[Array, Array], Array] | None = None
    load: Callable[[Array, Scene], Array] | None = None
    sensor: Callable[[Array, Scene], Array] | None = None
    disturbance: Callable[[Scene, int], Array] | None = None
    battery: bool = False


@dataclass(frozen=True, kw_only=True)
class Attack:
    """A world as drawn for N vehicles: which of them it affects, and how much.

    Attributes
    ----------
    world : World
        The world.
    has : ndarray of bool of shape (N,)
        Vehicles that it affects.
    branch : ndarray of int of shape (N,)
        Number of the branch whose sensor is affected.
    size : ndarray of shape (N,)
        Size of the effect, as in :class:`Scene`.
    full_scale_a : float
        Full scale of the junction. [A]
    seed : int
        Seed of this repetition.
    """

    world: World
    has: Mask
    branch: NDArray[np.int64]
    size: Array
    full_scale_a: float
    seed: int

    def truth(self, faults: Faults) -> Faults:
        """Return the linear faults of the fleet in this world, from its faults without it."""
        drift, offset_a, hardware = faults.drift.copy(), faults.offset_a.copy(), faults.hardware_drift
        j = np.flatnonzero(self.has)
        at = (j, self.branch[j])
        if self.world.truth is not None:
            drift[at], offset_a[at] = self.world.truth(drift[at], offset_a[at], self.size[j])
        if self.world.hardware is not None:
            hardware = np.where(self.has, self.world.hardware(hardware, self.size), hardware)
        return replace(faults, drift=drift, offset_a=offset_a, hardware_drift=hardware)

    def true_a(self, vehicle: int, i: Array, *, unseen: bool) -> Array:
        """Return the true currents of a vehicle in this world, shape (T, K), from those without it, i. [A]

        ``unseen``: whether it is the drive on which corrections are judged.
        """
        if not self.has[vehicle] or self.world.load is None:
            return i
        load_a = self.world.load(i, self._scene(vehicle, len(i), unseen=unseen))
        return np.column_stack([i[:, 0] + load_a, i[:, 1:]])

    def measured_a(self, vehicle: int, i_m: Array, *, unseen: bool, peak_a: Array) -> Array:
        """Return the measured currents of a vehicle in this world, shape (T, K), from those of linear sensors, i_m. [A]

        ``unseen`` is as in :meth:`true_a`; ``peak_a`` (K,) has the greatest magnitudes in the recording.
        """
        k, changed = int(self.branch[vehicle]), i_m.copy()
        scene = self._scene(vehicle, len(i_m), unseen=unseen, peak_a=float(peak_a[k]))
        if self.has[vehicle] and self.world.sensor is not None:
            changed[:, k] = self.world.sensor(i_m[:, k], scene)
        if self.has[vehicle] and self.world.disturbance is not None and not unseen:
            changed[:, k] += self.world.disturbance(scene, len(i_m))
        return changed

    def _scene(self, vehicle: int, samples: int, *, unseen: bool, peak_a: float = 0.0) -> Scene:
        rng = random_stream(Purpose.ATTACK, self.seed, vehicle, int(unseen))
        warm = 1.0 - np.exp(-2.0 * np.linspace(0.0, 1.0, samples))
        return Scene(
            size=float(self.size[vehicle]),
            full_scale_a=self.full_scale_a,
            peak_a=peak_a,
            progress=np.ones(samples) if unseen else np.linspace(0.0, 1.0, samples),
            temperature_c=rng.uniform(5.0, 25.0) + rng.uniform(20.0, 30.0) * warm / warm[-1],
            rng=rng,
        )


def draw_attack(name: str, vehicles: int, *, full_scale_a: float, seed: int) -> Attack:
    """Draw which vehicles and sensors of a fleet a world affects, and how much.

    Parameters
    ----------
    name : str
        Name of the world in :data:`WORLDS`.
    vehicles : int
        Fleet size N.
    full_scale_a : float
        Full scale of the junction. [A]
    seed : int
        Seed of this repetition.

    Returns
    -------
    Attack
        The world with what was drawn for the N vehicles.
    """
    world, rng = WORLDS[name], random_stream(Purpose.ATTACK, seed, vehicles, *name.encode())
    signed = world.sensor is not None or world.disturbance is not None
    sign = rng.choice([-1.0, 1.0], vehicles) if signed else 1.0
    return Attack(
        world=world,
        has=rng.random(vehicles) < world.share,
        branch=np.zeros(vehicles, np.int64) if world.battery else rng.integers(0, MOVING, vehicles),
        size=sign * rng.uniform(*world.size, vehicles),
        full_scale_a=full_scale_a,
        seed=seed,
    )


def _on_off(scene: Scene, samples: int, seconds: tuple[float, float], duty: float = 0.5) -> Array:
    """Return a signal that jumps between 1 and 0 at random instants, shape (samples,); its mean is about ``duty``."""
    lengths_s = scene.rng.uniform(*seconds, (2 * int(samples / HZ / seconds[0]) + 2,))
    state = np.arange(len(lengths_s)) % 2 == int(scene.rng.random() < duty)
    lengths_s[~state] *= (1.0 - duty) / duty
    return np.repeat(state.astype(float), (lengths_s * HZ).astype(int))[:samples]


def _spikes(scene: Scene, samples: int, share: float, signs: tuple[float, ...]) -> Array:
    height_a = scene.full_scale_a * scene.rng.uniform(0.1, 1.0, samples) * scene.rng.choice(signs, samples)
    return np.where(scene.rng.random(samples) < share, height_a, 0.0)


def _one_more_gain(d: Array, o: Array, size: Array) -> tuple[Array, Array]:
    return (1.0 + d) * (1.0 + size) - 1.0, o


def _low_pass(x: Array, time_constant_s: float) -> Array:
    """Filter a current by a low-pass of first order."""
    kept = np.exp(-1.0 / (HZ * time_constant_s))
    return np.asarray(lfilter([1.0 - kept], [1.0, -kept], x, zi=[kept * x[0]])[0])


def _mean(x: Array, scene: Scene) -> Array:
    """Return the moving mean of a current over the last ``scene.size`` seconds."""
    samples = round(HZ * abs(scene.size))
    return np.asarray(uniform_filter1d(x, samples, mode="nearest", origin=(samples - 1) // 2))


def _wander(x: Array, scene: Scene) -> Array:
    """Add a random walk to a current; the scene's size is its standard deviation at the end of the drive. [A]"""
    return np.asarray(x + scene.size * np.cumsum(scene.rng.standard_normal(len(x))) / np.sqrt(len(x)))


def _later_gain(d: Array, o: Array, size: Array) -> tuple[Array, Array]:
    """Return drift and offset after the whole step or ramp of the gain."""
    return (1.0 + d) * (1.0 + size) - 1.0, o * (1.0 + size)


def _earlier(x: Array, scene: Scene, part: Array) -> Array:
    """Return what is measured while the gain has made only ``part`` (0 to 1) of its change; x has the whole change."""
    return x * (1.0 + scene.size * part) / (1.0 + scene.size)


Change = Callable[[Array, Scene], Array]


def _load(share: float, size: tuple[float, float], load: Change, *causes: str) -> World:
    """Make the world of a load without a sensor, which the source carries."""
    return World(share=share, size=size, causes=("load", *causes), battery=True, load=load)


def _sensor(size: tuple[float, float], sensor: Change, *causes: str, **more: Any) -> World:
    """Make the world of a sensor that is not linear."""
    return World(size=size, causes=causes, sensor=sensor, **more)


def _disturbed(size: tuple[float, float], added: Callable[[Scene, int], Array], *causes: str) -> World:
    """Make the world of a disturbance that is in the recording, not on the drive on which corrections are judged."""
    return World(size=size, causes=causes, disturbance=added)


def _batch(share: float, offset_a: float) -> World:
    """Make the world of a batch of battery sensors with an offset in common, in addition to their own."""
    size = (offset_a, offset_a)
    return World(share=share, size=size, causes=("batch",), battery=True, truth=lambda d, o, s: (d, o + s))


STEP, BENT, SPIKE = (0.15, 0.15), (0.05, 0.2), (1.0, 1.0)
WORLDS = {
    "faults 30-60 %": World(share=0.0, magnitude=(0.3, 0.6)),
    "small errors in 30%": World(size=(0.3, 1.0), truth=lambda d, o, s: (d + 0.0015 * s, o + 0.5 * s)),
    **{f"battery {a:+g} A in {share:.0%}": _batch(share, a) for share in (1.0, 0.6) for a in (5.0, 12.0, 20.0, -12.0)},
    **{
        f"battery gain +10 % in {share:.0%}": World(share=share, size=(0.1, 0.1), battery=True, truth=_one_more_gain)
        for share in (1.0, 0.6)
    },
    "load 5 A in 30%": _load(0.3, (5.0, 5.0), lambda i, s: np.full(len(i), s.size)),
    "load 10 A in 15%": _load(0.15, (10.0, 10.0), lambda i, s: np.full(len(i), s.size)),
    "load 0-10 % of |motor| in 30%": _load(0.3, (0.0, 0.1), lambda i, s: s.size * np.abs(i[:, 1]), "sign"),
    "load 15 A switching in 15%": _load(
        0.15, (15.0, 15.0), lambda i, s: s.size * _on_off(s, len(i), (20.0, 120.0)), "switching"
    ),
    "inverted in 10%": World(share=0.1, causes=("inverted",), truth=lambda d, o, _: (-2.0 - d, -o)),
    "inverted in 30%": World(causes=("inverted",), truth=lambda d, o, _: (-2.0 - d, -o)),
    "dead in 10%": World(share=0.1, causes=("dead",), truth=lambda d, o, _: (0.0 * d - 1.0, 0.0 * o)),
    "clipped at 40-70 %": _sensor(
        (0.4, 0.7), lambda x, s: np.clip(x, -abs(s.size) * s.peak_a, abs(s.size) * s.peak_a), "clipped", "saturating"
    ),
    "quadratic 5-20 %": _sensor(BENT, lambda x, s: x + s.size * x**2 / s.full_scale_a, "quadratic"),
    "cubic 5-20 %": _sensor(BENT, lambda x, s: x + s.size * x**3 / s.full_scale_a**2, "cubic", "saturating"),
    "gain by sign 5-20 %": _sensor(BENT, lambda x, s: x * np.where(x > 0.0, 1.0 + s.size, 1.0), "sign"),
    "dead zone of 5 A": _sensor((5.0, 5.0), lambda x, s: x - np.clip(x, -abs(s.size), abs(s.size))),
    "low-pass of 1 s": _sensor((1.0, 1.0), lambda x, s: _low_pass(x, abs(s.size))),
    "battery: means over 1 s in 100%": _sensor((1.0, 1.0), _mean, share=1.0, battery=True),
    "zero wanders by 5 A": _sensor((5.0, 5.0), _wander),
    "gain step of 15 % midway": _sensor(
        STEP, lambda x, s: _earlier(x, s, np.ceil(s.progress - 0.5)), "step", truth=_later_gain
    ),
    "gain ramp to 15 %": _sensor(
        STEP, lambda x, s: _earlier(x, s, s.progress), "ramp", "temperature", truth=_later_gain
    ),
    "0.1-0.3 % per K": _sensor(
        (0.001, 0.003), lambda x, s: x * (1.0 + s.size * (s.temperature_c - REFERENCE_C)), "temperature", "ramp"
    ),
    "spikes in 0.5 %": _disturbed(SPIKE, lambda s, n: _spikes(s, n, 0.005, (1.0,)), "spikes"),
    "outliers in 0.2 %": _disturbed(SPIKE, lambda s, n: _spikes(s, n, 0.002, (-1.0, 1.0)), "outliers", "spikes"),
    "EMI bursts of 5-10 A": _disturbed(
        (5.0, 10.0), lambda s, n: s.size * _on_off(s, n, (1.0, 5.0), 0.1) * s.rng.standard_normal(n), "noise"
    ),
    "second variant x1.10 in 50%": World(
        share=0.5, size=(0.1, 0.1), causes=("variant",), hardware=lambda d_h, size: (1.0 + d_h) * (1.0 + size) - 1.0
    ),
}
"""Worlds by the names that the tables show; the share of affected vehicles is in the name where it is not 30 %.

``faults 30-60 %`` affects none of them, but changes the size of all faults."""
