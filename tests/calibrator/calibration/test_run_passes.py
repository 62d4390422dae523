"""The two passes over a store: every vehicle by itself, in any company, and none stops the others."""

import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from calibrator.calibration.first_pass import read_sample, take_census
from calibrator.calibration.in_order import Workers
from calibrator.calibration.previous import PreviousResult
from calibrator.calibration.second_pass import calibrate_bucket
from calibrator.calibration_settings import CalibrationSettings
from calibrator.errors import FleetError
from calibrator.faults import Faults
from calibrator.files.parameter_files import RunIdentity
from calibrator.files.storage import open_storage
from calibrator.options import Method
from calibrator.posterior.fleet import learn_fleet
from calibrator.posterior.fleet_task import FleetTask
from calibrator.results.chunk import ChunkResult, encode_chunk
from calibrator.summaries.record import Record
from calibrator.summaries.store import SummaryStore
from calibrator.summaries.vehicle_summary import VehicleSummary
from ecu_node.database import VehicleDatabase
from ecu_node.parameters import decode_parameters
from ecu_node.sensor_models import GainBySign
from tests.calibrator.evidence.simulated_drives import Conditions, summaries_of
from tests.calibrator.summaries.small_stores import BRANCHES, random_faults, record_of, small_store

VEHICLES = 60
ONE = Workers(processes=1)


@pytest.fixture(scope="module")
def store(database: VehicleDatabase, tmp_path_factory: pytest.TempPathFactory) -> SummaryStore:
    return small_store(tmp_path_factory.mktemp("store"), database, random_faults(VEHICLES))


@pytest.fixture(scope="module")
def task(store: SummaryStore, database: VehicleDatabase) -> FleetTask:
    census, settings = take_census(store, ONE), CalibrationSettings()
    identity = RunIdentity(
        database=database, method=Method.POSTERIOR, fleet="small", created="2026-01-01T00:00:00+00:00"
    )
    sample = read_sample(store, census, settings, (), everyone=False)
    return learn_fleet(sample, settings, {}, branches=BRANCHES, identity=identity, fleet_size=census.size).task


def texts(chunk: ChunkResult) -> dict[str, bytes]:
    table = pq.read_table(pa.BufferReader(chunk.parameters)).to_pylist()
    return {row["vehicle"]: row["parameters"].encode() for row in table}


def rows(chunk: ChunkResult) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = pq.read_table(pa.BufferReader(chunk.rows)).to_pylist()
    return found


def rewritten(store: SummaryStore, folder: Path, bucket: int, records: Mapping[str, Sequence[Record]]) -> SummaryStore:
    """A store with one bucket of other content."""
    other = SummaryStore(storage=open_storage(folder), identity=store.identity)
    other.write(bucket, records)
    return other


def fullest(store: SummaryStore) -> int:
    return max(store.buckets(), key=lambda bucket: len(store.outlines(bucket)))


def test_what_is_found_for_a_vehicle_does_not_depend_on_those_beside_it(
    store: SummaryStore, task: FleetTask, tmp_path: Path
) -> None:
    bucket = fullest(store)
    records = store.read(bucket)
    together = texts(calibrate_bucket(bucket, store=store, task=task))
    assert len(together) >= 5
    for name, items in records.items():
        alone = rewritten(store, tmp_path, bucket, {name: items})
        (found,) = texts(calibrate_bucket(bucket, store=alone, task=task)).values()
        assert found.decode().splitlines() == together[name].decode().splitlines()


def test_a_vehicle_that_cannot_be_estimated_does_not_stop_the_others(
    store: SummaryStore, task: FleetTask, tmp_path: Path
) -> None:
    bucket = fullest(store)
    records = store.read(bucket)
    expected = texts(calibrate_bucket(bucket, store=store, task=task))
    bad, *others = records
    found = records[bad][0].found
    assert found is not None
    huge = replace(found.summary, moments=found.summary.moments * 1e200)
    spoilt = {**records, bad: [replace(records[bad][0], found=replace(found, summary=huge))]}
    chunk = calibrate_bucket(bucket, store=rewritten(store, tmp_path, bucket, spoilt), task=task)
    assert texts(chunk) == {name: expected[name] for name in others}
    (left_out,) = [row for row in rows(chunk) if row["branch"] is None]
    assert (left_out["vehicle"], left_out["reason"][:37]) == (bad, "its summary holds impossible numbers;")


