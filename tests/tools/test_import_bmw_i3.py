"""Recorded trips of a BMW i3 become drives; samples that cannot be used are labelled as not good, with a notice."""

import gzip
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from calibrator.drive import Array
from calibrator.drives.store import list_drives
from calibrator.errors import DriveError, LogError
from calibrator.recordings.tables import read_table
from ecu_node.database import VehicleDatabase
from import_bmw_i3 import COLUMNS, ImportedTrip, app, signal_ranges, trip_from_table
from tests.ecu_node.vehicles import LAYOUT

SAMPLES = 600
IDLE_W = 500.0
OF_HEATER = ("auxiliary", "motor", "heater_demand")
"""Channels that are computed from the power of the heater."""


def columns(**changes: Any) -> dict[str, Array]:
    """A minute of a made-up trip: 1 kW of air conditioning, no heating, 500 W that nothing measures.

    A change is a value for all samples, or a mapping of samples to values.
    """
    torque = np.where(np.arange(SAMPLES) % 200 < 100, 0.0, 40.0)
    made = {
        "time": np.round(0.1 * np.arange(SAMPLES), 1),
        "speed": np.full(SAMPLES, 30.0),
        "accelerator": np.full(SAMPLES, 20.0),
        "torque": torque,
        "acceleration": np.zeros(SAMPLES),
        "voltage": np.full(SAMPLES, 400.0),
        "current": -(1000.0 + IDLE_W + 300.0 * torque) / 400.0,
        "heater": np.zeros(SAMPLES),
        "aircon": np.full(SAMPLES, 1.0),
    }
    for key, change in changes.items():
        for samples, value in change.items() if isinstance(change, dict) else [(slice(None), change)]:
            made[key][samples] = value
    return made


def write_csv(path: Path, values: dict[str, Array], old: str = "", new: str = "") -> Path:
    """Write a file as it is published; a value that is not a number is an empty cell."""
    header = ";".join({"time": "Time [s]", **COLUMNS}[key] + " " for key in values) + ";Battery Temperature [\xb0C]"
    cells = zip(*values.values(), strict=True)
    rows = ["".join(f"{cell:g};".replace("nan", "") for cell in row) + "20" for row in cells]
    data = "\n".join([header.replace(old, new), *rows, ""]).encode("latin-1")
    path.write_bytes(gzip.compress(data) if path.suffix == ".gz" else data)
    return path


def imported(path: Path, database: VehicleDatabase) -> ImportedTrip:
    return trip_from_table(read_table(path), vehicle="v", name="d", ranges=signal_ranges(database))


def run(*arguments: object) -> Result:
    return CliRunner().invoke(app, [*map(str, arguments)])


def test_currents_are_positive_into_the_junction_and_sum_to_zero(tmp_path: Path, database: VehicleDatabase) -> None:
    trip = imported(write_csv(tmp_path / "a.csv", columns()), database)
    values = {name: channel.value for name, channel in trip.drive.branches.items()}
    assert trip.notices == ()
    assert np.all(values["battery"] > 0.0)
    np.testing.assert_allclose(values["auxiliary"], -1000.0 / 400.0)
    np.testing.assert_allclose(values["motor"], -(IDLE_W + 300.0 * columns()["torque"]) / 400.0, rtol=1e-4)
    np.testing.assert_allclose(sum(values.values()), 0.0, atol=1e-12)
    assert trip.drive.inputs["aircon_demand"].value[0] == 1000.0


DEFAULT_AND_RAMPS = {range(200, 210): 5.52, range(400, 405): [1.0, 2.0, 3.0, 4.0, 5.0], range(405, 415): 5.52}
OUT_OF_RANGE = {"current": {100: -2000.0}, "voltage": {200: 1500.0}, "accelerator": {300: 250.0}}
CASES = {
    "default and its ramps": (
        {"heater": DEFAULT_AND_RAMPS},
        dict.fromkeys(OF_HEATER, (*range(199, 211), *range(399, 416))),
        "heater power reads its default of 5.52 kW 2 times: 29 samples of auxiliary, motor and heater_demand not",
    ),
    "heater above battery": (
        {"heater": 1.4},
        dict.fromkeys(OF_HEATER, range(SAMPLES)),
        "heater power is implausible over the whole trip: with the inverter idle it leaves -900 W",
    ),
    "heater within battery": ({"heater": 1.4, "current": columns()["current"] - 1400.0 / 400.0}, {}, None),
    "empty cell": (
        {"voltage": {10: np.nan}},
        {"auxiliary": [10], "motor": [10], "voltage": [10]},
        "column 'Battery Voltage [V]': 1 cells without a number, the first at 1.0 s; labelled as not good",
    ),
    "out of range": (
        OUT_OF_RANGE,
        {"battery": [100], "motor": [100, 200], "auxiliary": [200], "voltage": [200], "accelerator": [300]},
        "accelerator: 1 samples beyond the DBC's 0 to 100; labelled as not good",
    ),
}


