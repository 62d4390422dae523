"""Every extra, installed alone, makes its commands work."""

import json
import os
import re
import subprocess
import sys
import time
from pathlib import Path

import can
import pytest

from tests.package.clean_venv import CleanVenv, new_venv
from tests.package.conftest import VEHICLE, Installed

EXTRAS = ("bench", "calibrator", "cluster", "demo", "docs", "mf4", "update")
LAYOUT = ("--layout", "my_car.toml")


def calibrator(venv: CleanVenv, folder: Path, *arguments: object) -> str:
    """What a command prints that must succeed."""
    done = venv.run("calibrator", *arguments, folder=folder)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.parametrize("extra", EXTRAS)
def test_each_extra_alone_installs_without_conflicts(installed: Installed, extra: str, car: Path) -> None:
    venv = installed(extra)
    done = venv.run("python", "-m", "pip", "check", folder=car)
    assert done.returncode == 0, done.stdout
    assert venv.run("ecu-node", "schema", folder=car).returncode == 0


@pytest.mark.parametrize("interpreter", os.environ.get("HV_PYTHONS", "").split() or [sys.executable])
def test_calibrator_extra_suffices_from_logs_to_parameters_reports_and_exports(
    interpreter: str, wheel: Path, car: Path, fleet: Path, drive: Path, tmp_path: Path
) -> None:
    venv, result = new_venv(tmp_path / "environment", wheel, "calibrator", interpreter=interpreter), tmp_path / "result"
    layout = ("--layout", car / "my_car.toml")
    calibrator(venv, tmp_path, "import", fleet / "logs", *layout, "--out", "store")
    calibrator(venv, tmp_path, "calibrate", "store", *layout, "--out", result)
    calibrator(venv, tmp_path, "score", result, "--truth", fleet / "truth.json")
    calibrator(venv, tmp_path, "report", result)
    assert "<script>" in (result / "report.html").read_text()
    calibrator(venv, tmp_path, "report", result, "--vehicle", VEHICLE, "--out", "vehicle.html")
    parameters = result / "params" / f"{VEHICLE}.json"
    for kind in ("dcm", "cdfx", "c"):
        calibrator(venv, tmp_path, "export", parameters, *layout, "--format", kind, "--out", f"out-{kind}")
    calibrator(venv, tmp_path, "layout", "init", car / "hv_powertrain.dbc", "--log", drive, "--out", "guessed.toml")
    assert json.loads(calibrator(venv, tmp_path, "kirchhoff", drive, *layout, "--plot", "x.html", "--json"))["instants"]
    played = calibrator(venv, tmp_path, "replay", drive, "--interface", "virtual", "--channel", "x", "--speed", 0)
    assert " frames in " in played
    checked = venv.run("ecu-node", "check", "--params", parameters, *layout, "--vehicle", VEHICLE, folder=tmp_path)
    assert (checked.returncode, checked.stderr) == (0, "")


def test_update_extra_lets_a_vehicle_take_what_the_calibrator_published(
    installed: Installed, car: Path, tmp_path: Path
) -> None:
    off_board, on_board = installed("calibrator"), installed("update")
    calibrator(off_board, tmp_path, "repository", "key", "anna", "--no-passphrase", "--out", ".")
    roles = [word for role in ("root", "targets", "snapshot", "timestamp") for word in (f"--{role}", "anna.pub")]
    for words in (["init", *roles], ["add", car / "V001.json"], ["publish", "--key", "anna.key"], ["bundle", VEHICLE]):
        more = ["--out", "."] if words[0] == "bundle" else []
        calibrator(off_board, tmp_path, "repository", words[0], "repo", *words[1:], *more)
    root = ("--root", tmp_path / "repo" / "metadata" / "1.root.json")
    state, layout = ("--state", tmp_path / "state"), ("--layout", car / "my_car.toml")
    for command in (
        ("provision", "--vehicle", VEHICLE, *root, *state),
        ("update", tmp_path / f"{VEHICLE}.json.xz", *state, *layout),
        ("report", "--key", tmp_path / "anna.key", *state),
    ):
        done = on_board.run("ecu-node", *command, folder=tmp_path)
        assert done.returncode == 0, done.stderr


