"""Inputs that are computed from a current sensor are recognised by its noise; independent inputs are kept."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from calibrator import Junction
from calibrator.drive import Array, Channel, Drive
from calibrator.drives.computed_inputs import computed_inputs, shared_noise, why_computed

PERIOD_S = 0.1
BRANCHES = ["battery", "motor", "heater"]
Input = Callable[[pd.DataFrame, pd.DataFrame], Array]


def trip(seed: int, minutes: float = 12.0) -> pd.DataFrame:
    """True currents of a trip that is driven in town: power follows the pedal, the heater is switched. [A]"""
    rng, count = np.random.default_rng(seed), round(60.0 * minutes / PERIOD_S)
    pedal = np.repeat(rng.uniform(-0.6, 1.0, count // 50 + 1), 50)[:count]
    motor = -90.0 * np.convolve(pedal, np.ones(20) / 20.0, "same")
    heater = -10.0 * np.repeat(rng.choice([0.0, 0.4, 1.0], count // 300 + 1), 300)[:count]
    return pd.DataFrame(
        {"battery": -motor - heater, "motor": motor, "heater": heater}, index=PERIOD_S * np.arange(count)
    )


def drive_with(make: Input, seed: int, *, every: int = 1, battery_mean: int = 1) -> Drive:
    """A drive with noisy sensors, the motor's with a gain error of 8 %, and the input ``make(measured, true)``.

    Of the input every ``every``-th row is sent. With a ``battery_mean`` of n all channels come n times more rarely, and
    the battery's sensor shows the mean of the n rows before.
    """
    true = trip(seed, minutes=12.0 * battery_mean)
    shown = true.assign(battery=true["battery"].rolling(battery_mean, min_periods=1).mean(), motor=1.08 * true["motor"])
    shown = (shown + np.random.default_rng(seed + 100).normal(0.0, 0.3, true.shape)).iloc[::battery_mean]
    time_s, value = shown.index.to_numpy(), np.asarray(make(shown, true.iloc[::battery_mean]), np.float64)

    def channel(time_s: Array, value: Array) -> Channel:
        return Channel(time_s=time_s, value=value, good=np.isfinite(value))

    branches = {name: channel(time_s, shown[name].to_numpy()) for name in BRANCHES}
    inputs = {"input": channel(time_s[::every], value[::every])}
    return Drive(vehicle=f"V{seed}", name="d", branches=branches, inputs=inputs)


def unbalanced_drive(battery: Array, motor: Array, value: Array) -> Drive:
    """A drive of two branches, between which a current is missing, and an input."""
    time_s, good = PERIOD_S * np.arange(len(motor)), np.ones(len(motor), bool)
    noise = np.random.default_rng(7).normal(0.0, 0.1, (2, len(motor)))

    def channel(value: Array) -> Channel:
        return Channel(time_s=time_s, value=value, good=good)

    branches = {"battery": channel(battery + noise[0]), "motor": channel(motor + noise[1])}
    return Drive(vehicle="V1", name="d", branches=branches, inputs={"input": channel(value)})


def late_battery() -> Drive:
    """Currents that never rest, and a battery sensor that is a sample late; the input is the motor's exact power."""
    rng = np.random.default_rng(1)
    rough = np.convolve(rng.normal(size=20_000), np.ones(3), "same") * np.repeat(rng.uniform(1.0, 4.0, 200), 100)
    return unbalanced_drive(np.roll(rough, 1), -rough, 360.0 * rough)


def ripple_in_battery() -> Drive:
    """A ripple that the motor's sensor does not show; the input is the battery's voltage, which sags with it."""
    motor = trip(1)["motor"].to_numpy()
    battery = -motor + np.random.default_rng(1).normal(0.0, 0.5, len(motor))
    return unbalanced_drive(battery, motor, 380.0 - 0.1 * battery)


