"""``calibrator layout init``: a layout to begin with, from a DBC and a log."""

import shlex
from pathlib import Path
from typing import Annotated

import typer

from calibrator.errors import ProposalError
from calibrator.files.folders import require_possible_file
from calibrator.processes.interrupts import importing
from calibrator.terminal.options import JsonOption
from calibrator.terminal.text import dumps
from ecu_node.errors import printable
from ecu_node.failures import say_error
from ecu_node.standard_output import write_output
from ecu_node.user_files import write_atomically

__all__ = ["layout"]

layout = typer.Typer(help="Layouts: which signals of a DBC mean what.", no_args_is_help=True)


@layout.callback()
def _layout() -> None:
    """Layouts: which signals of a DBC mean what."""


@layout.command("init")
def init(
    dbc: Annotated[Path, typer.Argument(help="DBC of the vehicle.", metavar="DBC")],
    out: Annotated[Path | None, typer.Option("--out", help="File to write; without it, standard output.")] = None,
    log: Annotated[
        Path | None, typer.Option("--log", help="Log of a drive: only what is in it is proposed, and signs are told.")
    ] = None,
    json: JsonOption = False,
) -> None:
    """Propose a layout by units, names, comments and senders in a DBC, and by what a log shows.

    Whatever is guessed is marked in the file with '# confirm:' and the reason.
    """
    with importing():
        from calibrator.proposal.propose import propose_layout
        from calibrator.proposal.toml_text import layout_text
        from calibrator.recordings.frames import is_log

    if out is not None:
        if out.exists() or out.is_symlink():
            raise ProposalError(f"{out}: exists, and is not overwritten; choose another --out")
        require_possible_file(out)
    if is_log(dbc) and log is not None and not is_log(log):
        raise ProposalError(f"{dbc}: a log, and {log} is none; the DBC comes first, the log behind --log")
    proposal = propose_layout(dbc, log, _name_of(out or dbc))
    text = layout_text(proposal, out)
    names, guesses = [branch.name for branch in proposal.branches], text.count("# confirm:")
    if out is not None:
        out.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(out, text.encode())
    if json:
        file = None if out is None else str(out)
        write_output(dumps({"file": file, "branches": names, "guesses": guesses, "layout": text}))
        return
    if out is None:
        write_output(text.rstrip("\n"))
        return
    write_output(f"{printable(str(out))}: branches {', '.join(names)}; {guesses} guesses to confirm")
    shown_log = "LOG" if log is None else shlex.quote(str(log))
    say_error(f"next: calibrator doctor --layout {shlex.quote(str(out))} --log {shown_log}")


def _name_of(path: Path) -> str:
    """Name of a layout, from that of its file: letters, digits and underscores."""
    letters = "".join(char if char.isascii() and char.isalnum() else "_" for char in path.name.partition(".")[0])
    return letters if letters[:1].isalpha() else f"_{letters}"