def test_c_core_of_the_wheel_compiles_with_its_export(installed: Installed, car: Path, tmp_path: Path) -> None:
    venv = installed("calibrator")
    layout = ("--layout", car / "my_car.toml")
    calibrator(venv, tmp_path, "export", car / "V001.json", *layout, "--format", "c", "--out", "hv_calibration.c")
    code = "import ecu_node; print(ecu_node.__path__[0])"
    core = Path(venv.run("python", "-c", code, folder=tmp_path).stdout.strip()) / "c"
    sources = (str(core / "hv_correction.c"), "hv_calibration.c")
    subprocess.run(["gcc", "-std=c99", f"-I{core}", "-c", *sources], cwd=tmp_path, check=True)


def test_cluster_extra_calibrates_through_a_dask_scheduler(
    installed: Installed, car: Path, fleet: Path, tmp_path: Path
) -> None:
    venv, file = installed("cluster"), tmp_path / "scheduler.json"
    code = (
        "import sys, time; from distributed import LocalCluster\n"
        "if __name__ == '__main__':\n"
        "    cluster = LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address=None)\n"
        "    open(sys.argv[1], 'w').write(cluster.scheduler_address); time.sleep(600)\n"
    )
    (tmp_path / "cluster.py").write_text(code)
    command = [venv.program("python"), "cluster.py", str(file)]
    with subprocess.Popen(command, cwd=tmp_path, env=venv.environment) as cluster:
        try:
            while not (file.exists() and file.read_text()):
                assert cluster.poll() is None
                time.sleep(0.1)
            options = ("--layout", car / "my_car.toml", "--scheduler", file.read_text(), "--out", "result")
            calibrator(venv, tmp_path, "calibrate", fleet, *options)
        finally:
            cluster.terminate()
    assert (tmp_path / "result" / "results.parquet").is_file()


def test_extra_bench_suffices_to_compare_the_posterior_with_basis_pursuit(installed: Installed, unpacked: Path) -> None:
    command = ("-m", "bench", "posterior", "--quick")
    done = installed("bench").run("python", *command, folder=unpacked / "tools")
    assert done.returncode == 0, done.stderr
    found = json.loads((unpacked / "build" / "bench.json").read_text())
    assert any("basis pursuit" in (row["peer"] or "") for row in found)


def test_docs_are_built_from_the_source_distribution(installed: Installed, unpacked: Path) -> None:
    venv = installed("docs")
    path = os.pathsep.join([str(venv.folder / "bin"), venv.environment["PATH"]])
    environment = {**venv.environment, "PYTHONPATH": str(unpacked / "tools"), "PATH": path}
    options = ("--quiet", "--fail-on-warning", "--conf-dir", "docs", "--doctree-dir", "build/doctrees")
    with_tools = CleanVenv(folder=venv.folder, environment=environment)
    done = with_tools.run("sphinx-build", *options, ".", "build/docs", folder=unpacked)
    assert done.returncode == 0, done.stderr
    assert (unpacked / "build" / "docs" / "docs" / "index.html").is_file()


# A command without its extra names the extra, and installing it helps


STEPS: dict[str, tuple[tuple[str, ...], str]] = {
    "calibrator": (("--version",), "calibrator: typer is not installed; "),
    "demo": (
        ("simulate", *LAYOUT, "--vehicles", "2", "--minutes", "1", "--out", "two"),
        "calibrator: builtin drives need fastsim; install the extra: ",
    ),
    "mf4": (("kirchhoff", "drive.mf4", *LAYOUT), "calibrator: drive.mf4: reading MF4 needs asammdf; "),
    "cluster": (  # what is missing is reported before the fleet is read, which takes hours
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
def test_command_works_after_installing_the_extra_that_it_asks_for(wheel: Path, car: Path, tmp_path: Path) -> None:
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
        assert done.returncode == (1 if extra == "cluster" else 0), "there is no scheduler"
        assert "Traceback" not in done.stderr
