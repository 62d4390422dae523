"""The systemd unit: systemd verifies it, and it has the properties that the documentation promises."""

import os
import re
import runpy
import shutil
import subprocess
from pathlib import Path

import pytest

from ecu_node.cli import run_ecu_node

ROOT = Path(__file__).parents[2]
DEPLOY = ROOT / "deploy"
UNIT = DEPLOY / "ecu-node@.service"
LARGEST_EXPOSURE = 1.5
"""Largest exposure allowed by ``systemd-analyze security``; 10 is a service that may do everything."""


ANALYZE = shutil.which("systemd-analyze") or ""
with_systemd = pytest.mark.skipif(not ANALYZE, reason="no systemd-analyze here (apt-get install systemd)")


@pytest.fixture
def unit(tmp_path: Path) -> Path:
    """The unit, with a program that is there in place of the one that will be installed."""
    text = UNIT.read_text()
    assert "/opt/ecu-node/bin/ecu-node" in text
    path = tmp_path / "ecu-node@can0.service"
    path.write_text(text.replace("/opt/ecu-node/bin/ecu-node", "/bin/true"))
    return path


def run(*command: str) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "SYSTEMD_LOG_TARGET": "console", "SYSTEMD_COLORS": "0"}
    return subprocess.run(command, input="", capture_output=True, text=True, timeout=60, check=False, env=environment)


@with_systemd
@pytest.mark.parametrize("additions", [[], [*DEPLOY.glob("*.conf")]], ids=["without drop-ins", "with drop-ins"])
def test_systemd_finds_no_mistake_in_the_unit(unit: Path, additions: list[Path]) -> None:
    folder = unit.with_name(f"{unit.name}.d")
    folder.mkdir()
    for path in additions:
        shutil.copy(path, folder)
    result = run(ANALYZE, "verify", "--man=no", "--recursive-errors=no", str(unit))
    about_it = [line for line in result.stderr.splitlines() if "ecu-node" in line]
    assert (result.returncode, about_it) == (0, []), result.stderr


@with_systemd
def test_unit_has_few_privileges_according_to_systemd(unit: Path) -> None:
    threshold = str(int(10 * LARGEST_EXPOSURE))
    result = run(ANALYZE, "security", "--offline=true", "--no-pager", f"--threshold={threshold}", str(unit))
    assert result.returncode == 0, result.stdout


def test_node_accepts_the_command_line_of_the_systemd_unit(capsys: pytest.CaptureFixture[str]) -> None:
    """With the example environment only the missing layout keeps the node from running."""
    values = dict(re.findall(r"(?m)^(\w+)=(.*)$", (DEPLOY / "ecu-node.env").read_text()))
    (line,) = re.findall(r"(?m)^ExecStart=(.*)$", UNIT.read_text())
    command = line.replace("%i", "can0").split()[1:]
    for key, value in values.items():
        command = [word.replace(f"${{{key}}}", value) for word in command]
    command = [part for word in command for part in values.get(word.removeprefix("$"), word).split()]
    assert command[:3] == ["run", "--channel", "can0"]
    assert run_ecu_node(command) == 1
    assert capsys.readouterr().err.startswith("ecu-node: /etc/ecu-node/my_car.toml: cannot read the layout: ")


def test_deployed_requirements_match_the_constraints() -> None:
    for path, text in runpy.run_path(str(DEPLOY / "requirements.py"))["files"]().items():
        assert path.read_text() == text, f"{path} is out of date: run deploy/requirements.py"
