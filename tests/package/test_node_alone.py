"""The wheel without extras: only its dependencies are installed, and the node checks a parameter file and runs."""

import json
import re
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from tests.package.clean_venv import ROOT, CleanVenv
from tests.package.conftest import VEHICLE, Installed

LAYOUT = ("--layout", "my_car.toml")


@pytest.fixture(scope="module")
def node(installed: Installed) -> CleanVenv:
    return installed()


def test_only_what_the_node_needs_is_installed(node: CleanVenv) -> None:
    listed = json.loads(node.run("python", "-m", "pip", "list", "--format", "json", folder=node.folder).stdout)
    names = {canonicalize_name(package["name"]) for package in listed}
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert {canonicalize_name(Requirement(text).name) for text in project["dependencies"]} < names
    pinned = set(re.findall(r"(?m)^([a-z0-9-]+)==", (ROOT / "deploy" / "requirements.txt").read_text()))
    assert names == pinned | {"hv-current-correction", "pip"}
    assert node.run("python", "-m", "pip", "check", folder=node.folder).returncode == 0


def test_node_only_install_checks_a_parameter_file(node: CleanVenv, car: Path) -> None:
    arguments = ("--params", "V001.json", *LAYOUT, "--vehicle", VEHICLE, "--json")
    done = node.run("ecu-node", "check", *arguments, folder=car)
    assert (done.returncode, done.stderr) == (0, "")
    assert json.loads(done.stdout)["branches"]["battery"]["applied"] is True


def test_node_runs_on_a_virtual_bus_until_sigterm(node: CleanVenv, car: Path) -> None:
    bus = ("--interface", "virtual", "--channel", "drive")
    options = ("--unsigned", "--params", "V001.json", *LAYOUT, "--vehicle", VEHICLE, *bus)
    program = (
        "import os, signal, sys, threading; from ecu_node.cli import run_ecu_node\n"
        "threading.Timer(5.0, os.kill, (os.getpid(), signal.SIGTERM)).start()\n"
        "sys.exit(run_ecu_node(sys.argv[1:]))"
    )
    done = node.run("python", "-c", program, "run", *options, folder=car, timeout_s=120.0)
    assert (done.returncode, done.stdout) == (0, "")
    assert "running on virtual drive, correcting battery" in done.stderr
