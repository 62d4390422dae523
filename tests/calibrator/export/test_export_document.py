"""The functions of docs/export.md, of the header's comment, and those that are generated have the same names."""

import re
from pathlib import Path

from calibrator.export.c99 import HEADER, c99_files
from tests.calibrator.export.exports import MakeDatabase, checked_with, parameters_for

DOCUMENT = Path(__file__).parents[3] / "docs" / "export.md"
NAMES = {"hv_rewrite_MESSAGE", "hv_correct_BRANCH", "hv_read_MESSAGE_SIGNAL"}


def test_names_of_functions_are_those_that_are_generated(make_database: MakeDatabase, tmp_path: Path) -> None:
    database = make_database()
    parameters = parameters_for(database, heater=(0.05, 2.3))
    header = c99_files(checked_with(database, parameters, tmp_path))[HEADER]
    table = re.findall(r"(?m)^\| `\w+ (hv_\w+)\(", DOCUMENT.read_text())
    assert set(table) == NAMES
    assert set(re.findall(r"(?m)^ \* (hv_\w+)", header)) == NAMES
    generated = set(re.findall(r"(?m)^\w+ (hv_\w+)\(", header))
    assert {"hv_rewrite_Heater", "hv_correct_heater", "hv_read_Net_Voltage"} <= generated
    assert max(map(len, header.splitlines())) <= 120
