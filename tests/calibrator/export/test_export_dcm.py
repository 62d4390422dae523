"""DCM as another reader (dcmReader) finds it, and texts, which that reader passes over."""

import logging
import re
from pathlib import Path

import pytest
from dcmReader.dcm_reader import DcmReader
from msgspec.structs import replace

from calibrator.errors import ExportError
from calibrator.export.dcm import dcm_text
from ecu_node.database import VehicleDatabase
from ecu_node.parameters import VehicleParameters
from tests.calibrator.export.exports import checked_with, held_back, parameters_for

FAULTS = {"battery": (0.05, 2.3), "motor": (-1.23456789012345e-05, -1e-7)}


def read_back(database: VehicleDatabase, parameters: VehicleParameters, folder: Path) -> DcmReader:
    (folder / "v1.dcm").write_text(dcm_text(checked_with(database, parameters, folder)), encoding="utf-8")
    reader = DcmReader()
    reader.read(str(folder / "v1.dcm"))
    return reader


def values(reader: DcmReader) -> dict[str, float]:
    return {item.name: item.value for item in reader.get_parameters()}


def test_numbers_are_read_back_exactly(database: VehicleDatabase, tmp_path: Path) -> None:
    found = values(read_back(database, parameters_for(database, **FAULTS), tmp_path))
    assert found == {
        "HV.battery.applied": 1,
        "HV.battery.drift": 0.05,
        "HV.battery.offset": 2.3,
        "HV.battery.found.drift": 0.05,
        "HV.battery.found.offset": 2.3,
        "HV.motor.applied": 1,
        "HV.motor.drift": -1.23456789012345e-05,
        "HV.motor.offset": -1e-7,
        "HV.motor.found.drift": -1.23456789012345e-05,
        "HV.motor.found.offset": -1e-7,
    }


def test_what_is_held_back_corrects_nothing_and_is_still_told(database: VehicleDatabase, tmp_path: Path) -> None:
    parameters = held_back(parameters_for(database, battery=(0.0, 0.0)), "motor")
    found = values(read_back(database, parameters, tmp_path))
    assert {name: value for name, value in found.items() if "motor" in name} == {
        "HV.motor.applied": 0,
        "HV.motor.drift": 0.0,
        "HV.motor.offset": 0.0,
        "HV.motor.found.drift": 0.2,
        "HV.motor.found.drift_sd": 0.01,
        "HV.motor.found.offset": 7.0,
    }


def test_units_functions_and_limits_are_read_back(database: VehicleDatabase, tmp_path: Path) -> None:
    reader = read_back(database, parameters_for(database, **FAULTS), tmp_path)
    items = {item.name: item for item in reader.get_parameters()}
    assert [items[f"HV.battery.{name}"].unit for name in ("drift", "offset", "applied")] == ["-", "A", "-"]
    assert {item.function for item in items.values()} == {"HV_current_correction"}
    assert items["HV.battery.drift"].description == "battery: measured = (1 + drift) * true + offset"
    assert items["HV.battery.offset"].comment.strip() == "limits: -150.0 to 150.0"
    (function,) = reader.get_functions()
    assert (function.name, function.version) == ("HV_current_correction", "300")


def test_the_reader_understands_every_line_but_those_of_texts(
    database: VehicleDatabase, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.WARNING):
        read_back(database, parameters_for(database, **FAULTS), tmp_path)
    lines = [record.getMessage().split("\n")[-1].split()[0] for record in caplog.records]
    assert lines == ["TEXTSTRING", "LANGNAME", "FUNKTION", "TEXT", "END"] * (len(lines) // 5)


def test_texts_say_where_it_comes_from(database: VehicleDatabase, tmp_path: Path) -> None:
    checked = checked_with(database, replace(parameters_for(database, **FAULTS), vehicle="Zoë 1"), tmp_path)
    form = r'^TEXTSTRING HV\.(\w+)\n  LANGNAME "[^"\n]*"\n  FUNKTION \w+\n  TEXT "([^"\n]*)"\nEND$'
    found = dict(re.findall(form, dcm_text(checked), flags=re.MULTILINE))
    assert found == checked.provenance
    assert (found["vehicle"], found["parameter_set"]) == ("Zoë 1", "300")


@pytest.mark.parametrize("vehicle", ['a "b"', "a\\b", "a\nb"])
def test_texts_that_dcm_cannot_hold_are_refused(vehicle: str, database: VehicleDatabase, tmp_path: Path) -> None:
    checked = checked_with(database, replace(parameters_for(database, **FAULTS), vehicle=vehicle), tmp_path)
    with pytest.raises(ExportError, match=r"^v1\.json: vehicle '.*' has a quotation mark, a backslash or a control"):
        dcm_text(checked)
