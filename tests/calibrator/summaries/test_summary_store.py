"""Summaries on disk: nothing is lost, records add up, and nothing that does not fit gets in."""

import errno
import math
import re
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import duckdb
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from calibrator.errors import DriveError, FleetError
from calibrator.files.storage import Storage, StorageError, open_storage
from calibrator.summaries.identity import SCHEMA_VERSION, bucket_of, read_identity, write_identity
from calibrator.summaries.moments import DriveSummary
from calibrator.summaries.record import Record, joined_records
from calibrator.summaries.store import SummaryStore
from calibrator.summaries.store_report import compact_store, look_at_store
from calibrator.summaries.table import FIT_COLUMNS, MOST_BLOCKS, SCHEMA
from ecu_node.database import VehicleDatabase
from tests.calibrator.estimator.simulated_drives import Conditions, no_faults, summaries_of
from tests.calibrator.summaries.small_stores import identity_of, random_faults, record_of, small_store

VEHICLES = 40


@pytest.fixture(scope="module")
def store(database: VehicleDatabase, tmp_path_factory: pytest.TempPathFactory) -> SummaryStore:
    return small_store(tmp_path_factory.mktemp("store"), database, random_faults(VEHICLES))


def all_records(store: SummaryStore) -> list[Record]:
    return [record for bucket in store.buckets() for items in store.read(bucket).values() for record in items]


def summary_of(samples: int, seed: int = 1) -> DriveSummary:
    return summaries_of(no_faults(1, 2), Conditions(samples=samples), seed=seed)[0]


def test_what_is_read_is_what_was_written(store: SummaryStore) -> None:
    records = {record.vehicle: record for record in all_records(store)}
    assert sorted(records) == [f"V{j:03d}" for j in range(VEHICLES)]
    for name, summary in zip(
        sorted(records), summaries_of(random_faults(VEHICLES), Conditions(model_error_a=0.5), seed=1), strict=True
    ):
        expected, found = record_of(name, summary).found, records[name].found
        assert expected is not None
        assert found is not None
        np.testing.assert_allclose(found.summary.moments, expected.summary.moments, rtol=1e-15)
        np.testing.assert_array_equal(found.summary.noise_a2, expected.summary.noise_a2)
        for column in FIT_COLUMNS:
            np.testing.assert_array_equal(getattr(found.summary.fit, column), getattr(expected.summary.fit, column))
        assert found.delays.by_branch() == expected.delays.by_branch()
        np.testing.assert_array_equal(found.zero_current.offset_a, expected.zero_current.offset_a)
        assert (found.drives, found.recorded) == (expected.drives, expected.recorded)
        assert records[name].sources == ("1-2",)


def test_any_tool_can_read_it(store: SummaryStore) -> None:
    files = f"{store.url}/buckets/*.parquet"
    count, seconds = duckdb.execute(
        f"SELECT count(DISTINCT vehicle), sum(duration_s) FROM read_parquet('{files}')"
    ).fetchall()[0]
    assert count == VEHICLES
    assert seconds == pytest.approx(VEHICLES * 1800.0)


def test_added_records_are_files_of_their_own_until_they_are_put_together(
    tmp_path: Path, database: VehicleDatabase
) -> None:
    store = small_store(tmp_path / "store", database, random_faults(4))
    bucket = store.bucket_of("V001")
    before = {path.name: path.read_bytes() for path in (tmp_path / "store" / "buckets").iterdir()}
    store.append(bucket, {"V001": [record_of("V001", summary_of(600), ("d2",))]})
    for name, content in before.items():
        assert (tmp_path / "store" / "buckets" / name).read_bytes() == content
    assert [record.drives for record in store.read(bucket)["V001"]] == [("d1",), ("d2",)]
    old = store.files(bucket)[0]
    kept = {name: (tmp_path / "store" / "buckets" / name).read_bytes() for name in old}
    assert look_at_store(store.url).drives == 5
    assert compact_store(store.url).as_text().endswith("1 bucket written anew, 0 damaged records removed")
    (whole,), rest = store.files(bucket)
    assert rest == []
    for name, content in kept.items():  # as if the run had been killed before it removed them
        (tmp_path / "store" / "buckets" / name).write_bytes(content)
    assert store.files(bucket) == ([whole], old)
    assert [record.drives for record in store.read(bucket)["V001"]] == [("d1",), ("d2",)]
    report = look_at_store(store.url, whole=True)
    assert (report.vehicles, report.drives, sorted(report.faults)) == (4, 5, old)


