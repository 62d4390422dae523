"""The demo at a small size: that its steps fit together, not its figures."""

import subprocess
import sys
from pathlib import Path

import pytest

import demo

ROOT = Path(__file__).parents[2]


def run(*arguments: object) -> "subprocess.CompletedProcess[str]":
    command = [sys.executable, str(ROOT / "tools" / "demo.py"), *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False, cwd=ROOT, timeout=60)


@pytest.mark.long
def test_every_step_runs_up_to_the_picture(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(demo, "VEHICLES", 8)
    monkeypatch.setattr(demo, "BRANCHES", 2)
    monkeypatch.setattr(demo, "MINUTES", 4)
    monkeypatch.setattr(demo, "SECONDS", 1.0)
    out = tmp_path / "demo"
    demo.main(drives="builtin", out=out)
    printed = capfd.readouterr().out
    assert [line[4] for line in printed.splitlines() if line.startswith("=== ")] == list("12345")
    assert "RMSE of the sum" in printed
    assert "(confidence " in printed
    assert "put into V" in printed
    for picture in ("kirchhoff.png", "before_after.png"):
        assert (out / picture).stat().st_size > 0
    assert "#" in (out / "live.log").read_text()


def test_a_folder_that_is_not_the_demos_is_not_emptied(tmp_path: Path) -> None:
    (tmp_path / "mine").write_text("1")
    done = run("--out", tmp_path)
    assert done.returncode == 1
    assert done.stderr == f"demo: {tmp_path}: is not empty and was not made by the demo; choose another folder\n"
    assert [path.name for path in tmp_path.iterdir()] == ["mine"]


def test_a_folder_without_recordings_is_refused(tmp_path: Path) -> None:
    done = run("--drives", tmp_path, "--out", tmp_path / "out")
    assert done.returncode == 1
    assert done.stderr.startswith(f"demo: {tmp_path}: no .csv or .csv.gz in it")


def test_short_help_is_given() -> None:
    done = run("-h")
    assert (done.returncode, done.stderr) == (0, "")
    assert "--drives" in done.stdout
