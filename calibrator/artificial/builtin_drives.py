"""Drives without any recording: a fastsim vehicle on its own cycles, cut and joined into different trips.

fastsim (NREL) gives speed and mechanical and electrical motor power at 1 Hz for a battery-electric car on the UDDS and
HWFET cycles. This module adds the other branches of such a car's junction: heater and air conditioning, the converter
to the low-voltage net, a rear motor that takes a share of the torque, and the battery, which supplies all of them.

Currents are positive into the junction.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from types import ModuleType

import numpy as np
from scipy.interpolate import PchipInterpolator
from scipy.signal import lfilter

from calibrator.drive import Array
from calibrator.errors import FleetError

__all__ = ["BUILTIN_BRANCHES", "BUILTIN_INPUTS", "GroundTruth", "builtin_trip"]

BUILTIN_BRANCHES = ("battery", "motor", "auxiliary", "dcdc", "motor_rear")
BUILTIN_INPUTS = (
    "voltage", "torque", "speed", "acceleration", "accelerator", "heater_demand", "aircon_demand", "low_voltage_demand",
)  # fmt: skip
"""Inputs of ``dbc/hv_powertrain.toml``, in the units of its DBC."""

VEHICLE = "2022_Renault_Zoe_ZE50_R135.yaml"
CYCLES = ("udds.csv", "hwfet.csv")
STYLE = (1.0, 1.5)
"""Range of factors by which a driver hurries a cycle's time: accelerations grow with it. [1]"""

PERIOD_S = 0.1
OPEN_CIRCUIT_V = (330.0, 400.0)
"""Open-circuit voltage of the battery at 0 and 100 % charge. [V]"""
RESISTANCE_OHM = 0.08
GEAR_RAD_PER_M = 9.3 / 0.31
"""Motor angle per distance: gear ratio over tyre radius. [rad/m]"""
SLOWEST_RAD_S = 5.0
"""Motor speed below which power is not divided by speed to give torque. [rad/s]"""
MOTOR_W = 100e3
HEATER_LAG_S, AIRCON_LAG_S, DCDC_LAG_S = 8.0, 4.0, 0.4
DCDC_EFFICIENCY = 0.93


@dataclass(frozen=True, kw_only=True)
class GroundTruth:
    """One trip of the ideal vehicle.

    Attributes
    ----------
    name : str
        Name of the trip.
    period_s : float
        Sample period. [s]
    currents_a : mapping of str to ndarray of shape (T,)
        Ideal current of each branch, positive into the junction; they sum to zero. [A]
    inputs : mapping of str to ndarray of shape (T,)
        Inputs by the names of the layout, in the units of its DBC.
    """

    name: str
    period_s: float
    currents_a: Mapping[str, Array]
    inputs: Mapping[str, Array]

    def __len__(self) -> int:
        return len(next(iter(self.currents_a.values())))

    @property
    def time_s(self) -> Array:
        """Instants of the samples since the start, shape (T,). [s]"""
        return self.period_s * np.arange(float(len(self)))

    def matrix_a(self) -> Array:
        """Return the currents as an array of shape (T, K), branches in the order of ``currents_a``. [A]"""
        return np.stack(list(self.currents_a.values()), axis=1)

    @classmethod
    def joined(cls, trips: Sequence["GroundTruth"], name: str) -> "GroundTruth":
        """Join trips one after the other, with the inputs that all of them have."""
        first = trips[0]
        common = [key for key in first.inputs if all(key in trip.inputs for trip in trips)]
        return cls(
            name=name,
            period_s=first.period_s,
            currents_a={key: np.concatenate([trip.currents_a[key] for trip in trips]) for key in first.currents_a},
            inputs={key: np.concatenate([trip.inputs[key] for trip in trips]) for key in common},
        )

    def part(self, start: int, stop: int) -> "GroundTruth":
        """Return the samples from start to stop (excluded) as a trip of its own."""
        return GroundTruth(
            name=self.name,
            period_s=self.period_s,
            currents_a={name: x[start:stop] for name, x in self.currents_a.items()},
            inputs={name: x[start:stop] for name, x in self.inputs.items()},
        )


def builtin_trip(rng: np.random.Generator, *, duration_s: float, name: str) -> GroundTruth:
    """Return one random trip of the built-in vehicle, sampled at :data:`PERIOD_S`.

    Parameters
    ----------
    rng : numpy.random.Generator
        Source of chance: which parts of the cycles, in which style, and how the auxiliaries are used.
    duration_s : float
        Least duration, to within a second. [s]
    name : str
        Name of the trip.

    Returns
    -------
    GroundTruth
        Branches :data:`BUILTIN_BRANCHES` and inputs :data:`BUILTIN_INPUTS`.

    Raises
    ------
    FleetError
        If fastsim is not installed.
    """
    speed_ms, mechanical_w, electrical_w, charge = _drive(_speed_trace(rng, duration_s))
    samples = len(speed_ms)
    heater_demand = _random_steps(rng, samples, mean_s=90.0, levels=(0.0, 0.0, 800.0, 2000.0, 4000.0, 5500.0))
    aircon_demand = _random_steps(rng, samples, mean_s=60.0, levels=(0.0, 300.0, 700.0, 1500.0, 2500.0))
    low_voltage_demand = _random_steps(rng, samples, mean_s=30.0, levels=(250.0, 350.0, 450.0, 700.0, 1100.0))
    auxiliary_w = _lag(heater_demand, HEATER_LAG_S) + _lag(aircon_demand, AIRCON_LAG_S)
    dcdc_w = _lag(low_voltage_demand, DCDC_LAG_S) / DCDC_EFFICIENCY
    battery_a, voltage = _battery(electrical_w + auxiliary_w + dcdc_w, charge)
    torque = mechanical_w / np.maximum(GEAR_RAD_PER_M * speed_ms, SLOWEST_RAD_S)
    rear_share = 0.2 + 0.3 * np.minimum(np.abs(torque) / 200.0, 1.0)
    motor_a = electrical_w / voltage
    return GroundTruth(
        name=name,
        period_s=PERIOD_S,
        currents_a={
            "battery": battery_a,
            "motor": -(1.0 - rear_share) * motor_a,
            "auxiliary": -auxiliary_w / voltage,
            "dcdc": -dcdc_w / voltage,
            "motor_rear": -rear_share * motor_a,
        },
        inputs={
            "voltage": voltage,
            "torque": torque,
            "speed": 3.6 * speed_ms,
            "acceleration": np.gradient(speed_ms, PERIOD_S),
            "accelerator": np.clip(100.0 * mechanical_w / MOTOR_W, 0.0, 100.0),
            "heater_demand": heater_demand,
            "aircon_demand": aircon_demand,
            "low_voltage_demand": low_voltage_demand,
        },
    )


