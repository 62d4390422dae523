"""The command line: exit codes, one line for every error, and light imports."""

import json
import os
import pickle
import re
import subprocess
import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace

from ecu_node import cli
from ecu_node.cli import template_text
from ecu_node.core.status import Reason, TrustError
from ecu_node.database import VehicleDatabase
from ecu_node.errors import LayoutError, UserError
from ecu_node.parameters import write_parameters
from ecu_node.program import FAILED, INTERNAL_ERROR, end_of, split_debug
from tests.ecu_node.processes import ecu_node
from tests.ecu_node.vehicles import LAYOUT, SMALL_DBC, SMALL_LAYOUT, MakeDatabase, parameters_for
from tests.update.damage import a_device, a_folder, a_pipe, huge


@pytest.fixture
def params(database: VehicleDatabase, tmp_path: Path) -> Path:
    path = tmp_path / "v1.json"
    write_parameters(parameters_for(database, battery=(0.25, 5.0), motor=(0.0, 0.0)), path)
    return path


def check(params: Path, *more: str, layout: Path = LAYOUT) -> list[str]:
    return ["check", "--params", str(params), "--layout", str(layout), *more]


# ---- what 'check' and 'template' print


def test_check_shows_fit_parameters_and_their_integer_plan(params: Path) -> None:
    report = json.loads(ecu_node(*check(params, "--vehicle", "v1", "--json")).out)
    assert (report["fit"], report["reason"], report["vehicle"], report["parameter_set"]) == (True, "NONE", "v1", 300)
    battery, motor = report["branches"]["battery"], report["branches"]["motor"]
    assert (battery["drift"], battery["offset_a"], battery["applied"]) == (0.25, 5.0, True)
    assert battery["target"] == "HV_BatteryCorrected.BatteryCurrentCorrected"
    assert battery["plan"]["gain"] / 2 ** battery["plan"]["shift"] == pytest.approx(1 / 1.25)
    assert battery["plan"]["bias"] / 2 ** battery["plan"]["shift"] == pytest.approx(-5.0 / 1.25 / 0.02)
    assert motor["plan"]["gain"] == 2 ** motor["plan"]["shift"]
    assert not report["branches"]["dcdc"]["applied"]
    code, out, _ = ecu_node(*check(params))
    lines = out.splitlines()
    assert code == 0
    assert lines[0] == "vehicle v1, parameter set 300: fit"
    assert re.fullmatch(r"battery +\+25\.0000% +\+5\.000 A  corrected", lines[2])
    assert lines[3] == "  target HV_BatteryCorrected.BatteryCurrentCorrected"
    assert lines[4].startswith("  gain ")
    assert any(re.fullmatch(r"dcdc .* passed through", line) for line in lines)
    assert max(map(len, lines)) <= 80


