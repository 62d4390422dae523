"""What the documents name exists: tests in docs/safety.md, reasons and states in docs/node.md."""

import re
from enum import IntEnum
from pathlib import Path

import pytest

from ecu_node.status import Reason, State

ROOT = Path(__file__).parents[2]
FEWEST_HAZARDS = 15


def hazards() -> list[str]:
    """Rows of the table of hazards."""
    section = (ROOT / "docs" / "safety.md").read_text().partition("\n## Hazards\n")[2].partition("\n## ")[0]
    return [line for line in section.splitlines() if line.startswith("| ") and not line.startswith("| hazard |")]


def test_every_hazard_names_tests_and_every_test_exists() -> None:
    defined = {
        name
        for path in (ROOT / "tests").rglob("test_*.py")
        for name in re.findall(r"(?m)^def (test_\w+)", path.read_text())
    }
    named = [re.findall(r"`(test_\w+)`", row.rsplit("|", 2)[1]) for row in hazards()]
    assert len(named) >= FEWEST_HAZARDS
    assert [row for row, names in zip(hazards(), named, strict=True) if not names] == []
    assert {name for names in named for name in names} - defined == set()


@pytest.mark.parametrize("kind", [State, Reason])
def test_every_code_of_the_status_is_documented_with_its_number(kind: type[IntEnum]) -> None:
    rows = re.findall(r"(?m)^\| ([A-Z][\w, ]*) \| ([\d, ]+) \|", (ROOT / "docs" / "node.md").read_text())
    documented = {pair for names, numbers in rows for pair in zip(names.split(", "), numbers.split(", "), strict=True)}
    in_dbc = {("".join(part.title() for part in code.name.split("_")), str(code.value)) for code in kind}
    assert in_dbc - documented == set()