def test_a_vehicle_whose_evidence_cannot_be_used_does_not_stop_the_others(
    store: SummaryStore, task: FleetTask, monkeypatch: pytest.MonkeyPatch
) -> None:
    bucket = fullest(store)
    expected = texts(calibrate_bucket(bucket, store=store, task=task))
    bad, *others = expected
    calibrate = FleetTask.calibrate

    def refusing(task: FleetTask, vehicles: Sequence[VehicleSummary]) -> Any:
        if bad in {vehicle.vehicle for vehicle in vehicles}:
            raise FleetError("evidence is not finite")
        return calibrate(task, vehicles)

    monkeypatch.setattr(FleetTask, "calibrate", refusing)
    chunk = calibrate_bucket(bucket, store=store, task=task)
    assert {name: text for name, text in texts(chunk).items() if name != bad} == {
        name: expected[name] for name in others
    }
    (left_out,) = [row for row in rows(chunk) if row["branch"] is None]
    assert left_out["vehicle"] == bad
    assert left_out["reason"].startswith("its evidence cannot be used: evidence is not finite; ")


@pytest.mark.parametrize("noise_a2", [np.nan, -1.0, np.inf])
def test_a_vehicle_with_impossible_noise_stops_neither_pass(
    store: SummaryStore, task: FleetTask, tmp_path: Path, noise_a2: float
) -> None:
    bucket = fullest(store)
    records: dict[str, Sequence[Record]] = dict(store.read(bucket))
    bad = min(records)
    found = records[bad][0].found
    assert found is not None
    summary = replace(found.summary, noise_a2=np.full_like(found.summary.noise_a2, noise_a2))
    records[bad] = [replace(records[bad][0], found=replace(found, summary=summary))]
    other = rewritten(store, tmp_path, bucket, records)
    sample = read_sample(other, take_census(other, ONE), CalibrationSettings(), (), everyone=False)
    assert {item.vehicle for item in sample} == records.keys() - {bad}
    (left_out,) = [row for row in rows(calibrate_bucket(bucket, store=other, task=task)) if row["branch"] is None]
    assert (left_out["vehicle"], left_out["reason"][:37]) == (bad, "its summary holds impossible numbers;")


def test_a_vehicle_with_impossible_numbers_is_not_learnt_from(store: SummaryStore, tmp_path: Path) -> None:
    bucket = fullest(store)
    records: dict[str, Sequence[Record]] = dict(store.read(bucket))
    bad = min(records)
    found = records[bad][0].found
    assert found is not None
    moments = found.summary.moments.copy()
    moments[2, 1, 1] = np.inf
    records[bad] = [replace(records[bad][0], found=replace(found, summary=replace(found.summary, moments=moments)))]
    other = rewritten(store, tmp_path, bucket, records)
    sample = read_sample(other, take_census(other, ONE), CalibrationSettings(), (), everyone=False)
    assert {item.vehicle for item in sample} == records.keys() - {bad}


def test_a_vehicle_without_usable_drives_is_left_out_with_its_reason(
    store: SummaryStore, task: FleetTask, tmp_path: Path
) -> None:
    bucket = fullest(store)
    records: dict[str, Sequence[Record]] = dict(store.read(bucket))
    bad = next(name for name in (f"V9{j:02d}" for j in range(100)) if store.bucket_of(name) == bucket)
    records[bad] = [Record(vehicle=bad, drives=("x",), sources=("",), found=None, problem="drive x:\ncut")]
    other = rewritten(store, tmp_path, bucket, records)
    (left_out,) = [row for row in rows(calibrate_bucket(bucket, store=other, task=task)) if row["branch"] is None]
    assert (left_out["vehicle"], left_out["verdict"], left_out["reason"]) == (bad, "left out", "drive x: cut")
    census = take_census(other, ONE)
    assert (census.size, census.reasons) == (len(records) - 1, {bad: "drive x: cut"})


