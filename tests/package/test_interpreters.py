"""The smallest whole way, with every interpreter that HV_PYTHONS names: a fleet, its calibration, a check on board."""

import os
import sys
from pathlib import Path

import pytest

from tests.package.clean_venv import new_venv

INTERPRETERS = os.environ.get("HV_PYTHONS", "").split() or [sys.executable]


@pytest.mark.parametrize("interpreter", INTERPRETERS)
def test_a_fleet_is_calibrated_and_its_parameters_fit(interpreter: str, wheel: Path, car: Path, tmp_path: Path) -> None:
    venv = new_venv(tmp_path / "environment", wheel, "demo", interpreter=interpreter)
    layout = ("--layout", car / "my_car.toml")
    small = ("--vehicles", 6, "--currents", 2, "--minutes", 2)
    for program, *arguments in (
        ("calibrator", "simulate", *layout, *small, "--out", "fleet"),
        ("calibrator", "calibrate", "fleet", *layout, "--out", "result"),
        ("calibrator", "score", "result", "--truth", "fleet/truth.json"),
        ("calibrator", "report", "result"),
        ("ecu-node", "check", "--params", "result/params/V001.json", *layout, "--vehicle", "V001"),
        ("ecu-node", "schema"),
    ):
        done = venv.run(str(program), *arguments, folder=tmp_path)
        assert done.returncode == 0, done.stderr
        assert "Traceback" not in done.stderr
