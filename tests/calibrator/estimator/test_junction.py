"""A single junction: gains from a trusted sensor, offsets from load or charge balance, and what stays undetermined."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from calibrator import Junction, JunctionCalibrator
from calibrator.errors import ContradictionError, DriveError, FleetError
from tests.calibrator.command_here import calibrator as command
from tests.calibrator.command_here import reported, succeeded

JUNCTION = Junction(branches=["battery", "motor", "heater"], full_scale_a=400.0)
SECONDS, PERIOD_S = 240.0, 0.1


def recording(
    seed: int = 1,
    *,
    gain: tuple[float, float, float] = (0.0, 0.0, 0.0),
    offset_a: tuple[float, float, float] = (0.0, 0.0, 0.0),
    load_a: float = 0.0,
    heater_a: float | None = None,
    seconds: float = SECONDS,
) -> pd.DataFrame:
    """Three currents of a drive; what no branch measures flows out of the junction. None: the heater switches."""
    rng, time_s = np.random.default_rng(seed), np.arange(0.0, seconds, PERIOD_S)
    motor_a = 40.0 * np.convolve(rng.normal(size=len(time_s) + 19), np.full(20, 0.22), "valid")
    switched_a = 12.0 * np.repeat(rng.integers(0, 2, len(time_s) // 150 + 1), 150)[: len(time_s)]
    heated_a = switched_a if heater_a is None else np.full(len(time_s), heater_a)
    true_a = np.stack([motor_a + heated_a + load_a, -motor_a, -heated_a], axis=1)
    measured_a = true_a * (1.0 + np.array(gain)) + offset_a + rng.normal(0.0, 0.2, true_a.shape)
    return pd.DataFrame(measured_a, columns=list(JUNCTION.branches), index=time_s)


def found(frames: Any, **known: Any) -> pd.DataFrame:
    return JunctionCalibrator(**known).fit(frames, JUNCTION).parameters_.set_index(["vehicle", "branch"])


@pytest.fixture(scope="module")
def motor_off() -> pd.DataFrame:
    return recording(gain=(0.0, 0.05, 0.0))


MOTOR_READ = pd.DataFrame({"vehicle": ["vehicle"], "branch": ["motor"], "drift": [0.05], "drift_sd": [0.001]})


@pytest.mark.long
def test_corrections_of_random_junctions_raise_no_error_by_more_than_0_05_percent_of_full_scale() -> None:
    """600 cars with a gain error of the motor, offsets and loads that may be there, and a trusted battery sensor."""
    rng, growth_a = np.random.default_rng(5), []
    for case in range(600):
        gain, seed = rng.choice([-1.0, 1.0]) * rng.uniform(0.02, 0.15), int(rng.integers(10**6))
        load_a, mean_a = rng.choice([0.0, 0.0, 3.0, 20.0]), rng.choice([0.0, 20.0, 60.0, -40.0])
        sizes_a = rng.choice([-1.0, 1.0], 3) * 10.0 ** rng.uniform(-0.3, 1.5, 3)
        offset_a = np.where(rng.random(3) < 0.25, sizes_a, 0.0) * [0.0, 1.0, case % 3 != 2]
        more: list[dict[str, Any]] = [{}, {"load": (load_a, 0.2)}, {"trusted": ["battery", "heater"]}]
        car: dict[str, Any] = {"load_a": load_a, "seconds": 120.0, "heater_a": 50.0 if case % 4 == 3 else None}
        measured = recording(seed, gain=(0.0, gain, 0.0), offset_a=tuple(offset_a), **car)
        true = recording(seed, **car)  # and the same noise
        for frame, factor in ((measured, 1.0 + gain), (true, 1.0)):
            frame["battery"] += mean_a
            frame["motor"] -= factor * mean_a
        rows = found(measured, **({"trusted": ["battery"]} | more[case % 3])).loc["vehicle"]
        for name, row in rows[rows.corrected].iterrows():
            shown = measured[name], (measured[name] - row.offset_a) / (1.0 + row.gain_error)
            before, after = (np.sqrt(np.mean((each - true[name]) ** 2)) for each in shown)
            growth_a.append(after - before)
    assert len(growth_a) > 150
    assert np.max(growth_a) < 0.0005 * 400.0
    assert np.mean(np.array(growth_a) > 0.0) < 0.02


@pytest.mark.parametrize(("fault", "known", "corrected"), [
    ({"gain": (0.0, 0.05, 0.0)}, {"trusted": ["battery"]}, {"motor"}),
    pytest.param({"gain": (0.03, 0.05, 0.0)}, {"readings": MOTOR_READ}, {"battery", "motor"}, id="motor on a bench"),
    ({"offset_a": (0.0, 4.0, 0.0)}, {"trusted": ["battery"]}, set()),
    # of two branches the declared load leaves one offset; of three the gain alone is corrected
    ({"offset_a": (0.0, 4.0, 0.0), "load_a": 3.0}, {"trusted": ["battery", "heater"], "load": (3.0, 0.2)}, {"motor"}),
    ({"gain": (0.0, 0.1, 0.0), "offset_a": (0.0, 0.0, 6.0)}, {"trusted": ["battery"], "load": (0.0, 0.1)}, {"motor"}),
    ({"gain": (0.4, 0.0, 0.0), "offset_a": (3.0, 0.0, 0.0), "load_a": 30.0},
     {"trusted": ["motor", "heater"], "load": (30.0, 0.1)}, {"battery"}),
    ({}, {"trusted": ["battery"], "load": (0.0, 0.1)}, set()),
])  # fmt: skip
def test_faults_are_estimated_within_3_sd_and_only_sure_branches_are_corrected(
    fault: dict[str, Any], known: dict[str, Any], corrected: set[str]
) -> None:
    rows = found(recording(**fault), **known).loc["vehicle"]
    gain, offset_a = (np.array(fault.get(name, (0.0, 0.0, 0.0))) for name in ("gain", "offset_a"))
    assert (np.abs(rows.gain_error - gain) < 3.0 * rows.gain_error_sd).all()
    assert rows.gain_error_sd.max() < 0.01
    assert set(rows.index[rows.corrected]) == corrected
    assert (np.abs(rows.offset_a - offset_a) < 3.0 * rows.offset_sd_a).all()


@pytest.mark.parametrize(("missing", "gain"), [(0.0, 0.1), (25.0, 0.1), (0.0, 0.4)])
def test_charge_balance_determines_an_offset(missing: float, gain: float) -> None:
    """Also of a sensor with a gain error, and where a tenth of the samples of another branch are missing."""
    frame = recording(offset_a=(5.0, 0.0, 0.0), gain=(gain, 0.0, 0.0), load_a=30.0)
    true_ah = float((frame["battery"] - 5.0).mean()) / (1.0 + gain) * SECONDS / 3600.0
    frame.loc[100.0 : 100.0 + missing, "heater"] = np.nan
    row = found(frame, trusted=["motor"], charge_ah={"battery": (true_ah, 0.01)}).loc["vehicle", "battery"]
    assert row.offset_a == pytest.approx(5.0, abs=0.5)
    assert row.offset_sd_a < 0.5


@pytest.mark.parametrize("first_s", [0.0, 100.0])
def test_charge_across_a_gap_is_known_as_far_as_the_current_varies(first_s: float) -> None:
    """No sensor is wrong, and 10 s are missing, at the start or where 60 A more flow."""
    frame = recording(load_a=60.0)
    missing = (frame.index >= first_s) & (frame.index < first_s + 10.0)
    frame.loc[missing, ["battery", "motor"]] += [60.0, -60.0]
    charge_ah = float(frame["battery"].mean()) * SECONDS / 3600.0
    known = {"trusted": ["motor"], "charge_ah": {"battery": (charge_ah, 0.001)}}
    row = found(frame.assign(battery=frame["battery"].mask(missing)), **known).loc["vehicle", "battery"]
    assert abs(row.offset_a) < 2.0 * row.offset_sd_a
    assert not row.corrected


def test_charge_across_many_short_gaps_is_known_nearly_as_well() -> None:
    frame = recording(offset_a=(5.0, 0.0, 0.0), load_a=30.0)
    charge_ah = float((frame["battery"] - 5.0).mean()) * SECONDS / 3600.0
    lost = np.isin(np.arange(len(frame)) % 100, range(4))
    row = found(frame[~lost], trusted=["motor"], charge_ah={"battery": (charge_ah, 0.005)}).loc["vehicle", "battery"]
    assert row.corrected
    assert row.offset_a == pytest.approx(5.0, abs=0.5)


def test_gain_is_corrected_alone_where_no_offset_is_suspected() -> None:
    """Of a heater whose offset, a mean of none and several, would add more error; one that was read is corrected."""
    frame = recording(gain=(0.0, 0.08, -0.03), offset_a=(0.0, 0.8, 0.0))
    frame["dcdc"] = -3.0 - np.sin(frame.index.to_numpy() / 7.0)
    frame["battery"] -= frame["dcdc"]
    read = pd.DataFrame({"vehicle": "vehicle", "branch": ["battery", "motor"], "offset_a": [0.0, 0.8]})
    read = read.assign(offset_sd_a=0.05, drift=[0.0, np.nan], drift_sd=[0.002, np.nan])
    junction = Junction(branches=[*JUNCTION.branches, "dcdc"], full_scale_a=500.0)
    parameters = JunctionCalibrator(readings=read, load=(0.0, 0.1)).fit(frame, junction).parameters_
    rows = parameters.set_index("branch")
    assert rows.corrected[["motor", "heater"]].all()
    assert rows.gain_error["heater"] == pytest.approx(-0.03, abs=0.01)
    assert rows.offset_a["heater"] == 0.0
    assert rows.offset_a["motor"] == pytest.approx(0.8, abs=0.2)


def test_nothing_is_corrected_where_one_branch_is_a_mean_over_the_distance_of_the_rows() -> None:
    """As in rows of a second from a battery management system: gains differ between slow and fast changes."""
    frame = recording(seconds=1800.0)
    frame["battery"] = frame["battery"].rolling(10, min_periods=1).mean()
    calibrator = JunctionCalibrator(trusted=["battery"], load=(0.0, 0.1)).fit(frame.iloc[::10], JUNCTION)
    assert any(
        "gains of battery and motor differ between slow and fast changes" in text for text in calibrator.notices_
    )
    assert not calibrator.parameters_["corrected"].any()


def test_gain_of_a_branch_that_moves_little_is_known_less_well() -> None:
    """A sum that moves by 0.003 % of full scale with a current that moves by 0.15 % of it looks like 2 %."""
    frame = recording()
    frame["battery"] += 0.9 * frame["heater"]
    frame["heater"] *= 0.1
    assert found(frame, trusted=["battery"]).gain_error_sd["vehicle", "heater"] > 0.025


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_offset_reading_of_the_wrong_sign_is_noticed_by_the_junction_sum(sign: float) -> None:
    read = pd.DataFrame({"vehicle": ["vehicle"], "branch": ["battery"], "offset_a": [6.0 * sign], "offset_sd_a": [0.1]})
    calibrator = JunctionCalibrator(trusted=["motor"], readings=read).fit(recording(offset_a=(6.0, 0.0, 0.0)), JUNCTION)
    noticed = [text for text in calibrator.notices_ if "makes the junction sum worse; check the values and" in text]
    assert len(noticed) == (sign < 0.0)
    assert all("; vehicle: RMS 6.0" in text for text in noticed)


@pytest.mark.parametrize(("offset_a", "factor"), [(5.0, 1.0), (5.0, -1.0), (5.0, 0.36), (5.0, 0.0), (0.0, 1.1)])
def test_charge_that_only_a_second_opposite_offset_could_explain_corrects_nothing(
    offset_a: float, factor: float
) -> None:
    """A slip of the sign, kWh for Ah, none at all, or of a longer time than the recording."""
    frame = recording(offset_a=(offset_a, 0.0, 0.0)).add([30.0, -30.0, 0.0])
    true_ah = float((frame["battery"] - offset_a).mean()) * SECONDS / 3600.0
    charge_ah = {"battery": (factor * true_ah, 0.01)}
    calibrator = JunctionCalibrator(trusted=["motor"], load=(0.0, 0.1), charge_ah=charge_ah).fit(frame, JUNCTION)
    noticed = [text for text in calibrator.notices_ if "check value and sign of charge_ah" in text]
    assert len(noticed) == (factor != 1.0)
    assert calibrator.parameters_["corrected"].any() == (factor == 1.0)


@pytest.mark.parametrize(("offset_a", "load_a"), [((10.0, 0.0, -10.0), 0.0), ((-10.0, 0.0, 0.0), 16.0)])
def test_charge_is_believed_beside_an_opposite_offset_that_was_read_or_a_large_load(
    offset_a: tuple[float, float, float], load_a: float
) -> None:
    read = pd.DataFrame({"vehicle": ["vehicle"], "branch": ["heater"], "offset_a": [offset_a[2]], "offset_sd_a": [0.1]})
    frame = recording(offset_a=offset_a, load_a=load_a)
    charge_ah = {"battery": (float((frame["battery"] - offset_a[0]).mean()) * SECONDS / 3600.0, 0.01)}
    rows = found(frame, trusted=["motor"], load=(load_a, 1.0), charge_ah=charge_ah, readings=read)
    assert rows.corrected["vehicle", "battery"]
    assert rows.offset_a["vehicle", "battery"] == pytest.approx(offset_a[0], abs=0.5)


def test_several_junctions_are_calibrated_independently() -> None:
    # more vehicles than are read together
    frames = {f"V{number}": recording(number, gain=(0.0, 0.05, 0.0), seconds=60.0) for number in range(6)}
    rows = found(frames, trusted=["battery"]).xs("motor", level="branch")
    assert rows.gain_error.to_numpy() == pytest.approx(np.full(6, 0.05), abs=0.01)
    alone = found({"V0": frames["V0"]}, trusted=["battery"]).loc["V0", "motor"]
    pd.testing.assert_series_equal(rows.loc["V0"], alone, check_names=False)


def test_gain_of_a_branch_that_is_off_stays_undetermined() -> None:
    rows = found(recording(heater_a=0.0).assign(heater=0.0), trusted=["battery"]).loc["vehicle"]
    assert rows.gain_error_sd["heater"] > 0.1
    assert rows.gain_error_sd["motor"] < 0.01
    assert not rows.corrected["heater"]


@pytest.mark.parametrize(("heater_a", "drift"), [(40.0, 0.0), (100.0, 0.0), (-80.0, 0.0), (100.0, -0.3), (60.0, 0.2)])
def test_branch_with_a_constant_current_gives_no_other_branch_an_offset(heater_a: float, drift: float) -> None:
    """Its gain ratio says nothing, and is far from 1; the constant of the junction law turns with it."""
    frame = recording(gain=(drift, 0.0, 0.0), heater_a=heater_a)
    row = found(frame, trusted=["motor", "heater"], load=(0.0, 0.2)).loc["vehicle", "battery"]
    assert abs(row.gain_error - drift) < 4.0 * row.gain_error_sd < 0.02
    assert abs(row.offset_a) < 4.0 * row.offset_sd_a < 1.0
    assert row.corrected == bool(drift)


def test_nothing_is_corrected_without_a_trusted_sensor_and_gain_ratios_are_shown(motor_off: pd.DataFrame) -> None:
    calibrator = JunctionCalibrator().fit(motor_off, JUNCTION)
    assert not calibrator.parameters_.corrected.any()
    assert calibrator.parameters_.gain_error_sd.min() > 0.1
    assert "only ratios of gains are known" in calibrator.summary()
    assert any("0.95" in notice and "battery / motor" in notice for notice in calibrator.notices_)


def test_command_leaves_out_unusable_vehicles_and_agrees_with_python(motor_off: pd.DataFrame, tmp_path: Path) -> None:
    for name, frame in {"good": motor_off, "short": motor_off.iloc[:20], "empty": motor_off.iloc[:0]}.items():
        (tmp_path / "cars" / name).mkdir(parents=True)
        frame.rename_axis("time_s").to_csv(tmp_path / "cars" / name / "drive.csv")
    layout = write_layout(tmp_path, motor_off)
    arguments = ["calibrate", tmp_path / "cars", "--layout", layout, "--trusted", "battery", "--out", tmp_path / "r"]
    done = command(*arguments)
    assert done.returncode == 0, done.stderr
    assert [path.stem for path in (tmp_path / "r" / "params").iterdir()] == ["good"]
    assert "short: " in done.stdout
    assert "at least 5 s are needed" in done.stdout
    assert "next: calibrator report" in done.stderr
    assert "--hold-out is for a fleet" in command(*arguments[:-1], tmp_path / "x", "--hold-out", "good").stderr
    rows = pd.read_parquet(tmp_path / "r" / "results.parquet").set_index(["vehicle", "branch"]).loc["good"]
    here = found(motor_off, trusted=["battery"]).loc["vehicle"]
    assert rows.drift.to_dict() == pytest.approx(here.gain_error.to_dict(), abs=1e-4)


def test_offset_that_either_of_two_sensors_may_have_gives_two_explanations() -> None:
    frame = recording(offset_a=(0.0, 6.0, 0.0))
    calibrator = JunctionCalibrator(trusted=["battery"], load=(0.0, 0.1)).fit(frame, JUNCTION)
    first, second = calibrator.vehicles_["vehicle"].parameters.explanations[:2]
    assert {*first.offset_a, *second.offset_a} == {"motor", "heater"}
    assert first.probability + second.probability > 0.9
    assert not calibrator.parameters_.corrected.any()
    (motor,) = [text for text in calibrator.notices_ if "motor: gain" in text]
    assert re.search(r"offset (\+5\.\d|\+6\.\d) or 0 A: not corrected|offset 0 or \+[56]\.\d A: not corrected", motor)
    deciding = calibrator.vehicles_["vehicle"].parameters.deciding_evidence
    assert "the offset of motor, heater needs a zero-current window" in deciding


def test_car_at_rest_determines_an_offset_but_no_gain() -> None:
    frame = 0.01 * recording(gain=(0.0, 0.1, 0.0))[["battery", "motor"]] + [0.0, 5.0]
    junction = Junction(branches=["battery", "motor"], full_scale_a=400.0)
    calibrator = JunctionCalibrator(trusted=["battery"], load=(0.0, 0.1)).fit(frame, junction)
    rows = calibrator.parameters_.set_index("branch")
    assert rows.offset_a["motor"] == pytest.approx(5.0, abs=0.5)
    assert rows.gain_error_sd["motor"] > 0.1


def test_offset_of_a_parked_car_is_found_at_coarse_resolution_if_all_gains_are_known() -> None:
    """Currents of 5 A with an offset of 4 A, shown in steps of 0.1 A."""
    step = 0.1 * (np.arange(1200) // 3 % 2)
    frame = pd.DataFrame({"battery": 9.0 + step, "motor": 0.0, "heater": -5.0 - step}, index=0.1 * np.arange(1200))
    read = pd.DataFrame({"vehicle": ["vehicle"], "branch": ["battery"], "drift": [0.0], "drift_sd": [0.002]})
    row = found(frame, trusted=["motor", "heater"], readings=read, load=(0.0, 0.1)).loc["vehicle", "battery"]
    assert row.offset_a == pytest.approx(4.0, abs=0.5)
    assert row.corrected


def bent(frame: pd.DataFrame, rms_a: float) -> None:
    """Make the motor's sensor nonlinear: its deviation from a straight line has this RMS."""
    current_a = frame["motor"].to_numpy()
    curve = np.polynomial.Polynomial.fit(current_a, current_a**3, 1)
    bend = current_a**3 - curve(current_a)
    frame["motor"] += rms_a * bend / bend.std()