@pytest.mark.parametrize(("changes", "bad", "notice"), CASES.values(), ids=CASES)
def test_unusable_cells_are_labelled_as_not_good_in_every_channel_computed_from_them(
    changes: dict[str, Any], bad: dict[str, Any], notice: str | None, tmp_path: Path, database: VehicleDatabase
) -> None:
    trip = imported(write_csv(tmp_path / "a.csv", columns(**changes)), database)
    channels = {**trip.drive.branches, **trip.drive.inputs}
    found = {name: np.flatnonzero(~channel.good).tolist() for name, channel in channels.items()}
    assert {name: rows for name, rows in found.items() if rows} == {name: list(rows) for name, rows in bad.items()}
    assert any(text.startswith(notice) for text in trip.notices) if notice else not trip.notices


def test_files_without_a_column_usable_values_or_10_s_are_refused(tmp_path: Path, database: VehicleDatabase) -> None:
    path = write_csv(tmp_path / "a.csv", columns(), "Battery V", "Batery V")
    words = r"a\.csv: there is no column 'Battery Voltage \[V\]'; the columns are 'Batery V"
    with pytest.raises(LogError, match=words):
        imported(path, database)
    path = write_csv(tmp_path / "b.csv", {key: value[:31] for key, value in columns().items()})
    with pytest.raises(DriveError, match=r"b\.csv: only 3\.0 s long; at least 10 s are needed"):
        imported(path, database)
    path = write_csv(tmp_path / "c.csv", columns(current=np.nan))
    with pytest.raises(DriveError, match=r"c\.csv: column 'Battery Current \[A\]' has no usable value; leave"):
        imported(path, database)


def test_bad_file_does_not_stop_the_import_but_sets_the_exit_code(tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    for name in ("in/A.csv", "in/B.csv.gz", "B.csv"):
        write_csv(tmp_path / name, columns())
    write_csv(tmp_path / "in" / "C.csv", columns(), "Throttle", "Trottle")
    done = run(tmp_path / "in", tmp_path / "B.csv", "--layout", LAYOUT, "--out", tmp_path / "store")
    assert done.exit_code == 1
    assert [entry.vehicle for entry in list_drives(tmp_path / "store")] == ["A"]
    errors = [line for line in done.stderr.splitlines() if line.startswith("import_bmw_i3: ")]  # besides progress
    assert "two files for one trip" in errors[0]
    assert "C.csv: there is no column 'Throttle [%]'" in errors[1]
    assert "1 trips imported, 0.0 h; 0 already there; 2 left out" in done.stdout


def test_layout_without_a_branch_of_the_recordings_is_refused(tmp_path: Path) -> None:
    text = LAYOUT.read_text().replace('name = "auxiliary"', 'name = "heater"')
    (tmp_path / "l.toml").write_text(text.replace('"hv_powertrain.dbc"', f'"{LAYOUT.with_suffix(".dbc")}"'))
    path = write_csv(tmp_path / "A.csv", columns())
    done = run(path, "--layout", tmp_path / "l.toml", "--out", tmp_path / "store")
    assert done.exit_code == 1
    assert "no branch or input named auxiliary" in str(done.exception)


def test_existing_trips_are_not_overwritten(tmp_path: Path) -> None:
    path, store = write_csv(tmp_path / "A.csv", columns()), tmp_path / "store"
    done = run(path, "--layout", LAYOUT, "--out", store, "--json")
    assert done.exit_code == 0
    assert json.loads(done.stdout)["drives"]["A"]["duration_s"] == pytest.approx(59.9)
    before = Path(list_drives(store)[0].place).read_bytes()
    again = run(write_csv(path, columns(speed=50.0)), "--layout", LAYOUT, "--out", store)
    assert again.exit_code == 0
    assert "0 trips imported, 0.0 h; 1 already there; 0 left out" in again.stdout
    assert Path(list_drives(store)[0].place).read_bytes() == before
