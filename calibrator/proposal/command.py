"""``calibrator layout init``: a layout to begin with, from a database and a log, or from a table."""

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from calibrator.errors import ProposalError
from calibrator.files.folders import require_possible_file, write_files
from calibrator.processes.interrupts import importing
from calibrator.terminal.command_line import example
from calibrator.terminal.options import JsonOption
from calibrator.terminal.text import dumps
from ecu_node.errors import printable
from ecu_node.program import say_error, write_output

if TYPE_CHECKING:
    from calibrator.proposal.proposal import Proposal

__all__ = ["layout"]

layout = typer.Typer(help="Layouts: which signals or columns mean what.", no_args_is_help=True)


@layout.callback()
def _layout() -> None:
    """Layouts: which signals or columns mean what."""


@layout.command("init", epilog=example("calibrator layout init my_car.dbc --log drive.log --out my_car.toml"))
def propose(
    source: Annotated[
        Path, typer.Argument(help="Database of the vehicle (DBC, KCD, SYM, ARXML), or a table.", metavar="FILE")
    ],
    more: Annotated[list[Path] | None, typer.Argument(hidden=True)] = None,
    out: Annotated[Path | None, typer.Option("--out", help="File to write; without it, standard output.")] = None,
    log: Annotated[
        Path | None, typer.Option("--log", help="Log or table of a drive: only what it holds is proposed, with signs.")
    ] = None,
    branches: Annotated[
        str | None,
        typer.Option("--branches", help="No guess: battery=SIGNAL,-motor=SIGNAL, minus: positive out of the junction."),
    ] = None,
    json: JsonOption = False,
) -> None:
    """Find the branches of the junction by units, names and senders, and by what a recording shows.

    All candidates are listed with a score, and why each is not a branch. Whatever is guessed is marked in the file with
    '# confirm:' and the reason.
    """
    with importing():
        from calibrator.proposal.proposal import candidate_lines, layout_text, look_at, parsed_branches
        from calibrator.recordings.log_formats import is_log, is_table

    if more:
        line = f"calibrator layout init {source} --log {more[0]}"
        raise typer.BadParameter(f"{more[0]}: one file is expected here, and the log behind --log: {line}")
    if out is not None:
        if out.exists() or out.is_symlink():
            raise ProposalError(f"{out}: exists, and is not overwritten; choose another --out")
        require_possible_file(out)
    if source.exists() and is_log(source) and not is_table(source):
        other = f"and {log} is none; " if log is not None and not is_log(log) else ""
        raise ProposalError(f"{source}: a log, {other}the database comes first, the log behind --log")
    proposal = look_at(source, log, _name_of(out or source))
    if branches is not None:
        proposal = parsed_branches(branches, proposal)
        problem = proposal.unready()
    else:
        problem = proposal.problem()
        for line in candidate_lines(proposal) if not json else []:
            say_error(line)
    text = "" if problem else layout_text(proposal, out)
    if out is not None and text:
        write_files({out: text.encode()})
    if json:
        write_output(dumps(_as_json(proposal, out if text else None, text, problem)))
    if problem:
        raise ProposalError(f"{source}: {problem}; --branches battery=SIGNAL,-motor=SIGNAL names them without a guess")
    if json:
        return
    if out is None:
        write_output(text.rstrip("\n"))
        return
    names = ", ".join(item.branch for item in proposal.branches)
    guesses = text.count("# confirm:")
    write_output(f"{printable(str(out))}: branches {names}; {guesses} guess{'' if guesses == 1 else 'es'} to confirm")
    recording = "LOG" if proposal.recording is None else shlex.quote(str(proposal.recording))
    say_error(f"next: calibrator doctor --layout {shlex.quote(str(out))} --log {recording}")


def _as_json(proposal: "Proposal", out: Path | None, text: str, problem: str) -> dict[str, object]:
    return {
        "file": None if out is None else str(out),
        "branches": [item.branch for item in proposal.candidates if item.branch],
        "guesses": text.count("# confirm:"),
        "layout": text or None,
        "problem": problem or None,
        "candidates": [
            {
                "signal": item.name,
                "unit": item.unit,
                "place": item.place or None,
                "score": round(item.points, 1),
                "branch": item.branch or None,
                "sign": item.sign if item.branch else None,
                "why": item.why,
            }
            for item in proposal.candidates
        ],
    }


def _name_of(path: Path) -> str:
    """Return the name of a layout, made from that of its file: letters, digits and underscores."""
    letters = "".join(char if char.isascii() and char.isalnum() else "_" for char in path.name.partition(".")[0])
    return letters if letters[:1].isalpha() else f"_{letters}"
