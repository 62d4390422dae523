"""What a command says whose extra is missing is one line, and doing what it says helps."""

import re
from collections.abc import Callable
from pathlib import Path

import can
import pytest

from tests.package.clean_venv import CleanVenv, new_venv

LAYOUT = ("--layout", "my_car.toml")


def piped(program: str, *arguments: object) -> Callable[[CleanVenv, Path], tuple[int | None, str]]:
    """A command whose output nobody looks at."""

    def run(venv: CleanVenv, folder: Path) -> tuple[int | None, str]:
        done = venv.run(program, *arguments, folder=folder)
        return done.returncode, done.stderr

    return run


def steps() -> dict[str, tuple[Callable[[CleanVenv, Path], tuple[int | None, str]], str]]:
    """By extra, from the lightest on: what needs it, and what that says without it."""
    small = ("--vehicles", 2, "--minutes", 1)
    cluster = (
        "--scheduler",
        "tcp://127.0.0.1:9",
    )  # what is missing is told before the fleet is read, which takes hours
    return {
        "calibrator": (piped("calibrator", "--version"), "calibrator: typer is not installed; "),
        "demo": (
            piped("calibrator", "simulate", *LAYOUT, *small, "--out", "two"),
            "calibrator: builtin drives need fastsim; install the extra: ",
        ),
        "mf4": (
            piped("calibrator", "kirchhoff", "drive.mf4", *LAYOUT),
            "calibrator: drive.mf4: reading MF4 needs asammdf; ",
        ),
        "cluster": (
            piped("calibrator", "calibrate", "none", *LAYOUT, *cluster, "--out", "never"),
            "calibrator: --scheduler needs Dask: ",
        ),
    }


@pytest.fixture
def mf4(car: Path, drive: Path) -> None:
    with can.Logger(car / "drive.mf4") as log:
        for frame in can.LogReader(drive):
            log(frame)


@pytest.mark.usefixtures("mf4")
def test_doing_what_a_command_without_its_extra_says_makes_it_work(wheel: Path, car: Path, tmp_path: Path) -> None:
    venv = new_venv(tmp_path / "growing", wheel)
    for extra, (command, words) in steps().items():
        code, said = command(venv, car)
        assert code == 1, (extra, said)
        assert said.startswith(words)
        assert said.count("\n") == 1
        (remedy,) = re.findall(r"pip install '(\S+)'", said)
        assert remedy == f"hv-current-correction[{extra}]"
        venv.install(remedy)
        code, said = command(venv, car)
        assert "pip install" not in said
        assert code != 70
        assert "Traceback" not in said
