import json
from pathlib import Path

import pytest

from tests.calibrator.conftest import run_command


def test_the_page_of_the_fleet_is_written(result: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "new" / "page.html"
    assert run_command(["report", str(result), "--out", str(out)]) == 0
    assert out.read_text().startswith("<!DOCTYPE html>")
    assert capsys.readouterr().out == f"{out}: {out.stat().st_size / 1e6:.2f} MB; open it in a browser\n"


def test_its_numbers_come_as_json(result: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "page.html"
    assert run_command(["report", str(result), "--out", str(out), "--json", "--limit", "300"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["bytes"] == out.stat().st_size
    assert found["overview"]["verdicts"] == {"corrected": 2, "no sensor fault": 2, "cannot tell": 2}
    assert found["protection"]["limit_a"] == 300.0
    assert len(found["next_steps"]) == 5
    assert found["workshop"][0]["cause"] == "hardware"


def test_the_page_of_a_vehicle_is_named_after_it_and_stands_in_the_result(
    result: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert run_command(["report", str(result), "--vehicle", "V3", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["page"] == str(result / "V3.html")
    assert found["parameters"]["hardware_fault"]["drift"] == -0.06
    assert "Look at the hardware of V3" in (result / "V3.html").read_text()
    assert run_command(["report", str(result)]) == 0
    assert (result / "report.html").exists()
    assert not [*tmp_path.glob("*.html")]
