"""The calibrator in Python: from data frames, logs or summaries to parameters, and what is refused."""

import pickle
import re
import runpy
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pandas as pd
import pytest
from sklearn.base import clone

import calibrator
from calibrator import Fleet, FleetCalibrator, Junction, read_log
from calibrator.artificial.builtin_drives import builtin_trip
from calibrator.errors import ContradictionError, DriveError, FleetError
from calibrator.estimator.results import read_results
from calibrator.summaries.summary_store import SummaryStore
from ecu_node.database import VehicleDatabase
from ecu_node.errors import LayoutError, UserError
from tests.calibrator.command_here import succeeded
from tests.calibrator.conftest import LAYOUT
from tests.calibrator.drives.test_computed_inputs import trip
from tests.calibrator.estimator.test_run import contents, failing_for
from tests.calibrator.summaries.small_stores import random_faults, small_store

ROOT = Path(__file__).parents[3]
JUNCTION = Junction(branches=["battery", "motor"], full_scale_a=400.0)
INPUTS = ["power", "heat"]
Frames = dict[str, Any]


def frame(seed: int, *, gain_error: float = 0.0, minutes: float = 5.0) -> pd.DataFrame:
    """A drive with a row a second; the battery sensor has a gain error."""
    rng, time_s = np.random.default_rng(seed), np.arange(0.0, 60.0 * minutes)
    power = np.convolve(rng.normal(size=len(time_s) + 7), np.ones(8), "valid")
    heat = np.repeat(rng.integers(0, 2, len(time_s) // 20 + 1), 20)[: len(time_s)].astype(float)
    true_a = 40.0 * power + 15.0 * heat
    noise_a = rng.normal(0.0, 0.3, (2, len(time_s)))
    currents_a = {"battery": (1.0 + gain_error) * true_a + noise_a[0], "motor": -true_a + noise_a[1]}
    return pd.DataFrame({**currents_a, "power": power, "heat": heat}, index=time_s)


def frames(vehicles: int = 3) -> Frames:
    return {f"V{number}": frame(number) for number in range(1, vehicles + 1)}


@pytest.fixture(scope="module")
def example() -> Any:
    return SimpleNamespace(**runpy.run_path(str(ROOT / "examples" / "twelve_vehicles.py")))


@pytest.fixture(scope="module")
def fitted(example: Any) -> FleetCalibrator:
    return cast("FleetCalibrator", example.calibrator)


# Public interface


def test_package_exports_its_interface_and_imports_nothing_heavy() -> None:
    offered = ["Fleet", "FleetCalibrator", "Junction", "JunctionCalibrator", "read_log"]
    assert sorted(calibrator.__all__) == dir(calibrator) == offered
    with pytest.raises(AttributeError, match="no attribute 'fit'; it offers Fleet, FleetCalibrator"):
        _ = calibrator.fit
    heavy = ("numpy", "pandas", "scipy", "numba", "pyarrow", "sklearn", "cantools", "matplotlib", "typer")
    code = f"import sys, calibrator; print([name for name in {heavy} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert done.stdout.strip() == "[]"


def test_rounding_of_a_small_current_is_not_taken_for_a_gain_error() -> None:
    """Rounding to 2 A in a heater's 0 to 14 A makes its gain ratio too small by 1.5 % in every vehicle."""
    given = {}
    for number in range(8):
        drive, rng = frame(number, minutes=15.0), np.random.default_rng(100 + number)
        wanted = np.interp(drive.index, np.arange(0.0, 901.0, 30.0), rng.uniform(0.0, 14.0, 31))
        rounded = -2.0 * np.round(wanted / 2.0)
        given[f"V{number}"] = drive.assign(battery=drive["battery"] + wanted, heater=rounded, wanted=wanted)
    junction = Junction(branches=["battery", "motor", "heater"], full_scale_a=400.0)
    fitted = FleetCalibrator().fit(Fleet.from_frames(given, junction))
    assert not fitted.parameters_["corrected"].any()
    assert not [notice for notice in fitted.notices_ if "junction law" in notice]


def test_fault_of_a_sensor_from_which_an_input_is_computed_is_not_given_to_another_branch() -> None:
    given = {}
    for number in range(6):
        drive, rng = trip(number).drop(columns="heater"), np.random.default_rng(number)
        drive["battery"] = -drive["motor"]
        power = -360.0 * drive["motor"] * (1.0 + rng.normal(0.0, 0.001))
        drive["battery"] *= 1.10 if number == 3 else 1.0
        drive += rng.normal(0.0, 0.3, drive.shape)
        given[f"V{number}"] = drive.assign(pack_w=370.0 * drive["battery"], power=power)
    with pytest.raises(FleetError, match=r"inputs pack_w \(most like battery\), as if computed from current sensors"):
        Fleet.from_frames(given, JUNCTION, inputs=["pack_w"])
    found = FleetCalibrator().fit(Fleet.from_frames(given, JUNCTION))
    assert [notice for notice in found.notices_ if notice.startswith("inputs left out: pack_w (most like battery), ")]
    rows = found.parameters_.query("corrected")
    assert rows[["vehicle", "branch"]].to_numpy().tolist() == [["V3", "battery"]]
    assert rows["gain_error"].iloc[0] == pytest.approx(0.10, abs=0.005)


def test_twelve_vehicles_are_calibrated_from_data_frames(fitted: FleetCalibrator, example: Any) -> None:
    found = fitted.parameters_
    assert len(found) == 12 * 3
    assert set(found.loc[found["corrected"], "vehicle"]) == set(example.FAULTS)
    for vehicle, (branch, gain_error, offset_a) in example.FAULTS.items():
        (row,) = found[(found["vehicle"] == vehicle) & found["corrected"]].to_dict("records")
        assert row["branch"] == branch
        assert row["gain_error"] == pytest.approx(gain_error, abs=0.002)
        assert row["offset_a"] == pytest.approx(offset_a, abs=0.5)
    assert fitted.left_out_ == {}


def test_correction_gives_true_currents_on_corrected_branches_alone(fitted: FleetCalibrator, example: Any) -> None:
    measured = example.recorded_drive("V02", np.random.default_rng(5))
    corrected = fitted.vehicles_["V02"].correct(measured)
    branch = fitted.vehicles_["V02"].parameters.branches["battery"]
    expected = (measured["battery"] - branch.offset_a) / (1.0 + branch.drift)
    pd.testing.assert_series_equal(corrected["battery"], expected)
    pd.testing.assert_frame_equal(corrected.drop(columns="battery"), measured.drop(columns="battery"))
    assert (corrected[["battery", "motor", "heater"]].sum(axis=1) ** 2).mean() ** 0.5 < 0.7
    with pytest.raises(DriveError, match="vehicle V02: no column battery; it has motor"):
        fitted.vehicles_["V02"].correct(measured.drop(columns="battery"))
    with pytest.raises(DriveError, match="vehicle V02: column battery is of object"):
        fitted.vehicles_["V02"].correct(measured.astype({"battery": object}))


def test_fitted_calibrator_pickles_and_is_shown_as_text_and_html(fitted: FleetCalibrator) -> None:
    again = pickle.loads(pickle.dumps(fitted))
    pd.testing.assert_frame_equal(again.parameters_, fitted.parameters_)
    assert again.vehicles_ == fitted.vehicles_
    assert again.summary() == fitted.summary()
    assert again.summary().startswith("method posterior")
    assert "parameter files:" not in again.summary()
    assert "<table" in again._repr_html_()
    assert again.vehicles_["V02"].explain().startswith("V02: corrected (confidence ")
    assert "V02: corrected" in again.vehicles_["V02"]._repr_html_()


def test_constructor_only_stores_parameters_as_in_scikit_learn() -> None:
    plain = FleetCalibrator(harm_limit=0.01, trusted=["V1"])
    assert repr(plain) == "FleetCalibrator(harm_limit=0.01, trusted=['V1'])"
    assert clone(plain).get_params() == plain.get_params()
    assert plain.set_params(workers=1).workers == 1
    with pytest.raises(ContradictionError, match="no parameter 'x'; there are harm_limit, trusted"):
        plain.set_params(x=1)
    with pytest.raises(FleetError, match="has learned nothing yet; call fit"):
        plain.summary()
    assert repr(plain) in plain._repr_html_().replace("&#x27;", "'")


def test_results_of_frames_without_a_layout_have_no_files_for_the_node(fitted: FleetCalibrator, tmp_path: Path) -> None:
    with pytest.warns(UserWarning, match=r"no parameter files for the node are written: .*Junction\.from_layout"):
        out = fitted.write(tmp_path / "result")
    assert len(read_results(out)) == 36
    assert not (out / "params").exists()
    with pytest.raises(FleetError, match="exists and is not empty; choose another folder or remove it"):
        fitted.write(tmp_path / "result")


# The same result as by the command


def test_python_interface_writes_the_same_result_as_the_command(
    database: VehicleDatabase, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "1700000000")
    store: SummaryStore = small_store(tmp_path / "store", database, random_faults(20))
    bench = pd.DataFrame([("V001", "motor", 0.0, 0.001)], columns=["vehicle", "branch", "drift", "drift_sd"])
    bench.to_csv(tmp_path / "readings.csv", index=False)
    options = ("--workers", 1, "--hold-out", "V003,V004", "--harm-limit", 0.01, "--load", "0:0.5")
    known = ("--readings", tmp_path / "readings.csv")
    said = succeeded("calibrate", store.url, "--layout", LAYOUT, "--out", tmp_path / "command", *options, *known)
    capsys.readouterr()
    settings: dict[str, Any] = {"workers": 1, "hold_out": ["V003", "V004"], "harm_limit": 0.01, "readings": bench}
    settings["load"] = 0.0, 0.5
    found = FleetCalibrator(**settings).fit(Fleet.from_folder(store.url, LAYOUT))
    here, there = contents(found.write(tmp_path / "python")), contents(tmp_path / "command")
    here["run.json"] = here["run.json"].replace(b'"data frame"', b'"readings.csv"')  # where the readings came from
    assert here == there
    assert found.summary() in said
    assert found.notices_ == ["a notice"]
    assert capsys.readouterr() == ("", "")


def test_data_frames_with_a_layout_give_parameter_files_for_the_node(tmp_path: Path) -> None:
    trips = [builtin_trip(np.random.default_rng(seed), duration_s=240.0, name="trip") for seed in range(3)]
    tables = [pd.DataFrame({**trip.currents_a, **trip.inputs}, index=trip.time_s) for trip in trips]
    given = {f"V{number}": table for number, table in enumerate(tables)}
    junction = Junction.from_layout(LAYOUT, branches=list(trips[0].currents_a))
    found = FleetCalibrator().fit(Fleet.from_frames(given, junction))
    out = found.write(tmp_path / "result")
    assert {path.stem for path in (out / "params").iterdir()} == set(given)
    with pytest.raises(FleetError, match="inputs wind: not in the layout; it has "):
        Fleet.from_frames(given, junction, inputs=["wind"])


def test_log_converts_to_a_data_frame_usable_for_a_fleet(two_vehicles: Path) -> None:
    paths = sorted((two_vehicles / "logs").rglob("*.log*"))
    log = read_log(paths[0], LAYOUT)
    found = log.to_frame()
    assert found.index.name == "time_s"
    assert np.diff(found.index) == pytest.approx(0.1)
    assert {"battery", "motor"} <= set(found)
    assert repr(log).startswith(f"RecordedLog({paths[0].parent.name} {log.drive.name}, ")
    recorded = {path.parent.name: read_log(path, LAYOUT).to_frame() for path in paths}
    junction = Junction.from_layout(LAYOUT, branches=["battery", "motor"])
    assert len(FleetCalibrator().fit(Fleet.from_frames(recorded, junction)).vehicles_) == 2


def test_internal_error_in_one_vehicle_leaves_it_out_with_a_warning(monkeypatch: pytest.MonkeyPatch) -> None:
    failing_for("V2", ZeroDivisionError("by nothing"), monkeypatch)
    with pytest.warns(RuntimeWarning, match="left out: V2: internal error: ZeroDivisionError: by nothing"):
        found = FleetCalibrator().fit(Fleet.from_frames(frames(), JUNCTION))
    assert sorted(found.vehicles_) == ["V1", "V3"]


# Data frames that are accepted


def test_index_of_timestamps_or_seconds_gives_the_same_result() -> None:
    seconds = frames()
    clock = {
        name: each.set_index(pd.Timestamp("2026-01-01T12:00Z") + pd.to_timedelta(each.index, unit="s"))
        for name, each in seconds.items()
    }
    one, other = (FleetCalibrator().fit(Fleet.from_frames(given, JUNCTION)) for given in (seconds, clock))
    pd.testing.assert_frame_equal(one.parameters_, other.parameters_)


def test_several_frames_per_vehicle_and_missing_samples_are_accepted() -> None:
    given = {**frames(5), "V9": [frame(90, gain_error=0.1), frame(91, gain_error=0.1)]}
    given["V9"][0].iloc[20:40, 0] = np.nan
    given["V8"] = frame(80, minutes=1.0)
    found = FleetCalibrator().fit(Fleet.from_frames(given, JUNCTION, inputs=INPUTS))
    parameters = found.vehicles_["V9"].parameters
    assert parameters.branches["battery"].drift == pytest.approx(0.1, abs=0.01)
    assert 575.0 <= parameters.provenance.duration_s <= 582.0
    assert parameters.provenance.drives == ["frame 1", "frame 2"]
    assert "at least 120 s are needed" in found.left_out_["V8"]


def test_readings_and_trust_contradicted_by_drives_give_notices() -> None:
    given = {**frames(8), "V4": frame(4, gain_error=0.1), "V5": frame(5, gain_error=0.1)}
    offset = pd.DataFrame({"vehicle": ["V3"], "branch": "motor", "offset_a": 40.0, "offset_sd_a": 0.1})
    readings = pd.concat([bench_rows(["V4", "V7"], 0.1), offset])  # the reading of V7 is of V4
    found = FleetCalibrator(readings=readings, trusted=["V1", "V2", "V5"]).fit(Fleet.from_frames(given, JUNCTION))
    said = "\n".join(notice for notice in found.notices_ if "bench" in notice or "trusted" in notice)
    assert re.fullmatch(
        r"only 2 of the trusted vehicles can carry the reference, 3 are needed: it is the fleet's\n"
        r"vehicle V5 is not trusted: the gains of its sensors motor and battery differ by \+9.\d%; check it again\n"
        r"vehicle V7: the bench reading of its battery sensor is not what its drives show.*\n"
        r"vehicle V3: the bench reading of its motor sensor is not what its drives show.*",
        said,
    )


@pytest.mark.parametrize(
    ("column", "factor", "said"), [("battery", -1.0, "reads with the wrong sign"), ("motor", 0.0, "does not follow")]
)
def test_explain_says_which_signs_are_wrong_and_currents_unrelated(column: str, factor: float, said: str) -> None:
    given = frames(6)
    given["V6"][column] = factor * given["V6"][column] + np.sin(given["V6"].index)
    found = FleetCalibrator().fit(Fleet.from_frames(given, JUNCTION))
    assert said in found.vehicles_["V6"].explain()


def changed(**changes: Callable[[pd.DataFrame], Any]) -> Callable[[], Frames]:
    """Three vehicles, one or more of them changed."""
    return lambda: {name: changes.get(name, lambda each: each)(each) for name, each in frames().items()}


def still(each: pd.DataFrame) -> pd.DataFrame:
    return each.assign(motor=3.0)


def retimed(change: Callable[[Any], Any]) -> Callable[[], Frames]:
    """Three vehicles, the second one at other times."""
    return changed(V2=lambda each: each.set_index(change(each.index)))


def of_all(change: Callable[[pd.DataFrame], Any]) -> Callable[[], Frames]:
    return lambda: {name: change(each) for name, each in frames().items()}


def in_milliseconds(each: pd.DataFrame) -> pd.DataFrame:
    return each.assign(ms=1000 * np.arange(len(each))).set_index("ms")


@pytest.mark.parametrize(("given", "message"), [
    (dict, r"dict without vehicles: expected data frames by vehicle"),
    (lambda: frames(1), r"a single vehicle, V1: a fleet that is compared with itself needs 5 or more"),
    (lambda: {"a/b": frame(1), "V2": frame(2)}, r"vehicle 'a/b' cannot be used"),
    (changed(V2=lambda _: []), r"vehicle V2: list given; expected a DataFrame or a list of them"),
    (changed(V2=lambda each: each["motor"]), r"vehicle V2: Series given; expected a DataFrame or a list of them"),
    (changed(V2=lambda _: frame(1)), r"vehicle V2, frame 1: the same as vehicle V1, frame 1"),
    (changed(V2=lambda each: each.drop(columns="motor")), r"vehicle V2, frame 1: no column motor; it has battery"),
    (changed(V3=lambda each: each.drop(columns="heat")), r"vehicle V3, frame 1: no column heat; it has battery"),
    (changed(V3=lambda each: each.assign(wind=1.0)), r"V3, frame 1: column wind, which vehicle V1, frame 1 has n"),
    (changed(V2=lambda each: each.astype({"motor": str})), r"V2, frame 1: column motor is of .*expected numbers"),
    (changed(V2=lambda each: each.astype({"motor": bool})), r"V2, frame 1: column motor is of bool; expected numbers"),
    (changed(V2=lambda each: each.assign(motor=np.nan)), r"V2, frame 1: column motor has no number at all"),
    (changed(V1=still, V2=still), r"branch motor never changes in most vehicles: stuck, or not connected"),
    (lambda: {1: frame(1), "1": frame(2)}, r"vehicle 1 is there twice; give all of its frames as one list"),
    (retimed(lambda time: time.where(time != 7.0)), r"V2, frame 1: 1 rows without a time"),
    (retimed(lambda time: time / 60.0), r"V2, frame 1: rows are 0\.0167 s apart, and those of the fleet 1 s"),
    (of_all(lambda each: each.assign(motor=1e-3 * each["motor"])), r"the largest motor current .* in kA"),
    (changed(V2=lambda each: each.iloc[::-1]), r"V2, frame 1: the time does not rise at row 1 \(299.0 "),
    (retimed(lambda time: time.where(time != 7.0, 6.0)), r"V2, frame 1: the time does not rise at row 7 \(6.0 -> "),
    (changed(V2=lambda each: each.reset_index(drop=True)), r"V2, frame 1: its index counts rows; expected the tim"),
    (changed(V2=lambda each: each.reset_index(drop=True).iloc[::2]), r"V2, frame 1: its index counts rows"),
    (retimed(lambda time: time.astype(str)), r"V2, frame 1: its index is of .*; expected"),
    (changed(V2=lambda each: each.iloc[:1]), r"V2, frame 1: 1 rows; leave the frame out"),
    (changed(V2=lambda each: each.assign(motor=1e-3 * each["motor"])), r"V2: the largest motor .*perhaps it is in kA"),
    (of_all(lambda each: each.set_index(60.0 * each.index)), r"V1, frame 1: rows are 60 s apart, expected 5 s at mo"),
    (of_all(in_milliseconds), r"V1, frame 1: its index is whole numbers, 100"),
    (of_all(lambda each: each[["battery", "motor"]]), r"inputs none: expected one or more"),
])  # fmt: skip
def test_unusable_data_frames_are_refused_in_one_line(given: Callable[[], Frames], message: str) -> None:
    with pytest.raises(UserError, match=message) as caught:
        Fleet.from_frames(given(), JUNCTION)
    assert "\n" not in str(caught.value)
    assert type(caught.value).__module__ == "calibrator.errors"


@pytest.mark.parametrize(("branches", "full_scale_a", "message"), [
    (["battery"], 400.0, r"branches \['battery'\]: a junction has 2 to 16 branches"),
    ("battery", 400.0, r"branches 'battery': expected a list of names"),
    (["battery", "battery"], 400.0, r"branches \['battery', 'battery'\]: expected different names"),
    (["battery", "motor"], 0.0, r"full_scale_a 0.0: expected the nominal maximum current in A"),
    (["battery", "motor"], "400 A", r"full_scale_a '400 A': expected the nominal maximum current in A"),
])  # fmt: skip
def test_wrong_branches_or_full_scale_are_refused(branches: Any, full_scale_a: Any, message: str) -> None:
    with pytest.raises(FleetError, match=message):
        Junction(branches=branches, full_scale_a=full_scale_a)


def bench_rows(vehicles: list[str], drift: float) -> pd.DataFrame:
    return pd.DataFrame({"vehicle": vehicles, "branch": "battery", "drift": drift, "drift_sd": 0.01})


def test_wrong_paths_and_parameters_are_refused(tmp_path: Path) -> None:
    with pytest.raises(FleetError, match="no such folder, store of drives or store of summaries"):
        Fleet.from_folder(tmp_path / "nothing", LAYOUT)
    with pytest.raises(LayoutError, match=r"none\.toml"):
        Junction.from_layout(tmp_path / "none.toml")
    with pytest.raises(LayoutError, match="no branch 'turbine'; known are battery"):
        Junction.from_layout(LAYOUT, branches=["battery", "turbine"])
    fleet = Fleet.from_frames(frames(), JUNCTION)
    wrong: tuple[tuple[dict[str, Any], str], ...] = (
        ({"harm_limit": 2.0}, "harm_limit 2.0: expected a number from 0 to 1"),
        ({"expected_faults": "half"}, "expected_faults 'half': expected a number from 0 to 1"),
        ({"workers": 0}, "workers 0: expected a whole number from 1 to 256"),
        ({"scheduler": 1}, "scheduler 1: expected the address of a Dask scheduler"),
        ({"readings": "nothere.csv"}, "readings 'nothere.csv': expected a file that exists"),
        ({"readings": [1]}, r"readings \[1\]: expected a DataFrame or the path of a CSV table"),
        ({"readings": bench_rows([], 0.1)}, "^readings: no reading below the header; leave readings out if there"),
        ({"readings": bench_rows(["V1"], 0.1).drop(columns="branch")}, "^readings: columns vehicle, drift.*; expected"),
        ({"readings": bench_rows(["V1"], 0.1).assign(branch="x")}, "^readings: row 0: no branch 'x'"),
        ({"trusted": [1]}, "fleet frames: no usable vehicle 1 to trust"),
        ({"trusted": "V9"}, "fleet frames: no usable vehicle V9 to trust"),
    )
    for parameters, message in wrong:
        with pytest.raises(UserError, match=message):
            FleetCalibrator(**parameters).fit(fleet)
    with pytest.raises(FleetError, match="a Fleet of data frames cannot be pickled or copied; pickle the frames"):
        pickle.dumps(fleet)
    assert pickle.loads(pickle.dumps(Fleet.from_folder(ROOT / "tests", LAYOUT))).place == str(ROOT / "tests")