def switched(frame: pd.DataFrame, rms_a: float) -> None:
    """Switch a load without a sensor, every 15 s at random."""
    rng = np.random.default_rng(5)
    load = np.repeat(rng.integers(0, 2, len(frame) // 150 + 1), 150)[: len(frame)].astype(float)
    frame["battery"] += rms_a * load / load.std()


@pytest.mark.parametrize(("spoil", "share"), [(bent, 0.002), (switched, 0.008)])
def test_misfit_of_the_documented_smallest_size_is_found_and_nothing_is_corrected(spoil: Any, share: float) -> None:
    """Sizes are RMS, in fractions of full scale, as docs/junction.md states them."""
    for seed in (300, 301):
        frame = recording(seed, gain=(0.0, 0.1, 0.0))
        spoil(frame, share * 400.0)
        calibrator = JunctionCalibrator(trusted=["battery"]).fit(frame, JUNCTION)
        assert calibrator.vehicles_["vehicle"].parameters.findings
        assert not calibrator.parameters_.corrected.any()


def test_sensors_of_one_car_at_several_meters_are_estimated_together() -> None:
    """The battery is known by the first meter, so the second meter is known by the battery."""
    junction = Junction(branches=["battery", "charger"], full_scale_a=400.0)
    frames = {}
    for seed, (name, gain) in enumerate({"station_1": 0.0, "station_2": 0.03}.items()):
        frame = recording(seed, gain=(-0.02, gain, gain))
        frames[name] = pd.DataFrame({"battery": frame["battery"], "charger": frame["motor"] + frame["heater"]})
    readings = pd.DataFrame({"vehicle": ["station_1"], "branch": ["charger"], "drift": [0.0], "drift_sd": [0.001]})
    calibrator = JunctionCalibrator(meter="charger", readings=readings).fit(frames, junction)
    rows = calibrator.parameters_.set_index(["vehicle", "branch"])
    assert rows.gain_error["station_1", "battery"] == pytest.approx(-0.02, abs=0.009)
    assert rows.gain_error["station_1", "battery"] == rows.gain_error["station_2", "battery"]
    assert rows.gain_error["station_2", "charger"] == pytest.approx(0.03, abs=0.012)


BATTERY_READ = pd.DataFrame({"vehicle": ["vehicle"], "branch": ["battery"], "drift": [0.0], "drift_sd": [0.002]})


@pytest.mark.parametrize(
    "known", [{"trusted": ["battery"]}, {"readings": BATTERY_READ}], ids=["battery trusted", "battery read on a bench"]
)
def test_notice_if_a_gain_error_of_the_only_known_sensor_would_explain_all_others(
    known: dict[str, Any],
) -> None:
    wrong = JunctionCalibrator(**known).fit(recording(gain=(0.05, 0.0, 0.0), seconds=1200.0), JUNCTION)
    assert any("against battery: a gain error of its own of +5." in notice for notice in wrong.notices_)
    right = JunctionCalibrator(**known).fit(recording(gain=(0.0, 0.05, 0.0), seconds=1200.0), JUNCTION)
    assert not any("against battery" in notice for notice in right.notices_)


def test_nothing_is_corrected_if_trusted_sensors_contradict_each_other() -> None:
    calibrator = JunctionCalibrator(trusted=["battery", "motor"]).fit(recording(gain=(0.0, 0.05, 0.2)), JUNCTION)
    assert any("contradicts itself" in notice for notice in calibrator.notices_)
    assert not calibrator.parameters_.corrected.any()


@pytest.mark.parametrize(("change", "cause"), [
    (lambda motor: motor.clip(-50.0, 50.0), "clipped"),
    (lambda motor: motor.where(motor.index < 120.0, 1.1 * motor), "step"),
    (lambda motor: motor.where(motor > 0.0, 1.1 * motor), "sign"),
    (lambda motor: motor * (1.0 + 0.0005 * motor.abs()), "saturating"),
])  # fmt: skip
def test_nonlinear_sensor_gives_a_finding_without_branch_and_nothing_is_corrected(change: Any, cause: str) -> None:
    frame = recording()
    calibrator = JunctionCalibrator(trusted=["battery"]).fit(frame.assign(motor=change(frame["motor"])), JUNCTION)
    findings = calibrator.vehicles_["vehicle"].parameters.findings
    assert [each.cause for each in findings] == [cause]
    assert findings[0].branch is None
    assert not calibrator.parameters_.corrected.any()
    assert set(calibrator.parameters_.verdict) == {"cannot tell"}


def steady_heater(rng: np.random.Generator, frame: pd.DataFrame) -> None:
    """While constant it has no noise either; treating it as noisy once gave a step of 10^10 A."""
    steady = frame["heater"].where(frame.index > 150.0, -2.0)
    frame["battery"] -= steady - frame["heater"]
    frame["heater"] = steady


def switched_heater(rng: np.random.Generator, frame: pd.DataFrame) -> None:
    """Two levels of a current fit any straight line; subtracting noise once gave an error of 10^5 % at full scale."""
    heater_a = np.repeat(rng.choice([-1.0, -31.0], len(frame) // 75 + 1), 75)[: len(frame)]
    frame["battery"] = -frame["motor"] - heater_a + rng.normal(0.0, 0.2, len(frame))
    frame["heater"] = heater_a + rng.normal(0.0, 0.2, len(frame))


def noisy(branch: str, sd_a: float) -> Any:
    def spoil(rng: np.random.Generator, frame: pd.DataFrame) -> None:
        frame[branch] += rng.normal(0.0, sd_a, len(frame))

    return spoil


def second_motor(rng: np.random.Generator, frame: pd.DataFrame) -> None:
    frame["battery"] += 30.0 * np.convolve(rng.normal(size=len(frame) + 19), np.full(20, 0.22), "valid")


@pytest.mark.parametrize(("spoil", "causes"), [
    (noisy("motor", 0.0), set()), (noisy("motor", 10.0), set()), (noisy("battery", 10.0), set()),
    (steady_heater, set()), (switched_heater, set()), (second_motor, {"switching"}),
])  # fmt: skip
def test_noise_and_loads_are_not_taken_for_nonlinear_sensors(spoil: Any, causes: set[str]) -> None:
    for seed in range(2):
        frame = recording(seed, gain=(0.0, 0.1, -0.2), offset_a=(0.0, 3.0, 0.0))
        spoil(np.random.default_rng(seed + 100), frame)
        calibrator = JunctionCalibrator(trusted=["battery"]).fit(frame, JUNCTION)
        assert {each.cause for each in calibrator.vehicles_["vehicle"].parameters.findings} == causes


def test_errors_of_estimated_gains_match_their_standard_deviations() -> None:
    """Gains of twelve junctions are within their deviation about as often as normal errors, and never far outside."""
    errors = []
    for seed in range(12):
        gain = np.random.default_rng(seed).uniform(-0.2, 0.2, 2)
        rows = found(recording(seed, gain=(0.0, *gain), seconds=60.0), trusted=["battery"]).loc["vehicle"]
        errors += list((rows.gain_error[["motor", "heater"]] - gain) / rows.gain_error_sd[["motor", "heater"]])
    assert np.mean(np.abs(errors) < 1.0) >= 0.6
    assert np.abs(errors).max() < 4.0


@pytest.mark.parametrize(("change", "known", "match"), [
    (lambda frame: frame.assign(motor=-frame["motor"]), {}, "check sign and unit of branch"),
    (lambda frame: frame.drop(columns="motor"), {}, "no column motor"),
    (lambda frame: frame.assign(motor=2.4 * frame["motor"]), {"trusted": ["battery"]}, "motor sensor reads 2.5 times"),
    (lambda frame: frame.iloc[:20], {}, "at least 5 s are needed"),
    (lambda frame: frame, {"trusted": ["gearbox"]}, "trusted gearbox: no such branch"),
    (lambda frame: frame, {"load": (-3.0, 0.1)}, "a value from 0 with its standard deviation"),
    (lambda frame: frame, {"charge_ah": {"battery": 3.0}}, "a value with its standard deviation"),
    (lambda frame: frame.iloc[::50].iloc[:7], {}, "tell too little: at least"),
    (lambda frame: {"a": frame, "b": frame * 1.001}, {"charge_ah": {"battery": (1.0, 0.1)}}, "of one vehicle"),
    *((lambda frame, of=of: [frame, frame.assign(battery=frame["battery"].where(of(frame.index)))],
       {"charge_ah": {"battery": (1.0, 0.1)}}, "have no samples of it")
      for of in (lambda time_s: abs(time_s - 100.0) > 30.0, lambda time_s: time_s < 150.0)),
    (lambda _: (long := recording(seconds=1500.0))[abs(long.index - 700.0) > 150.0],  # counts as a gap of 60 s
     {"charge_ah": {"battery": (1.0, 0.1)}}, "less than 60 s at once"),
])  # fmt: skip
def test_junction_calibrator_refuses_wrong_arguments_and_data_with_one_line(
    motor_off: pd.DataFrame, change: Any, known: dict[str, Any], match: str
) -> None:
    with pytest.raises((FleetError, DriveError, ContradictionError), match=match) as raised:
        JunctionCalibrator(**known).fit(change(motor_off), JUNCTION)
    assert "\n" not in str(raised.value)


def write_layout(folder: Path, frame: pd.DataFrame) -> Path:
    branches = "".join(f'[[branch]]\nname = "{name}"\nsignal = "{name}"\nsign = 1\n' for name in frame)
    (folder / "layout.toml").write_text(f'schema = 1\nname = "car"\nfull_scale_a = 400.0\n{branches}')
    return folder / "layout.toml"


def test_declared_load_is_not_counted_as_error_of_the_sum(tmp_path: Path) -> None:
    frame = recording(gain=(0.0, 0.05, 0.0), offset_a=(0.0, -1.5, 0.0), load_a=2.0)
    frame.rename_axis("time_s").to_csv(tmp_path / "drive.csv")
    drive, layout = tmp_path / "drive.csv", write_layout(tmp_path, frame)
    options = ["--trusted", "battery", "--trusted", "heater", "--load", "2:0.1", "--out", tmp_path / "result"]
    found = reported("calibrate", drive, "--layout", layout, *options)
    assert found["junction_rms_deployed_a"] < 0.5 < 2.0 < found["junction_rms_measured_a"]
    (parameters,) = (tmp_path / "result" / "params").iterdir()
    sums = succeeded("kirchhoff", drive, "--layout", layout, "--parameters", parameters)
    assert re.search(r"RMSE of the sum about the 2 A expected: 2.\d+ A measured, 0.4\d A corrected", sums)
