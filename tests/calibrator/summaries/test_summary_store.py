"""Summaries on disk: nothing is lost, records add up, and data that do not fit are refused."""

import re
import shutil
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import duckdb
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from calibrator.errors import DriveError, FleetError
from calibrator.files.storage import Storage, open_storage
from calibrator.summaries.identity import SCHEMA_VERSION, read_identity, write_identity
from calibrator.summaries.moments import DriveSummary
from calibrator.summaries.record import MOST_BLOCKS, SCHEMA, Record, joined_records
from calibrator.summaries.summary_store import MOST_FILES, SummaryStore, compact_store, look_at_store
from ecu_node.database import VehicleDatabase
from tests.calibrator.estimator.simulated_drives import Conditions, no_faults, summaries_of
from tests.calibrator.summaries.small_stores import (
    CONDITIONS,
    fullest,
    identity_of,
    random_faults,
    record_of,
    small_store,
)

VEHICLES = 40


@pytest.fixture(scope="module")
def store(database: VehicleDatabase, tmp_path_factory: pytest.TempPathFactory) -> SummaryStore:
    return small_store(tmp_path_factory.mktemp("store"), database, random_faults(VEHICLES))


def all_records(store: SummaryStore) -> list[Record]:
    return [record for bucket in store.buckets() for items in store.read(bucket).values() for record in items]


def summary_of(samples: int, seed: int = 1) -> DriveSummary:
    return summaries_of(no_faults(1, 2), Conditions(samples=samples), seed=seed)[0]


def test_summaries_are_read_back_as_written(store: SummaryStore) -> None:
    records = {record.vehicle: record for record in all_records(store)}
    assert sorted(records) == [f"V{j:03d}" for j in range(VEHICLES)]
    summaries = summaries_of(random_faults(VEHICLES), CONDITIONS, seed=1)
    for (name, record), summary in zip(sorted(records.items()), summaries, strict=True):
        written = replace(record_of(name, summary), duration_s=1800.0)
        np.testing.assert_equal(asdict(record), asdict(written))


def test_summary_files_are_readable_by_duckdb(store: SummaryStore) -> None:
    query = f"SELECT count(DISTINCT vehicle), sum(duration_s) FROM read_parquet('{store.url}/buckets/*.parquet')"
    assert duckdb.execute(query).fetchall() == [(VEHICLES, pytest.approx(VEHICLES * 1800.0))]


def test_records_stay_files_until_compacted_and_none_counts_twice(tmp_path: Path, database: VehicleDatabase) -> None:
    store = small_store(tmp_path / "store", database, random_faults(4))
    bucket = store.bucket_of("V001")
    before = {path.name: path.read_bytes() for path in (tmp_path / "store" / "buckets").iterdir()}
    store.append(bucket, [record_of("V001", summary_of(600), ("d2",))])
    for name, content in before.items():
        assert (tmp_path / "store" / "buckets" / name).read_bytes() == content
    assert [record.drives for record in store.read(bucket)["V001"]] == [("d1",), ("d2",)]
    kept = {name: (tmp_path / "store" / "buckets" / name).read_bytes() for name in store.files(bucket)}
    assert look_at_store(store.url).drives == 5
    assert compact_store(store.url) == 1
    (merged,) = store.files(bucket)
    for name, content in kept.items():  # as if the run had been killed before it removed them
        (tmp_path / "store" / "buckets" / name).write_bytes(content)
    assert store.files(bucket) == [*kept, merged]
    assert [record.drives for record in store.read(bucket)["V001"]] == [("d1",), ("d2",)]
    report = look_at_store(store.url, whole=True)
    assert (report.vehicles, report.drives, report.faults) == (4, 5, {})


def test_many_files_of_a_bucket_are_merged(own_store: SummaryStore) -> None:
    (record, *_) = all_records(own_store)
    bucket, before = own_store.bucket_of(record.vehicle), own_store.read(own_store.bucket_of(record.vehicle))
    for _ in range(MOST_FILES + 3):
        own_store.append(bucket, [record])
    assert len(own_store.files(bucket)) <= MOST_FILES
    assert {name: [each.drives for each in records] for name, records in own_store.read(bucket).items()} == {
        name: [each.drives for each in records] for name, records in before.items()
    }


def test_records_of_a_vehicle_add_up(store: SummaryStore) -> None:
    parts = [summary_of(900, seed) for seed in (1, 2)]
    both = joined_records([record_of("V1", part, (f"d{k}",), shown_a=1.5) for k, part in enumerate(parts)])
    assert both.drives == ("d0", "d1")
    np.testing.assert_allclose(both.summary.total, parts[0].total + parts[1].total)
    assert len(both.summary.moments) == len(parts[0].moments) + len(parts[1].moments)
    assert both.zero_current.sd_a[1] == pytest.approx(0.1 / np.sqrt(2.0))


def test_blocks_of_a_long_drive_are_merged_without_changing_its_sums(tmp_path: Path, database: VehicleDatabase) -> None:
    long = summary_of(30 * (MOST_BLOCKS + 40))
    store = SummaryStore(storage=open_storage(tmp_path), identity=identity_of(database, 1))
    bucket = store.bucket_of("V1")
    store.append(bucket, [record_of("V1", long)])
    (record,) = store.read(bucket)["V1"]
    assert record.found is not None
    kept = record.found.summary
    assert len(kept.moments) <= MOST_BLOCKS < len(long.moments)
    np.testing.assert_allclose(kept.total, long.total, rtol=1e-12)
    assert kept.noise_a2.mean() == pytest.approx(long.noise_a2.mean(), rel=0.02)


