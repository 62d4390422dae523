"""Layout and logs of one vehicle, examined: facts, findings, and what can be done next."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec

from calibrator.doctor.channel_facts import ChannelFacts, channel_facts
from calibrator.doctor.channel_findings import (
    branch_findings,
    input_findings,
    log_findings,
    scale_findings,
    stuck_finding,
)
from calibrator.doctor.findings import Finding, Severity
from calibrator.doctor.junction import JunctionFacts, junction_facts
from calibrator.doctor.junction_findings import junction_findings
from calibrator.doctor.read_logs import ReadLog, read_logs
from calibrator.doctor.steps import NextSteps, explained_shares, next_steps
from calibrator.doctor.stuck import stuck_parts
from calibrator.doctor.usable import usable_part
from calibrator.doctor.voltage import voltage_slip, without_slip
from calibrator.doctor.words import is_battery
from calibrator.drive import Drive
from calibrator.drives.align import base_inputs
from ecu_node.database import VehicleDatabase
from ecu_node.layout import Input, Layout

__all__ = ["Examination", "examine"]

VOLTAGE = "_junction_voltage"
"""Input that the doctor adds for itself: what powers are divided by."""
WELL_EXPLAINED = 0.5
"""Share of a current's variation that model inputs should explain at least. [1]"""


@dataclass(frozen=True, kw_only=True)
class Examination:
    """What the doctor found.

    Attributes
    ----------
    layout : Layout
        As the user has it.
    logs : tuple of ReadLog
        What was looked at.
    branches, inputs : tuple of ChannelFacts
        Of those that the DBC has, in the order of the layout.
    junction : JunctionFacts or None
        None with fewer than two usable branches.
    explained : dict of str to float
        Share of each current's variation that the model inputs explain; empty if that cannot be told.
    findings : tuple of Finding
        Errors first.
    steps : NextSteps
        What can be done.
    """

    layout: Layout
    logs: tuple[ReadLog, ...]
    branches: tuple[ChannelFacts, ...]
    inputs: tuple[ChannelFacts, ...]
    junction: JunctionFacts | None
    explained: dict[str, float]
    findings: tuple[Finding, ...]
    steps: NextSteps

    @property
    def has_errors(self) -> bool:
        """Whether any finding is an error."""
        return any(finding.severity is Severity.ERROR for finding in self.findings)


def examine(layout: Layout, paths: Sequence[Path]) -> Examination:
    """Examine a layout and logs of one vehicle.

    Parameters
    ----------
    layout : Layout
        The layout; its DBC is read.
    paths : sequence of Path
        At least one log.

    Returns
    -------
    Examination
        Everything that was found.

    Raises
    ------
    UserError
        If DBC or a log cannot be read at all.
    """
    database, findings = usable_part(layout)
    logs = read_logs(paths, _with_voltage(database))
    alone = all(log.drive is None for log in logs)
    findings += [finding for log in logs for finding in log_findings(log, alone=alone)]
    branches = [_branch_facts(name, logs, database) for name in database.layout.branch_names]
    inputs = [_input_facts(item, logs, database) for item in database.layout.input]
    needed = base_inputs(database.layout, database.layout.model_inputs)
    findings += [finding for facts in branches for finding in branch_findings(facts, layout)]
    findings += [finding for facts in inputs for finding in input_findings(facts, needed=facts.name in needed)]
    drives = [log.drive for log in logs if log.drive is not None]
    usable = [facts.name for facts in branches if facts.good]
    right, slips = _right_voltage(drives, database)
    findings += slips
    junction = None
    if len(usable) > 1:
        battery = next((name for name in usable if is_battery(name, layout.find_branch(name).source)), None)
        junction = junction_facts(right, layout, usable, battery=battery, voltage=VOLTAGE)
        findings += junction_findings(junction, layout)
        findings += [stuck_finding(stuck) for stuck in stuck_parts(right, layout, usable)]
    else:
        findings.append(_no_sum(usable))
    findings += scale_findings(branches, layout)
    explained = explained_shares(drives, database.layout, usable) if usable else {}
    findings += _unexplained(explained, drives)
    order = list(Severity)
    findings.sort(key=lambda finding: order.index(finding.severity))
    return Examination(
        layout=layout,
        logs=tuple(logs),
        branches=tuple(branches),
        inputs=tuple(inputs),
        junction=junction,
        explained=explained,
        findings=tuple(findings),
        steps=next_steps(database, layout, drives, usable, findings),
    )


def _voltage_signal(database: VehicleDatabase) -> str | None:
    """What powers are divided by, or else the first input in volts."""
    layout = database.layout
    volts = [item.signal for item in layout.input if database.signal(item.signal)[1].unit == "V"]
    names = [*(branch.voltage for branch in layout.branch if branch.voltage), *volts]
    return names[0] if names else None


def _with_voltage(database: VehicleDatabase) -> VehicleDatabase:
    """The same with the voltage as one more input."""
    signal = _voltage_signal(database)
    if signal is None:
        return database
    inputs = [*database.layout.input, Input(name=VOLTAGE, signal=signal)]
    return replace(database, layout=msgspec.structs.replace(database.layout, input=inputs))


def _right_voltage(drives: Sequence[Drive], database: VehicleDatabase) -> tuple[list[Drive], list[Finding]]:
    """Drives with the currents that a slip of the voltage spoils put right, and what is to be said of it."""
    signal = _voltage_signal(database)
    divided = [branch.name for branch in database.layout.branch if branch.voltage == signal]
    if signal is None or database.signal(signal)[1].unit != "V":
        return list(drives), []
    slip = voltage_slip(drives, VOLTAGE, signal)
    if slip is None:
        return list(drives), []
    return [without_slip(drive, slip, divided) for drive in drives], [slip.finding()]


def _branch_facts(name: str, logs: Sequence[ReadLog], database: VehicleDatabase) -> ChannelFacts:
    branch = database.layout.find_branch(name)
    channels = [log.drive.branches.get(name) if log.drive is not None else None for log in logs]
    return channel_facts(
        name, branch.source, logs, database, channels=channels, timeout_s=branch.timeout_s, unit="A"
    )  # fmt: skip


def _input_facts(item: Input, logs: Sequence[ReadLog], database: VehicleDatabase) -> ChannelFacts:
    channels = [log.drive.inputs.get(item.name) if log.drive is not None else None for log in logs]
    unit = database.signal(item.signal)[1].unit or ""
    return channel_facts(
        item.name, item.signal, logs, database, channels=channels, timeout_s=database.layout.max_age_s, unit=unit
    )


def _no_sum(usable: Sequence[str]) -> Finding:
    return Finding(
        severity=Severity.ERROR,
        kind="too few branches",
        subject="sum",
        text=f"usable frames of {', '.join(usable) or 'no branch'} only, so there is no sum to look at",
        remedy="a junction needs two branches: record the buses that carry them, or name other signals",
    )


def _unexplained(explained: dict[str, float], drives: Sequence[Drive]) -> list[Finding]:
    if not drives:
        return []
    return [
        Finding(
            severity=Severity.WARNING,
            kind="inputs",
            subject=name,
            text=f"the model inputs explain {100.0 * share:.0f} % of how its current varies",
            remedy="give the model what drives this current (docs/layout.md, 'Inputs matter'): its torque times speed, "
            "its demand",
            figures={"share": share},
        )
        for name, share in explained.items()
        if share < WELL_EXPLAINED
    ]
