"""Drives into a store: each is read once, changes are noticed, bad ones are tried again."""

import re
import shutil
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
from tests.calibrator.command_here import calibrator, succeeded
from tests.ecu_node.vehicles import LAYOUT

EQUIPMENT = Equipment(branches=("battery", "motor"), inputs=("speed",), fleet_inputs=("speed",), notices=())
Change = Callable[[dict[str, Array]], object]


class SmallFleet:
    """A store of drives, and the store of their summaries."""

    def __init__(self, folder: Path, database: VehicleDatabase) -> None:
        self.drives, self.out, self.database = folder / "drives", folder / "summaries", database

    def write(self, vehicle: str, name: str = "a", samples: int = 3000, change: Change = lambda _: None) -> None:
        """Write a drive whose channels may be changed first."""
        rng = np.random.default_rng([ord(letter) for letter in vehicle + name])
        time_s = 0.1 * np.arange(samples)
        speed = 30.0 + 20.0 * np.sin(0.3 * time_s + rng.random())
        battery = 2.0 * speed + rng.normal(size=samples)
        values = {"battery": battery, "motor": -battery, "speed": speed, "torque": speed}
        values["voltage"] = np.full(samples, 350.0)
        change(values)
        good = np.ones(samples, bool)
        channels = {key: Channel(time_s=time_s, value=value, good=good) for key, value in values.items()}
        branches = {key: channels.pop(key) for key in EQUIPMENT.branches}
        drive = Drive(vehicle=vehicle, name=name, branches=branches, inputs=channels)
        write_drive(self.drives, drive, self.database.layout)

    def file(self, drive: str) -> Path:
        return self.drives / "drives" / f"{drive}.parquet"

    def copy(self, source: str, target: str) -> None:
        shutil.copy(self.file(source), self.file(target))

    def open(self, equipment: Equipment = EQUIPMENT) -> SummaryStore:
        return open_store(open_storage(self.out), equipment, self.database, find_fleet(self.drives))

    def add(self) -> SummariseReport:
        """Add all drives that are new."""
        return add_drives(self.open(), find_fleet(self.drives), self.database, workers=Workers())

    def records(self) -> dict[str, list[Record]]:
        store = self.open()
        return {name: records for bucket in store.buckets() for name, records in store.read(bucket).items()}

    def kept(self) -> dict[str, list[tuple[str, ...]]]:
        """Drives of each record, by vehicle."""
        return {name: [record.drives for record in records] for name, records in self.records().items()}

    def total(self, vehicle: str) -> DriveSummary:
        return joined_records(self.records()[vehicle]).summary


@pytest.fixture
def fleet(tmp_path: Path, database: VehicleDatabase) -> SmallFleet:
    return SmallFleet(tmp_path, database)


def turned_up(channels: dict[str, Array]) -> None:
    for name in EQUIPMENT.branches:
        channels[name] *= 1.5


def test_drive_is_read_once_and_again_only_if_it_was_changed(fleet: SmallFleet) -> None:
    for vehicle in ("V1", "V2"):
        fleet.write(vehicle)
    first, again = fleet.add(), fleet.add()
    assert (first.vehicles, first.drives, first.left_out) == (2, 2, {})
    assert (again.vehicles, again.drives) == (0, 0)
    fleet.write("V2", "b")
    more = fleet.add()
    assert (more.vehicles, more.drives) == (1, 1)
    assert fleet.kept() == {"V1": [("a",)], "V2": [("a",), ("b",)]}
    before = fleet.total("V1").total
    fleet.write("V1", change=turned_up)
    shutil.rmtree(fleet.drives / "drives" / "V2")
    assert fleet.add().drives == 1
    assert fleet.kept() == {"V1": [("a",)], "V2": [("a",), ("b",)]}
    assert fleet.total("V1").total[1, 1] == pytest.approx(2.25 * before[1, 1], rel=1e-6)


def test_drive_that_cannot_be_read_is_left_out_alone_and_tried_again(fleet: SmallFleet) -> None:
    for name in "abcd":
        fleet.write("V1", name)
    whole = {name: fleet.file(f"V1/{name}").read_bytes() for name in "ac"}
    for name, content in whole.items():
        fleet.file(f"V1/{name}").write_bytes(content[:1000])
    first = fleet.add()
    assert (first.vehicles, first.drives, list(first.left_out)) == (1, 2, ["V1/a", "V1/c"])
    assert all("not a drive" in why for why in first.left_out.values())
    again = fleet.add()
    assert (again.vehicles, again.left_out) == (0, first.left_out)
    assert fleet.kept() == {"V1": [("a",), ("c",), ("b", "d")]}, "what is known is not noted again"
    fleet.file("V1/a").write_bytes(whole["a"])
    assert fleet.add().left_out == {"V1/c": first.left_out["V1/c"]}
    assert fleet.kept() == {"V1": [("c",), ("b", "d"), ("a",)]}
    assert fleet.total("V1").duration_s > 890.0


