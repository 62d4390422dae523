"""Documents: links lead somewhere, tables name existing tests and all codes, references have every command."""

import json
import os
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from enum import IntEnum
from pathlib import Path

import pytest

from docs_site.command_reference import command_help
from ecu_node.core.status import Reason, State
from tests.ecu_node.processes import ecu_node
from tests.test_json_everywhere import CALIBRATOR, ECU_NODE

ROOT = Path(__file__).parents[2]
PLACES = ("*.md", "deploy/*.md", "docs/*.md", "docs/reference/*.md", "docs/results/*.md", "examples/*.ipynb")
DOCUMENTS = sorted(path for place in PLACES for path in ROOT.glob(place))


def text_of(path: Path) -> str:
    """Prose of a document: the text cells of a notebook, and no blocks of code."""
    text = path.read_text()
    if path.suffix == ".ipynb":
        cells = json.loads(text)["cells"]
        text = "\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "markdown")
    return re.sub(r"(?ms)^```.*?^```", "", text)


def headings(path: Path) -> set[str]:
    """Anchors that code hosts, and the site, give the headings of a document."""
    titles = re.findall(r"(?m)^#+ (.+)$", text_of(path))
    plain = [re.sub(r"\[([^]]*)\]\([^)]*\)", r"\1", title).strip().lower() for title in titles]
    return {re.sub(r"[^\w\- ]", "", title).replace(" ", "-") for title in plain}


def links(path: Path) -> Iterator[tuple[str, str]]:
    """File and heading of each relative link of a document; a heading of its own has no file."""
    for target in re.findall(r"\]\(([^)\s]+)\)", text_of(path)):
        if not re.match(r"[a-z]+:", target):
            file, _, heading = target.partition("#")
            yield file, heading


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_links_lead_to_files_and_headings_that_exist(path: Path) -> None:
    for file, heading in links(path):
        target = path.parent / file if file else path
        assert target.exists(), file
        assert not heading or heading in headings(target), f"{file}#{heading}"


# ---- tables of hazards, faults and codes; the layout of the document


MEASURED = """VERSION ""
BU_: BMS Inverter{senders}
BO_ 256 BMS_1: 8 BMS
 SG_ PackCurrent : 0|16@1- (0.1,0) [-3276.7|3276.7] "A" Vector__XXX
 SG_ PackVoltage : 16|16@1+ (0.1,0) [0|1000] "V" Vector__XXX
BO_ 272 INV_3: 8 Inverter
 SG_ DcPower : 0|16@1- (0.02,0) [-600|600] "kW" Vector__XXX
"""


@pytest.mark.parametrize(("document", "head"), [("safety.md", "| hazard |"), ("fault_table.md", "| fault |")])
def test_every_row_of_the_safety_tables_names_existing_tests(document: str, head: str) -> None:
    sections = (ROOT / "docs" / document).read_text().split("\n## ")
    lines = "\n".join(section for section in sections if head in section).splitlines()
    rows = [line for line in lines if line.startswith("| ") and not line.startswith(head)]
    named = [re.findall(r"`(test_\w+)`", row.rsplit("|", 2)[1]) for row in rows]
    tests = (path.read_text() for path in (ROOT / "tests").rglob("test_*.py"))
    defined = {name for text in tests for name in re.findall(r"(?m)^def (test_\w+)", text)}
    assert rows
    assert [row for row, names in zip(rows, named, strict=True) if not names] == []
    assert {name for names in named for name in names} - defined == set()


@pytest.mark.parametrize("kind", [State, Reason])
def test_every_code_of_the_status_is_documented_with_its_number(kind: type[IntEnum]) -> None:
    rows = re.findall(r"(?m)^\| ([A-Z][\w, ]*) \| ([\d, ]+) \|", (ROOT / "docs" / "node.md").read_text())
    documented = {pair for names, numbers in rows for pair in zip(names.split(", "), numbers.split(", "), strict=True)}
    in_dbc = {("".join(part.title() for part in code.name.split("_")), str(code.value)) for code in kind}
    assert in_dbc - documented == set()


def test_overlay_signals_copied_from_the_layout_document_pass_ecu_node_check(tmp_path: Path) -> None:
    """The signals are put into DBC and layout as the document says; ``ecu-node check`` then has no warning."""
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


# ---- references of the site


def test_reference_has_every_command_with_examples_that_calibrator_accepts() -> None:
    assert dict(command_help("ecu-node")).keys() == {"ecu-node", *ECU_NODE}
    reference = dict(command_help("calibrator"))
    assert reference.keys() == CALIBRATOR.keys()
    for name, text in reference.items():
        examples = text.replace("\\\n", "").partition("Example:\n")[2].partition("\n\n")[0].splitlines()
        assert examples or (" " in name and hasattr(CALIBRATOR[name], "commands")), name
        for words in map(shlex.split, examples):
            command, used = CALIBRATOR["calibrator"], words[1:]
            while hasattr(command, "commands"):
                command, used = command.commands[used[0]], used[1:]
            command.make_context(name, used)


def test_shell_completes_commands() -> None:
    words = {"_CALIBRATOR_COMPLETE": "complete_bash", "COMP_WORDS": "calibrator ki", "COMP_CWORD": "1"}
    command, environment = [sys.executable, "-m", "calibrator"], os.environ | words
    shown = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    assert shown.stdout.split() == ["kirchhoff"]
