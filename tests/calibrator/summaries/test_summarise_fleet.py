"""Drives into a store: each is read once, changes are noticed, bad ones are tried again."""

import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from calibrator.drive import Array, Channel, Drive, Equipment
from calibrator.drives.store import write_drive
from calibrator.errors import DriveError, FleetError
from calibrator.files.storage import open_storage
from calibrator.processes.run_many import Workers
from calibrator.sources.fleet_source import find_fleet
from calibrator.summaries.moments import DriveSummary
from calibrator.summaries.record import Record, joined_records
from calibrator.summaries.summarise_fleet import SummariseReport, add_drives, read_vehicle_summary
from calibrator.summaries.summary_store import SummaryStore, open_store
from ecu_node.database import VehicleDatabase
from tests.calibrator.conftest import LAYOUT

EQUIPMENT = Equipment(branches=("battery", "motor"), inputs=("speed",), fleet_inputs=("speed",), notices=())


Change = Callable[[dict[str, Array]], object]


def write(
    store: Path,
    vehicle: str,
    name: str,
    database: VehicleDatabase,
    *,
    samples: int = 3000,
    change: Change = lambda _: None,
) -> None:
    """Write a drive whose channels may be changed first."""
    rng = np.random.default_rng([ord(letter) for letter in vehicle + name])
    time_s = 0.1 * np.arange(samples)
    speed = 30.0 + 20.0 * np.sin(0.3 * time_s + rng.random())
    battery = 2.0 * speed + rng.normal(size=samples)
    values = {"battery": battery, "motor": -battery, "speed": speed, "torque": speed}
    values["voltage"] = np.full(samples, 350.0)
    change(values)
    channels = {key: Channel(time_s=time_s, value=value, good=np.ones(samples, bool)) for key, value in values.items()}
    branches = {key: channels.pop(key) for key in EQUIPMENT.branches}
    write_drive(store, Drive(vehicle=vehicle, name=name, branches=branches, inputs=channels), database.layout)


def add(drives: Path, out: Path, database: VehicleDatabase) -> tuple[SummariseReport, SummaryStore]:
    fleet = find_fleet(drives)
    store = open_store(open_storage(out), EQUIPMENT, database, fleet)
    return add_drives(store, fleet, database, workers=Workers()), store


def turned_up(channels: dict[str, Array]) -> None:
    for name in EQUIPMENT.branches:
        channels[name] *= 1.5


def total(store: SummaryStore, vehicle: str) -> DriveSummary:
    return joined_records(store.read(store.bucket_of(vehicle))[vehicle]).summary


def records_in(store: SummaryStore) -> dict[str, list[Record]]:
    return {name: records for bucket in store.buckets() for name, records in store.read(bucket).items()}


def drives_in(store: SummaryStore) -> dict[str, list[tuple[str, ...]]]:
    return {name: [record.drives for record in records] for name, records in records_in(store).items()}


def test_drive_is_read_once_and_again_only_if_it_was_changed(tmp_path: Path, database: VehicleDatabase) -> None:
    drives, out = tmp_path / "drives", tmp_path / "summaries"
    for vehicle in ("V1", "V2"):
        write(drives, vehicle, "a", database)
    first, store = add(drives, out, database)
    assert (first.vehicles, first.drives, first.left_out) == (2, 2, {})
    again, _ = add(drives, out, database)
    assert (again.vehicles, again.drives) == (0, 0)
    write(drives, "V2", "b", database)
    more, store = add(drives, out, database)
    assert (more.vehicles, more.drives) == (1, 1)
    assert drives_in(store) == {"V1": [("a",)], "V2": [("a",), ("b",)]}
    bucket = store.bucket_of("V2")
    assert store.files(bucket) == [f"{bucket:05d}-00000.parquet", f"{bucket:05d}-00001.parquet"]
    before = total(store, "V1").total
    write(drives, "V1", "a", database, change=turned_up)
    shutil.rmtree(drives / "drives" / "V2")
    changed, store = add(drives, out, database)
    assert (changed.drives, drives_in(store)) == (1, {"V1": [("a",)], "V2": [("a",), ("b",)]})
    after = total(store, "V1").total
    assert after[1, 1] == pytest.approx(2.25 * before[1, 1], rel=1e-6)


def test_vehicle_with_a_bad_drive_is_left_out_and_tried_again(tmp_path: Path, database: VehicleDatabase) -> None:
    drives, out = tmp_path / "drives", tmp_path / "summaries"
    for vehicle in ("V1", "V2"):
        write(drives, vehicle, "a", database)
    path = drives / "drives" / "V1" / "a.parquet"
    whole = path.read_bytes()
    path.write_bytes(whole[:1000])
    added, store = add(drives, out, database)
    assert list(added.left_out) == ["V1"]
    assert "not a drive" in added.left_out["V1"]
    path.write_bytes(whole)
    again, store = add(drives, out, database)
    assert (again.vehicles, again.left_out) == (1, {})
    assert drives_in(store) == {"V1": [("a",)], "V2": [("a",)]}


