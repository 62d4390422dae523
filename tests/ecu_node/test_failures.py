"""One line for every error, the traceback only with --debug."""

import pickle

import pytest

from ecu_node import cli
from ecu_node.cli import run_ecu_node
from ecu_node.core.status import Reason, TrustError
from ecu_node.errors import LayoutError, UserError
from ecu_node.program import FAILED, INTERNAL_ERROR, end_of, split_debug


@pytest.mark.parametrize(
    ("error", "code", "text"),
    [
        (LayoutError("my.toml: a field is wrong"), FAILED, "prog: my.toml: a field is wrong"),
        (UserError("a name\nwith a line end\x1b[31m"), FAILED, "prog: a name with a line end\\x1b[31m"),
        (PermissionError(13, "Permission denied", "out/x"), FAILED, "prog: out/x: Permission denied; see that it is "),
        (MemoryError(), FAILED, "prog: there is not enough memory; give it less at a time"),
        (TypeError("a\nb"), INTERNAL_ERROR, "prog: internal error: TypeError: a b; run again with --debug and report "),
    ],
)
def test_every_error_is_reported_in_one_line(
    error: Exception, code: int, text: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert end_of("prog", error, debug=False) == code
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(text)


def test_trust_error_keeps_its_reason_when_pickled() -> None:
    found = pickle.loads(pickle.dumps(TrustError(Reason.REVOKED, "number 5 was revoked")))
    assert (type(found), found.reason, str(found)) == (TrustError, Reason.REVOKED, "number 5 was revoked")


def test_debug_option_works_anywhere_before_a_double_dash() -> None:
    assert split_debug(["run", "--debug", "x"]) == (["run", "x"], True)
    assert split_debug(["--debug", "run", "--", "--debug"]) == (["run", "--", "--debug"], True)
    assert split_debug(["run", "--", "--debug"]) == (["run", "--", "--debug"], False)


def test_internal_error_names_file_and_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def broken(*_: object) -> None:
        raise ZeroDivisionError("nobody thought of that")

    monkeypatch.setattr(cli, "load_python_can", broken)
    assert run_ecu_node(["schema"]) == INTERNAL_ERROR
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("ecu-node: internal error: ZeroDivisionError: nobody thought of that (cli.py, line ")
    assert run_ecu_node(["schema", "--debug"]) == INTERNAL_ERROR
    assert "in broken" in capsys.readouterr().err
