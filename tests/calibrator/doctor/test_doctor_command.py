import json
import subprocess
from pathlib import Path

import pytest

from calibrator.doctor.text import examination_text
from ecu_node.database import VehicleDatabase
from tests.calibrator.command_here import calibrator
from tests.calibrator.doctor.artificial_logs import examined, true_drive, write_layout, write_log


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory, database: VehicleDatabase) -> Path:
    return write_log(tmp_path_factory.mktemp("log"), true_drive(), database)


def doctor(*arguments: object) -> "subprocess.CompletedProcess[str]":
    return calibrator("doctor", *arguments)


def test_exit_code_0_without_errors_and_1_with_one(log: Path, tmp_path: Path) -> None:
    right = doctor("--layout", write_layout(tmp_path), "--log", log)
    assert (right.returncode, right.stderr) == (0, "")
    assert right.stdout.splitlines()[-1].startswith("ready for: kirchhoff, import, calibrate")
    wrong = doctor("--layout", write_layout(tmp_path, inverted=("motor",)), "--log", log)
    assert (wrong.returncode, wrong.stderr) == (1, "")
    (line,) = [line for line in wrong.stdout.splitlines() if line.startswith("error")]
    assert "motor: its sign is inverted" in line
    assert 'set sign = -1 in the [[branch]] "motor"' in line


def test_json_has_facts_findings_and_steps(log: Path, tmp_path: Path) -> None:
    layout = write_layout(tmp_path, inverted=("battery",))
    report = json.loads(doctor("--layout", layout, "--log", log, "--log", log, "--json").stdout)
    assert report["logs"] == [str(log), str(log)]
    assert report["branches"]["battery"]["in_logs"] == 2
    assert [(f["kind"], f["subject"]) for f in report["findings"] if f["severity"] == "error"] == [("sign", "battery")]
    assert report["ready"] == ["kirchhoff"]
    assert report["sum"]["mean_a"] is not None


def test_a_missing_log_and_a_missing_dbc_are_one_line(tmp_path: Path) -> None:
    done = doctor("--layout", write_layout(tmp_path), "--log", "none.log")
    assert (done.returncode, done.stdout, done.stderr) == (
        1,
        "",
        "calibrator: none.log: no such file; give a log that is there\n",
    )
    (tmp_path / "hv_powertrain.dbc").unlink()
    done = doctor("--layout", tmp_path / "layout.toml", "--log", "none.log")
    assert done.returncode == 1
    assert len(done.stderr.splitlines()) == 1
    assert doctor("--layout", tmp_path / "layout.toml").returncode == 2


def test_on_a_terminal_nothing_is_wider_than_it(log: Path, tmp_path: Path) -> None:
    found = examined(write_layout(tmp_path, inverted=("motor",)), log)
    assert all(len(line) <= 80 for line in examination_text(found, 80).splitlines())
    folded = " ".join(examination_text(found, 80).split())
    assert folded == " ".join(examination_text(found, None).split())