def test_drives_of_other_branches_cannot_be_added(tmp_path: Path, database: VehicleDatabase) -> None:
    drives, out = tmp_path / "drives", tmp_path / "summaries"
    write(drives, "V1", "a", database)
    open_store(open_storage(out), EQUIPMENT, database, find_fleet(drives))
    other = Equipment(branches=("battery", "dcdc"), inputs=("speed",), fleet_inputs=("speed",), notices=())
    with pytest.raises(
        FleetError, match="cannot be added to this store: branches battery, motor against battery, dcdc"
    ):
        open_store(open_storage(out), other, database, find_fleet(drives))


def copy(drives: Path, source: str, target: str) -> None:
    path = drives / "drives" / f"{target}.parquet"
    path.parent.mkdir(parents=True, exist_ok=True)
    shutil.copy(drives / "drives" / f"{source}.parquet", path)


def test_recording_found_in_two_vehicles_counts_for_neither(tmp_path: Path, database: VehicleDatabase) -> None:
    drives, out = tmp_path / "drives", tmp_path / "summaries"
    for vehicle in ("V1", "V2", "V3"):
        write(drives, vehicle, "a", database)
    _, store = add(drives, out, database)
    copy(drives, "V1/a", "V2/b")
    for _ in range(2):  # the second run gives the same
        added, store = add(drives, out, database)
        reasons = {name: text.partition(";")[0] for name, text in added.left_out.items()}
        assert reasons == {"V1": "same recording as V2", "V2": "same recording as V1"}
        usable = [(name, *each.drives) for name, records in records_in(store).items() for each in records if each.found]
        assert sorted(usable) == [("V2", "a"), ("V3", "a")]
    (drives / "drives" / "V2" / "b.parquet").unlink()
    added, store = add(drives, tmp_path / "other", database)
    assert (added.left_out, drives_in(store)) == ({}, {name: [("a",)] for name in ("V1", "V2", "V3")})


def test_duplicate_recording_of_a_vehicle_counts_once(tmp_path: Path, database: VehicleDatabase) -> None:
    drives = tmp_path / "drives"
    write(drives, "V1", "a", database)
    copy(drives, "V1/a", "V1/b")
    added, store = add(drives, tmp_path / "at once", database)
    assert added.notices == ["vehicle V1: drives a, b hold the same recording, which counts once"]
    assert total(store, "V1").duration_s < 301.0
    copy(drives, "V1/a", "V1/c")
    _, store = add(drives, tmp_path / "at once", database)
    assert total(store, "V1").duration_s < 301.0


def test_short_drive_counts_if_its_vehicle_has_others(tmp_path: Path, database: VehicleDatabase) -> None:
    drives, out = tmp_path / "drives", tmp_path / "summaries"
    write(drives, "V1", "a", database)
    add(drives, out, database)
    for vehicle in ("V1", "V2"):
        write(drives, vehicle, "short", database, samples=601)
    added, store = add(drives, out, database)
    assert list(added.left_out) == ["V2"]
    assert added.left_out["V2"].endswith("s of usable data in 1 drive; at least 120 s are needed")
    assert total(store, "V1").duration_s > 350.0


def put(name: str, value: float) -> Change:
    return lambda channels: channels[name].put(100, value)


@pytest.mark.parametrize(("change", "message"), [
    (put("motor", 1e12), "drive d: branch motor shows 1e+12 A, full scale of the junction being 400 A"),
    (put("motor", np.nan), "drive d: branch motor shows nan A"),
    (put("battery", -np.inf), "drive d: branch battery shows inf A"),
    (put("speed", np.nan), "drive d: input speed has values that are no numbers"),
])  # fmt: skip
def test_impossible_values_of_a_drive_are_reported(
    tmp_path: Path, database: VehicleDatabase, change: Change, message: str
) -> None:
    write(tmp_path, "V1", "d", database, change=change)
    with pytest.raises(DriveError, match=re.escape(message)):
        read_vehicle_summary(find_fleet(tmp_path).vehicles["V1"], EQUIPMENT, database)


def test_internal_error_while_summarising_exits_with_70(
    tmp_path: Path, database: VehicleDatabase, monkeypatch: pytest.MonkeyPatch
) -> None:
    write(tmp_path / "drives", "V1", "a", database)
    path = tmp_path / "sitecustomize.py"  # a bug in a process that reads
    path.write_text("import numpy\nnumpy.ascontiguousarray = lambda *_, **__: 1 // 0\n")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    line = [sys.executable, "-m", "calibrator", "summarise", str(tmp_path / "drives"), "--layout", str(LAYOUT)]
    done = subprocess.run(
        [*line, "--out", str(tmp_path / "out")], capture_output=True, text=True, check=False, timeout=300
    )
    assert done.returncode == 70
    assert "internal error in 1 vehicle, which are left out: V1: ZeroDivisionError" in done.stderr
