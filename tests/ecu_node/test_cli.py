"""The command line: exit codes, one-line messages, and light imports."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import msgspec
import pytest

from ecu_node.cli import run_ecu_node
from ecu_node.database import VehicleDatabase
from ecu_node.parameters import write_parameters
from tests.ecu_node.vehicles import LAYOUT, SMALL_DBC, SMALL_LAYOUT, MakeDatabase, parameters_for


@pytest.fixture
def params(database: VehicleDatabase, tmp_path: Path) -> Path:
    path = tmp_path / "v1.json"
    write_parameters(parameters_for(database, battery=(0.25, 5.0), motor=(0.0, 0.0)), path)
    return path


def check(params: Path, *more: str, layout: Path = LAYOUT) -> list[str]:
    return ["check", "--params", str(params), "--layout", str(layout), *more]


def test_check_shows_parameters_that_fit_with_their_integer_plan(
    params: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run_ecu_node(check(params, "--vehicle", "v1", "--json")) == 0
    report = json.loads(capsys.readouterr().out)
    assert (report["fit"], report["reason"], report["vehicle"], report["parameter_set"]) == (True, "NONE", "v1", 300)
    battery, motor = report["branches"]["battery"], report["branches"]["motor"]
    assert (battery["drift"], battery["offset_a"], battery["applied"]) == (0.25, 5.0, True)
    assert battery["target"] == "HV_BatteryCorrected.BatteryCurrentCorrected"
    assert battery["plan"]["gain"] / 2 ** battery["plan"]["shift"] == pytest.approx(1 / 1.25)
    assert battery["plan"]["bias"] / 2 ** battery["plan"]["shift"] == pytest.approx(-5.0 / 1.25 / 0.02)
    assert motor["plan"]["gain"] == 2 ** motor["plan"]["shift"]
    assert not report["branches"]["dcdc"]["applied"]
    assert run_ecu_node(check(params)) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "vehicle v1, parameter set 300: fit"
    assert re.fullmatch(r"battery +\+25\.0000% +\+5\.000 A  corrected", lines[2])
    assert lines[3] == "  target HV_BatteryCorrected.BatteryCurrentCorrected"
    assert lines[4].startswith("  gain ")
    assert any(re.fullmatch(r"dcdc .* passed through", line) for line in lines)
    assert max(map(len, lines)) <= 80


RUN = "run --unsigned --params p --layout l --channel c0"


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (f"{RUN} --gateway c0", "c0 is the bus of the sensors itself; two"),
        (f"{RUN} --gateway c1 --listen-only", "a gateway must pass frames on"),
        ("run --unsigned --state s --layout l --channel c0", "--state holds signed parameters; leave --unsigned out"),
        ("run --params p --layout l --channel c0", "--params names a file that nobody signed: give --state"),
        (f"{RUN} --telemetry udp://h", "is expected, found 'udp://h'"),
        (f"{RUN} --telemetry udp://:5000", "is expected, found 'udp://:5000"),
        (f"{RUN} --telemetry mqtt://h:1", "is expected, found 'mqtt://h:1'"),
        (f"{RUN} --telemetry=", "is expected, found none"),
        ("monitor --layout l --channel c --json", "--json needs --once SECONDS"),
        ("monitor --layout l --channel c --once 0", "'0': expected a number of seconds above 0, at most 86400"),
        (f"template --layout l --vehicle {'v' * 65}", "of at most 64 characters, found 65 characters"),
        ("template --layout l --vehicle \x07", r"printable and of at most 64 characters, found '\x07'"),
        ("template --layout l --vehicle=", "--vehicle: the identity of the vehicle is expected"),
    ],
)
def test_wrong_use_prints_one_line_and_exits_with_2(
    arguments: str, words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit, match="2"):
        run_ecu_node(arguments.split(" "))
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("ecu-node")
    assert words in line


def test_layout_without_signals_for_corrected_currents_needs_a_gateway(
    make_database: MakeDatabase, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The options of run are those of check."""
    bare = re.sub(r', (corrected|quality) = "[\w.]+"', "", SMALL_LAYOUT)
    database = make_database(bare)
    write_parameters(parameters_for(database, battery=(0.1, 1.0)), tmp_path / "v1.json")
    options = check(tmp_path / "v1.json", layout=database.layout.path)
    assert run_ecu_node(options) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert "page 'Layout'" in line
    assert line.endswith("--gateway CHANNEL")
    assert run_ecu_node([*options, "--gateway", "can1", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["branches"]["battery"]["target"] == "Pair.Battery"


def test_check_shows_which_fault_is_not_applied_and_why(
    database: VehicleDatabase, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    parameters = msgspec.structs.replace(parameters_for(database, battery=(0.25, 5.0)), vehicle="v\x1b[2J")
    held = msgspec.structs.replace(parameters.branches["battery"], apply=False)
    write_parameters(msgspec.structs.replace(parameters, branches={"battery": held}), tmp_path / "v1.json")
    assert run_ecu_node(check(tmp_path / "v1.json")) == 0
    text = capsys.readouterr().out
    assert '+5.000 A  passed through, "apply" is false' in text
    assert "vehicle v\\x1b[2J, parameter set 300: fit" in text, "a stranger's name moves no cursor"


def test_check_warns_that_can_fd_messages_need_the_fd_option(
    make_database: MakeDatabase, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    database = make_database(dbc=SMALL_DBC.replace("PairOut: 8", "PairOut: 12"))
    write_parameters(parameters_for(database, battery=(0.1, 1.0)), tmp_path / "v1.json")
    assert run_ecu_node(check(tmp_path / "v1.json", layout=database.layout.path)) == 0
    assert "warning: CAN FD messages (PairOut): 'ecu-node run' needs --fd" in capsys.readouterr().out


def test_check_of_unfit_parameters_exits_with_1_and_gives_the_reason(
    params: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert run_ecu_node(check(params, "--vehicle", "v2", "--json")) == 1
    report = json.loads(capsys.readouterr().out)
    assert (report["fit"], report["reason"]) == (False, "WRONG_VEHICLE")
    assert report["message"] == f"{params}: parameters are for vehicle 'v1', this is 'v2'"
    monkeypatch.setenv("ECU_NODE_VEHICLE", "v2")
    assert run_ecu_node(check(params)) == 1
    assert capsys.readouterr().out.startswith(f"NOT FIT (WRONG_VEHICLE): {params}: parameters are for vehicle 'v1'")


@pytest.mark.parametrize("command", ["check", "schema", "--help"])
def test_closed_output_pipe_causes_no_traceback(params: Path, command: str) -> None:
    arguments = check(params) if command == "check" else [command]
    reading, writing = os.pipe()
    os.close(reading)
    program = [sys.executable, "-m", "ecu_node", *arguments]
    with os.fdopen(writing, "w") as closed:
        done = subprocess.run(program, stdout=closed, stderr=subprocess.PIPE, text=True, timeout=60, check=False)
    assert (done.returncode, done.stderr) == (1, "")


def test_node_does_not_import_numpy_pandas_or_asammdf(params: Path) -> None:
    code = (
        "import sys; from ecu_node.cli import run_ecu_node; "
        f"assert 'can' not in sys.modules; run_ecu_node({check(params)!r}); import can; "
        "assert not {'numpy', 'pandas', 'asammdf'} & set(sys.modules), 'heavy'"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False)
    assert result.returncode == 0, result.stderr
