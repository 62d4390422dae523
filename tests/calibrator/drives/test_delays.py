from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from calibrator.drive import Array, Channel, Drive, Mask
from calibrator.drives.delays import estimate_delays, without_delays
from calibrator.errors import DriveError
from tests.calibrator.drives.delayed_drives import MadeUp, made_up_drive

TWO = ("battery", "motor")
THREE = ("battery", "motor", "auxiliary")
PAIR = MadeUp(
    size_a={"motor": 50.0},
    delay_s={"battery": 0.05, "motor": 0.237},
    gain={"battery": 1.1, "motor": 0.85},
    offset_a={"motor": 60.0},
    noise_a=0.4,
)
TRIO = MadeUp(
    size_a={"motor": 50.0, "auxiliary": 10.0},
    delay_s={"battery": 0.25, "motor": 0.02, "auxiliary": 0.183},
    noise_a=0.4,
    stepping=frozenset({"auxiliary"}),
)


def changed(branch: str, change: Callable[[Channel], Channel]) -> Drive:
    """A drive of the pair of which one branch is changed."""
    drive = made_up_drive(1, PAIR)
    return replace(drive, branches={**drive.branches, branch: change(drive.branches[branch])})


def with_value(branch: str, change: Callable[[Array], Array]) -> Drive:
    return changed(branch, lambda channel: replace(channel, value=change(channel.value)))


def kept(channel: Channel, which: Mask) -> Channel:
    return Channel(time_s=channel.time_s[which], value=channel.value[which], good=channel.good[which])


SIMILAR = MadeUp(
    size_a={"motor": 50.0, "motor_rear": 80.0, "dcdc": 20.0},
    delay_s={"battery": 0.1, "motor": 0.28, "motor_rear": 0.0, "dcdc": 0.2},
    noise_a=0.2,
    alike=0.95,
)


@pytest.mark.parametrize(("vehicle", "branches", "delays_s", "within_s"), [
    *((replace(PAIR, delay_s={"battery": 0.5, "motor": 0.5 + late_s}), TWO, [late_s], 1e-3)
      for late_s in (-0.49, -0.301, 0.0, 0.0137, 0.187, 0.49)),
    (SIMILAR, ("battery", "motor", "motor_rear", "dcdc"), [0.18, -0.1, 0.1], 5e-3),
])  # fmt: skip
def test_delays_are_found_whatever_gains_and_offsets_the_sensors_have(
    vehicle: MadeUp, branches: tuple[str, ...], delays_s: list[float], within_s: float
) -> None:
    found = estimate_delays([made_up_drive(4, vehicle)], branches)
    assert found.branches == branches
    assert found.known.all()
    np.testing.assert_allclose(found.delay_s, [0.0, *delays_s], atol=within_s)
    assert found.sd_s[0] == 0.0
    assert ((found.sd_s[1:] > 0.0) & (found.sd_s[1:] < within_s)).all()


def honest_sd_s(vehicles: list[MadeUp], branches: tuple[str, ...]) -> Array:
    """Return the stated standard deviations of the last branch's delay; the errors must have this size and mean 0."""
    drives = [made_up_drive(seed, vehicle) for seed, vehicle in enumerate(vehicles)]
    found = [estimate_delays([drive], branches, max_sd_s=0.05) for drive in drives]
    delay_s, sd_s = np.array([(each.delay_s[-1], each.sd_s[-1]) for each in found]).T
    error_s = delay_s - [vehicle.delay_s[branches[-1]] for vehicle in vehicles]
    assert abs(error_s.mean()) < 3.0 * error_s.std() / np.sqrt(len(vehicles))
    assert 0.7 < np.sqrt(np.mean((error_s / sd_s) ** 2)) < 1.5
    return np.asarray(sd_s)


def test_noise_does_not_bias_the_delay_at_any_phase_of_the_frames() -> None:
    """Frames of 50 and 100 Hz with fixed phases: over many phases and noises the mean error is zero."""
    small = replace(PAIR, size_a={"motor": 5.0}, duration_s=100.0)
    honest_sd_s([replace(small, delay_s={"motor": 0.1 + 0.02 * k / 40.0}) for k in range(40)], TWO)


def test_delay_of_a_noisy_branch_is_unbiased_and_its_standard_deviation_is_right() -> None:
    """Steps of 1.5 A under noise of 0.4 A."""
    small = replace(TRIO, size_a={"motor": 50.0, "auxiliary": 1.5}, duration_s=600.0)
    sd_s = honest_sd_s([replace(small, delay_s={"auxiliary": 0.1 + 0.05 * k / 30.0}) for k in range(30)], THREE)
    assert np.isfinite(sd_s).all()
    assert np.median(sd_s) < 5.3e-3