def test_the_bucket_of_a_vehicle_depends_on_its_name_alone() -> None:
    assert [bucket_of(name, 16) for name in ("V1", "V2", "WBA123")] == [8, 9, 13]
    counts = np.bincount([bucket_of(f"V{j}", 64) for j in range(6400)], minlength=64)
    assert counts.min() > 60
    assert counts.max() < 145


def test_records_of_a_vehicle_add_up(store: SummaryStore) -> None:
    parts = [summary_of(900, seed) for seed in (1, 2)]
    both = joined_records([record_of("V1", part, (f"d{k}",), shown_a=1.5) for k, part in enumerate(parts)])
    assert both.drives == ("d0", "d1")
    np.testing.assert_allclose(both.summary.total, parts[0].total + parts[1].total)
    assert len(both.summary.moments) == len(parts[0].moments) + len(parts[1].moments)
    assert both.zero_current.sd_a[1] == pytest.approx(0.1 / np.sqrt(2.0))


def test_a_long_drive_is_shortened_and_its_sums_stay(tmp_path: Path, database: VehicleDatabase) -> None:
    long = summary_of(30 * (MOST_BLOCKS + 40))
    store = SummaryStore(storage=open_storage(tmp_path), identity=identity_of(database, 1))
    bucket = store.bucket_of("V1")
    store.write(bucket, {"V1": [record_of("V1", long)]})
    (record,) = store.read(bucket)["V1"]
    assert record.found is not None
    kept = record.found.summary
    assert len(kept.moments) <= MOST_BLOCKS < len(long.moments)
    np.testing.assert_allclose(kept.total, long.total, rtol=1e-12)
    assert kept.noise_a2.mean() == pytest.approx(long.noise_a2.mean(), rel=0.02)


def test_drives_too_short_by_themselves_count_together() -> None:
    parts = [record_of("V1", summary_of(90, seed), (f"d{seed}",)) for seed in (1, 2)]
    with pytest.raises(DriveError, match=r"90\.0 s of usable data in 1 drive; at least 120 s are needed"):
        joined_records(parts[:1])
    assert joined_records(parts).summary.duration_s == 180.0


def test_a_record_without_data_says_why_and_does_not_spoil_the_others() -> None:
    bad = Record(vehicle="V1", drives=("x",), sources=("",), found=None, problem="drive x: cut")
    with pytest.raises(DriveError, match="drive x: cut"):
        joined_records([bad])
    assert joined_records([bad, record_of("V1", summary_of(600))]).drives == ("d1",)


def test_numbers_that_are_not_finite_are_refused() -> None:
    summary = summary_of(600)
    summary.moments[3, 1, 1] = np.nan
    with pytest.raises(DriveError, match="its summary holds impossible numbers; look at its recordings"):
        joined_records([record_of("V1", summary)])


@pytest.mark.parametrize("damage", [b"", b"PAR1", b"x" * 5000])
def test_a_damaged_bucket_is_named(tmp_path: Path, database: VehicleDatabase, damage: bytes) -> None:
    store = small_store(tmp_path, database, no_faults(2, 2))
    path = next((tmp_path / "buckets").iterdir())
    path.write_bytes(damage)
    with pytest.raises(FleetError, match=rf"{path.name}: damaged file of summaries: .*; remove it and summarise again"):
        store.read(int(path.name[:5]))
    with pytest.raises(FleetError, match="damaged file of summaries"):
        store.outlines(int(path.name[:5]))


def spoil(store: SummaryStore, bucket: int, changes: Mapping[str, Any]) -> str:
    """Change columns of the first vehicle of a bucket, as another tool would; its name."""
    path = Path(store.url) / "buckets" / store.files(bucket)[0][0]
    rows = pq.read_table(path).to_pylist()
    name = str(rows[0]["vehicle"])
    rows[0] |= changes
    pq.write_table(pa.Table.from_pylist(rows, schema=SCHEMA), path)
    return name


def fullest(store: SummaryStore) -> int:
    return max(store.buckets(), key=lambda bucket: len(store.outlines(bucket)))


