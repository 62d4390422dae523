import json
import os
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


def test_the_page_of_a_vehicle_is_named_after_it(
    result: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert run_command(["report", str(result), "--vehicle", "V3", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["page"] == "V3.html"
    assert found["parameters"]["hardware_fault"]["drift"] == -0.06
    assert "Look at the hardware of V3" in (tmp_path / "V3.html").read_text()


def test_a_limit_that_no_battery_has_is_refused(
    result: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "page.html"
    assert run_command(["report", str(result), "--out", str(out), "--limit", "-3"]) == 2
    assert "expected a number from 0.1 to 10000" in capsys.readouterr().err
    assert not out.exists()


def test_the_page_of_a_vehicle_has_its_margin(result: Path, tmp_path: Path) -> None:
    out = tmp_path / "page.html"
    assert run_command(["report", str(result), "--vehicle", "V1", "--limit", "300", "--out", str(out)]) == 0
    assert "<b>34.0 A</b> given back" in out.read_text()


def test_a_pipe_is_not_replaced_by_a_page(result: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pipe = tmp_path / "pipe.html"
    os.mkfifo(pipe)
    assert run_command(["report", str(result), "--out", str(pipe)]) == 1
    assert "is no file but a device, pipe or socket" in capsys.readouterr().err
    assert pipe.is_fifo()


def test_a_recording_is_not_replaced_by_a_page(
    result: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "drive.csv").write_text("t,a")
    assert run_command(["report", str(result), "--out", str(tmp_path / "drive.csv")]) == 2
    assert "drive.csv: expected a file name that ends with .html" in capsys.readouterr().err
    assert (tmp_path / "drive.csv").read_text() == "t,a"


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda folder: folder / "missing", "not a result of 'calibrator calibrate'"),
        (lambda folder: folder, "not a result of 'calibrator calibrate'"),
    ],
)
def test_what_is_no_result_is_told_in_one_line(
    tmp_path: Path, make: "object", message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert callable(make)
    assert run_command(["report", str(make(tmp_path)), "--out", str(tmp_path / "page.html")]) == 1
    told = capsys.readouterr().err
    assert told.count("\n") == 1
    assert message in told
    assert not (tmp_path / "page.html").exists()
