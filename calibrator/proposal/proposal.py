"""A layout as it can be guessed from a database and a log, or from a table; and its text."""

import difflib
import json
import math
import os
import textwrap
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined

from calibrator.errors import LogError, ProposalError
from calibrator.proposal.branches import (
    ONLY_CHARGING,
    TAKEN,
    Verdict,
    close_sum,
    closure,
    find_signs,
    judge_all,
    with_usual_sign,
)
from calibrator.proposal.candidates import Candidate, of_database, of_table, with_log, with_table
from calibrator.proposal.inputs import FOR_FLEETS, computed_motor, derive, find_inputs
from calibrator.recordings.frames import read_frames
from calibrator.recordings.tables import bare_name, is_table, layout_from_branches, read_table
from calibrator.words import PLACES, places_of, words_of
from ecu_node.database import read_database
from ecu_node.errors import DatabaseError, printable
from ecu_node.layout import Layout

__all__ = ["Proposal", "layout_text", "look_at", "parsed_branches"]

TYPICAL_A = 400.0
"""Full scale of many cars' junctions, where neither database nor recording tells it. [A]"""
LARGEST_A = 2000.0
"""A range beyond it is that of the number of bits, not of a current. [A]"""
HEADROOM = 2.0
"""A recorded drive hardly ever has the nominal maximum in it. [1]"""
ROUND = (1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0)
COMPUTED = 0.1
"""Relative standard deviation of a current that is computed from torque and speed: the losses. [1]"""
OPEN = 0.6
"""Share of the greatest current that the sum still varies by, from which on a branch must be missing. [1]"""
OTHER_UNIT = 100.0
"""Times the battery's current that no other branch reaches in the same unit. [1]"""
TIMEOUT_PERIODS, GAP_TIMES = 5.0, 1.5
"""A time-out bridges four lost frames, and the gaps that a recording shows. [1]"""
LEAST_TIMEOUT_S, USUAL_TIMEOUT_S, LONGEST_TIMEOUT_S = 0.1, 0.5, 2.0
"""A time base of 0.1 s needs no less; where no rate is known; longer gaps are losses. [s]"""
TIMEOUT_STEP_S = 0.05
CHECKS = frozenset({"crc", "checksum", "crc8", "chk"})
"""Words of the signal that protects a message."""
_WIDTH = 80
"""Columns of a terminal, into which remarks are folded; keys and values stay whole."""


@dataclass(frozen=True, kw_only=True)
class Proposal:
    """What was found.

    Attributes
    ----------
    name : str
        Of the layout.
    database : Path or None
        The DBC, KCD, SYM or ARXML; None for a table.
    recording : Path or None
        The log or table that was looked at.
    verdicts : tuple of Verdict
        All currents and powers, the branches first.
    everything : tuple of Candidate
        All signals or columns, of a database also those that are not in the log.
    found : tuple of Candidate
        Those among which was chosen.
    voltage : Candidate or None
        What powers are divided by.
    """

    name: str
    database: Path | None
    recording: Path | None
    verdicts: tuple[Verdict, ...]
    everything: tuple[Candidate, ...]
    found: tuple[Candidate, ...]
    voltage: Candidate | None

    @property
    def branches(self) -> list[Verdict]:
        """Those that are taken, in the order of a layout."""
        order = {place: k for k, place in enumerate(PLACES)}
        taken = [verdict for verdict in self.verdicts if verdict.branch]
        return sorted(taken, key=lambda verdict: (order.get(verdict.place, len(order)), -verdict.score))

    @property
    def battery(self) -> Candidate | None:
        """Current or power of the battery, if it is taken."""
        return next((v.candidate for v in self.branches if v.place == "battery"), None)

    @property
    def files(self) -> str:
        """Names of the files, for messages."""
        return " and ".join(path.name for path in (self.database, self.recording) if path is not None)

    def with_branches(self, chosen: Mapping[int, str]) -> "Proposal":
        """The same with other verdicts as branches, by number and name, with signs that fit these."""
        verdicts = [with_usual_sign(replace(v, branch=chosen.get(k, ""))) for k, v in enumerate(self.verdicts)]
        signed = iter(find_signs([verdict for verdict in verdicts if verdict.branch], self.voltage))
        verdicts = [next(signed) if verdict.branch else verdict for verdict in verdicts]
        return replace(self, verdicts=tuple(verdicts))

    def unready(self) -> str:
        """Why the branches cannot be written; empty if they can."""
        candidates = [verdict.candidate for verdict in self.branches]
        if len(candidates) < 2:
            return "a junction has at least two branches"
        if self.voltage is None and any(item.quantity == "power" for item in candidates):
            return "there is no voltage of the junction to divide a power by"
        if unsigned := [item.name for item in candidates if item.wrong == "sign"]:
            return f"the log shows {unsigned[0]} signed; in the database it is unsigned: correct it"
        return ""

    def problem(self) -> str:
        """Why the branches make no layout that can be trusted without a look; empty if they do."""
        battery = self.battery
        if battery is None:
            return "no pack current found: no candidate is the current or power of a high-voltage battery"
        if not any(verdict.place in {"motor", "charger"} for verdict in self.branches):
            wrong = "; it is signed, and unsigned in the database" if battery.wrong == "sign" else ""
            others = f"no current, power or torque of a motor or charger was found{wrong}"
            return f"the pack current is {battery.name}, but {others}"
        share = closure(self.branches, self.voltage)
        if share > OPEN:
            names = ", ".join(verdict.branch for verdict in self.branches)
            reach = {verdict.candidate.name: _reach(verdict.candidate) for verdict in self.branches}
            most = max(reach, key=reach.__getitem__)
            unit = f"; {most} reaches {reach[most]:,.0f}: in mA?" if reach[most] > OTHER_UNIT * _reach(battery) else ""
            return (
                f"the sum of {names} still varies by {share:.0%} of the greatest of them: a branch is missing or wrong"
                f"{unit}"
            )
        return self.unready()