def switched_load() -> Drive:
    """A load without a sensor that is switched every second; the input is the demand of all consumers, with noise."""
    motor, rng = trip(1)["motor"].to_numpy(), np.random.default_rng(1)
    load = np.repeat(rng.choice([0.0, 8.0], len(motor) // 10 + 1), 10)[: len(motor)]
    return unbalanced_drive(load - motor, motor, 360.0 * (load - motor + rng.normal(0.0, 0.2, len(motor))))


def switched_branch() -> Drive:
    """A branch that is switched every three seconds, which the battery shows as a mean; the input is its demand."""
    switched = np.repeat(np.random.default_rng(1).choice([0.0, 0.4, 1.0], 2000), 30)
    battery = np.convolve(switched, np.ones(10) / 10.0)[: len(switched)]
    return unbalanced_drive(20.0 * battery, -20.0 * switched, 7200.0 * switched)


def rippling_torque() -> Drive:
    """A ripple of the motor that the battery's sensor filters; the input is the torque, at a speed that changes."""
    rng, motor = np.random.default_rng(1), trip(1)["motor"].to_numpy()
    speed = np.interp(np.arange(len(motor)), np.linspace(0.0, len(motor), 40), rng.uniform(0.3, 3.0, 40))
    rippling = motor + rng.normal(0.0, 0.6, len(motor))
    return unbalanced_drive(-motor, rippling, -rippling / speed)


def computed_in(drives: list[Drive]) -> dict[str, str]:
    layout = Junction(branches=BRANCHES, full_scale_a=400.0).as_database(["input"], PERIOD_S).layout
    return computed_inputs([shared_noise(drive, ["input", "not recorded"], layout) for drive in drives])


def voltage(battery_a: pd.Series) -> pd.Series:
    """Voltage that sags with the battery's current. [V]"""
    return 370.0 - 0.08 * battery_a


@pytest.mark.parametrize(("make", "every", "branch"), [
    (lambda m, _: m["battery"] * voltage(m["battery"]), 1, "battery"),
    (lambda m, _: (m["battery"] * voltage(m["battery"]) / 100.0).round() / 10.0, 1, "battery"),
    (lambda m, _: m["motor"] * -0.36, 1, "motor"),
    (lambda m, _: m["heater"] * -360.0, 1, "heater"),
    (lambda m, _: (m["battery"] * 360.0).shift(4), 1, "battery"),
    (lambda m, _: m["battery"] * 360.0, 3, "battery"),
    (lambda m, _: np.repeat(m["battery"].to_numpy()[::2], 2), 1, "battery"),
    (lambda m, _: 360.0 * (m["battery"] + m["heater"]), 1, "motor"),
], ids=[
    "power", "power in steps of 0.1 kW", "motor power", "heater power", "0.4 s late", "sent less often",
    "held for 0.2 s", "sum of battery and heater",
])  # fmt: skip
def test_input_that_is_computed_from_a_current_sensor_is_found(make: Input, every: int, branch: str) -> None:
    computed = computed_in([drive_with(make, seed, every=every) for seed in range(5)])
    assert computed == {"input": branch}
    assert why_computed(computed).startswith(f"input (most like {branch}), as if computed from current sensors")


@pytest.mark.parametrize(("make", "battery_mean"), [
    (lambda _, t: t["motor"] * -360.0, 1),
    (lambda _, t: t["heater"] * -360.0, 1),
    (lambda _, t: t["battery"] * 360.0, 10),  # the battery's mean and the motor differ by a current, which is no noise
    (lambda _, t: t["motor"] * -360.0, 10),
    (lambda m, _: np.full(len(m), 5.0), 1),
], ids=[
    "true motor power", "true heater power", "true battery power, battery shows means of 1 s",
    "true motor power, battery shows means of 1 s", "constant",
])  # fmt: skip
def test_independent_input_is_kept_however_well_it_explains_a_current(make: Input, battery_mean: int) -> None:
    assert computed_in([drive_with(make, seed, battery_mean=battery_mean) for seed in range(5)]) == {}


@pytest.mark.parametrize("drive", [
    late_battery, ripple_in_battery, switched_load, switched_branch, rippling_torque,
], ids=[
    "late (liveliest stretches)", "voltage and ripple (not 0 within full scale)", "switched load (wild differences)",
    "switched branch (changes rarely)", "torque (like no current)",
])  # fmt: skip
def test_independent_input_is_kept_where_a_sensor_is_late_or_shows_less_than_the_others(
    drive: Callable[[], Drive],
) -> None:
    assert computed_in([drive()]) == {}


def test_input_is_kept_if_it_is_computed_in_one_vehicle_of_six() -> None:
    def computed(m: pd.DataFrame, _: pd.DataFrame) -> Array:
        return np.asarray(m["battery"] * 360.0)

    def own(_: pd.DataFrame, t: pd.DataFrame) -> Array:
        return np.asarray(t["battery"] * 360.0)

    assert computed_in([drive_with(computed, 0), *(drive_with(own, seed) for seed in range(1, 6))]) == {}


def test_input_without_values_or_at_another_time_is_kept() -> None:
    drive = drive_with(lambda m, _: m["battery"] * 360.0, 0)
    shown = drive.inputs["input"]
    unusable = replace(shown, good=np.zeros(len(shown.good), np.bool_))
    later = replace(shown, time_s=shown.time_s + 1000.0)
    assert computed_in([drive]) == {"input": "battery"}
    assert computed_in([replace(drive, inputs={"input": each}) for each in (unusable, later)]) == {}
    assert computed_in([]) == {}