def test_check_of_unfit_parameters_exits_with_1_and_says_why(params: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    done = ecu_node(*check(params, "--vehicle", "v2", "--json"))
    report = json.loads(done.out)
    assert (done.code, report["fit"], report["reason"]) == (1, False, "WRONG_VEHICLE")
    assert report["message"] == f"{params}: parameters are for vehicle 'v1', this is 'v2'"
    monkeypatch.setenv("ECU_NODE_VEHICLE", "v2")
    done = ecu_node(*check(params))
    assert (done.code, done.err) == (1, "")
    assert done.out.startswith(f"NOT FIT (WRONG_VEHICLE): {params}: parameters are for vehicle 'v1'")


def test_layout_without_corrected_signals_fits_only_a_gateway(make_database: MakeDatabase, tmp_path: Path) -> None:
    """'ecu-node run' has the same option --gateway."""
    database = make_database(re.sub(r', (corrected|quality) = "[\w.]+"', "", SMALL_LAYOUT))
    write_parameters(parameters_for(database, battery=(0.1, 1.0)), tmp_path / "v1.json")
    options = check(tmp_path / "v1.json", layout=database.layout.path)
    code, _, err = ecu_node(*options)
    assert (code, err.count("\n")) == (1, 1)
    assert "page 'Layout'" in err
    assert err.endswith("--gateway CHANNEL\n")
    report = json.loads(ecu_node(*options, "--gateway", "can1", "--json").out)
    assert report["branches"]["battery"]["target"] == "Pair.Battery"


NARROW_AND_FD = SMALL_DBC.replace("PairOut: 8", "PairOut: 12").replace("1- (0.1,0) [-3000|3000]", "1- (0.1,0) [-50|50]")


def test_check_warns_of_unapplied_faults_fd_and_narrow_signals(make_database: MakeDatabase, tmp_path: Path) -> None:
    database = make_database(dbc=NARROW_AND_FD)
    parameters = parameters_for(database, battery=(0.25, 5.0))
    held = {"battery": replace(parameters.branches["battery"], apply=False)}
    write_parameters(replace(parameters, vehicle="v\x1b[2J", branches=held), tmp_path / "v1.json")
    text = ecu_node(*check(tmp_path / "v1.json", layout=database.layout.path)).out
    assert '+5.000 A  passed through, "apply" is false' in text
    assert "vehicle v\\x1b[2J, parameter set 300: fit" in text, "a stranger's name moves no cursor"
    assert "warning: CAN FD messages (PairOut): 'ecu-node run' needs --fd" in text
    assert text.count("warning: branch") == 1
    assert "warning: branch battery: PairOut.Battery holds -50 to 50, but Pair.Battery -3000 to 3000; values" in text


@pytest.mark.parametrize(("more", "count"), [("", 2), ('\n[e2e]\nprofile = "P05"\noffset = 5\nmessages = ["Pair"]', 0)])
def test_check_of_a_gateway_warns_of_checksums_without_e2e(
    make_database: MakeDatabase, tmp_path: Path, more: str, count: int
) -> None:
    names = ("PairCRC8", "Pair_CheckSum", "Crcle", "Checked")
    signals = "".join(f' SG_ {name} : {32 + k}|1@1+ (1,0) [0|1] "" Node\n' for k, name in enumerate(names))
    database = make_database(SMALL_LAYOUT + more, SMALL_DBC.replace(" SG_ Battery : 7", f"{signals} SG_ Battery : 7"))
    write_parameters(parameters_for(database, battery=(0.25, 5.0)), tmp_path / "v1.json")
    options = check(tmp_path / "v1.json", layout=database.layout.path)
    assert ecu_node(*options).out.count("looks like a checksum") == 0
    text = ecu_node(*options, "--gateway", "can1").out
    assert text.count("looks like a checksum") == text.count("warning: message Pair: signal Pair") == count


@pytest.mark.parametrize(("load", "expected_a"), [("[unmeasured_load]\nmean_a = 6.1\nsd_a = 1.0\n", 6.1), ("", 0.0)])
def test_template_expects_the_unmeasured_load(make_database: MakeDatabase, load: str, expected_a: float) -> None:
    database = make_database(f"{SMALL_LAYOUT}{load}")
    document = json.loads(template_text(database, "v1", datetime(2026, 6, 1, 12, 0, tzinfo=UTC)))
    assert document["junction_residual"]["expected_a"] == expected_a


# ---- errors: one line each, the traceback only with --debug


ERRORS = [
    (LayoutError("my.toml: a field is wrong"), FAILED, "prog: my.toml: a field is wrong"),
    (UserError("a name\nwith a line end\x1b[31m"), FAILED, "prog: a name with a line end\\x1b[31m"),
    (PermissionError(13, "Permission denied", "out/x"), FAILED, "prog: out/x: Permission denied; see that it is "),
    (MemoryError(), FAILED, "prog: there is not enough memory; give it less at a time"),
    (TypeError("a\nb"), INTERNAL_ERROR, "prog: internal error: TypeError: a b; run again with --debug and report "),
]


@pytest.mark.parametrize(("error", "code", "text"), ERRORS)
def test_each_error_is_one_line(error: Exception, code: int, text: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert end_of("prog", error, debug=False) == code
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(text)


def test_trust_error_keeps_its_reason_when_pickled() -> None:
    found = pickle.loads(pickle.dumps(TrustError(Reason.REVOKED, "number 5 was revoked")))
    assert (type(found), found.reason, str(found)) == (TrustError, Reason.REVOKED, "number 5 was revoked")


def test_internal_error_message_names_file_and_line_of_the_fault(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object) -> None:
        raise ZeroDivisionError("nobody thought of that")

    monkeypatch.setattr(cli, "load_python_can", broken)
    code, _, err = ecu_node("schema")
    assert (code, err.count("\n")) == (INTERNAL_ERROR, 1)
    assert err.startswith("ecu-node: internal error: ZeroDivisionError: nobody thought of that (cli.py, line ")
    assert "in broken" in ecu_node("schema", "--debug").err


def test_debug_option_works_anywhere_before_a_double_dash() -> None:
    assert split_debug(["run", "--debug", "x"]) == (["run", "x"], True)
    assert split_debug(["--debug", "run", "--", "--debug"]) == (["run", "--", "--debug"], True)
    assert split_debug(["run", "--", "--debug"]) == (["run", "--", "--debug"], False)


UNSUITABLE = {
    a_pipe: "it is a pipe; a file is expected",
    a_device: "it is a device; a file is expected",
    a_folder: "it is a folder; a file is expected",
    huge: "it is larger than [0-9]+ bytes",
}
ROLES = {
    "small.dbc": "ecu-node: .*small.dbc: cannot read the DBC: ",
    "other.toml": "ecu-node: .*other.toml: cannot read the layout: ",
    "p.json": r"NOT FIT \(MALFORMED_PARAMETERS\): .*p\.json: not a parameter file: ",
}


@pytest.mark.parametrize("make", UNSUITABLE)
@pytest.mark.parametrize("role", ROLES)
def test_input_that_is_no_regular_file_or_huge_is_refused_in_one_line(make: Any, role: str, tmp_path: Path) -> None:
    """It is not read: a pipe would keep the reader waiting, and a device never ends."""
    (tmp_path / role).touch()
    make(tmp_path / role)
    (tmp_path / "small.toml").write_text(SMALL_LAYOUT)
    layout = {"small.dbc": tmp_path / "small.toml", "other.toml": tmp_path / role}.get(role, LAYOUT)
    code, out, err = ecu_node(*check(tmp_path / "p.json", layout=layout))
    assert code == 1
    assert re.match(ROLES[role] + UNSUITABLE[make], out + err)
    assert role == "p.json" or (out + err).count("\n") == 1


# ---- as a program


def program(*arguments: str, stdout: int = subprocess.PIPE, **environment: str) -> "subprocess.CompletedProcess[str]":
    command, env = [sys.executable, "-m", "ecu_node", *arguments], {**os.environ, **environment}
    return subprocess.run(command, stdout=stdout, stderr=subprocess.PIPE, text=True, timeout=60, check=False, env=env)


MONITOR = ["monitor", "--layout", str(LAYOUT), "--interface", "virtual", "--channel", "full", "--once", "0.1"]
COMMANDS = [(check(Path("p")), ""), (["--help"], ""), (["--version"], "1"), (MONITOR, "1")]


@pytest.mark.parametrize(("arguments", "unbuffered"), COMMANDS, ids=["check", "--help", "--version", "monitor"])
def test_unwritable_output_prints_one_line_and_exits_with_1(arguments: list[str], unbuffered: str) -> None:
    with Path("/dev/full").open("w") as full:
        done = program(*arguments, stdout=full.fileno(), PYTHONUNBUFFERED=unbuffered)
    line = "ecu-node: standard output: cannot write the result: No space left on device; give it somewhere else to go\n"
    assert (done.returncode, done.stderr) == (1, line)


TEMPLATE = ["template", "--layout", str(LAYOUT), "--vehicle", "v1"]
UNREAD = [(check(Path("p")), 1), (["--help"], 0), (TEMPLATE, 0), (MONITOR[:-2], 0)]


@pytest.mark.parametrize(("arguments", "code"), UNREAD, ids=["check, not fit", "--help", "template", "monitor"])
def test_closed_output_pipe_changes_no_exit_code_and_ends_the_monitor(arguments: list[str], code: int) -> None:
    reading, writing = os.pipe()
    os.close(reading)
    done = program(*arguments, stdout=writing)
    os.close(writing)
    assert (done.returncode, done.stderr) == (code, "")


def test_names_that_the_terminal_cannot_show_are_escaped() -> None:
    done = program(*check(Path("\N{SUN}.json")), PYTHONIOENCODING="ascii")
    assert (done.returncode, done.stderr) == (1, "")
    assert done.stdout.startswith("NOT FIT (NO_PARAMETERS): \\u2609.json: no such parameter file")


def test_node_imports_libraries_late_and_none_of_numpy_pandas_or_asammdf(params: Path) -> None:
    code = (
        "import sys; from ecu_node.cli import run_ecu_node; "
        "assert not {'can', 'cantools', 'cryptography'} & set(sys.modules), 'a service starts slowly'; "
        f"run_ecu_node({check(params)!r}); import can; "
        "assert not {'numpy', 'pandas', 'asammdf'} & set(sys.modules), 'heavy'"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False)
    assert result.returncode == 0, result.stderr
