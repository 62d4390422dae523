"""The functions of docs/export.md, of the header's comment, and those that are generated have the same names."""

import re
from pathlib import Path

from calibrator.export.c99 import HEADER, c99_files
from ecu_node.database import VehicleDatabase
from ecu_node.sensor_models import TemperatureDrift
from tests.calibrator.export.exports import checked_with, parameters_for, with_branch

DOCUMENT = Path(__file__).parents[3] / "docs" / "export.md"
NAMES = {"hv_rewrite_MESSAGE", "hv_correct_BRANCH", "hv_read_MESSAGE_SIGNAL"}


def test_names_of_functions_are_those_that_are_generated(database: VehicleDatabase, tmp_path: Path) -> None:
    model = TemperatureDrift(drift_per_k=0.001, reference_c=25.0)
    parameters = with_branch(parameters_for(database, battery=(0.05, 2.3)), "battery", model)
    header = c99_files(checked_with(database, parameters, tmp_path))[HEADER]
    table = re.findall(r"(?m)^\| `\w+ (hv_\w+)\(", DOCUMENT.read_text())
    assert set(table) == NAMES
    assert set(re.findall(r"(?m)^ \* (hv_\w+)", header)) == NAMES
    generated = set(re.findall(r"(?m)^\w+ (hv_\w+)\(", header))
    assert {"hv_rewrite_HV_Battery", "hv_correct_battery", "hv_read_HV_Battery_JunctionBoxTemperature"} <= generated
    assert max(map(len, header.splitlines())) <= 120