@pytest.fixture
def own_store(store: SummaryStore, tmp_path: Path) -> SummaryStore:
    shutil.copytree(store.url, tmp_path / "store")
    return SummaryStore(storage=open_storage(tmp_path / "store"), identity=store.identity)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"moments": None}, "its summary is damaged: moments, noise_a2 and fit sums do not fit the other columns"),
        ({"moments": [1.0] * 29}, "its summary is damaged: moments, noise_a2 and fit sums"),
        ({"noise_a2": []}, "its summary is damaged: moments, noise_a2 and fit sums"),
        ({"noise_a2": [math.nan] * 120}, "its summary holds impossible numbers"),
        ({"noise_a2": [None] * 120}, "its summary holds impossible numbers"),
        ({"moments": [-1.0] * 60 * 21}, "its summary holds impossible numbers"),
        ({"levels": [1.0]}, "its summary is damaged: moments, noise_a2 and fit sums"),
        ({"spikes": None}, "its summary is damaged: moments, noise_a2 and fit sums"),
        ({"spikes": [-1.0] * 240}, "its summary holds impossible numbers"),
        ({"temperature_c": [math.inf] * 60}, "its summary holds impossible numbers"),
        ({"duration_s": None}, "its summary is damaged: duration_s"),
        ({"duration_s": math.inf}, "its summary holds impossible numbers"),
        ({"delay_reference": "bogus"}, "its summary is damaged: delay_reference"),
        ({"delay_s": [0.1]}, "its summary is damaged: delay_s"),
        ({"delay_s": [0.1, math.nan]}, "its summary holds impossible numbers"),
        ({"delay_sd_s": [0.1, -0.1]}, "its summary holds impossible numbers"),
        ({"zero_sd_a": None}, "its summary is damaged: zero_sd_a"),
        ({"zero_offset_a": [1.0, 1.0], "zero_sd_a": [0.0, 0.1]}, "its summary holds impossible numbers"),
        ({"zero_offset_a": [1.0, math.nan], "zero_sd_a": [0.1, 0.1]}, "its summary holds impossible numbers"),
        ({"recorded": None}, "its summary is damaged: recorded"),
        ({"sources": []}, "its summary is damaged: sources"),
    ],
)
def test_a_vehicle_whose_row_makes_no_sense_is_left_out_and_the_others_stay_as_they_are(
    store: SummaryStore, own_store: SummaryStore, changes: dict[str, Any], reason: str
) -> None:
    bucket = fullest(store)
    bad = spoil(own_store, bucket, changes)
    before, after = store.read(bucket), own_store.read(bucket)
    with pytest.raises(DriveError, match=reason):
        joined_records(after[bad])
    for name in before.keys() - {bad}:
        first, second = (joined_records(records[name]).summary for records in (before, after))
        np.testing.assert_array_equal(second.moments, first.moments)
        np.testing.assert_array_equal(second.noise_a2, first.noise_a2)
    assert len(own_store.outlines(bucket)) == len(before)


def test_a_damaged_record_is_not_made_up_for_by_another_of_its_vehicle() -> None:
    damaged = Record(vehicle="V1", drives=("x",), sources=("",), found=None, problem="damaged", damaged=True)
    with pytest.raises(DriveError, match="damaged"):
        joined_records([damaged, record_of("V1", summary_of(600))])


@pytest.mark.parametrize("name", ["../../evil", "", "-V1", "Vä"])
def test_a_vehicle_whose_name_cannot_be_used_is_left_out_with_it(own_store: SummaryStore, name: str) -> None:
    bucket = fullest(own_store)
    spoil(own_store, bucket, {"vehicle": name})
    expected = rf"vehicle {re.escape(repr(name))} cannot be used; .* not starting with a dash, dot"
    with pytest.raises(DriveError, match=expected):
        joined_records(own_store.read(bucket)[name])
    (outline,) = [item for item in own_store.outlines(bucket) if item.vehicle == name]
    assert re.match(expected, outline.problem)


def test_a_problem_is_told_in_one_line(own_store: SummaryStore) -> None:
    bucket = fullest(own_store)
    name = spoil(own_store, bucket, {"problem": "cut\n  there\n"})
    assert own_store.read(bucket)[name][0].problem == "cut there"
    assert [item.problem for item in own_store.outlines(bucket) if item.vehicle == name] == ["cut there"]


def test_a_bucket_that_is_the_copy_of_another_is_refused(own_store: SummaryStore) -> None:
    first, second = own_store.buckets()[:2]
    folder = Path(own_store.url) / "buckets"
    shutil.copy(folder / own_store.files(first)[0][0], folder / own_store.files(second)[0][0])
    for read in (own_store.read, own_store.outlines, own_store.known):
        with pytest.raises(FleetError, match=rf"{second:05d}-0.*: vehicle V\d+ belongs into bucket {first:05d}"):
            read(second)


