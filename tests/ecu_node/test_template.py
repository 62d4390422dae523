"""``ecu-node template``: what it prints fits at once, and once filled in it is applied."""

import json
from datetime import UTC, datetime
from pathlib import Path

import pytest

from ecu_node.cli import run_ecu_node, template_text
from tests.ecu_node.vehicles import LAYOUT, SMALL_LAYOUT, MakeDatabase

NOW = datetime(2026, 6, 1, 12, 0, tzinfo=UTC)


def check(params: Path) -> list[str]:
    return ["check", "--params", str(params), "--layout", str(LAYOUT), "--vehicle", "my car", "--json"]


def test_template_fits_its_layout_and_corrects_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run_ecu_node(["template", "--layout", str(LAYOUT), "--vehicle", "my car"]) == 0
    (tmp_path / "V.json").write_text(capsys.readouterr().out)
    assert run_ecu_node(check(tmp_path / "V.json")) == 0
    report = json.loads(capsys.readouterr().out)
    assert (report["vehicle"], report["warnings"]) == ("my car", [])
    assert [branch["applied"] for branch in report["branches"].values()] == [False] * len(report["branches"])


@pytest.mark.parametrize(("load", "expected_a"), [("[unmeasured_load]\nmean_a = 6.1\nsd_a = 1.0\n", 6.1), ("", 0.0)])
def test_template_expects_the_load_that_the_layout_declares(
    make_database: MakeDatabase, load: str, expected_a: float
) -> None:
    document = json.loads(template_text(make_database(f"{SMALL_LAYOUT}{load}"), "v1", NOW))
    assert document["junction_residual"]["expected_a"] == expected_a
