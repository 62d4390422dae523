"""Drives into a store: each is read once, changes are noticed, bad ones are tried again."""

import threading
from pathlib import Path

import numpy as np
import pytest

from calibrator.drive import Channel, Drive
from calibrator.drives.store import write_drive
from calibrator.errors import FleetError
from calibrator.files.storage import open_storage
from calibrator.sources.fleet_source import Equipment, find_fleet
from calibrator.summaries.add_drives import Added, add_drives
from calibrator.summaries.open_store import open_store
from calibrator.summaries.record import joined_records
from calibrator.summaries.store import SummaryStore
from ecu_node.database import VehicleDatabase

EQUIPMENT = Equipment(branches=("battery", "motor"), inputs=("speed",), fleet_inputs=("speed",), notices=())


def write(store: Path, vehicle: str, name: str, database: VehicleDatabase, *, scale: float = 1.0) -> None:
    rng = np.random.default_rng([ord(letter) for letter in vehicle + name])
    time_s = 0.1 * np.arange(3000)
    speed = 30.0 + 20.0 * np.sin(0.3 * time_s + rng.random())

    def channel(value: np.ndarray[tuple[int], np.dtype[np.float64]]) -> Channel:
        return Channel(time_s=time_s, value=value, good=np.ones(len(time_s), bool))

    battery = scale * (2.0 * speed + rng.normal(size=len(time_s)))
    branches = {"battery": channel(battery), "motor": channel(-battery)}
    write_drive(
        store, Drive(vehicle=vehicle, name=name, branches=branches, inputs={"speed": channel(speed)}), database.layout
    )


def add(
    drives: Path, out: Path, database: VehicleDatabase, *, exactly: bool = False, part: tuple[int, int] = (1, 1)
) -> tuple[Added, SummaryStore]:
    fleet = find_fleet(drives)
    store = open_store(open_storage(out), EQUIPMENT, database, fleet)
    return add_drives(store, fleet, database, workers=1, exactly=exactly, part=part), store


def drives_in(store: SummaryStore) -> dict[str, list[tuple[str, ...]]]:
    return {
        name: [record.drives for record in records]
        for bucket in store.buckets()
        for name, records in store.read(bucket).items()
    }


def test_each_drive_is_read_once(tmp_path: Path, database: VehicleDatabase) -> None:
    drives, out = tmp_path / "drives", tmp_path / "summaries"
    for vehicle in ("V1", "V2"):
        write(drives, vehicle, "a", database)
    first, store = add(drives, out, database)
    assert (first.vehicles, first.drives, first.problems) == (2, 2, {})
    again, _ = add(drives, out, database)
    assert (again.vehicles, again.drives) == (0, 0)
    write(drives, "V2", "b", database)
    more, store = add(drives, out, database)
    assert (more.vehicles, more.drives) == (1, 1)
    assert drives_in(store) == {"V1": [("a",)], "V2": [("a",), ("b",)]}


def test_two_drives_added_one_after_the_other_are_as_both_at_once(tmp_path: Path, database: VehicleDatabase) -> None:
    for name in ("a", "b"):
        write(tmp_path / "both", "V1", name, database)
    _, at_once = add(tmp_path / "both", tmp_path / "s1", database)
    for name in ("a", "b"):
        write(tmp_path / "later", "V1", name, database)
        _, later = add(tmp_path / "later", tmp_path / "s2", database)
    totals = [joined_records(store.read(store.bucket_of("V1"))["V1"]).summary.total for store in (at_once, later)]
    np.testing.assert_allclose(totals[1], totals[0], rtol=2e-3)
    assert totals[1][-1, -1] == totals[0][-1, -1]


def test_a_drive_that_was_changed_is_read_again(tmp_path: Path, database: VehicleDatabase) -> None:
    drives, out = tmp_path / "drives", tmp_path / "summaries"
    write(drives, "V1", "a", database)
    _, store = add(drives, out, database)
    before = joined_records(store.read(store.bucket_of("V1"))["V1"]).summary.total
    write(drives, "V1", "a", database, scale=1.5)
    again, store = add(drives, out, database)
    assert again.drives == 1
    after = joined_records(store.read(store.bucket_of("V1"))["V1"]).summary.total
    assert after[1, 1] == pytest.approx(2.25 * before[1, 1], rel=1e-6)
    assert drives_in(store) == {"V1": [("a",)]}


