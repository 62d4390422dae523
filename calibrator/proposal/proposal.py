"""Guess a layout from a database and a log, or from a table, and write its text."""

import difflib
import json
import math
import os
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from calibrator.errors import LogError, ProposalError
from calibrator.files.templates import templates_of
from calibrator.proposal.branches import (
    ONLY_CHARGING,
    TAKEN,
    close_sum,
    closure,
    find_signs,
    judge_all,
)
from calibrator.proposal.candidates import FLOWS, Candidate, of_database, of_table, with_log, with_table
from calibrator.proposal.inputs import FOR_FLEETS, computed_motor, derive, find_inputs
from calibrator.recordings.log_formats import is_table, read_frames
from calibrator.recordings.readers import other_address
from calibrator.recordings.tables import bare_name, layout_from_branches, likely_full_scale_a, read_table
from calibrator.words import places_of, words_of
from ecu_node.database import read_database
from ecu_node.errors import DatabaseError, printable
from ecu_node.layout import Layout

__all__ = ["Proposal", "candidate_lines", "layout_text", "look_at", "parsed_branches"]

TYPICAL_A = 400.0
"""Full scale of many cars' junctions, taken where neither database nor recording tells it. [A]"""
LARGEST_A = 2000.0
"""A range beyond this comes from the number of bits, not from the current. [A]"""
COMPUTED = 0.1
"""Relative standard deviation of a current computed from torque and speed, which leaves out the losses. [1]"""
OPEN = 0.6
"""A branch is missing or wrong if the sum varies by more than this share of the greatest current's variation. [1]"""
OTHER_UNIT = 100.0
"""A branch that reaches this many times the battery's current is probably in another unit. [1]"""
TIMEOUT_PERIODS, GAP_TIMES = 5.0, 1.5
"""A time-out is at least so many periods, to bridge four lost frames, and so many times the longest gap. [1]"""
LEAST_TIMEOUT_S, USUAL_TIMEOUT_S, LONGEST_TIMEOUT_S = 0.1, 0.5, 2.0
"""Shortest time-out, as the time base is 0.1 s; the one for an unknown rate; and the longest, as longer gaps are lost
frames unless all frames are that rare. [s]"""
TIMEOUT_STEP_S = 0.05
STATED = "as --branches says"
"""Reason given for a sign that the user has stated."""
SHOWN = 12
"""Most candidates that are listed, so that they fit on a screen."""
CHECKS = frozenset({"crc", "checksum", "crc8", "chk"})
"""Words in the name of a signal that protects its message."""


@dataclass(frozen=True, kw_only=True)
class Proposal:
    """Candidates for the branches and inputs of a layout, and the files that they come from.

    Attributes
    ----------
    name : str
        Name of the layout.
    database : Path or None
        The DBC, KCD, SYM or ARXML; None for a table.
    recording : Path or None
        The log or table that was looked at.
    candidates : tuple of Candidate
        All currents and powers, the branches first.
    everything : tuple of Candidate
        All signals or columns, of a database also those that are not in the log.
    found : tuple of Candidate
        Signals or columns from which branches and inputs are chosen: everything, or what the log has of it.
    voltage : Candidate or None
        Voltage by which powers are divided.
    elsewhere : str
        What :func:`.other_address` says of the first message with a current, power or voltage that comes from another
        address; empty if none does.
    """

    name: str
    database: Path | None
    recording: Path | None
    candidates: tuple[Candidate, ...]
    everything: tuple[Candidate, ...]
    found: tuple[Candidate, ...]
    voltage: Candidate | None
    elsewhere: str = ""

    @property
    def branches(self) -> list[Candidate]:
        """Candidates that are branches, in the order of a layout."""
        return [item for item in self.candidates if item.branch]

    @property
    def battery(self) -> Candidate | None:
        """Current or power of the battery, if it is taken."""
        return next((item for item in self.branches if item.place == "battery"), None)

    @property
    def files(self) -> str:
        """Names of the files, for messages."""
        return " and ".join(path.name for path in (self.database, self.recording) if path is not None)

    def unready(self) -> str:
        """Say why these branches cannot be written as a layout; empty if they can."""
        if len(self.branches) < 2:
            return "a junction has at least two branches"
        if self.voltage is None and any(item.quantity == "power" for item in self.branches):
            return "there is no voltage of the junction to divide a power by"
        if unsigned := [item.name for item in self.branches if item.wrong == "sign"]:
            return f"the log shows {unsigned[0]} signed; in the database it is unsigned: correct it"
        return ""

    def problem(self) -> str:
        """Say why the branches that were guessed make no plausible layout; empty if they do."""
        battery = self.battery
        if battery is None:
            what = "no pack current found: no candidate is the current or power of a high-voltage battery"
            return f"{what}; {self.elsewhere}" if self.elsewhere else what
        if not any(item.place in {"motor", "charger"} for item in self.branches):
            wrong = "; it is signed, and unsigned in the database" if battery.wrong == "sign" else ""
            others = f"no current or power of a motor or charger was found, nor torque and speed of a motor{wrong}"
            return f"the pack current is {battery.name}, but {others}"
        share = closure(self.branches, self.voltage)
        if share > OPEN:
            names = ", ".join(item.branch for item in self.branches)
            alike = [item for item in self.branches if item.quantity == battery.quantity]
            most = max(alike, key=lambda item: item.peak)
            unit = f"; {most.name} reaches {most.peak:,.0f}: in mA?" if most.peak > OTHER_UNIT * battery.peak else ""
            varies = f"the sum of {names} still varies by {100.0 * share:.0f} % of the greatest of them"
            return f"{varies}: a branch is missing or wrong{unit}"
        return self.unready()