def test_failed_drive_does_not_invalidate_other_records_of_its_vehicle() -> None:
    bad = Record(vehicle="V1", drives=("x",), sources=("",), found=None, problem="drive x: cut")
    with pytest.raises(DriveError, match="drive x: cut"):
        joined_records([bad])
    assert joined_records([bad, record_of("V1", summary_of(600))]).drives == ("d1",)


@pytest.mark.parametrize("damage", [b"", b"PAR1", b"x" * 5000], ids=["empty", "first bytes alone", "other content"])
def test_damaged_file_of_bucket_is_refused_and_named(tmp_path: Path, database: VehicleDatabase, damage: bytes) -> None:
    store = small_store(tmp_path, database, no_faults(2, 2))
    path = next((tmp_path / "buckets").iterdir())
    path.write_bytes(damage)
    with pytest.raises(FleetError, match=rf"{path.name}: damaged file of summaries: .*; remove it and summarise again"):
        store.read(int(path.name[:5]))
    with pytest.raises(FleetError, match="damaged file of summaries"):
        store.outlines(int(path.name[:5]))


def spoil(store: SummaryStore, bucket: int, changes: Mapping[str, Any]) -> None:
    """Change columns of the first vehicle of a bucket, as another tool would."""
    path = Path(store.url) / "buckets" / store.files(bucket)[0]
    rows = pq.read_table(path).to_pylist()
    rows[0] |= changes
    pq.write_table(pa.Table.from_pylist(rows, schema=SCHEMA), path)


@pytest.fixture
def own_store(store: SummaryStore, tmp_path: Path) -> SummaryStore:
    shutil.copytree(store.url, tmp_path / "store")
    return SummaryStore(storage=open_storage(tmp_path / "store"), identity=store.identity)


@pytest.mark.parametrize(
    "changes",
    [{"moments": [1.0] * 29}, {"noise_a2": []}, {"delay_reference": "bogus"}],
    ids=["other number of moments", "no noise", "unknown branch"],
)
def test_rows_with_columns_of_another_store_are_refused(own_store: SummaryStore, changes: dict[str, Any]) -> None:
    bucket = fullest(own_store)
    spoil(own_store, bucket, changes)
    with pytest.raises(FleetError, match="damaged file of summaries: its columns are not those of this store"):
        own_store.read(bucket)


@pytest.mark.parametrize("name", ["../../evil", "", "-V1", "Vä"])
def test_unusable_vehicle_name_in_a_bucket_is_refused(own_store: SummaryStore, name: str) -> None:
    bucket = fullest(own_store)
    spoil(own_store, bucket, {"vehicle": name})
    expected = rf"parquet: vehicle {re.escape(repr(name))} cannot be used; .* not starting with a dash, dot"
    for read in (own_store.read, own_store.outlines):
        with pytest.raises(DriveError, match=expected):
            read(bucket)


def test_changed_byte_in_a_bucket_is_detected(own_store: SummaryStore) -> None:
    bucket = fullest(own_store)
    path = Path(own_store.url) / "buckets" / own_store.files(bucket)[0]
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    with pytest.raises(FleetError, match="damaged file of summaries: it is cut or changed, or no Parquet file"):
        own_store.read(bucket)
    report = look_at_store(own_store.url, whole=True)
    assert list(report.faults) == [f"bucket {bucket:05d}"]
    assert f"\nfaults:\n  bucket {bucket:05d}: " in report.as_text()


def test_file_copied_from_another_bucket_is_refused(own_store: SummaryStore) -> None:
    first, second = own_store.buckets()[:2]
    folder = Path(own_store.url) / "buckets"
    shutil.copy(folder / own_store.files(first)[0], folder / own_store.files(second)[0])
    for read in (own_store.read, own_store.outlines):
        with pytest.raises(FleetError, match=rf"{second:05d}-0.*: vehicle V\d+ belongs into bucket {first:05d}"):
            read(second)


def test_summary_store_works_in_object_storage(database: VehicleDatabase) -> None:
    store = small_store(Storage(url="memory://fleet/one"), database, random_faults(4))
    assert len(all_records(store)) == 4
    assert read_identity(open_storage("memory://fleet/one"), database) == store.identity
    assert set(store.versions()) == {store.files(bucket)[0] for bucket in store.buckets()}


def test_store_of_another_layout_version_or_content_is_refused(tmp_path: Path, database: VehicleDatabase) -> None:
    storage, identity = open_storage(tmp_path), identity_of(database, 1)
    assert read_identity(storage, database) is None
    write_identity(storage, identity)
    path = tmp_path / "summaries.json"
    text = path.read_text()
    for change, message in (
        ((identity.layout_sha256, "0" * 64), "made with another layout than"),
        ((identity.dbc_sha256, "0" * 64), "made with another DBC than"),
        ((f'"schema_version": {SCHEMA_VERSION}', '"schema_version": 99'), "schema version 99, expected"),
        (("{", "[", 1), "not a store of summaries"),
        (('"branches"', '"branchs"'), "not a store of summaries"),
        (("{", 2000 * "[", 1), "not a store of summaries"),
        (('"buckets": 16', '"buckets": 0'), r"not a store of summaries: Expected `int` >= 16 - at `\$.buckets`"),
        (('"period_s": 1.0', '"period_s": 0.0'), "filter bank: period 0.0 s; expected a positive number"),
    ):
        path.write_text(text.replace(*change))
        assert path.read_text() != text
        with pytest.raises(FleetError, match=rf"^{path}: .*{message}"):
            read_identity(storage, database)
