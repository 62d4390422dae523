"""A proposed layout as TOML, every guess with its reason."""

import json
import os
import textwrap
from pathlib import Path

from calibrator.proposal.branches import ProposedBranch
from calibrator.proposal.propose import Proposal
from calibrator.proposal.targets import checked_messages
from ecu_node.errors import printable

__all__ = ["layout_text"]

_WIDTH = 80
"""Columns of a terminal, into which remarks are folded; keys and values stay whole."""


def layout_text(proposal: Proposal, out: Path | None) -> str:
    """Write a proposed layout.

    Parameters
    ----------
    proposal : Proposal
        What was guessed.
    out : Path or None
        File that the text is for; the DBC is named relative to its folder. None: relative to this folder.

    Returns
    -------
    str
        A layout; its remarks ``# confirm:`` say what was guessed, and why.
    """
    lines = [*_head(proposal, out)]
    if checked := checked_messages(proposal.branches):
        lines += _folded(f"confirm: {', '.join(checked)} seem to be protected end to end: say how in [e2e]")
    for branch in proposal.branches:
        lines += ["", *_branch(proposal, branch)]
    for item in proposal.inputs:
        lines += ["", "[[input]]", f"name = {_text(item.name)}"]
        lines += _guess(item.signal.about, f"signal = {_text(item.signal.name)}")
    for derived in proposal.derived:
        remark = f"   # {derived.remark}" if derived.remark else ""
        lines += ["", "[[derived]]", f"name = {_text(derived.name)}", f"formula = {_text(derived.formula)}{remark}"]
    return "\n".join(lines) + "\n"


def _head(proposal: Proposal, out: Path | None) -> list[str]:
    source = proposal.dbc.name + (f" and {proposal.log.name}" if proposal.log is not None else "")
    folder = out.absolute().parent if out is not None else Path.cwd()
    dbc = os.path.relpath(proposal.dbc.absolute(), folder)
    lines = [
        *_folded(
            f"Guessed by 'calibrator layout init' from {source}. Confirm or correct what is marked so; then "
            f"'calibrator doctor' compares it with a log. What the keys mean: docs/layout.md"
        ),
        "schema = 1",
        f"name = {_text(proposal.name)}",
        f"dbc = {_text(dbc)}",
        *_guess(proposal.full_scale_reason, f"full_scale_a = {proposal.full_scale_a:g}"),
    ]
    model = [item.name for item in proposal.derived if item.for_vehicle]
    fleet = [item.name for item in proposal.derived]
    temperature = next((item.name for item in proposal.inputs if item.role == "sensor_temperature"), None)
    if temperature is not None:
        lines += _guess("it is that of the current sensors", f"temperature = {_text(temperature)}")
    if model:
        lines += ["# Which inputs below drive the model of one vehicle, and that of the fleet.", *_names(model)]
        lines += _names(fleet, "fleet_inputs")
    else:
        lines.append("# model_inputs = [...]   # nothing found to drive a model: 'calibrate' needs [[input]]s")
    return lines


def _names(names: list[str], key: str = "model_inputs") -> list[str]:
    lines, line = [f"{key} = ["], "   "
    for name in names:
        entry = f' "{name}",'
        if len(line) + len(entry) > _WIDTH:
            lines.append(line)
            line = "   "
        line += entry
    return [*lines, line, "]"]


def _branch(proposal: Proposal, branch: ProposedBranch) -> list[str]:
    sign = proposal.signs[branch.name]
    lines = ["[[branch]]", f"name = {_text(branch.name)}"]
    if branch.signal.quantity == "current":
        lines += _guess(branch.reason, f"signal = {_text(branch.signal.name)}")
    else:
        assert proposal.voltage is not None
        lines += _guess(branch.reason, f"power = {_text(branch.signal.name)}")
        lines.append(f"voltage = {_text(proposal.voltage.name)}")
    for item in branch.alternatives:
        lines += _folded(f"or: {_text(item.name)} ({item.about})")
    lines += _guess(sign.reason, f"sign = {sign.sign}")
    lines.append(f"timeout_s = {proposal.timeouts_s[branch.name]:g}")
    target = proposal.targets.get(branch.name)
    if target is not None:
        lines += _guess("that the node alone sends its message", f"corrected = {_text(target.corrected)}")
        lines += [f"quality = {_text(target.quality)}"] if target.quality is not None else []
    return lines


def _guess(reason: str, line: str) -> list[str]:
    """A key that was guessed, under the reason for it."""
    return [*_folded(f"confirm: {reason}"), line]


def _folded(text: str) -> list[str]:
    """A remark; texts of a DBC are kept from breaking it."""
    plain = printable(" ".join(text.split()))
    return textwrap.wrap(
        plain, _WIDTH, initial_indent="# ", subsequent_indent="#   ", break_long_words=False, break_on_hyphens=False
    )


def _text(value: str) -> str:
    return json.dumps(value, ensure_ascii=False)
