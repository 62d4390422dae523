import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

from calibrator.drive import Channel, Drive
from calibrator.drives.store import iterate_drives, list_drives, read_drive_file, write_drive
from calibrator.errors import DriveError
from calibrator.files.storage import StorageError
from ecu_node.database import VehicleDatabase
from ecu_node.layout import Layout


@pytest.fixture
def layout(database: VehicleDatabase) -> Layout:
    return database.layout


def some_drive(vehicle: str = "V1", name: str = "monday") -> Drive:
    value = np.array([1.5, np.nan, -2.0])
    channel = Channel(time_s=np.array([0.0, 0.1, 0.3]), value=value, good=np.isfinite(value))
    empty = Channel(time_s=np.zeros(0), value=np.zeros(0), good=np.zeros(0, np.bool_))
    return Drive(vehicle=vehicle, name=name, branches={"battery": channel, "motor": empty}, inputs={"voltage": channel})


def test_stored_drive_is_read_back_exactly(tmp_path: Path, layout: Layout) -> None:
    read = read_drive_file(Path(write_drive(tmp_path, some_drive(), layout)), layout)
    assert list(read.branches) == ["battery", "motor"]
    np.testing.assert_equal(asdict(read), asdict(some_drive()))


def test_drives_are_listed_and_read_in_order_of_vehicle_and_name(tmp_path: Path, layout: Layout) -> None:
    for vehicle, name in (("V2", "a"), ("V1", "b"), ("V1", "a.2")):
        write_drive(tmp_path, some_drive(vehicle, name), layout)
    expected = [("V1", "a.2"), ("V1", "b"), ("V2", "a")]
    assert [(entry.vehicle, entry.name) for entry in list_drives(tmp_path)] == expected
    assert [(drive.vehicle, drive.name) for drive in iterate_drives(tmp_path, layout)] == expected


@pytest.mark.parametrize("name", ["", "..", "../x", "/etc/x", "a/b", "a\\b", ".hidden", "x" * 65, "a\nb", "a.", "ä"])
def test_vehicle_or_drive_name_unusable_as_a_file_name_is_refused(tmp_path: Path, layout: Layout, name: str) -> None:
    for drive in (some_drive(vehicle=name), some_drive(name=name)):
        with pytest.raises(DriveError, match="cannot be used; expected 1 to 64 letters"):
            write_drive(tmp_path / "store", drive, layout)
    assert not (tmp_path / "store").exists()


@pytest.mark.parametrize(("changed", "words"), [
    ({"layout_sha256": "0" * 64}, r"monday\.parquet: made with layout hv_powertrain .*000.*import the logs again"),
    ({"dbc_sha256": "0" * 64}, r"made with another DBC than .*hv_powertrain\.dbc; import the logs again with this DBC"),
    ({"schema_version": 99}, "schema version 99, expected 1; import the logs again"),
])  # fmt: skip
def test_drive_of_other_layouts_is_refused(tmp_path: Path, layout: Layout, changed: dict[str, Any], words: str) -> None:
    path = Path(write_drive(tmp_path, some_drive(), layout))
    table = pq.read_table(path)
    about = json.loads(table.schema.metadata[b"calibrator.drive"]) | changed
    pq.write_table(table.replace_schema_metadata({b"calibrator.drive": json.dumps(about)}), path)
    with pytest.raises(DriveError, match=words):
        read_drive_file(path, layout)


@pytest.mark.parametrize("size", [0, 3, 100, -10])
def test_truncated_drive_file_is_refused(tmp_path: Path, layout: Layout, size: int) -> None:
    path = Path(write_drive(tmp_path, some_drive(), layout))
    path.write_bytes(path.read_bytes()[:size])
    with pytest.raises(DriveError, match=r"monday\.parquet: (not a drive|cannot read the drive): .*import it again"):
        read_drive_file(path, layout)


def test_folder_that_is_not_a_store_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DriveError, match="not a drive store"):
        list_drives(tmp_path)


def test_store_that_cannot_be_written_is_reported_with_what_to_do(tmp_path: Path, layout: Layout) -> None:
    (tmp_path / "store").write_text("a file")
    with pytest.raises(StorageError, match=r"cannot write it: .*; choose another folder"):
        write_drive(tmp_path / "store", some_drive(), layout)