def _reach(candidate: Candidate) -> float:
    channel = candidate.channel
    return 0.0 if channel is None or not channel.good.any() else float(np.abs(channel.value[channel.good]).max())


def look_at(source: Path, log: Path | None, name: str) -> Proposal:
    """Judge what a database, with a log, or a table has.

    Parameters
    ----------
    source : Path
        A database (DBC, KCD, SYM, ARXML), or a table.
    log : Path or None
        Beside a database, one of the vehicle's logs or a table of its signals: only signals in it are then judged, and
        by what it shows.
    name : str
        Of the layout.

    Returns
    -------
    Proposal
        Whether its branches make a layout, :meth:`Proposal.problem` says.

    Raises
    ------
    DatabaseError, LogError
        If one of the files cannot be used.
    """
    database: Path | None = None
    if is_table(source):
        if log is not None:
            raise ProposalError(f"{source}: a table, which needs no --log; leave --log {log} out")
        everything = found = of_table(read_table(source))
        log = source
    else:
        if not source.is_file():
            raise DatabaseError(f"{source}: no such file; a database (DBC, KCD, SYM, ARXML) or a table is expected")
        database = source
        everything = found = of_database(read_database(_bare_layout(name, source)).databases[""])
        if log is not None:
            if is_table(log):
                found, what = with_table(everything, read_table(log)), "columns"
            else:
                found, what = with_log(everything, read_frames(log)), "identifiers"
            if not found:
                raise LogError(f"{log}: none of its {what} is in {source}; check that both belong to the same vehicle")
    verdicts = judge_all(found, everything)
    battery = next((verdict.candidate for verdict in verdicts if verdict.place == "battery" and verdict.branch), None)
    voltage = find_inputs(found, battery=battery, roles=["voltage"]).get("voltage")
    if battery is not None and not any(verdict.branch.startswith("motor") for verdict in verdicts):
        computed = computed_motor(found, voltage)
        if computed is not None:
            motor = Verdict(candidate=computed[0], place="motor", score=TAKEN, why="", branch="motor")
            verdicts.insert(1, motor)
            if log is None:  # a charger carries nothing while the motor does
                verdicts = [
                    replace(v, branch="", why=ONLY_CHARGING) if v.branch.startswith("charger") else v for v in verdicts
                ]
    verdicts = close_sum(verdicts, voltage)
    proposal = Proposal(
        name=name,
        database=database,
        recording=log,
        verdicts=tuple(verdicts),
        everything=tuple(everything),
        found=tuple(found),
        voltage=voltage,
    )
    return proposal.with_branches({k: verdict.branch for k, verdict in enumerate(verdicts) if verdict.branch})


def parsed_branches(text: str, proposal: Proposal) -> Proposal:
    """The proposal with branches as ``battery=Ibat,-motor=Imot`` names them.

    Parameters
    ----------
    text : str
        As :func:`.layout_from_branches` takes it, of columns or signals: ``Message.Signal``, or the signal alone where
        that is clear.
    proposal : Proposal
        What was found.

    Raises
    ------
    LayoutError
        If the text is not of that form.
    ProposalError
        If no current or power has such a name.
    """
    chosen = []
    for branch in layout_from_branches(text).layout.branch:
        item = _named(branch.source, proposal)
        place = next((v.place for v in proposal.verdicts if v.candidate.name == item.name), "")
        place = next(iter(places_of(words_of(branch.name))), place)
        said = Verdict(candidate=item, place=place, score=100.0, why="", branch=branch.name, sign=branch.sign)
        chosen.append(replace(said, sign_reason="as --branches says"))
    made = replace(proposal, verdicts=tuple(chosen))
    voltages = find_inputs(proposal.found, battery=made.battery, roles=["voltage"])
    return replace(made, voltage=voltages.get("voltage"))