def look_at(source: Path, log: Path | None, name: str) -> Proposal:
    """Guess branches among the signals of a database, with or without a log, or the columns of a table.

    Parameters
    ----------
    source : Path
        A database (DBC, KCD, SYM, ARXML), or a table.
    log : Path or None
        Beside a database, a log of the vehicle or a table of its signals: only signals in it are then candidates, and
        their values in it count.
    name : str
        Name of the layout.

    Returns
    -------
    Proposal
        :meth:`Proposal.problem` says whether its branches make a layout.

    Raises
    ------
    DatabaseError, LogError
        If one of the files cannot be used.
    ProposalError
        If a log is given beside a table.
    """
    database, elsewhere = None if is_table(source) else source, ""
    if database is None:
        if log is not None:
            raise ProposalError(f"{source}: a table, which needs no --log; leave --log {log} out")
        everything = found = of_table(read_table(source))
        log = source
    else:
        if not source.is_file():
            raise DatabaseError(f"{source}: no such file; a database (DBC, KCD, SYM, ARXML) or a table is expected")
        dbc, path = str(source.absolute()), Path("the layout")
        bare = Layout(schema=1, name=name, dbc=dbc, full_scale_a=1.0, branch=[], path=path, digest="")
        vehicle = read_database(bare)
        everything = found = of_database(vehicle.databases[""])
        if log is not None:
            frames = None if is_table(log) else read_frames(log)
            found = with_table(everything, read_table(log)) if frames is None else with_log(everything, frames)
            if frames is not None:
                flows = [item.message for item in everything if item.message and item.quantity in FLOWS]
                elsewhere = next(filter(None, (other_address(frames, flow, vehicle) for flow in flows)), "")
            if not found:
                what = "columns" if frames is None else "identifiers"
                advice = elsewhere or "check that both belong to the same vehicle"
                raise LogError(f"{log}: none of its {what} is in {source}; {advice}")
    items = judge_all(found, everything)
    battery = next((item for item in items if item.place == "battery" and item.branch), None)
    voltage = find_inputs(found, battery=battery, roles=["voltage"]).get("voltage")
    has_motor = any(item.branch.startswith("motor") for item in items)
    computed = None if battery is None or has_motor else computed_motor(found, voltage)
    if computed is not None:
        items.insert(1, replace(computed[0], place="motor", score=TAKEN, branch="motor"))
    if log is None and (has_motor or computed is not None):
        items = [
            replace(item, branch="", why=ONLY_CHARGING) if item.branch.startswith("charger") else item for item in items
        ]
    items = close_sum(items, voltage)
    signed = iter(find_signs([item for item in items if item.branch], voltage))
    return Proposal(
        name=name,
        database=database,
        recording=log,
        candidates=tuple(next(signed) if item.branch else item for item in items),
        everything=tuple(everything),
        found=tuple(found),
        voltage=voltage,
        elsewhere=elsewhere,
    )


def candidate_lines(proposal: Proposal) -> list[str]:
    """Return two lines per candidate, with score and reason: all branches, then others, up to :data:`SHOWN` in all."""
    shown, lines = proposal.candidates[: max(SHOWN, len(proposal.branches))], list[str]()
    for item in shown:
        taken = f"{item.branch} ({item.sign:+d})" if item.branch else "not taken"
        lines += [f"{item.points:3.0f}  {taken:<17} {item.name}", f"     {item.why or item.about}"[:79]]
    if left := len(proposal.candidates) - len(shown):
        lines.append(f"     and {left} more, of fewer points (--json has them all)")
    return [*map(printable, lines)]


