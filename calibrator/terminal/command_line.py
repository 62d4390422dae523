"""What all command lines made with typer share: how they are set up, and how they end.

Wrong use and errors are one line on standard error, with what to do; ``--debug`` shows the traceback of an error.
"""

import re
import sys
import textwrap
from collections.abc import Iterator, Sequence
from typing import Any

import typer

from calibrator.errors import ContradictionError
from ecu_node.program import DEBUG_HINT, FAILED, end_of, flush_output, say_error, split_debug

__all__ = ["EXIT_CODES", "command_app", "example", "run_app", "run_tool"]

_PACKAGES = ("calibrator", "ecu_node", "tools")
"""Packages of this program: an internal error is reported with the last place of its traceback in one of them."""
EXIT_CODES = (
    f"Exit codes: 0 done, 1 failed, 2 wrong use, 70 internal error, 130 interrupted, 143 ended by SIGTERM. {DEBUG_HINT}"
)
_HELP = ["-h", "--help"]
INTERRUPTED = 130
WRONG_USE = 2
_UsageError: Any = typer.BadParameter.__base__
"""Base class of all errors of wrong use; typer gives it no public name."""


def command_app(**settings: Any) -> typer.Typer:
    """Return a command line without commands, set up as all command lines here are.

    Parameters
    ----------
    **settings
        More arguments of ``typer.Typer``; they replace shared ones of the same name.

    Returns
    -------
    typer.Typer
        To be run by :func:`run_app`.
    """
    shared = {
        "add_completion": False,
        "pretty_exceptions_enable": False,
        "rich_markup_mode": None,
        "context_settings": {"help_option_names": _HELP},
    }
    return typer.Typer(**(shared | settings))


def example(*commands: str) -> str:
    """Return the text "Example: ..." that the help of a command shows below its options.

    Parameters
    ----------
    *commands : str
        Whole command lines; long ones are broken with a backslash.

    Returns
    -------
    str
        To be given to typer as ``epilog``.
    """
    kept = [re.sub(r"(--\S+) (?!-)", "\\1\0", line) for line in commands]  # an option stays with its value
    lines = [textwrap.wrap(line, 72, break_long_words=False, break_on_hyphens=False) for line in kept]
    return "\b\n" + "\n".join(["Example:", *("  " + " \\\n    ".join(parts) for parts in lines)]).replace("\0", " ")


def run_app(app: typer.Typer, program: str, arguments: Sequence[str]) -> int:
    """Run a command line and return its exit code; errors are printed on standard error.

    Parameters
    ----------
    app : typer.Typer
        Made by :func:`command_app`.
    program : str
        Name with which messages begin, such as ``calibrator``.
    arguments : sequence of str
        Without the program's name; ``--debug`` may stand anywhere.

    Returns
    -------
    int
        Exit code, see :data:`EXIT_CODES`.
    """
    others, debug = split_debug(arguments)
    if "" in others:
        say_error(f"{program}: an empty argument; give a value, such as '.' for this folder; see '{program} --help'")
        return WRONG_USE
    command = typer.main.get_command(app)
    for each in _all_commands(command):
        each.epilog = f"{each.epilog}\n\n{EXIT_CODES}" if each.epilog else EXIT_CODES
        each.short_help = (each.help or "").partition("\n\n")[0]  # the list of commands shows all of it, not cut
        for parameter in each.params:
            _in_words(parameter)
    try:
        code = command.main(args=others, prog_name=program, standalone_mode=False)
    except SystemExit as end:
        if isinstance(end.code, str):
            say_error(f"{program}: {end.code}")
            return FAILED
        # typer calls it a failure that nobody reads the help any more
        is_unread_help = isinstance(end.__context__, BrokenPipeError) and not set(_HELP).isdisjoint(others)
        return 0 if is_unread_help else end.code or 0
    except _UsageError as error:
        return _end_of_wrong_use(program, error)
    except Exception as error:  # noqa: BLE001 (each is reported, and ends the program)
        flush_output()  # if it was standard output that failed, this says so
        code = end_of(program, error, debug=debug, packages=_PACKAGES)
        return WRONG_USE if isinstance(error, ContradictionError) else code
    return code if isinstance(code, int) else 0


def _in_words(parameter: Any) -> None:
    """Let the help of a parameter say in plain words what to give: ``LOG`` and ``PATH``, not ``{log} <Path>``."""
    if parameter.param_type_name == "option":
        if parameter.multiple:
            parameter.help = f"{parameter.help} May be repeated."
        kind = parameter.bare_type().removeprefix("list[").rstrip("]")
        parameter.metavar = parameter.metavar or {"Path": "PATH", "str": "TEXT"}.get(kind)
        return
    parameter.metavar = parameter.metavar or parameter.name.upper()
    name = parameter.metavar + ("..." if parameter.nargs != 1 else "")
    pieces = [] if parameter.hidden else [name if parameter.required else f"[{name}]"]
    parameter.get_usage_pieces = lambda ctx: pieces  # noqa: ARG005
    parameter.display_type_rich = lambda ctx: ""  # noqa: ARG005


def run_tool(app: typer.Typer, program: str) -> None:
    """Run a command line with the arguments of this process, and end the process with the exit code."""
    try:
        code = run_app(app, program, sys.argv[1:])
        flush_output()
    except KeyboardInterrupt:
        code = INTERRUPTED
    except Exception as error:  # noqa: BLE001 (standard output that cannot be written)
        code = end_of(program, error, debug=False, packages=_PACKAGES)
    if code == INTERRUPTED:
        say_error(f"{program}: interrupted")
    sys.exit(code)


def _all_commands(command: Any) -> Iterator[Any]:
    """Yield a command, its subcommands, and theirs."""
    yield command
    for each in getattr(command, "commands", {}).values():
        yield from _all_commands(each)


def _end_of_wrong_use(program: str, error: Any) -> int:
    """Say what is wrong and where help is; show the help if there is no argument at all. Return the exit code."""
    if type(error).__name__ == "NoArgsIsHelpError":
        error.show()
        return WRONG_USE
    path = error.ctx.command_path if error.ctx is not None else program
    text = " ".join(error.format_message().split()).replace(": Value error, ", ": ").rstrip(".")
    remedy = "see that you may read it" if text.endswith("is not readable") else f"see '{path} --help'"
    say_error(f"{path}: {text}; {remedy}")
    return WRONG_USE
