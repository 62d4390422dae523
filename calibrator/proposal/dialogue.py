"""The candidates on one screen of a terminal: arrow keys, space to take or leave, enter to write."""

import os
import re
import sys
import termios
import tty
from collections.abc import Mapping

from rich.console import Console
from rich.live import Live
from rich.text import Text

from calibrator.errors import ProposalError
from calibrator.proposal.proposal import Proposal
from ecu_node.errors import printable

__all__ = ["ask", "candidate_lines"]

SHOWN = 12
"""Candidates in a list that nobody scrolls."""
KEYS = "up/down move   space take or leave   enter write   q quit"
_KEY = re.compile(rb"\x1b(?:[\[O][A-D])?|.", re.DOTALL)
_MOVES = {"\x1b[A": -1, "\x1bOA": -1, "\x1b[B": 1, "\x1bOB": 1}


def candidate_lines(proposal: Proposal) -> list[str]:
    """Candidates with score and reason, the branches first; at most :data:`SHOWN` and all branches."""
    shown, lines = proposal.candidates[: max(SHOWN, len(proposal.branches))], list[str]()
    for item in shown:
        taken = f"{item.branch} ({item.sign:+d})" if item.branch else "not taken"
        lines += [f"{item.points:3.0f}  {taken:<17} {item.name}", f"     {item.why or item.about}"[:79]]
    if left := len(proposal.candidates) - len(shown):
        lines.append(f"     and {left} more, of fewer points (--json has them all)")
    return [*map(printable, lines)]


def ask(proposal: Proposal) -> Proposal:
    """Let somebody choose among the candidates; the signs follow from what is chosen.

    Parameters
    ----------
    proposal : Proposal
        With at least one candidate, and what would be taken without a question.

    Returns
    -------
    Proposal
        With the branches that were chosen.

    Raises
    ------
    ProposalError
        If they quit.
    """
    chosen = {k: item.branch for k, item in enumerate(proposal.candidates) if item.branch}
    at, note, terminal = 0, "", sys.stdin.fileno()
    before = termios.tcgetattr(terminal)
    console = Console(stderr=True, highlight=False)
    try:
        tty.setcbreak(terminal)
        with Live(console=console, screen=True, auto_refresh=False) as live:
            while True:
                live.update(_screen(proposal, chosen, at, note, console.height), refresh=True)
                typed, told, note = os.read(terminal, 64), note, ""
                for key in [part.decode(errors="replace") for part in _KEY.findall(typed)] or ["q"]:
                    at = min(max(at + _MOVES.get(key, 0), 0), len(proposal.candidates) - 1)
                    if key in {"q", "\x1b"}:
                        raise ProposalError("nothing was written")
                    if key == " ":
                        _toggle(proposal, chosen, at)
                    if key in {"\r", "\n"}:
                        made = proposal.with_branches(chosen)
                        problem = made.problem()
                        note = made.unready() or (f"enter again writes it, but {problem}" if problem else "")
                        if not note or (note == told and not made.unready()):
                            return made
    finally:
        termios.tcsetattr(terminal, termios.TCSADRAIN, before)


def _toggle(proposal: Proposal, chosen: dict[int, str], at: int) -> None:
    """Take a candidate or leave it; one battery takes the place of the other."""
    if chosen.pop(at, None) is not None:
        return
    name = proposal.candidates[at].place or "branch"
    for k in [k for k, branch in chosen.items() if branch == name == "battery"]:
        del chosen[k]
    names = [name, *(f"{name}_{number}" for number in range(2, len(chosen) + 3))]
    chosen[at] = next(free for free in names if free not in chosen.values())


def _screen(proposal: Proposal, chosen: Mapping[int, str], at: int, note: str, height: int) -> Text:
    items, rows = proposal.candidates, max(height - 10, 3)
    top = min(max(at - rows + 2, 0), max(len(items) - rows, 0))
    lines = [f"Which of these currents meet at the junction?   {proposal.files}", ""]
    for k, item in enumerate(items[top : top + rows], start=top):
        mark, name = "x" if k in chosen else " ", item.name.rpartition(".")[2]
        row = f"[{mark}] {item.points:3.0f} {chosen.get(k, ''):<12} {name:<24} {item.why or item.about}"
        lines.append(f"{'>' if k == at else ' '} {row}")
    hidden, item = len(items) - top - rows, items[at]
    lines.append(f"     ... {hidden} more below" if hidden > 0 else "")
    lines += [f"  {item.name}: {item.about}", f"  {item.why}", f"  {note}", f"  {KEYS}"]
    return Text("\n".join(map(printable, lines)), no_wrap=True, overflow="ellipsis")