def parsed_branches(text: str, proposal: Proposal) -> Proposal:
    """Return the proposal with the branches that a text such as ``battery=Ibat,-motor=Imot`` names.

    Parameters
    ----------
    text : str
        Branches in the form of :func:`.layout_from_branches`, by columns or by signals: ``Message.Signal``, or the
        signal alone where that is clear.
    proposal : Proposal
        Proposal with the candidates to choose from.

    Raises
    ------
    LayoutError
        If the text is not of that form.
    ProposalError
        If no current or power has such a name.
    """
    chosen, judged = [], {item.name: item.place for item in proposal.candidates}
    for branch in layout_from_branches(text).layout.branch:
        item = _named(branch.source, proposal)
        place = next(iter(places_of(words_of(branch.name))), judged.get(item.name, ""))
        item = replace(item, quantity=item.quantity or "current", place=place, score=100.0, why="", branch=branch.name)
        chosen.append(replace(item, sign=branch.sign, sign_reason=STATED))
    made = replace(proposal, candidates=tuple(chosen))
    return replace(made, voltage=find_inputs(made.found, battery=made.battery, roles=["voltage"]).get("voltage"))


def _named(wanted: str, proposal: Proposal) -> Candidate:
    """Return the only candidate with this name, or this last part of its name; ProposalError if none or several fit."""
    items = (*proposal.everything, *proposal.found)
    known = {item.name: item for item in items if item.quantity in {"current", "power", ""}}
    same = [name for name in known if wanted in {name.rpartition(".")[2], bare_name(name)}]
    if wanted in known or len(same) == 1:
        return known[wanted if wanted in known else same[0]]
    near = same or difflib.get_close_matches(wanted, known, n=3, cutoff=0.4) or list(known)[:8]
    what = "stands for several" if same else "is no current or power there"
    raise ProposalError(f"{proposal.files}: {wanted!r} {what}; there are {', '.join(near) or 'none'}")


# ---- text


def layout_text(proposal: Proposal, out: Path | None) -> str:
    """Return the text of a layout (TOML).

    Parameters
    ----------
    proposal : Proposal
        Proposal with at least two branches.
    out : Path or None
        File that the text is for; the database is named relative to its folder. None: relative to the current folder.

    Returns
    -------
    str
        Text of the layout; its remarks ``# confirm:`` say what was guessed, and why.
    """
    branches = proposal.branches
    inputs = find_inputs(proposal.found, battery=proposal.battery, taken={item.name for item in branches})
    if any(item.formula for item in branches) and (computed := computed_motor(proposal.found, proposal.voltage)):
        inputs = computed[1] | {name: item for name, item in inputs.items() if name not in computed[1]}
    scale_a, scale_reason = _full_scale(proposal)
    messages = {item.message.name: item.message for item in branches if item.message}
    folder = out.absolute().parent if out is not None else Path.cwd()
    environment = templates_of("calibrator.proposal")
    # A text from the database must not end the remark that it stands in.
    environment.filters["plain"] = lambda text: printable(" ".join(text.split()))
    environment.filters["toml"] = partial(json.dumps, ensure_ascii=False)
    text: str = environment.get_template("layout.toml.jinja").render(
        proposal=proposal,
        dbc=proposal.database and os.path.relpath(proposal.database.absolute(), folder),
        scale_a=scale_a,
        scale_reason=scale_reason,
        inputs=inputs,
        derived=derive(inputs),
        model_inputs=[name for name in derive(inputs) if not name.startswith(FOR_FLEETS)],
        wrong_ranges=[item.name for item in (*branches, *inputs.values()) if item.wrong == "range"],
        checked=[name for name, m in messages.items() if any(CHECKS & set(words_of(s.name)) for s in m.signals)],
        taken=TAKEN,
        stated=STATED,
        uncertainty=COMPUTED,
        timeout_s=_timeout_s,
    )
    return text


def _full_scale(proposal: Proposal) -> tuple[float, str]:
    """Return a likely full scale of the junction [A], and where it comes from."""
    peak_a, battery = max(item.peak * (item.quantity == "current") for item in proposal.branches), proposal.battery
    if proposal.recording is not None and peak_a > 0.0:
        return likely_full_scale_a(peak_a), f"the recording reaches {peak_a:.0f} A; give the nominal maximum"
    if battery is not None and battery.quantity == "current" and battery.reach <= LARGEST_A:
        return battery.reach, f"the database lets {battery.name} reach {battery.reach:g} A"
    return TYPICAL_A, "typical of a car; nothing tells it"


def _timeout_s(item: Candidate) -> float:
    """Return the time-out of a branch, from the cycle time in the database or the frames of a recording. [s]"""
    steps_s = np.diff(item.channel.time_s) if item.channel is not None else np.zeros(0)
    period_s = (item.message.cycle_time or 0) * 1e-3 if item.message is not None else 0.0
    wanted_s = min(TIMEOUT_PERIODS * period_s or USUAL_TIMEOUT_S, LONGEST_TIMEOUT_S)
    if len(steps_s):
        longest_s = min(GAP_TIMES * float(steps_s.max()), LONGEST_TIMEOUT_S)
        wanted_s = max(TIMEOUT_PERIODS * float(np.median(steps_s)), longest_s)
    return max(round(math.ceil(wanted_s / TIMEOUT_STEP_S - 1e-9) * TIMEOUT_STEP_S, 3), LEAST_TIMEOUT_S)