def test_a_bad_drive_costs_its_vehicle_and_is_tried_again(tmp_path: Path, database: VehicleDatabase) -> None:
    drives, out = tmp_path / "drives", tmp_path / "summaries"
    for vehicle in ("V1", "V2"):
        write(drives, vehicle, "a", database)
    path = drives / "drives" / "V1" / "a.parquet"
    whole = path.read_bytes()
    path.write_bytes(whole[:1000])
    added, store = add(drives, out, database)
    assert list(added.problems) == ["V1"]
    assert "not a drive" in added.problems["V1"]
    path.write_bytes(whole)
    again, store = add(drives, out, database)
    assert (again.vehicles, again.problems) == (1, {})
    assert drives_in(store) == {"V1": [("a",)], "V2": [("a",)]}


def test_going_on_does_not_try_again_what_could_not_be_used(tmp_path: Path, database: VehicleDatabase) -> None:
    drives, out = tmp_path / "drives", tmp_path / "summaries"
    for vehicle in ("V1", "V2"):
        write(drives, vehicle, "a", database)
    path = drives / "drives" / "V1" / "a.parquet"
    path.write_bytes(path.read_bytes()[:1000])
    _, store = add(drives, out, database, exactly=True)
    before = store.versions()
    again, store = add(drives, out, database, exactly=True)
    assert (again.vehicles, store.versions()) == (0, before)
    write(drives, "V1", "a", database)
    mended, _ = add(drives, out, database, exactly=True)
    assert (mended.vehicles, mended.problems) == (1, {})


def test_drives_that_change_while_they_are_read_stay_with_their_vehicle(
    tmp_path: Path, database: VehicleDatabase
) -> None:
    drives, out = tmp_path / "drives", tmp_path / "summaries"
    for number in range(6):
        write(drives, f"V{number}", "a", database)
    add(drives, out, database)
    for number in (1, 3):
        write(drives, f"V{number}", "b", database)
    fleet = find_fleet(drives)
    store = open_store(open_storage(out), EQUIPMENT, database, fleet)
    stop = threading.Event()

    def touch() -> None:
        while not stop.wait(0.01):
            for number in (0, 2, 4):
                (drives / "drives" / f"V{number}" / "a.parquet").touch()

    toucher = threading.Thread(target=touch)
    toucher.start()
    add_drives(store, fleet, database, workers=1)
    stop.set()
    toucher.join()
    found = {
        name: (bucket, {record.vehicle for record in records}, {d for record in records for d in record.drives})
        for bucket in store.buckets()
        for name, records in store.read(bucket).items()
    }
    for number in range(6):
        name, expected = f"V{number}", {"a", "b"} if number in {1, 3} else {"a"}
        assert found[name] == (store.bucket_of(name), {name}, expected)


def test_a_store_that_is_to_hold_these_drives_alone_loses_the_others(tmp_path: Path, database: VehicleDatabase) -> None:
    drives, out = tmp_path / "drives", tmp_path / "summaries"
    for vehicle in ("V1", "V2"):
        write(drives, vehicle, "a", database)
    add(drives, out, database)
    (drives / "drives" / "V1" / "a.parquet").unlink()
    (drives / "drives" / "V1").rmdir()
    _, store = add(drives, out, database, exactly=True)
    assert drives_in(store) == {"V2": [("a",)]}


def test_drives_of_other_branches_cannot_be_added(tmp_path: Path, database: VehicleDatabase) -> None:
    drives, out = tmp_path / "drives", tmp_path / "summaries"
    write(drives, "V1", "a", database)
    add(drives, out, database)
    other = Equipment(branches=("battery", "dcdc"), inputs=("speed",), fleet_inputs=("speed",), notices=())
    with pytest.raises(
        FleetError, match="cannot be added to this store: branches battery, motor against battery, dcdc"
    ):
        open_store(open_storage(out), other, database, find_fleet(drives))


def test_parts_of_the_work_add_up(tmp_path: Path, database: VehicleDatabase) -> None:
    drives = tmp_path / "drives"
    for number in range(6):
        write(drives, f"V{number}", "a", database)
    added = [add(drives, tmp_path / "parts", database, part=(number, 3))[0].vehicles for number in (1, 2, 3)]
    assert sum(added) == 6
    assert max(added) < 6
    _, whole = add(drives, tmp_path / "whole", database)
    assert drives_in(SummaryStore(storage=open_storage(tmp_path / "parts"), identity=whole.identity)) == drives_in(
        whole
    )
