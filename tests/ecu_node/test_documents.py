"""Everything named in the documents exists: tests of hazards and faults, reasons and states of the status."""

import json
import re
from enum import IntEnum
from pathlib import Path

import pytest

from ecu_node.core.status import Reason, State
from tests.ecu_node.processes import ecu_node

ROOT = Path(__file__).parents[2]
MEASURED = """VERSION ""
BU_: BMS Inverter{senders}
BO_ 256 BMS_1: 8 BMS
 SG_ PackCurrent : 0|16@1- (0.1,0) [-3276.7|3276.7] "A" Vector__XXX
 SG_ PackVoltage : 16|16@1+ (0.1,0) [0|1000] "V" Vector__XXX
BO_ 272 INV_3: 8 Inverter
 SG_ DcPower : 0|16@1- (0.02,0) [-600|600] "kW" Vector__XXX
"""


@pytest.mark.parametrize(
    ("document", "head", "fewest"), [("safety.md", "| hazard |", 15), ("fault_table.md", "| fault |", 25)]
)
def test_every_row_of_the_safety_tables_names_existing_tests(document: str, head: str, fewest: int) -> None:
    sections = (ROOT / "docs" / document).read_text().split("\n## ")
    lines = "\n".join(section for section in sections if head in section).splitlines()
    rows = [line for line in lines if line.startswith("| ") and not line.startswith(head)]
    named = [re.findall(r"`(test_\w+)`", row.rsplit("|", 2)[1]) for row in rows]
    tests = (path.read_text() for path in (ROOT / "tests").rglob("test_*.py"))
    defined = {name for text in tests for name in re.findall(r"(?m)^def (test_\w+)", text)}
    assert len(rows) >= fewest
    assert [row for row, names in zip(rows, named, strict=True) if not names] == []
    assert {name for names in named for name in names} - defined == set()


@pytest.mark.parametrize("kind", [State, Reason])
def test_every_code_of_the_status_is_documented_with_its_number(kind: type[IntEnum]) -> None:
    rows = re.findall(r"(?m)^\| ([A-Z][\w, ]*) \| ([\d, ]+) \|", (ROOT / "docs" / "node.md").read_text())
    documented = {pair for names, numbers in rows for pair in zip(names.split(", "), numbers.split(", "), strict=True)}
    in_dbc = {("".join(part.title() for part in code.name.split("_")), str(code.value)) for code in kind}
    assert in_dbc - documented == set()


def test_overlay_signals_of_the_layout_document_suffice(tmp_path: Path) -> None:
    """They are put in as the document says, and a template of the layout then fits."""
    document = (ROOT / "docs" / "layout.md").read_text()
    layout = re.findall(r"(?s)```toml\n(.*?)```", document.partition("\n## ")[0])[0]
    section = document.partition("\n## Signals for the corrected currents\n")[2].partition("\n## ")[0]
    dbc, branch, status = re.findall(r"(?s)```(?:toml)?\n(.*?)```", section)
    sign = re.findall(r"(?m)^sign = 1 .*\n", layout)[0]
    (tmp_path / "my_car.toml").write_text(f"{layout.replace(sign, sign + branch)}\n{status}")
    (tmp_path / "my_car.dbc").write_text(f"{MEASURED.format(senders=' CorrectionNode')}\n{dbc}")
    files = ["--layout", str(tmp_path / "my_car.toml"), "--vehicle", "V1"]
    (tmp_path / "V1.json").write_text(ecu_node("template", *files).out)
    report = json.loads(ecu_node("check", "--params", tmp_path / "V1.json", *files, "--json").out)
    shown = {name: (branch["target"], branch["applied"]) for name, branch in report["branches"].items()}
    assert shown == {"battery": ("BMS_1_Corrected.PackCurrentCorrected", False), "motor": (None, False)}
    assert (report["vehicle"], report["warnings"]) == ("V1", [])
