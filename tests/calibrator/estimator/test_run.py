"""Whole runs, as a user types them and bucket by bucket: every vehicle by itself, and none stops the others."""

import json
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from calibrator.errors import FleetError
from calibrator.estimator import run
from calibrator.estimator.fleet_task import FleetTask, calibrate_bucket, learn_task
from calibrator.estimator.results import left_out_of, read_results, read_run
from calibrator.estimator.run import read_sample, take_census
from calibrator.estimator.settings import CalibrationSettings
from calibrator.faults import Faults
from calibrator.files.parameter_files import RunIdentity
from calibrator.files.storage import open_storage
from calibrator.options import Method
from calibrator.processes import run_many
from calibrator.processes.run_many import Workers
from calibrator.summaries.record import Record
from calibrator.summaries.store import SummaryStore
from calibrator.summaries.vehicle_summary import VehicleSummary
from ecu_node.database import VehicleDatabase
from tests.calibrator.command_here import calibrator
from tests.calibrator.estimator.simulated_drives import Conditions, summaries_of
from tests.calibrator.processes.dask_cluster import DaskCluster
from tests.calibrator.summaries.small_stores import BRANCHES, random_faults, record_of, small_store

LAYOUT = Path(__file__).parents[3] / "dbc" / "hv_powertrain.toml"
VEHICLES = 24
ONE = Workers(processes=1)