def test_more_drives_reduce_the_standard_deviation_of_the_delay() -> None:
    drives = [made_up_drive(seed, TRIO, name=f"d{seed}") for seed in range(4)]
    one, four = estimate_delays(drives[:1], THREE), estimate_delays(drives, THREE)
    assert np.all(four.sd_s[1:] < 0.8 * one.sd_s[1:])
    np.testing.assert_allclose(four.delay_s, [0.0, -0.23, -0.067], atol=4e-3)


def test_no_delay_remains_after_delays_are_removed() -> None:
    drive = made_up_drive(1, PAIR)
    value, time_s = drive.branches["motor"].value.copy(), drive.branches["motor"].time_s.copy()
    aligned = without_delays(drive, estimate_delays([drive], TWO).by_branch())
    assert estimate_delays([aligned], TWO).delay_s[1] == pytest.approx(0.0, abs=1e-5)
    np.testing.assert_array_equal(drive.branches["motor"].time_s, time_s)
    np.testing.assert_array_equal(drive.branches["motor"].value, value)
    assert aligned.branches["battery"].time_s.tolist() == drive.branches["battery"].time_s.tolist()


DRAWN = np.random.default_rng(2)
NOISE = DRAWN.normal(size=100_000)


def without_some(channel: Channel) -> Channel:
    good = DRAWN.random(len(channel.good)) > 0.1
    return replace(channel, value=np.where(good, channel.value, np.nan), good=good)


@pytest.mark.parametrize(("drive", "within_s"), [
    (with_value("motor", lambda a: np.where(np.arange(len(a)) % 2500 < 5, 650.0, a)), 5e-3),
    (changed("motor", lambda c: kept(c, np.floor(c.time_s / 20.0) % 3 != 0)), 1e-3),
    (changed("motor", without_some), 1e-3),
    (changed("battery", lambda c: replace(c, value=c.value + 4.0 * (np.floor(c.time_s / 17.0) % 2))), 2e-3),
    (with_value("motor", lambda a: np.where(a > 60.0, 1.15, 0.95) * (a - 60.0)), 3e-3),
], ids=["wild samples", "gaps", "bad samples", "offset that steps", "a gain for each sign"])  # fmt: skip
def test_gaps_outliers_steps_and_sensor_faults_hardly_change_the_delay(drive: Drive, within_s: float) -> None:
    found = estimate_delays([drive], TWO, max_sd_s=0.02)
    assert found.known.all()
    assert found.delay_s[1] == pytest.approx(0.187, abs=within_s)


NO_SAMPLES = changed("motor", lambda c: replace(c, good=np.zeros(len(c.good), np.bool_)))
SHORT = made_up_drive(1, replace(PAIR, duration_s=30.0))


@pytest.mark.parametrize("drive", [
    *(with_value(branch, lambda a: np.full(len(a), 12.0)) for branch in TWO),
    *(with_value(branch, lambda a: 12.0 + 0.4 * NOISE[: len(a)]) for branch in TWO),
    with_value("motor", lambda a: -a),
    made_up_drive(1, replace(PAIR, size_a={"motor": 0.0})),
    made_up_drive(1, replace(PAIR, delay_s={"motor": 0.8})),
    NO_SAMPLES,
    SHORT,
], ids=["battery constant", "motor constant", "battery noise alone", "motor noise alone", "motor with a wrong sign",
        "motor off", "delay beyond the longest", "no good samples", "short drive"])  # fmt: skip
def test_delay_is_marked_as_not_known_if_the_drive_does_not_show_it(drive: Drive) -> None:
    found = estimate_delays([drive], TWO)
    assert found.known.tolist() == [True, False]
    assert found.delay_s.tolist() == [0.0, 0.0]
    assert found.sd_s.tolist() == [0.0, np.inf]


def test_missing_drives_or_branches_are_refused() -> None:
    drive = made_up_drive(1, replace(PAIR, duration_s=1.0))
    with pytest.raises(DriveError, match="no drive to estimate delays from"):
        estimate_delays([], TWO)
    with pytest.raises(DriveError, match="vehicle V1, drive d: no branch heater; it has battery, motor"):
        estimate_delays([drive], ("battery", "heater"))
    with pytest.raises(DriveError, match="choose at least two"):
        estimate_delays([drive], ("battery",))
    with pytest.raises(DriveError, match="no branch heater"):
        without_delays(drive, {"heater": 0.1})
