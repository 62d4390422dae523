"""The systemd unit: what systemd itself says of it, and the properties that the documentation promises."""

import os
import shutil
import subprocess
from pathlib import Path

import pytest

from ecu_node.cli import main

ROOT = Path(__file__).parents[2]
DEPLOY = ROOT / "deploy"
UNIT = DEPLOY / "ecu-node@.service"
LARGEST_EXPOSURE = 1.5
"""Of 10, where 10 is a service that may do everything."""


def settings(path: Path) -> dict[str, list[str]]:
    """Settings of a unit or network file in the order of their lines; a key may come more than once."""
    found: dict[str, list[str]] = {}
    for line in path.read_text().splitlines():
        if line and not line.startswith(("#", "[")):
            key, _, value = line.partition("=")
            found.setdefault(key, []).append(value)
    return found


@pytest.fixture
def analyze() -> str:
    path = shutil.which("systemd-analyze")
    if path is None:
        pytest.skip("no systemd-analyze here (apt-get install systemd)")
    return path


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
    return subprocess.run(
        command, capture_output=True, text=True, timeout=60, check=False, stdin=subprocess.DEVNULL, env=environment
    )


def test_systemd_finds_nothing_wrong_with_it(analyze: str, unit: Path) -> None:
    result = run(analyze, "verify", "--man=no", "--recursive-errors=no", str(unit))
    about_it = [line for line in result.stderr.splitlines() if "ecu-node" in line]
    assert (result.returncode, about_it) == (0, []), result.stderr


def test_before_the_program_is_installed_the_check_of_the_installation_document_says_so(
    analyze: str, tmp_path: Path
) -> None:
    document = (UNIT.parent / "README.md").read_text()
    assert "systemd-analyze verify /etc/systemd/system/ecu-node@.service" in document
    unit = tmp_path / UNIT.name
    unit.write_text(UNIT.read_text().replace("/opt/ecu-node", f"{tmp_path}/none"))
    result = run(analyze, "verify", str(unit))
    assert result.returncode == 1
    assert f"Command {tmp_path}/none/bin/ecu-node is not executable" in result.stderr
    assert "`Command ... is not executable`" in document


def test_systemd_finds_nothing_wrong_with_its_additions(analyze: str, unit: Path) -> None:
    folder = unit.with_name(f"{unit.name}.d")
    folder.mkdir()
    for path in DEPLOY.glob("*.conf"):
        shutil.copy(path, folder)
    result = run(analyze, "verify", "--man=no", "--recursive-errors=no", str(unit))
    assert (result.returncode, [line for line in result.stderr.splitlines() if "ecu-node" in line]) == (0, [])


def test_systemd_would_find_what_is_wrong_with_it(analyze: str, unit: Path) -> None:
    unit.write_text(unit.read_text().replace("WatchdogSec=5s", "WatchdogSec=often"))
    result = run(analyze, "verify", "--man=no", "--recursive-errors=no", str(unit))
    assert "ecu-node@can0.service:" in result.stderr
    assert "Failed to parse sec value, ignoring: often" in result.stderr


def test_it_may_do_next_to_nothing(analyze: str, unit: Path) -> None:
    threshold = str(int(10 * LARGEST_EXPOSURE))
    result = run(analyze, "security", "--offline=true", "--no-pager", f"--threshold={threshold}", str(unit))
    assert result.returncode == 0, result.stdout


@pytest.mark.parametrize(
    ("key", "values"),
    [
        ("Type", ["notify"]),
        ("NotifyAccess", ["main"]),
        ("WatchdogSec", ["5s"]),
        ("Restart", ["on-failure"]),
        ("RestartSec", ["5s"]),
        ("RestartPreventExitStatus", ["2"]),
        ("StartLimitIntervalSec", ["0"]),
        ("ExecReload", ["kill -HUP $MAINPID"]),
        ("EnvironmentFile", ["/etc/ecu-node/%i.env"]),
        ("DynamicUser", ["yes"]),
        ("StateDirectory", ["ecu-node/%i"]),
        ("CapabilityBoundingSet", [""]),
        ("AmbientCapabilities", [""]),
        ("NoNewPrivileges", ["yes"]),
        ("RestrictAddressFamilies", ["AF_CAN AF_UNIX"]),
        ("ProtectSystem", ["strict"]),
        ("MemoryMax", ["128M"]),
        ("SystemCallFilter", ["@system-service", "~@privileged @resources"]),
    ],
)
def test_what_is_promised_is_there(key: str, values: list[str]) -> None:
    assert settings(UNIT)[key] == values


def test_a_gateway_gets_what_the_rules_in_the_kernel_need_and_nothing_else() -> None:
    assert settings(DEPLOY / "gateway.conf") == {
        "Wants": ["modprobe@can_gw.service"],
        "After": ["modprobe@can_gw.service"],
        "AmbientCapabilities": ["CAP_NET_ADMIN"],
        "CapabilityBoundingSet": ["CAP_NET_ADMIN"],
        "RestrictAddressFamilies": ["AF_NETLINK"],
    }


def test_the_network_file_uses_only_what_networkd_knows() -> None:
    """Keys of systemd.network(5)."""
    known = {"Name", "RequiredForOnline", "BitRate", "SamplePoint", "RestartSec"}
    found = settings(DEPLOY / "80-can0.network")
    assert found.keys() == known
    assert (found["BitRate"], found["RestartSec"]) == (["500K"], ["100ms"])


def test_the_command_of_the_unit_is_one_that_the_node_takes(capsys: pytest.CaptureFixture[str]) -> None:
    """With the example environment: all that keeps it from running is the layout that is not there."""
    environment = settings(DEPLOY / "ecu-node.env")
    values = {key: value for key, (value,) in environment.items()}
    (line,) = settings(UNIT)["ExecStart"]
    command = line.replace("%i", "can0").split()[1:]
    for key, value in values.items():
        command = [word.replace(f"${{{key}}}", value) for word in command]
    command = [part for word in command for part in values.get(word.removeprefix("$"), word).split()]
    assert command[:3] == ["run", "--channel", "can0"]
    assert main(command) == 1
    assert capsys.readouterr().err.startswith("ecu-node: /etc/ecu-node/my_car.toml: cannot read the layout: ")