@pytest.mark.parametrize(
    "name", ["99999-00000.parquet", "00016-00000.parquet", "3.parquet", "00003-00000 (copy).parquet"]
)
def test_a_file_that_is_no_bucket_of_the_store_is_refused(own_store: SummaryStore, name: str) -> None:
    folder = Path(own_store.url) / "buckets"
    shutil.copy(next(folder.iterdir()), folder / name)
    with pytest.raises(FleetError, match=rf"{re.escape(name)}: no file of this store, whose buckets are 00000"):
        own_store.buckets()


def test_a_bucket_that_is_not_there_is_empty(store: SummaryStore) -> None:
    assert (store.read(999), store.known(999), store.outlines(999)) == ({}, {}, [])


def test_object_storage_holds_the_same(database: VehicleDatabase) -> None:
    store = small_store(Storage(url="memory://fleet/one"), database, random_faults(4))
    assert len(all_records(store)) == 4
    assert read_identity(open_storage("memory://fleet/one"), database) == store.identity
    assert set(store.versions()) == {store.files(bucket)[0][0] for bucket in store.buckets()}


def test_no_place_is_refused() -> None:
    for place in ("", " ", "file://", "s3://"):
        with pytest.raises(StorageError, match=f"^{place!r}: names no place; give the path of a folder or a URL"):
            open_storage(place)


def test_a_full_disk_is_told_with_what_to_do(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(path: Path, content: bytes) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("calibrator.files.storage.write_atomically", full)
    expected = rf"^{tmp_path}/x: cannot write it: No space left on device; make room, and run the same command again"
    with pytest.raises(StorageError, match=expected):
        open_storage(tmp_path).write("x", b"")


def test_storage_of_an_unknown_kind_is_refused_in_one_line() -> None:
    with pytest.raises(StorageError, match=r"^nokind://x: no way to reach this kind of storage: "):
        open_storage("nokind://x").names()


def test_a_store_of_another_layout_version_or_content_is_refused(tmp_path: Path, database: VehicleDatabase) -> None:
    storage, identity = open_storage(tmp_path), identity_of(database, 1)
    assert read_identity(storage, database) is None
    write_identity(storage, identity)
    path = tmp_path / "summaries.json"
    text = path.read_text()
    for change, message in (
        ((identity.layout_sha256, "0" * 64), "made with another layout than"),
        ((identity.dbc_sha256, "0" * 64), "made with another DBC than"),
        ((f'"schema_version": {SCHEMA_VERSION}', '"schema_version": 99'), "schema version 99, expected"),
        (('"block_s": 30.0', '"block_s": 60.0'), "blocks of 60 s, expected 30 s"),
        (("{", "[", 1), "not a store of summaries"),
        (('"branches"', '"branchs"'), "not a store of summaries"),
        (("{", 2000 * "[", 1), "not a store of summaries"),
        (('"buckets": 16', '"buckets": 0'), "0 buckets, expected 16 to 32768"),
        (('"buckets": 16', '"buckets": 40000'), "40000 buckets, expected 16 to 32768"),
        (('    "motor"', '    "steam"'), "branches battery, steam; expected 2 or more different ones of auxiliary, "),
        (('    "motor"', '    "battery"'), "branches battery, battery; expected 2 or more different ones of"),
        (
            ('    "torque"', '    "magic"', 1),
            "fleet_inputs speed, magic, voltage; expected 0 or more different ones of",
        ),
        (('"input_names": [\n      "speed"', '"input_names": [\n      "torque2"'), "a filter bank of torque2, torque"),
        (('"period_s": 1.0', '"period_s": 0.0'), "filter bank: period 0.0 s; expected a positive number; summarise"),
    ):
        path.write_text(text.replace(*change))
        assert path.read_text() != text
        with pytest.raises(FleetError, match=rf"^{path}: .*{message}"):
            read_identity(storage, database)


def test_what_does_not_fit_a_store_is_told(database: VehicleDatabase) -> None:
    identity = identity_of(database, 1)
    assert identity.difference(identity) == ""
    other = type(identity)(
        **{**{n: getattr(identity, n) for n in identity.__struct_fields__}, "branches": ("battery", "dcdc")}
    )
    assert identity.difference(other) == "branches battery, motor against battery, dcdc"