def _named(wanted: str, proposal: Proposal) -> Candidate:
    known = {item.name: item for item in proposal.everything if item.quantity in {"current", "power", ""}}
    known |= {item.name: item for item in proposal.found if item.name in known}
    whole = {name: {name, name.rpartition(".")[2], bare_name(name)} for name in known}
    same = [wanted] if wanted in known else [name for name, names in whole.items() if wanted in names]
    if len(same) == 1:
        item = known[same[0]]
        return item if item.quantity else replace(item, quantity="current")
    near = same or difflib.get_close_matches(wanted, known, n=3, cutoff=0.4) or list(known)[:8]
    what = "stands for several" if same else "is no current or power there"
    raise ProposalError(f"{proposal.files}: {wanted!r} {what}; there are {', '.join(near) or 'none'}")


def _bare_layout(name: str, database: Path) -> Layout:
    path = Path("the layout")
    return Layout(schema=1, name=name, dbc=str(database.absolute()), full_scale_a=1.0, branch=[], path=path, digest="")


# ---- text


def _inputs(proposal: Proposal) -> dict[str, Candidate]:
    """The inputs that go with the branches, by name."""
    taken = {verdict.candidate.name for verdict in proposal.branches}
    inputs = find_inputs(proposal.found, battery=proposal.battery, taken=taken)
    computed = computed_motor(proposal.found, proposal.voltage)
    if computed is None or not any(verdict.candidate.formula for verdict in proposal.branches):
        return inputs
    return computed[1] | {name: item for name, item in inputs.items() if name not in computed[1]}


def layout_text(proposal: Proposal, out: Path | None) -> str:
    """Write a layout.

    Parameters
    ----------
    proposal : Proposal
        With at least two branches.
    out : Path or None
        File that the text is for; the database is named relative to its folder. None: relative to this folder.

    Returns
    -------
    str
        A layout; its remarks ``# confirm:`` say what was guessed, and why.
    """
    inputs = _inputs(proposal)
    derived = derive(inputs)
    scale_a, scale_reason = _full_scale(proposal)
    used = [v.candidate for v in proposal.branches] + [*inputs.values()]
    messages = {v.candidate.message.name: v.candidate.message for v in proposal.branches if v.candidate.message}
    folder = out.absolute().parent if out is not None else Path.cwd()
    environment = Environment(
        loader=PackageLoader("calibrator.proposal", ""),
        autoescape=False,  # noqa: S701 (a text, no page)
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters |= {"remark": _remark, "entries": _entries, "toml": partial(json.dumps, ensure_ascii=False)}
    text: str = environment.get_template("layout.toml.jinja").render(
        proposal=proposal,
        dbc=proposal.database and os.path.relpath(proposal.database.absolute(), folder),
        scale_a=scale_a,
        scale_reason=scale_reason,
        inputs=inputs,
        derived=derived,
        model_inputs=[name for name in derived if not name.startswith(FOR_FLEETS)],
        wrong_ranges=[item.name for item in used if item.wrong == "range"],
        checked=[name for name, m in messages.items() if any(CHECKS & set(words_of(s.name)) for s in m.signals)],
        taken=TAKEN,
        uncertainty=COMPUTED,
        timeout_s=_timeout_s,
    )
    return text


def _full_scale(proposal: Proposal) -> tuple[float, str]:
    peak_a = max((v.candidate.peak for v in proposal.branches if v.candidate.quantity == "current"), default=0.0)
    if proposal.recording is not None and peak_a > 0.0:
        least = HEADROOM * peak_a
        decade = 10.0 ** math.floor(math.log10(least))
        scale_a = next(step * decade for step in ROUND if step * decade >= least * (1.0 - 1e-9))
        return scale_a, f"the recording reaches {peak_a:.0f} A; give the nominal maximum"
    battery = proposal.battery
    if battery is not None and battery.quantity == "current":
        reach_a = max(abs(battery.low), abs(battery.high))
        if reach_a <= LARGEST_A:
            return reach_a, f"the database lets {battery.name} reach {reach_a:g} A"
    return TYPICAL_A, "typical of a car; nothing tells it"


def _entries(names: Iterable[str]) -> list[str]:
    """Names in lines that a terminal holds."""
    return textwrap.wrap(" ".join(f'"{name}",' for name in names), _WIDTH - 4, break_long_words=False)


def _timeout_s(item: Candidate) -> float:
    """From the cycle time, or from what a recording shows."""
    steps_s = np.diff(item.channel.time_s) if item.channel is not None else np.zeros(0)
    period_s = (item.message.cycle_time or 0) * 1e-3 if item.message is not None else 0.0
    wanted_s = TIMEOUT_PERIODS * period_s or USUAL_TIMEOUT_S
    if len(steps_s):
        wanted_s = max(TIMEOUT_PERIODS * float(np.median(steps_s)), GAP_TIMES * float(steps_s.max()))
    wanted_s = min(wanted_s, LONGEST_TIMEOUT_S)
    return max(round(math.ceil(wanted_s / TIMEOUT_STEP_S - 1e-9) * TIMEOUT_STEP_S, 3), LEAST_TIMEOUT_S)


def _remark(text: str) -> str:
    """A remark; texts of a database are kept from breaking it."""
    wrapper = textwrap.TextWrapper(
        _WIDTH, initial_indent="# ", subsequent_indent="#   ", break_long_words=False, break_on_hyphens=False
    )
    return wrapper.fill(printable(" ".join(text.split())))
