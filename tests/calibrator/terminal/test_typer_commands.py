"""What command lines made with typer share."""

import re
from collections.abc import Iterator
from typing import Any

import pytest
from typer.main import get_command

from calibrator.cli import COMMANDS as ALL
from calibrator.cli import app as calibrator_app
from calibrator.errors import ContradictionError, FleetError
from calibrator.terminal.command_line import command_app, run_app, run_tool
from ecu_node.program import write_output

app = command_app(no_args_is_help=True)


@app.command()
def fail(kind: str) -> None:
    """Raise something. And so on, with a first paragraph that is far too long for one line of a list of commands.

    The second paragraph is for the command's own help.
    """
    errors = {"user": FleetError("no fleet"), "contradiction": ContradictionError("both"), "bug": KeyError(1)}
    raise errors[kind]


@app.command()
def hello() -> None:
    """Print."""
    write_output("hello")


@pytest.mark.parametrize(("arguments", "code", "text"), [
    (["fail", "user"], 1, "prog: no fleet"),
    (["fail", "contradiction"], 2, "prog: both"),
    (["fail", "bug"], 70, "prog: internal error: KeyError: 1"),
    (["fail", "user", "--numbre", "0"], 2, "prog fail: No such option: --numbre"),
    (["fail", "user", "more\nlines"], 2, "prog fail: Got unexpected extra argument"),
])  # fmt: skip
def test_error_of_a_command_is_printed_on_one_line_and_sets_the_exit_code(
    arguments: list[str], code: int, text: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run_app(app, "prog", arguments) == code
    printed = capsys.readouterr()
    assert printed.out == ""
    (line,) = printed.err.splitlines()
    assert line.lower().startswith(text.lower())


def test_folder_that_may_not_be_read_is_named_with_what_to_do(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("os.access", lambda *_: False)  # also for root, who may read all
    assert run_app(calibrator_app, "prog", ["report", "."]) == 2
    line = "prog report: Invalid value for 'RESULT': path '.' is not readable; see that you may read it\n"
    assert capsys.readouterr().err == line


@pytest.mark.parametrize(
    "arguments", [["--debug", "fail", "user"], ["fail", "--debug", "user"], ["fail", "user", "--debug"]]
)
def test_debug_shows_the_traceback_at_any_position(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert run_app(app, "prog", arguments) == 1
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "Traceback (most recent call last):"
    assert lines[-1] == "prog: no fleet"


def test_help_is_not_truncated_and_lists_exit_codes(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_app(app, "prog", ["--help"]) == 0
    words = " ".join(capsys.readouterr().out.split())
    assert "too long for one line of a list of commands." in words
    assert "..." not in words.partition("Commands:")[2]
    assert "second paragraph" not in words
    for text in ("70 internal error", "--debug shows the traceback of an error"):
        assert text in words


COMMANDS = [[], ["layout"], ["layout", "init"], ["repository"], ["repository", "init"], ["repository", "add"]]
COMMANDS += [[name] for names in ALL.values() for name in names if [name] not in COMMANDS]


@pytest.mark.parametrize("command", COMMANDS, ids=" ".join)
def test_help_of_every_command_fits_80_columns_and_has_an_example(
    command: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    assert run_app(calibrator_app, "calibrator", [*command, "--help"]) == 0
    text = capsys.readouterr().out
    assert max(map(len, text.splitlines())) <= 80
    assert f"Example:\n    {' '.join(['calibrator', *command])} " in text
    assert re.search(r"list\[|<[a-zA-Z]+>|[{}]|e\+[0-9]", text) is None


def number_options(command: Any, *words: str) -> Iterator[list[str]]:
    """Names of commands and option, as they are typed, of each option that takes a number."""
    for name, each in getattr(command, "commands", {}).items():
        yield from number_options(each, *words, name)
    yield from ([*words, option.opts[0]] for option in command.params if option.metavar == "NUMBER")


@pytest.mark.parametrize("given", ["few", "nan", "inf"])
def test_number_options_refuse_words_nan_and_inf_with_bounds(given: str, capsys: pytest.CaptureFixture[str]) -> None:
    options = [*number_options(get_command(calibrator_app))]
    assert len(options) > 20
    for words in options:
        assert run_app(calibrator_app, "calibrator", [*words, given]) == 2
        assert re.search(f"'{words[-1]}': {given}: expected a (whole )?number from .* to", capsys.readouterr().err)


def test_ctrl_c_ends_a_tool_with_code_130(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    tool = command_app()

    @tool.command()
    def interrupted() -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("sys.argv", ["tool.py"])
    with pytest.raises(SystemExit) as end:
        run_tool(tool, "tool")
    assert end.value.code == 130
    assert capsys.readouterr().err == "tool: interrupted\n"
