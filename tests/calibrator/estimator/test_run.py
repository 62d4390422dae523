"""Whole runs, by command and by bucket: vehicles are independent, and none stops the others."""

import json
import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from calibrator.errors import FleetError
from calibrator.estimator import run
from calibrator.estimator.fleet_task import FleetTask, calibrate_bucket, learn_task
from calibrator.estimator.results import Calibrated, left_out_of, read_results, read_run
from calibrator.estimator.run import read_sample
from calibrator.estimator.settings import CalibrationSettings, RunIdentity
from calibrator.files.storage import open_storage
from calibrator.processes import run_many
from calibrator.processes.run_many import Workers
from calibrator.summaries.record import Record
from calibrator.summaries.summary_store import SummaryStore
from calibrator.summaries.vehicle_summary import VehicleSummary, ZeroCurrent
from ecu_node.database import VehicleDatabase
from tests.calibrator.command_here import calibrator, succeeded
from tests.calibrator.conftest import LAYOUT
from tests.calibrator.estimator.simulated_drives import Conditions, summaries_of
from tests.calibrator.summaries.small_stores import BRANCHES, fullest, random_faults, record_of, small_store

VEHICLES = 24
ONE = Workers(processes=1)


@pytest.fixture(scope="module", autouse=True)
def environment() -> Iterator[None]:
    """Results have the same time stamp, and are made by one thread."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SOURCE_DATE_EPOCH", "1700000000")
        patch.setenv("OMP_NUM_THREADS", "1")
        yield


def words(store: str, out: Path, *options: object) -> tuple[object, ...]:
    """The command line that calibrates a store."""
    return "calibrate", store, "--layout", LAYOUT, "--out", out, "--workers", 1, *options


def contents(result: Path) -> dict[str, bytes]:
    return {str(path.relative_to(result)): path.read_bytes() for path in sorted(result.rglob("*")) if path.is_file()}


@pytest.fixture(scope="module")
def store(database: VehicleDatabase, tmp_path_factory: pytest.TempPathFactory) -> SummaryStore:
    return small_store(tmp_path_factory.mktemp("fleet") / "store", database, random_faults(VEHICLES))


@pytest.fixture(scope="module")
def result(store: SummaryStore) -> Path:
    out = Path(store.url).parent / "result"
    succeeded(*words(store.url, out))
    return out


@pytest.fixture(scope="module")
def task(store: SummaryStore, database: VehicleDatabase) -> FleetTask:
    settings = CalibrationSettings()
    identity = RunIdentity(database=database, settings=settings, fleet="small", created="2026-01-01T00:00:00+00:00")
    sample = read_sample(store, settings)
    return learn_task(sample, {}, branches=BRANCHES, identity=identity, fleet_size=VEHICLES)[0]


def test_learning_sample_is_limited_to_a_number_of_blocks(store: SummaryStore, monkeypatch: pytest.MonkeyPatch) -> None:
    settings = CalibrationSettings()
    whole = read_sample(store, settings)
    monkeypatch.setattr(run, "MOST_BLOCKS", sum(len(item.summary.moments) for item in whole[:10]))
    assert [item.vehicle for item in read_sample(store, settings)] == [item.vehicle for item in whole[:10]]
    trusted = CalibrationSettings(trusted=frozenset([whole[-1].vehicle]))
    assert read_sample(store, trusted)[-1].vehicle == whole[-1].vehicle


def test_fleet_in_whose_windows_current_flows_is_calibrated_without_them(store: SummaryStore, task: FleetTask) -> None:
    seen = ZeroCurrent(offset_a=np.array([0.84, -0.84]), sd_a=np.full(2, 0.1))
    plain = read_sample(store, CalibrationSettings())
    flowing = [replace(each, zero_current=seen) for each in plain]
    found, notices = learn_task(flowing, {}, branches=BRANCHES, identity=task.identity, fleet_size=VEHICLES)
    assert next(each for each in notices if "so one flows" in each).startswith("most vehicles: two sensors show")
    one, other = task.estimate(plain[:3]), found.estimate(flowing[:3])
    np.testing.assert_array_equal(one.offset_a, other.offset_a)
    assert task.choices(plain[0].vehicle) != found.choices(plain[0].vehicle), "--since looks at them again"


@pytest.mark.parametrize("shown_a", [0.84, 0.1])
def test_vehicle_has_a_finding_if_a_current_flows_in_its_windows(
    store: SummaryStore, task: FleetTask, shown_a: float
) -> None:
    seen = ZeroCurrent(offset_a=np.array([shown_a, -shown_a]), sd_a=np.full(2, 0.05))
    vehicle = replace(read_sample(store, CalibrationSettings())[0], zero_current=seen)
    found = task.calibrate([vehicle])[vehicle.vehicle]
    assert isinstance(found, Calibrated)
    assert [each.cause for each in found.parameters.findings] == ["window"] * (shown_a > 0.5)


def texts(chunk: bytes) -> dict[str, bytes]:
    return {row["vehicle"]: row["parameters"].encode() for row in rows(chunk) if row["parameters"] is not None}


def rows(chunk: bytes) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = pq.read_table(pa.BufferReader(chunk)).to_pylist()
    return found


def left_out(chunk: bytes) -> dict[str, str]:
    return {row["vehicle"]: row["reason"] for row in rows(chunk) if row["branch"] is None}


def rewritten(store: SummaryStore, folder: Path, bucket: int, records: Mapping[str, Sequence[Record]]) -> SummaryStore:
    """Make a new store that has these records in one bucket, and no others."""
    other = SummaryStore(storage=open_storage(Path(mkdtemp(dir=folder))), identity=store.identity)
    other.append(bucket, [record for items in records.values() for record in items])
    return other


# The result


def test_result_has_every_vehicle_once_in_order(result: Path) -> None:
    found = read_results(result)
    assert [row["vehicle"] for row in found[::2]] == [f"V{j:03d}" for j in range(VEHICLES)]
    assert sorted(path.stem for path in (result / "params").iterdir()) == [f"V{j:03d}" for j in range(VEHICLES)]
    assert read_run(result).vehicles == VEHICLES
    assert [path.name for path in result.parent.iterdir() if path.name.startswith(".result")] == []
    assert {path.name for path in result.iterdir()} == {"params", "buckets", "results.parquet", "run.json"}


def test_results_with_one_and_with_two_workers_are_identical(
    store: SummaryStore, result: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(run, "WORTH_PROCESSES", 1)
    succeeded(*words(store.url, tmp_path / "two", "--workers", 2))
    assert contents(tmp_path / "two") == contents(result)


def test_small_fleet_starts_no_processes(store: SummaryStore, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run_many, "_outcomes", None)  # which starts processes
    succeeded(*words(store.url, tmp_path / "out", "--workers", 2))


# What is refused


@pytest.mark.parametrize(("options", "code", "message"), [
    (("--method", "published"), 1, "a store of summaries, and --method published needs the drives"),
    (("--branches", "battery,motor"), 1, "a store of summaries, and --branches needs the drives"),
    (("--charge", "battery=3:0.1"), 1, "a store of summaries, and --charge needs the drives"),
    (("--meter", "motor"), 1, "a store of summaries, and --meter needs the drives"),
    (("--load", "much"), 2, "expected a number and its standard deviation"),
    (("--load=-3:0.1",), 2, "expected what flows out of the junction"),
    (("--charge", "battery"), 2, "expected a branch with its charge"),
    (("--charge", "battery=3"), 2, "give its standard deviation"),
    (("--charge", "battery=3:0.1", "--charge", "battery=4:0.1"), 2, "a branch is named twice"),
    (("--trusted", "battery"), 1, "a store of summaries, and --trusted with a branch needs the drives"),
    (("--trusted", "V777"), 1, "fleet small: no usable vehicle V777 to trust"),
    (("--hold-out", "V003", "--trusted", "V003"), 2, "vehicle V003 is both held out and trusted"),
    (("--since", "earlier", "--branches", "battery,motor"), 2, "--branches and --since exclude each other"),
    (("--hold-out", "V777"), 1, "fleet small: no usable vehicle V777 to hold out"),
    (("--since", ""), 2, "an empty argument; give a value"),
    (("--since", "nothing"), 1, "not a result of 'calibrator calibrate'"),
    (("--scheduler", "tcp://127.0.0.1:9"), 1, "tcp://127.0.0.1:9: no Dask scheduler answers"),
])  # fmt: skip
def test_wrong_option_is_refused_in_one_line_and_leaves_nothing(
    store: SummaryStore, tmp_path: Path, options: tuple[str, ...], code: int, message: str, monkeypatch: Any
) -> None:
    monkeypatch.setattr(run_many, "CONNECT_S", 0.5)
    done = calibrator(*words(store.url, tmp_path / "out", *options))
    assert (done.returncode, message in done.stderr.splitlines()[-1]) == (code, True), done.stderr
    assert list(tmp_path.iterdir()) == []


def test_store_that_is_empty_ambiguous_or_not_named_is_refused(store: SummaryStore, tmp_path: Path) -> None:
    shutil.copytree(store.url, tmp_path / "empty", ignore=shutil.ignore_patterns("*.parquet"))
    shutil.copytree(store.url, tmp_path / "both")
    (tmp_path / "both" / "drives").mkdir()
    for place, code, message in (
        (tmp_path / "both", 1, "both: holds drives (drives) and summaries (summaries.json); move one of them"),
        (tmp_path / "empty", 1, "empty: the store of summaries is empty; add drives with 'calibrator summarise'"),
        ("", 2, "an empty argument; give a value"),
    ):
        done = calibrator(*words(str(place), tmp_path / "out"))
        assert (done.returncode, message in done.stderr.splitlines()[-1]) == (code, True), done.stderr
        assert not list(tmp_path.glob(".out.*"))


# Second pass


def test_parameters_do_not_depend_on_others_in_the_bucket(store: SummaryStore, task: FleetTask, tmp_path: Path) -> None:
    bucket = fullest(store)
    records = store.read(bucket)
    together = texts(calibrate_bucket(bucket, store=store, task=task))
    assert len(together) >= 5
    for name, items in records.items():
        alone = rewritten(store, tmp_path, bucket, {name: items})
        (found,) = texts(calibrate_bucket(bucket, store=alone, task=task)).values()
        assert found.decode().splitlines() == together[name].decode().splitlines()


def test_vehicle_with_impossible_numbers_is_left_out(store: SummaryStore, task: FleetTask, tmp_path: Path) -> None:
    bucket = fullest(store)
    records: dict[str, Sequence[Record]] = dict(store.read(bucket))
    expected = texts(calibrate_bucket(bucket, store=store, task=task))
    bad = min(records)
    found = records[bad][0].found
    assert found is not None
    spoilt = replace(found.summary, moments=np.inf * found.summary.moments)
    records[bad] = [replace(records[bad][0], found=replace(found, summary=spoilt))]
    other = rewritten(store, tmp_path, bucket, records)
    sample = read_sample(other, CalibrationSettings())
    assert {item.vehicle for item in sample} == records.keys() - {bad}
    chunk = calibrate_bucket(bucket, store=other, task=task)
    assert texts(chunk) == {name: text for name, text in expected.items() if name != bad}
    assert left_out(chunk)[bad].startswith("its summary holds impossible numbers; look at its recordings")


def failing_for(bad: str, error: Exception, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the estimation of vehicles fail if this one is among them."""
    estimate = FleetTask.estimate

    def refusing(task: FleetTask, vehicles: Sequence[VehicleSummary]) -> Any:
        if bad in {vehicle.vehicle for vehicle in vehicles}:
            raise error
        return estimate(task, vehicles)

    monkeypatch.setattr(FleetTask, "estimate", refusing)


