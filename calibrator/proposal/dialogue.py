"""The candidates on one screen of a terminal: arrow keys, space to take or leave, enter to write."""

import os
import re
import shutil
import sys
import termios
import tty
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

from calibrator.errors import ProposalError
from calibrator.proposal.branches import closure
from calibrator.proposal.proposal import OPEN, Proposal
from ecu_node.errors import printable

__all__ = ["ask", "candidate_lines"]

SHOWN = 12
"""Candidates in a list that nobody scrolls."""
ON, OFF = "\x1b[?1049h\x1b[?25l", "\x1b[?25h\x1b[?1049l"
"""The other screen of a terminal without a cursor, and back."""
KEYS = "up/down move   space take or leave   s turn sign   enter write   q quit"
_KEY = re.compile(rb"\x1b(?:[\[O][A-D])?|.", re.DOTALL)


def candidate_lines(proposal: Proposal) -> list[str]:
    """Candidates with score and reason, the branches first; at most :data:`SHOWN` and all branches."""
    shown = proposal.verdicts[: max(SHOWN, len(proposal.branches))]
    lines = []
    for verdict in shown:
        taken = f"{verdict.branch} ({verdict.sign:+d})" if verdict.branch else "not taken"
        lines.append(printable(f"{_points(verdict.score)}  {taken:<17} {verdict.candidate.name}"))
        lines.append(printable(f"     {verdict.why or verdict.candidate.about}"[:79]))
    left = len(proposal.verdicts) - len(shown)
    return [*lines, f"     and {left} more, of fewer points (--json has them all)"] if left else lines


def _points(score: float) -> str:
    """Score as people see it, 0 to 100."""
    return f"{min(max(score, 0.0), 100.0):3.0f}"


def ask(proposal: Proposal) -> Proposal:
    """Let somebody choose among the candidates.

    Parameters
    ----------
    proposal : Proposal
        With at least one candidate, and what would be taken without a question.

    Returns
    -------
    Proposal
        With the branches and signs that were chosen.

    Raises
    ------
    ProposalError
        If they quit.
    """
    chosen = {k: verdict.branch for k, verdict in enumerate(proposal.verdicts) if verdict.branch}
    turned: dict[int, int] = {}
    at, note = 0, ""
    with _keys() as keys:
        while True:
            current = _turned(proposal.with_branches(chosen), turned)
            _draw(_screen(current, at, note))
            key, note = next(keys), ""
            if key in {b"q", b"\x1b", b""}:
                raise ProposalError("nothing was written")
            if key in {b"\r", b"\n"}:
                note = current.unready()
                if not note:
                    return current
            elif key[-1:] in {b"A", b"k"}:
                at = max(at - 1, 0)
            elif key[-1:] in {b"B", b"j"}:
                at = min(at + 1, len(proposal.verdicts) - 1)
            elif key == b" ":
                _toggle(proposal, chosen, at)
                turned.pop(at, None)
            elif key == b"s" and at in chosen:
                turned[at] = -current.verdicts[at].sign


def _toggle(proposal: Proposal, chosen: dict[int, str], at: int) -> None:
    """Take a candidate or leave it; one battery takes the place of the other."""
    if chosen.pop(at, None) is not None:
        return
    verdict = proposal.verdicts[at]
    name = verdict.place or "branch"
    if name == "battery":
        for k in [k for k, branch in chosen.items() if branch == "battery"]:
            del chosen[k]
    names = [name, *(f"{name}_{number}" for number in range(2, len(chosen) + 3))]
    chosen[at] = next(free for free in names if free not in chosen.values())


def _turned(proposal: Proposal, turned: dict[int, int]) -> Proposal:
    verdicts = [
        replace(verdict, sign=turned[k], sign_reason="as you said") if verdict.branch and k in turned else verdict
        for k, verdict in enumerate(proposal.verdicts)
    ]
    return replace(proposal, verdicts=tuple(verdicts))


def _screen(proposal: Proposal, at: int, note: str) -> list[str]:
    columns, height = shutil.get_terminal_size()
    width, rows = columns - 1, max(height - 12, 3)
    top = min(max(at - rows + 2, 0), max(len(proposal.verdicts) - rows, 0))
    files = ", ".join(path.name for path in (proposal.database, proposal.recording) if path is not None)
    lines = [f"Which of these currents meet at the junction?   {files}", "", "      score branch       sign signal"]
    wide = max((len(v.candidate.name.rpartition(".")[2]) for v in proposal.verdicts[top : top + rows]), default=0)
    wide = min(wide, width // 2 - 10)
    for k, verdict in enumerate(proposal.verdicts[top : top + rows], start=top):
        mark, sign = ("x", f"{verdict.sign:+d}") if verdict.branch else (" ", "")
        signal = verdict.candidate.name.rpartition(".")[2][:wide]
        head = f"{'>' if k == at else ' '} [{mark}]  {_points(verdict.score)} {verdict.branch:<12} {sign:>4} "
        line = printable(f"{head}{signal:<{wide}}  {verdict.why or verdict.candidate.about}")[:width].ljust(width)
        lines.append(f"\x1b[7m{line}\x1b[0m" if k == at else line)
    hidden = len(proposal.verdicts) - top - rows
    lines += ["" if hidden <= 0 else f"       ... {hidden} more below"]
    verdict = proposal.verdicts[at]
    lines += [f"  {verdict.candidate.name}: {verdict.candidate.about}", f"  {verdict.why}"]
    lines.append(f"  sign {verdict.sign:+d}: {verdict.sign_reason}" if verdict.branch else "  not taken")
    return [*lines, "", f"  {note or _closing(proposal)}", "", f"  {KEYS}"]


def _closing(proposal: Proposal) -> str:
    count, share = len(proposal.branches), closure(proposal.branches, proposal.voltage)
    if share != share:  # noqa: PLR0124 (NaN)
        return f"{count} branches; no recording tells whether their sum closes (--log)."
    verdict = "closes" if share <= OPEN else "DOES NOT CLOSE"
    return f"The sum of these {count} {verdict}: it varies by {share:.1%} of the greatest of them."


def _draw(lines: list[str]) -> None:
    columns, _ = shutil.get_terminal_size()
    fitted = [line if line.startswith("\x1b") else printable(line)[: columns - 1] for line in lines]
    sys.stderr.write("\x1b[H" + "".join(f"{line}\x1b[K\n" for line in fitted) + "\x1b[J")
    sys.stderr.flush()


@contextmanager
def _keys() -> Iterator[Iterator[bytes]]:
    """Keys as they are pressed; the terminal is as it was afterwards."""
    terminal = sys.stdin.fileno()
    before = termios.tcgetattr(terminal)
    sys.stderr.write(ON)
    try:
        tty.setcbreak(terminal)
        yield _pressed(terminal)
    finally:
        termios.tcsetattr(terminal, termios.TCSADRAIN, before)
        sys.stderr.write(OFF)
        sys.stderr.flush()


def _pressed(terminal: int) -> Iterator[bytes]:
    while typed := os.read(terminal, 64):
        yield from _KEY.findall(typed)
    yield b""
