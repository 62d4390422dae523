"""CSV: one row per branch, of one vehicle or many, that any reader of RFC 4180 understands."""

import csv
from pathlib import Path

import pytest
from msgspec.structs import replace

from calibrator.errors import ExportError
from calibrator.export.csv_table import COLUMNS, csv_text
from ecu_node.database import VehicleDatabase
from tests.calibrator.export.exports import checked_with, held_back, parameters_for


def rows(text: str) -> list[dict[str, str]]:
    return list(csv.DictReader(text.splitlines(keepends=True)))


def test_each_branch_is_a_row_with_what_was_found(database: VehicleDatabase, tmp_path: Path) -> None:
    checked = checked_with(database, held_back(parameters_for(database, battery=(0.05, -1.5)), "motor"), tmp_path)
    battery, motor = rows(csv_text([checked]))
    assert {name: battery[name] for name in ("branch", "signal", "signal_unit", "drift", "offset_a", "applied")} == {
        "branch": "battery",
        "signal": "HV_Battery.BatteryCurrent",
        "signal_unit": "A",
        "drift": "0.05",
        "offset_a": "-1.5",
        "applied": "true",
    }
    assert [motor[name] for name in ("drift", "drift_sd", "offset_sd_a", "applied", "held_back")] == [
        "0.2",
        "0.01",
        "",
        "false",
        "harm limit",
    ]


def test_vehicles_stand_below_each_other_under_one_header(database: VehicleDatabase, tmp_path: Path) -> None:
    parameters = parameters_for(database, battery=(0.05, -1.5), motor=(0.0, 0.0))
    tables = [checked_with(database, replace(parameters, vehicle=name), tmp_path) for name in ("a", 'b, "c"\nd')]
    text = csv_text(tables)
    found = [(row["vehicle"], row["branch"]) for row in rows(text)]
    assert found == [("a", "battery"), ("a", "motor"), ('b, "c"\nd', "battery"), ('b, "c"\nd', "motor")]
    assert text.startswith(",".join(COLUMNS) + "\r\n")
    assert text.count("\r\n") == 5


@pytest.mark.parametrize("vehicle", ["=1+1", "+cmd|' /C calc'!A0", "-x", "@SUM(A1)", "\t=1", "\r=1"])
def test_a_name_that_a_spreadsheet_would_run_is_refused(
    vehicle: str, database: VehicleDatabase, tmp_path: Path
) -> None:
    checked = checked_with(database, replace(parameters_for(database, battery=(0.05, 0.0)), vehicle=vehicle), tmp_path)
    with pytest.raises(ExportError, match=r"^v1\.json: vehicle ['\"].*['\"] begins as a formula does"):
        csv_text([checked])


@pytest.mark.parametrize("vehicle", ["-12", "+1", "a=1", "Zoë-1"])
def test_numbers_and_other_names_are_no_formulas(vehicle: str, database: VehicleDatabase, tmp_path: Path) -> None:
    checked = checked_with(database, replace(parameters_for(database, battery=(0.05, 0.0)), vehicle=vehicle), tmp_path)
    assert rows(csv_text([checked]))[0]["vehicle"] == vehicle


def test_where_it_comes_from_stands_in_every_row(database: VehicleDatabase, tmp_path: Path) -> None:
    checked = checked_with(database, parameters_for(database, battery=(0.05, -1.5), motor=(0.0, 0.0)), tmp_path)
    for row in rows(csv_text([checked])):
        assert {name: row[name] for name in checked.provenance} == checked.provenance