@pytest.mark.parametrize(("error", "reason"), [
    (FleetError("evidence is not finite"), "its evidence cannot be used: evidence is not finite; look at its rec"),
    (KeyError("x"), "internal error: KeyError: 'x' (test_run.py:"),
])  # fmt: skip
def test_vehicle_that_cannot_be_estimated_does_not_stop_the_others(
    store: SummaryStore, task: FleetTask, monkeypatch: pytest.MonkeyPatch, error: Exception, reason: str
) -> None:
    bucket = fullest(store)
    expected = texts(calibrate_bucket(bucket, store=store, task=task))
    bad, *others = expected
    failing_for(bad, error, monkeypatch)
    chunk = calibrate_bucket(bucket, store=store, task=task)
    assert texts(chunk) == {name: expected[name] for name in others}
    assert left_out(chunk)[bad].startswith(reason)


def test_internal_error_in_one_vehicle_exits_with_70_and_calibrates_the_others(
    store: SummaryStore, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    failing_for("V012", ZeroDivisionError("by nothing"), monkeypatch)
    done = calibrator(*words(store.url, tmp_path / "out"))
    assert done.returncode == 70
    last = done.stderr.splitlines()[-1]
    assert last.startswith("calibrator: internal error in 1 vehicle, which are left out: V012: ZeroDivisionError: by")
    assert read_run(tmp_path / "out").vehicles == VEHICLES - 1


# Since an earlier result


@pytest.mark.parametrize(
    ("drift", "offset_a", "moved"), [(0.0, 0.0, None), (0.08, 0.0, "battery drift"), (0.0, 30.0, "battery")]
)
def test_option_since_recalibrates_changed_vehicles_and_detects_moved_sensors(
    store: SummaryStore, result: Path, tmp_path: Path, drift: float, offset_a: float, moved: str | None
) -> None:
    faults = random_faults(VEHICLES).take(slice(9, 10))
    change = np.array([1.0, 0.0])  # of the battery sensor
    faults = replace(faults, drift=faults.drift + drift * change, offset_a=faults.offset_a + offset_a * change)
    (new,) = summaries_of(faults, Conditions(model_error_a=0.5), seed=5)
    shutil.copytree(store.url, tmp_path / "store")
    grown = SummaryStore(storage=open_storage(tmp_path / "store"), identity=store.identity)
    grown.append(grown.bucket_of("V009"), [record_of("V009", new, ("d2",))])
    said = succeeded(*words(grown.url, tmp_path / "out", "--since", result))
    old, now = contents(result / "params"), contents(tmp_path / "out" / "params")
    assert [name for name in old if old[name] != now[name]] == ["V009.json"]
    (battery,) = [r for r in read_results(tmp_path / "out") if (r["vehicle"], r["branch"]) == ("V009", "battery")]
    assert f"V009: {moved}" in said if moved else "moved since" not in said
    assert (b'"d1"' in now["V009.json"]) == (moved is None)
    assert abs(battery["drift"] - faults.drift[0, 0]) <= 4.0 * battery["drift_sd"]
    assert abs(battery["offset_a"] - faults.offset_a[0, 0]) <= 4.0 * battery["offset_sd_a"]


def test_option_since_recalibrates_only_vehicles_that_a_changed_option_concerns(
    store: SummaryStore, result: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "1800000000")  # stands in parameters that are found anew
    readings = tmp_path / "readings.csv"
    readings.write_text("vehicle,branch,offset_a,offset_sd_a\nV009,battery,0.0,300.0\n")
    old = contents(result / "params")
    for number, (options, concerned) in enumerate([
        ((), set()),
        (("--readings", readings), {"V009.json"}),
        (("--harm-limit", "0.02"), set(old)),
        (("--hold-out", "V009"), set(old)),
    ]):  # fmt: skip
        out = tmp_path / f"out{number}"
        succeeded(*words(store.url, out, "--since", result, *options))
        now = contents(out / "params")
        assert {name for name in old if old[name] != now[name]} == concerned


def test_option_since_names_vehicles_removed_from_the_store(store: SummaryStore, result: Path, tmp_path: Path) -> None:
    """Also if it was the only one of its bucket."""
    shutil.copytree(store.url, tmp_path / "store")
    gone = {name for name in (f"V{j:03d}" for j in range(VEHICLES)) if store.bucket_of(name) == fullest(store)}
    for path in (tmp_path / "store" / "buckets").glob(f"{fullest(store):05d}-*"):
        path.unlink()
    succeeded(*words(str(tmp_path / "store"), tmp_path / "out", "--since", result))
    why = "it is not in this store; its earlier parameters are in the earlier result"
    assert left_out_of(tmp_path / "out") == dict.fromkeys(gone, why)


def test_option_since_refuses_an_incomplete_result(store: SummaryStore, result: Path, tmp_path: Path) -> None:
    shutil.copytree(result, tmp_path / "earlier")
    part = tmp_path / "earlier" / "buckets" / f"{fullest(store):05d}.parquet"
    part.unlink()
    done = calibrator(*words(store.url, tmp_path / "out", "--since", tmp_path / "earlier"))
    assert f"{part}: missing part of a result; calibrate without --since" in done.stderr


@pytest.mark.parametrize(("key", "value", "message"), [
    ("method", "published", "its method is published, that of this run posterior; calibrate without --since"),
    ("branches", ["battery"], "its list of branches is battery, that of this run battery, motor"),
    ("layout_sha256", "0", "its version of "),
    ("buckets", 32, "its number of buckets is 32, that of this run 16"),
])  # fmt: skip
def test_option_since_refuses_an_incompatible_result(
    store: SummaryStore, result: Path, tmp_path: Path, key: str, value: object, message: str
) -> None:
    shutil.copytree(result, tmp_path / "earlier")
    run_file = tmp_path / "earlier" / "run.json"
    run_file.write_text(json.dumps({**json.loads(run_file.read_text()), key: value}))
    done = calibrator(*words(store.url, tmp_path / "out", "--since", tmp_path / "earlier"))
    assert (done.returncode, message in done.stderr.splitlines()[-1]) == (1, True), done.stderr
