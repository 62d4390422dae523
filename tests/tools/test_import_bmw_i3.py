import gzip
import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from calibrator.drive import Array
from calibrator.drives.store import list_drives
from calibrator.errors import DriveError, LogError
from calibrator.recordings.tables import read_table
from ecu_node.database import read_database
from ecu_node.layout import read_layout
from import_bmw_i3 import COLUMNS, ImportedTrip, app, signal_ranges, trip_from_table

ROOT = Path(__file__).parents[2]
LAYOUT = ROOT / "dbc" / "hv_powertrain.toml"
SAMPLES = 600
IDLE_W = 500.0
RANGES = signal_ranges(read_database(read_layout(LAYOUT)))


def columns() -> dict[str, Array]:
    """A minute of a made-up trip: 1 kW of air conditioning, no heating, 500 W that nothing measures."""
    time_s = np.round(0.1 * np.arange(SAMPLES), 1)
    torque = np.where(np.arange(SAMPLES) % 200 < 100, 0.0, 40.0)
    power_w = 1000.0 + IDLE_W + 300.0 * torque
    return {
        "time": time_s,
        "speed": np.full(SAMPLES, 30.0),
        "accelerator": np.full(SAMPLES, 20.0),
        "torque": torque,
        "acceleration": np.zeros(SAMPLES),
        "voltage": np.full(SAMPLES, 400.0),
        "current": -power_w / 400.0,
        "heater": np.zeros(SAMPLES),
        "aircon": np.full(SAMPLES, 1.0),
    }


def write_csv(path: Path, values: dict[str, Array]) -> Path:
    header = ";".join({"time": "Time [s]", **COLUMNS}[key] + " " for key in values) + ";Battery Temperature [\xb0C]"
    rows = [";".join(f"{cell:g}" for cell in row) + ";20" for row in zip(*values.values(), strict=True)]
    text = "\n".join([header, *rows]) + "\n"
    data = text.encode("latin-1")
    path.write_bytes(gzip.compress(data) if path.suffix == ".gz" else data)
    return path


def imported(path: Path) -> ImportedTrip:
    return trip_from_table(read_table(path), vehicle="v", name="d", ranges=RANGES)


def with_text(path: Path, old: str, new: str, line: int) -> Path:
    lines = path.read_bytes().decode("latin-1").splitlines()
    assert old in lines[line - 1]
    lines[line - 1] = lines[line - 1].replace(old, new, 1)
    path.write_bytes("\n".join(lines).encode("latin-1"))
    return path


def run(*arguments: object) -> Result:
    return CliRunner().invoke(app, [*map(str, arguments)])


def test_currents_are_positive_into_the_junction_and_sum_to_zero(tmp_path: Path) -> None:
    trip = imported(write_csv(tmp_path / "a.csv", columns()))
    values = {name: channel.value for name, channel in trip.drive.branches.items()}
    assert trip.notices == ()
    assert np.all(values["battery"] > 0.0)
    np.testing.assert_allclose(values["auxiliary"], -1000.0 / 400.0)
    np.testing.assert_allclose(values["motor"], -(IDLE_W + 300.0 * columns()["torque"]) / 400.0, rtol=1e-4)
    np.testing.assert_allclose(sum(values.values()), 0.0, atol=1e-12)
    assert trip.drive.inputs["aircon_demand"].value[0] == 1000.0


def test_default_value_of_the_heater_and_adjacent_lines_are_labelled(tmp_path: Path) -> None:
    values = columns()
    values["heater"][200:210] = 5.52
    values["heater"][400:405] = [1.0, 2.0, 3.0, 4.0, 5.0]
    values["heater"][405:415] = 5.52
    trip = imported(write_csv(tmp_path / "a.csv", values))
    bad = np.flatnonzero(~trip.drive.branches["auxiliary"].good)
    assert bad.tolist() == [*range(199, 211), *range(399, 416)]
    assert trip.drive.branches["battery"].good.all()
    assert np.array_equal(trip.drive.branches["motor"].good, trip.drive.inputs["heater_demand"].good)
    assert trip.notices == (
        "heater power reads its default of 5.52 kW 2 times: 29 samples of auxiliary, motor and heater_demand not good",
    )


def test_heater_power_above_battery_power_is_implausible(tmp_path: Path) -> None:
    trip = imported(write_csv(tmp_path / "a.csv", columns() | {"heater": np.full(SAMPLES, 1.4)}))
    assert not trip.drive.branches["auxiliary"].good.any()
    assert trip.drive.branches["battery"].good.all()
    assert "implausible over the whole trip: with the inverter idle it leaves -900 W" in trip.notices[0]
    values = columns() | {"heater": np.full(SAMPLES, 1.4), "current": columns()["current"] - 1400.0 / 400.0}
    assert imported(write_csv(tmp_path / "b.csv", values)).notices == ()