def _speed_trace(rng: np.random.Generator, duration_s: float) -> Array:
    """Join random parts of the cycles, each driven in a style of its own, into speeds at 1 Hz. [m/s]"""
    pieces = _microtrips()
    parts: list[Array] = [np.zeros(3)]
    while sum(map(len, parts)) < duration_s:
        piece = pieces[rng.integers(len(pieces))]
        style = rng.uniform(*STYLE)
        hurried = np.interp(np.arange(0.0, len(piece) - 1, style), np.arange(len(piece)), piece)
        parts += [hurried, np.zeros(rng.integers(4, 20))]
    return np.concatenate(parts)


def _microtrips() -> list[Array]:
    """Return the parts of the cycles between two standstills, each as speeds at 1 Hz. [m/s]"""
    fastsim = _fastsim()
    pieces: list[Array] = []
    for name in CYCLES:
        speed = np.asarray(fastsim.Cycle.from_resource(name).to_dict()["speed_meters_per_second"])
        stops = np.flatnonzero(speed < 0.05)
        pieces += [speed[a : b + 1] for a, b in pairwise(stops) if b - a > 1]
    return pieces


def _drive(speed_ms: Array) -> tuple[Array, Array, Array, Array]:
    """Let the fastsim vehicle follow speeds [m/s] given at 1 Hz.

    Return at 10 Hz: speed [m/s], mechanical and electrical motor power [W], state of charge [1].
    """
    fastsim = _fastsim()
    seconds = np.arange(float(len(speed_ms)))
    vehicle = fastsim.Vehicle.from_resource(VEHICLE)
    vehicle.set_save_interval(1)
    cycle = fastsim.Cycle.from_dict({"time_seconds": seconds.tolist(), "speed_meters_per_second": speed_ms.tolist()})
    run = fastsim.SimDrive(vehicle, cycle)
    run.walk()
    table = run.to_dataframe()
    fine = np.arange(0.0, seconds[-1], PERIOD_S)
    motor = "veh.pt_type.BEV.em.history."
    names = (
        "veh.history.speed_ach_meters_per_second",
        f"{motor}pwr_mech_prop_out_watts",
        f"{motor}pwr_elec_prop_in_watts",
        "veh.pt_type.BEV.res.history.soc",
    )
    speed, mechanical, electrical, charge = (
        np.asarray(PchipInterpolator(seconds, table[name].to_numpy())(fine)) for name in names
    )
    return np.maximum(speed, 0.0), mechanical, electrical, charge


def _battery(power_w: Array, charge: Array) -> tuple[Array, Array]:
    """Return current [A], positive on discharge, and terminal voltage [V] of a battery that gives this power."""
    open_v = OPEN_CIRCUIT_V[0] + (OPEN_CIRCUIT_V[1] - OPEN_CIRCUIT_V[0]) * charge
    current = (open_v - np.sqrt(open_v**2 - 4.0 * RESISTANCE_OHM * power_w)) / (2.0 * RESISTANCE_OHM)
    return current, open_v - RESISTANCE_OHM * current


def _random_steps(rng: np.random.Generator, samples: int, *, mean_s: float, levels: tuple[float, ...]) -> Array:
    """Return a demand that jumps between levels at random instants, on average mean_s apart. [W]"""
    jumps = rng.random(samples) < PERIOD_S / mean_s
    return np.asarray(rng.choice(levels, size=int(jumps.sum()) + 1)[np.cumsum(jumps)])


def _lag(demand: Array, time_constant_s: float) -> Array:
    """Filter a demand by a first-order lag that starts at rest in its first value."""
    pole = np.exp(-PERIOD_S / time_constant_s)
    return np.asarray(lfilter([1.0 - pole], [1.0, -pole], demand, zi=[pole * demand[0]])[0])


def _fastsim() -> ModuleType:
    """Return the fastsim package; if it is not installed, FleetError says how to install it."""
    try:
        import fastsim  # noqa: PLC0415
    except ImportError:
        raise FleetError(
            "builtin drives need fastsim; install the extra: pip install 'hv-current-correction[demo]'"
        ) from None
    module: ModuleType = fastsim
    return module