@pytest.fixture(scope="module", autouse=True)
def environment() -> Iterator[None]:
    """Results are made at the same time, and by one thread."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SOURCE_DATE_EPOCH", "1700000000")
        patch.setenv("OMP_NUM_THREADS", "1")
        yield


def calibrate(store: str, out: Path, *options: object) -> subprocess.CompletedProcess[str]:
    return calibrator("calibrate", store, "--layout", LAYOUT, "--out", out, *options)


def contents(result: Path) -> dict[str, bytes]:
    return {str(path.relative_to(result)): path.read_bytes() for path in sorted(result.rglob("*")) if path.is_file()}


@pytest.fixture(scope="module")
def store(database: VehicleDatabase, tmp_path_factory: pytest.TempPathFactory) -> SummaryStore:
    return small_store(tmp_path_factory.mktemp("fleet") / "store", database, random_faults(VEHICLES))


@pytest.fixture(scope="module")
def result(store: SummaryStore) -> Path:
    out = Path(store.url).parent / "result"
    done = calibrate(store.url, out, "--workers", 1)
    assert done.returncode == 0, done.stderr
    return out


@pytest.fixture(scope="module")
def task(store: SummaryStore, database: VehicleDatabase) -> FleetTask:
    identity = RunIdentity(
        database=database, method=Method.POSTERIOR, fleet="small", created="2026-01-01T00:00:00+00:00"
    )
    settings = CalibrationSettings()
    sample = read_sample(store, take_census(store, ONE), settings, ())
    return learn_task(sample, settings, {}, branches=BRANCHES, identity=identity, fleet_size=VEHICLES)[0]


def test_no_more_blocks_are_learnt_from_than_memory_holds(store: SummaryStore, monkeypatch: pytest.MonkeyPatch) -> None:
    census, settings = take_census(store, ONE), CalibrationSettings()
    whole = read_sample(store, census, settings, ())
    monkeypatch.setattr(run, "MOST_BLOCKS", sum(len(item.summary.moments) for item in whole[:10]))
    assert [item.vehicle for item in read_sample(store, census, settings, ())] == [item.vehicle for item in whole[:10]]
    trusted = CalibrationSettings(trusted=frozenset([whole[-1].vehicle]))
    assert read_sample(store, census, trusted, ())[-1].vehicle == whole[-1].vehicle


def texts(chunk: bytes) -> dict[str, bytes]:
    return {row["vehicle"]: row["parameters"].encode() for row in rows(chunk) if row["parameters"] is not None}


def rows(chunk: bytes) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = pq.read_table(pa.BufferReader(chunk)).to_pylist()
    return found


def left_out(chunk: bytes) -> dict[str, str]:
    return {row["vehicle"]: row["reason"] for row in rows(chunk) if row["branch"] is None}


def rewritten(store: SummaryStore, folder: Path, bucket: int, records: Mapping[str, Sequence[Record]]) -> SummaryStore:
    """A store with one bucket of other content."""
    other = SummaryStore(storage=open_storage(folder), identity=store.identity)
    other.write(bucket, records)
    return other


def copied(store: SummaryStore, folder: Path, name: str, records: Sequence[Record]) -> SummaryStore:
    """A copy of a store with other records of one vehicle."""
    shutil.copytree(store.url, folder)
    other = SummaryStore(storage=open_storage(folder), identity=store.identity)
    bucket = other.bucket_of(name)
    other.write(bucket, {**other.read(bucket), name: records})
    return other


def fullest(store: SummaryStore) -> int:
    return max(store.buckets(), key=lambda bucket: len(store.outlines(bucket)))


def spoilt(record: Record, **changes: Any) -> Record:
    """The same record with another summary."""
    assert record.found is not None
    return replace(record, found=replace(record.found, summary=replace(record.found.summary, **changes)))


# The result


def test_result_has_every_vehicle_once_in_order(result: Path) -> None:
    found = read_results(result)
    assert [row["vehicle"] for row in found[::2]] == [f"V{j:03d}" for j in range(VEHICLES)]
    assert sorted(path.stem for path in (result / "params").iterdir()) == [f"V{j:03d}" for j in range(VEHICLES)]
    assert read_run(result).vehicles == VEHICLES
    assert [path.name for path in result.parent.iterdir() if path.name.startswith(".result")] == []
    assert {path.name for path in result.iterdir()} == {"params", "buckets", "results.parquet", "run.json"}


def test_result_is_the_same_for_any_number_of_workers(store: SummaryStore, result: Path, tmp_path: Path) -> None:
    done = calibrate(store.url, tmp_path / "two", "--workers", 2)
    assert done.returncode == 0, done.stderr
    assert contents(tmp_path / "two") == contents(result)


@pytest.mark.long
def test_cluster_that_loses_a_worker_gives_the_same_result(database: VehicleDatabase, tmp_path: Path) -> None:
    pytest.importorskip("distributed")
    store = small_store(tmp_path / "store", database, random_faults(300))
    here = calibrate(store.url, tmp_path / "here", "--workers", 2)
    assert here.returncode == 0, here.stderr

    def chunks() -> int:
        return len(list(tmp_path.glob(".there.*/buckets/[0-9]*.parquet")))

    with DaskCluster(tmp_path) as cluster:
        there = ("--out", tmp_path / "there", "--scheduler", cluster.address)
        words = ("calibrate", store.url, "--layout", LAYOUT, *there)
        with subprocess.Popen([sys.executable, "-m", "calibrator", *words], stderr=subprocess.PIPE) as process:
            until = time.monotonic() + 300.0
            while chunks() < 2 and process.poll() is None and time.monotonic() < until:
                time.sleep(0.005)
            left = len(store.buckets()) - chunks()
            cluster.workers[0].send_signal(signal.SIGKILL)
            _, errors = process.communicate(timeout=300)
    assert left > 0, "the worker was to be killed in the middle"
    assert process.returncode == 0, errors.decode()
    assert contents(tmp_path / "there") == contents(tmp_path / "here")


# What is refused


@pytest.mark.parametrize(
    ("options", "code", "message"),
    [
        (("--method", "published"), 1, "a store of summaries, and --method published needs the drives"),
        (("--branches", "battery,motor"), 1, "a store of summaries, and --branches needs the drives"),
        (("--charge", "battery=3:0.1"), 1, "a store of summaries, and --charge needs the drives"),
        (("--meter", "motor"), 1, "a store of summaries, and --meter needs the drives"),
        (("--trusted", "battery"), 1, "a store of summaries, and --trusted with a branch needs the drives"),
        (("--trusted", "V777"), 1, "fleet small: no usable vehicle V777 to trust"),
        (("--hold-out", "V777"), 1, "fleet small: no usable vehicle V777 to hold out"),
        (("--hold-out", "V003", "--trusted", "V003"), 2, "vehicle V003 is both held out and trusted"),
        (("--since", "earlier", "--branches", "battery,motor"), 2, "--branches and --since exclude each other"),
        (("--since", "nothing"), 1, "not a result of 'calibrator calibrate'"),
        (("--scheduler", "tcp://127.0.0.1:9"), 1, "tcp://127.0.0.1:9: no Dask scheduler answers"),
    ],
)
def test_wrong_option_is_refused_in_one_line_and_leaves_nothing(
    store: SummaryStore, tmp_path: Path, options: tuple[str, ...], code: int, message: str, monkeypatch: Any
) -> None:
    monkeypatch.setattr(run_many, "CONNECT_S", 0.5)
    done = calibrate(store.url, tmp_path / "out", *options)
    assert done.returncode == code
    assert message in done.stderr.splitlines()[-1]
    assert "Traceback" not in done.stderr
    assert list(tmp_path.iterdir()) == []


def test_place_that_is_no_fleet_is_refused(store: SummaryStore, tmp_path: Path) -> None:
    shutil.copytree(store.url, tmp_path / "both")
    (tmp_path / "both" / "drives").mkdir()
    shutil.copytree(store.url, tmp_path / "empty", ignore=shutil.ignore_patterns("*.parquet"))
    (tmp_path / "file").touch()
    for place, code, message in (
        (tmp_path / "nothing", 1, "nothing: no such folder, store of drives or store of summaries"),
        (tmp_path / "file", 1, "file: not a known log format; expected .log"),
        (tmp_path / "both", 1, "both: holds drives (drives) and summaries (summaries.json); move one of them"),
        (tmp_path / "empty", 1, "empty: the store of summaries is empty; add drives with 'calibrator summarise'"),
        (
            "memory://none",
            1,
            "memory://none: no drive in it; problem 1: memory://none: nothing is there, or no logs",
        ),
        ("", 2, "an empty name; give the path"),
        ("file://", 1, "'file://': names no place"),
    ):
        done = calibrate(str(place), tmp_path / "out")
        assert (done.returncode, message in done.stderr.splitlines()[-1]) == (code, True), done.stderr
        assert not list(tmp_path.glob(".out.*"))


# Second pass


def test_vehicle_gets_the_same_parameters_in_any_company(store: SummaryStore, task: FleetTask, tmp_path: Path) -> None:
    bucket = fullest(store)
    records = store.read(bucket)
    together = texts(calibrate_bucket(bucket, store=store, task=task))
    assert len(together) >= 5
    for name, items in records.items():
        alone = rewritten(store, tmp_path, bucket, {name: items})
        (found,) = texts(calibrate_bucket(bucket, store=alone, task=task)).values()
        assert found.decode().splitlines() == together[name].decode().splitlines()


@pytest.mark.parametrize("what", ["huge", "infinite", "noise nan", "noise negative"])
def test_vehicle_with_impossible_numbers_stops_neither_pass(
    store: SummaryStore, task: FleetTask, tmp_path: Path, what: str
) -> None:
    bucket = fullest(store)
    records: dict[str, Sequence[Record]] = dict(store.read(bucket))
    expected = texts(calibrate_bucket(bucket, store=store, task=task))
    bad = min(records)
    record = records[bad][0]
    assert record.found is not None
    moments, noise_a2 = record.found.summary.moments.copy(), record.found.summary.noise_a2
    moments[2, 1, 1] = np.inf
    changes = {
        "huge": {"moments": 1e200 * record.found.summary.moments},
        "infinite": {"moments": moments},
        "noise nan": {"noise_a2": np.full_like(noise_a2, np.nan)},
        "noise negative": {"noise_a2": -np.ones_like(noise_a2)},
    }
    records[bad] = [spoilt(record, **changes[what])]
    other = rewritten(store, tmp_path, bucket, records)
    sample = read_sample(other, take_census(other, ONE), CalibrationSettings(), ())
    assert {item.vehicle for item in sample} == records.keys() - {bad}
    chunk = calibrate_bucket(bucket, store=other, task=task)
    assert texts(chunk) == {name: text for name, text in expected.items() if name != bad}
    assert left_out(chunk)[bad].startswith("its summary holds impossible numbers; look at its recordings")


def test_vehicle_without_usable_drives_is_left_out_with_its_reason(
    store: SummaryStore, task: FleetTask, tmp_path: Path
) -> None:
    bucket = fullest(store)
    records: dict[str, Sequence[Record]] = dict(store.read(bucket))
    bad = next(name for name in (f"V9{j:02d}" for j in range(100)) if store.bucket_of(name) == bucket)
    records[bad] = [Record(vehicle=bad, drives=("x",), sources=("",), found=None, problem="drive x:\ncut")]
    other = rewritten(store, tmp_path, bucket, records)
    assert left_out(calibrate_bucket(bucket, store=other, task=task)) == {bad: "drive x: cut"}
    census = take_census(other, ONE)
    assert (census.size, census.reasons) == (len(records) - 1, {bad: "drive x: cut"})


def failing_for(bad: str, error: Exception, monkeypatch: pytest.MonkeyPatch) -> None:
    """From now on vehicles cannot be estimated if this one is among them."""
    estimate = FleetTask.estimate

    def refusing(task: FleetTask, vehicles: Sequence[VehicleSummary]) -> Any:
        if bad in {vehicle.vehicle for vehicle in vehicles}:
            raise error
        return estimate(task, vehicles)

    monkeypatch.setattr(FleetTask, "estimate", refusing)


@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (FleetError("evidence is not finite"), "its evidence cannot be used: evidence is not finite; look at its rec"),
        (KeyError("x"), "internal error: KeyError: 'x' (test_run.py:"),
    ],
)
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


def test_internal_error_is_named_and_ends_the_command_with_70(
    store: SummaryStore, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    failing_for("V012", ZeroDivisionError("by nothing"), monkeypatch)
    done = calibrate(store.url, tmp_path / "out", "--workers", 1)
    assert done.returncode == 70
    last = done.stderr.splitlines()[-1]
    assert last.startswith("calibrator: internal error in 1 vehicle, which are left out: V012: ZeroDivisionError: by")
    assert read_run(tmp_path / "out").vehicles == VEHICLES - 1


# Since an earlier result


def earlier_result(folder: Path, chunk: bytes, bucket: int) -> Path:
    (folder / "buckets").mkdir(parents=True)
    (folder / "buckets" / f"{bucket:05d}.parquet").write_bytes(chunk)
    return folder


def faults_of_vehicle(j: int, **changes: float) -> Faults:
    """Faults of vehicle j of the store, with changes to its battery sensor."""
    faults = random_faults(VEHICLES).take(slice(j, j + 1))
    drift, offset_a = faults.drift.copy(), faults.offset_a.copy()
    drift[0, 0] += changes.get("drift", 0.0)
    offset_a[0, 0] += changes.get("offset_a", 0.0)
    return replace(faults, drift=drift, offset_a=offset_a)


def test_only_those_who_drove_since_are_calibrated(store: SummaryStore, result: Path, tmp_path: Path) -> None:
    (new,) = summaries_of(faults_of_vehicle(9, drift=0.08), Conditions(model_error_a=0.5), seed=5)
    before = store.read(store.bucket_of("V009"))["V009"]
    grown = copied(store, tmp_path / "store", "V009", [*before, record_of("V009", new, ("d2",))])
    done = calibrate(grown.url, tmp_path / "out", "--since", result, "--workers", 1)
    assert done.returncode == 0, done.stderr
    assert "moved since the earlier result:" in done.stdout
    assert "V009: battery drift" in done.stdout
    old, now = contents(result / "params"), contents(tmp_path / "out" / "params")
    assert [name for name in old if old[name] != now[name]] == ["V009.json"]


def test_vehicle_of_the_earlier_result_that_is_in_the_store_no_more_is_named(
    store: SummaryStore, result: Path, tmp_path: Path
) -> None:
    """Also if it was the only one of its bucket."""
    shutil.copytree(store.url, tmp_path / "store")
    gone = {name for name in (f"V{j:03d}" for j in range(VEHICLES)) if store.bucket_of(name) == fullest(store)}
    for path in (tmp_path / "store" / "buckets").glob(f"{fullest(store):05d}-*"):
        path.unlink()
    done = calibrate(str(tmp_path / "store"), tmp_path / "out", "--since", result, "--workers", 1)
    assert done.returncode == 0, done.stderr
    why = "it is not in this store; its earlier parameters are in the earlier result"
    assert left_out_of(tmp_path / "out") == dict.fromkeys(gone, why)


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("method", "published", "a result of the method published; --since goes on from one of the posterior"),
        ("branches", ["battery"], "a result with branches battery; this fleet has battery, motor"),
        ("layout_sha256", "0", "made with another version of layout or DBC"),
        ("buckets", 32, "made from a store of 32 buckets, and this one has 16"),
    ],
)
def test_since_a_result_of_something_else_is_refused(
    store: SummaryStore, result: Path, tmp_path: Path, key: str, value: object, message: str
) -> None:
    shutil.copytree(result, tmp_path / "earlier")
    run_file = tmp_path / "earlier" / "run.json"
    run_file.write_text(json.dumps({**json.loads(run_file.read_text()), key: value}))
    done = calibrate(store.url, tmp_path / "out", "--since", tmp_path / "earlier")
    assert (done.returncode, message in done.stderr.splitlines()[-1]) == (1, True), done.stderr


def test_changed_drive_counts_though_its_name_is_known(store: SummaryStore, task: FleetTask, tmp_path: Path) -> None:
    bucket = fullest(store)
    records: dict[str, Sequence[Record]] = dict(store.read(bucket))
    previous = earlier_result(tmp_path / "r", calibrate_bucket(bucket, store=store, task=task), bucket)
    name = min(name for name in records if int(name[1:]) % 3 == 0)
    (changed,) = summaries_of(faults_of_vehicle(int(name[1:]), drift=0.08), Conditions(model_error_a=0.5), seed=7)
    records[name] = [replace(record_of(name, changed), sources=("3-4",))]
    other = rewritten(store, tmp_path / "s", bucket, records)
    chunk = calibrate_bucket(bucket, store=other, task=task, previous=previous)
    (battery,) = [row for row in rows(chunk) if row["vehicle"] == name and row["branch"] == "battery"]
    assert battery["drift"] == pytest.approx(0.08, abs=0.005)


@pytest.mark.parametrize(("changes", "text"), [({}, None), ({"drift": 0.08}, "drift"), ({"offset_a": 30.0}, "offset")])
def test_moved_sensor_is_named_and_calibrated_from_the_new_drives(
    store: SummaryStore, task: FleetTask, tmp_path: Path, changes: dict[str, float], text: str | None
) -> None:
    bucket = fullest(store)
    records: dict[str, Sequence[Record]] = dict(store.read(bucket))
    name = min(name for name in records if int(name[1:]) % 3 == 0)
    previous = earlier_result(tmp_path / "r", calibrate_bucket(bucket, store=store, task=task), bucket)
    faults = faults_of_vehicle(int(name[1:]), **changes)
    (new,) = summaries_of(faults, Conditions(model_error_a=0.5), seed=77)
    records[name] = [*records[name], record_of(name, new, ("d2",))]
    other = rewritten(store, tmp_path / "s", bucket, records)
    chunk = calibrate_bucket(bucket, store=other, task=task, previous=previous)
    moved = {str(row["branch"]): str(row["moved"]) for row in rows(chunk) if row["moved"] is not None}
    if text is None:
        assert not moved
        assert b'"d1",\n      "d2"' in texts(chunk)[name]
        return
    assert list(moved) == ["battery"]
    assert text in moved["battery"]
    (battery,) = [row for row in rows(chunk) if row["vehicle"] == name and row["branch"] == "battery"]
    for column, truth in (("drift", faults.drift), ("offset_a", faults.offset_a)):
        sd = battery["drift_sd" if column == "drift" else "offset_sd_a"]
        assert abs(battery[column] - truth[0, 0]) <= 4.0 * sd
    assert b'"d1"' not in texts(chunk)[name]