def test_reason_of_a_vehicle_names_its_drives_that_cannot_be_read(fleet: SmallFleet) -> None:
    fleet.write("V1", samples=601)
    fleet.write("V1", "b")
    fleet.file("V1/b").write_bytes(b"")
    why = fleet.add().left_out["V1"]
    assert re.search("s of usable data in 1 drive; at least 120 s are needed; b: .*b.parquet: not a drive", why)


def test_summarise_fails_as_long_as_the_store_has_no_usable_vehicle(fleet: SmallFleet) -> None:
    arguments = ("summarise", fleet.drives, "--layout", LAYOUT, "--out", fleet.out)
    fleet.write("V1", samples=601)
    done = calibrator(*arguments)
    assert (done.returncode, "V1: 60" in done.stdout) == (1, True)
    assert "no vehicle could be summarised, for the reasons given above" in done.stderr
    fleet.write("V2")
    for _ in range(2):  # the second run adds nothing
        succeeded(*arguments)


def test_drives_of_other_branches_cannot_be_added(fleet: SmallFleet) -> None:
    fleet.write("V1")
    fleet.open()
    other = Equipment(branches=("battery", "dcdc"), inputs=("speed",), fleet_inputs=("speed",), notices=())
    with pytest.raises(FleetError, match="added to this store: branches battery, motor against battery, dcdc"):
        fleet.open(other)


def test_recording_found_in_two_vehicles_counts_for_neither(fleet: SmallFleet) -> None:
    for vehicle in ("V1", "V2", "V3"):
        fleet.write(vehicle)
    fleet.add()
    fleet.copy("V1/a", "V2/b")
    for _ in range(2):  # the second run gives the same
        again = fleet.add()
        reasons = {name: text.partition(";")[0] for name, text in again.left_out.items()}
        assert reasons == {"V1": "same recording as V2", "V2": "same recording as V1"}
        assert again.drives == 0
        usable = [(name, *each.drives) for name, records in fleet.records().items() for each in records if each.found]
        assert sorted(usable) == [("V2", "a"), ("V3", "a")]


def test_duplicate_recording_of_a_vehicle_counts_once(fleet: SmallFleet) -> None:
    fleet.write("V1")
    fleet.copy("V1/a", "V1/b")
    assert fleet.add().notices == ["vehicle V1: drives a, b hold the same recording, which counts once"]
    assert fleet.total("V1").duration_s < 301.0
    fleet.copy("V1/a", "V1/c")
    fleet.add()
    assert fleet.total("V1").duration_s < 301.0


def test_short_drive_is_used_only_if_all_drives_of_its_vehicle_are_long_enough_together(fleet: SmallFleet) -> None:
    fleet.write("V1")
    fleet.add()
    for vehicle in ("V1", "V2"):
        fleet.write(vehicle, "short", samples=601)
    left_out = fleet.add().left_out
    assert list(left_out) == ["V2"]
    assert left_out["V2"].endswith("s of usable data in 1 drive; at least 120 s are needed")
    assert fleet.total("V1").duration_s > 350.0


def put(name: str, value: float) -> Change:
    return lambda channels: channels[name].put(100, value)


@pytest.mark.parametrize(("change", "message"), [
    (put("motor", 1e12), "drive a: branch motor shows 1e+12 A, full scale of the junction being 400 A"),
    (put("motor", np.nan), "drive a: branch motor shows nan A"),
    (put("battery", -np.inf), "drive a: branch battery shows inf A"),
    (put("speed", np.nan), "drive a: input speed has values that are no numbers"),
])  # fmt: skip
def test_impossible_values_of_a_drive_are_refused_and_named(fleet: SmallFleet, change: Change, message: str) -> None:
    fleet.write("V1", change=change)
    with pytest.raises(DriveError, match=re.escape(message)):
        read_vehicle_summary(find_fleet(fleet.drives).vehicles["V1"], EQUIPMENT, fleet.database)
