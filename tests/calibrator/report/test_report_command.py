import json
from pathlib import Path

from tests.calibrator.command_here import calibrator


def test_page_and_numbers_of_the_fleet(result: Path, tmp_path: Path) -> None:
    out = tmp_path / "new" / "page.html"
    done = calibrator("report", result, "--out", out)
    assert (done.returncode, done.stdout) == (0, f"{out}: {out.stat().st_size / 1e6:.2f} MB; open it in a browser\n")
    found = json.loads(calibrator("report", result, "--out", out, "--json", "--limit", 300).stdout)
    assert found["bytes"] == out.stat().st_size
    assert found["overview"]["verdicts"] == {"corrected": 2, "no sensor fault": 2, "cannot tell": 2}
    assert found["protection"]["limit_a"] == 300.0
    assert len(found["next_steps"]) == 5
    assert found["workshop"][0]["cause"] == "hardware"


def test_page_is_named_after_its_vehicle_and_stands_in_the_result(result: Path) -> None:
    found = json.loads(calibrator("report", result, "--vehicle", "V3", "--json").stdout)
    assert found["page"] == str(result / "V3.html")
    assert found["parameters"]["hardware_fault"]["drift"] == -0.06
    assert "Look at the hardware of V3" in (result / "V3.html").read_text()
    assert calibrator("report", result).returncode == 0
    assert (result / "report.html").exists()
