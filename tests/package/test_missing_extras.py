"""What a command says whose extra is missing is one line, and doing what it says helps."""

import re
from pathlib import Path

import can
import pytest

from tests.package.clean_venv import new_venv

LAYOUT = ("--layout", "my_car.toml")
STEPS: dict[str, tuple[tuple[str, ...], str]] = {
    "calibrator": (("--version",), "calibrator: typer is not installed; "),
    "demo": (
        ("simulate", *LAYOUT, "--vehicles", "2", "--minutes", "1", "--out", "two"),
        "calibrator: builtin drives need fastsim; install the extra: ",
    ),
    "mf4": (("kirchhoff", "drive.mf4", *LAYOUT), "calibrator: drive.mf4: reading MF4 needs asammdf; "),
    "cluster": (  # what is missing is told before the fleet is read, which takes hours
        ("calibrate", "none", *LAYOUT, "--scheduler", "tcp://127.0.0.1:9", "--out", "never"),
        "calibrator: --scheduler needs Dask: ",
    ),
}
"""By extra, from the lightest on: arguments of a command that needs it, and what that says without it."""


@pytest.fixture
def mf4(car: Path, drive: Path) -> None:
    with can.Logger(car / "drive.mf4") as log:
        for frame in can.LogReader(drive):
            log(frame)


@pytest.mark.usefixtures("mf4")
def test_doing_what_a_command_without_its_extra_says_makes_it_work(wheel: Path, car: Path, tmp_path: Path) -> None:
    venv = new_venv(tmp_path / "growing", wheel)
    for extra, (arguments, words) in STEPS.items():
        done = venv.run("calibrator", *arguments, folder=car)
        assert done.returncode == 1, (extra, done.stderr)
        assert done.stderr.startswith(words)
        assert done.stderr.count("\n") == 1
        (remedy,) = re.findall(r"pip install '(\S+)'", done.stderr)
        assert remedy == f"hv-current-correction[{extra}]"
        venv.install(remedy)
        done = venv.run("calibrator", *arguments, folder=car)
        assert "pip install" not in done.stderr
        assert done.returncode != 70
        assert "Traceback" not in done.stderr