def test_an_empty_cell_is_labelled_with_its_line(tmp_path: Path) -> None:
    path = with_text(write_csv(tmp_path / "a.csv", columns()), ";400;", ";;", line=12)
    trip = imported(path)
    assert np.flatnonzero(~trip.drive.inputs["voltage"].good).tolist() == [10]
    assert np.flatnonzero(~trip.drive.branches["auxiliary"].good).tolist() == [10]
    assert trip.notices == (
        "column 'Battery Voltage [V]': 1 cells without a number, the first at 1.0 s; labelled as not good",
    )


def test_files_that_cannot_be_used_are_refused(tmp_path: Path) -> None:
    path = with_text(write_csv(tmp_path / "a.csv", columns()), "Battery V", "Batery V", line=1)
    with pytest.raises(
        LogError, match=r"a\.csv: there is no column 'Battery Voltage \[V\]'; the columns are 'Batery V"
    ):
        imported(path)
    path = write_csv(tmp_path / "b.csv", {key: value[:31] for key, value in columns().items()})
    with pytest.raises(DriveError, match=r"b\.csv: only 3\.0 s long; at least 10 s are needed"):
        imported(path)
    path = write_csv(tmp_path / "c.csv", columns() | {"current": np.full(SAMPLES, np.nan)})
    with pytest.raises(DriveError, match=r"c\.csv: column 'Battery Current \[A\]' has no usable value; leave"):
        imported(path)


def test_bad_file_does_not_stop_the_import_but_sets_the_exit_code(tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    write_csv(tmp_path / "in" / "A.csv", columns())
    write_csv(tmp_path / "in" / "B.csv.gz", columns())
    with_text(write_csv(tmp_path / "in" / "C.csv", columns()), "Throttle", "Trottle", line=1)
    write_csv(tmp_path / "B.csv", columns())
    done = run(tmp_path / "in", tmp_path / "B.csv", "--layout", LAYOUT, "--out", tmp_path / "store")
    assert done.exit_code == 1
    assert [entry.vehicle for entry in list_drives(tmp_path / "store")] == ["A"]
    errors = [line for line in done.stderr.splitlines() if line.startswith("import_bmw_i3: ")]  # besides progress
    assert "two files for one trip" in errors[0]
    assert "C.csv: there is no column 'Throttle [%]'" in errors[1]
    assert "1 trips imported, 0.0 h; 0 already there; 2 left out" in done.stdout


def test_a_layout_without_these_branches_is_refused(tmp_path: Path) -> None:
    text = LAYOUT.read_text().replace('name = "auxiliary"', 'name = "heater"')
    (tmp_path / "l.toml").write_text(text.replace('"hv_powertrain.dbc"', f'"{LAYOUT.parent / "hv_powertrain.dbc"}"'))
    path = write_csv(tmp_path / "A.csv", columns())
    done = run(path, "--layout", tmp_path / "l.toml", "--out", tmp_path / "store")
    assert done.exit_code == 1
    assert "no branch or input named auxiliary" in str(done.exception)


def test_values_outside_the_dbc_range_and_those_computed_from_them_are_labelled(tmp_path: Path) -> None:
    values = columns()
    values["current"][100] = -2000.0
    values["voltage"][200] = 1500.0
    values["accelerator"][300] = 250.0
    trip = imported(write_csv(tmp_path / "a.csv", values))
    channels = {**trip.drive.branches, **trip.drive.inputs}
    bad = {name: np.flatnonzero(~channel.good).tolist() for name, channel in channels.items()}
    inputs = {"voltage": [200], "accelerator": [300]}
    wanted = {"battery": [100], "motor": [100, 200], "auxiliary": [200], **inputs}
    assert {name: rows for name, rows in bad.items() if rows} == wanted
    assert "accelerator: 1 samples beyond the DBC's 0 to 100; labelled as not good" in trip.notices


def test_existing_trips_are_not_overwritten(tmp_path: Path) -> None:
    path, store = write_csv(tmp_path / "A.csv", columns()), tmp_path / "store"
    done = run(path, "--layout", LAYOUT, "--out", store, "--json")
    assert done.exit_code == 0
    assert json.loads(done.stdout)["drives"]["A"]["duration_s"] == pytest.approx(59.9)
    before = Path(list_drives(store)[0].place).read_bytes()
    write_csv(path, columns() | {"speed": np.full(SAMPLES, 50.0)})
    again = run(path, "--layout", LAYOUT, "--out", store)
    assert again.exit_code == 0
    assert "0 trips imported, 0.0 h; 1 already there; 0 left out" in again.stdout
    assert Path(list_drives(store)[0].place).read_bytes() == before