def test_the_sample_is_the_whole_of_a_small_fleet_less_those_held_out(store: SummaryStore) -> None:
    census = take_census(store, ONE)
    names = {item.vehicle for item in read_sample(store, census, CalibrationSettings(), (), everyone=False)}
    assert names == {f"V{j:03d}" for j in range(VEHICLES)}
    held_out = CalibrationSettings(hold_out=frozenset({"V003", "V004"}))
    assert names - {item.vehicle for item in read_sample(store, census, held_out, ("V004",), everyone=False)} == {
        "V003"
    }


def test_the_sample_of_a_large_fleet_is_of_fixed_size_and_holds_those_that_were_checked(
    store: SummaryStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("calibrator.calibration.first_pass.MOST_LEARNT", 10)
    census = take_census(store, ONE)
    last = list(store.read(max(census.usable)))[-1]
    settings = CalibrationSettings(trusted=frozenset({last}))
    sample = [item.vehicle for item in read_sample(store, census, settings, (), everyone=False)]
    assert last in sample
    assert len(sample) == 11


def test_too_few_vehicles_are_refused(database: VehicleDatabase, tmp_path: Path) -> None:
    lonely = small_store(tmp_path, database, random_faults(1))
    with pytest.raises(FleetError, match="1 usable vehicle to learn from, at least 2 are needed"):
        read_sample(lonely, take_census(lonely, ONE), CalibrationSettings(), (), everyone=False)


def previous_of(folder: Path, chunk: ChunkResult, bucket: int) -> PreviousResult:
    (folder / "parameters").mkdir(parents=True)
    (folder / "parameters" / f"{bucket:05d}.parquet").write_bytes(chunk.parameters)
    return PreviousResult(folder=folder)


def faults_of_vehicle(j: int, **changes: float) -> Faults:
    """Faults of vehicle j of the store, with changes to its battery sensor."""
    faults = random_faults(VEHICLES).take(slice(j, j + 1))
    drift, offset_a = faults.drift.copy(), faults.offset_a.copy()
    drift[0, 0] += changes.get("drift", 0.0)
    offset_a[0, 0] += changes.get("offset_a", 0.0)
    return replace(faults, drift=drift, offset_a=offset_a)


def test_a_drive_that_was_changed_is_heeded_though_its_name_is_known(
    store: SummaryStore, task: FleetTask, tmp_path: Path
) -> None:
    bucket = fullest(store)
    records: dict[str, Sequence[Record]] = dict(store.read(bucket))
    previous = previous_of(tmp_path / "r", calibrate_bucket(bucket, store=store, task=task), bucket)
    name = min(name for name in records if int(name[1:]) % 3 == 0)
    (changed,) = summaries_of(faults_of_vehicle(int(name[1:]), drift=0.08), Conditions(model_error_a=0.5), seed=7)
    records[name] = [replace(record_of(name, changed), sources=("3-4",))]
    other = rewritten(store, tmp_path / "s", bucket, records)
    chunk = calibrate_bucket(bucket, store=other, task=task, previous=previous)
    (battery,) = [row for row in rows(chunk) if row["vehicle"] == name and row["branch"] == "battery"]
    assert battery["drift"] == pytest.approx(0.08, abs=0.005)


def test_a_sensor_that_is_not_linear_keeps_its_earlier_model_as_summaries_do_not_tell_it(
    store: SummaryStore, task: FleetTask, tmp_path: Path
) -> None:
    bucket = fullest(store)
    first = texts(calibrate_bucket(bucket, store=store, task=task))
    name = min(first)
    earlier = decode_parameters(first[name], name)
    model = GainBySign(drift_positive=0.1, drift_negative=-0.1)
    battery = msgspec.structs.replace(earlier.branches["battery"], sensor_model=model)
    bent = msgspec.structs.replace(earlier, branches={**earlier.branches, "battery": battery})
    previous = previous_of(tmp_path / "r", encode_chunk([bent], {}, drives={name: "other drives"}), bucket)
    found = texts(calibrate_bucket(bucket, store=store, task=task, previous=previous))
    assert decode_parameters(found[name], name) == bent


def test_an_earlier_vehicle_that_the_store_lacks_is_told(store: SummaryStore, task: FleetTask, tmp_path: Path) -> None:
    bucket = fullest(store)
    records: dict[str, Sequence[Record]] = dict(store.read(bucket))
    previous = previous_of(tmp_path / "r", calibrate_bucket(bucket, store=store, task=task), bucket)
    name = max(records)
    del records[name]
    other = rewritten(store, tmp_path / "s", bucket, records)
    (left_out,) = [
        row
        for row in rows(calibrate_bucket(bucket, store=other, task=task, previous=previous))
        if row["branch"] is None
    ]
    assert (left_out["vehicle"], left_out["reason"][:23]) == (name, "it is not in this store")


def test_an_earlier_result_that_cannot_be_reached_is_refused(
    store: SummaryStore, task: FleetTask, tmp_path: Path
) -> None:
    with pytest.raises(FleetError, match="the earlier result cannot be reached from here"):
        calibrate_bucket(fullest(store), store=store, task=task, previous=PreviousResult(folder=tmp_path))
    (tmp_path / "parameters").mkdir()
    (tmp_path / "parameters" / f"{fullest(store):05d}.parquet").write_bytes(b"nonsense")
    with pytest.raises(FleetError, match="damaged part of a result"):
        calibrate_bucket(fullest(store), store=store, task=task, previous=PreviousResult(folder=tmp_path))


def test_vehicles_that_have_not_driven_since_keep_their_parameters(
    store: SummaryStore, task: FleetTask, tmp_path: Path
) -> None:
    bucket = fullest(store)
    first = calibrate_bucket(bucket, store=store, task=task)
    later = replace(task, identity=replace(task.identity, created="2027-01-01T00:00:00+00:00"))
    again = calibrate_bucket(bucket, store=store, task=later, previous=previous_of(tmp_path, first, bucket))
    assert texts(again) == texts(first)


@pytest.mark.parametrize(("changes", "text"), [({}, None), ({"drift": 0.08}, "drift"), ({"offset_a": 30.0}, "offset")])
def test_a_sensor_that_moved_is_told_and_calibrated_from_the_new_drives(
    store: SummaryStore, task: FleetTask, tmp_path: Path, changes: dict[str, float], text: str | None
) -> None:
    bucket = fullest(store)
    records: dict[str, Sequence[Record]] = dict(store.read(bucket))
    name = min(name for name in records if int(name[1:]) % 3 == 0)
    previous = previous_of(tmp_path / "r", calibrate_bucket(bucket, store=store, task=task), bucket)
    faults = faults_of_vehicle(int(name[1:]), **changes)
    (new,) = summaries_of(faults, Conditions(model_error_a=0.5), seed=77)
    records[name] = [*records[name], record_of(name, new, ("d2",))]
    later = replace(task, identity=replace(task.identity, created="2027-01-01T00:00:00+00:00"))
    chunk = calibrate_bucket(
        bucket, store=rewritten(store, tmp_path / "s", bucket, records), task=later, previous=previous
    )
    moved = {str(row["branch"]): str(row["moved"]) for row in rows(chunk) if row["moved"] is not None}
    if text is None:
        assert not moved
        assert b'"d1",\n      "d2"' in texts(chunk)[name]
        return
    assert list(moved) == ["battery"]
    assert text in moved["battery"]
    (battery,) = [row for row in rows(chunk) if row["vehicle"] == name and row["branch"] == "battery"]
    for name_of, truth in (("drift", faults.drift), ("offset_a", faults.offset_a)):
        sd = battery["drift_sd" if name_of == "drift" else "offset_sd_a"]
        assert abs(battery[name_of] - truth[0, 0]) <= 4.0 * sd
    assert b'"d1"' not in texts(chunk)[name]


def test_a_cluster_without_dask_is_refused_before_the_fleet_is_read(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)  # makes its import fail
    with pytest.raises(FleetError, match=r"--scheduler needs Dask: pip install 'hv-current-correction\[cluster\]'"):
        Workers(processes=1, scheduler="tcp://127.0.0.1:8786")
    assert Workers(processes=1).scheduler is None
