"""Which of the next commands the layout and the logs are ready for, and what others wait for."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from calibrator.doctor.findings import Finding, Severity
from calibrator.drive import Drive
from calibrator.drives.align import align, base_inputs
from calibrator.errors import DriveError
from ecu_node.database import VehicleDatabase
from ecu_node.errors import UserError
from ecu_node.guard import Mode
from ecu_node.in_force import InForce
from ecu_node.layout import Layout
from ecu_node.wiring import wire

__all__ = ["NextSteps", "explained_shares", "next_steps"]

LEAST_SHARE = 0.05
"""Of the greatest branch's variation: that of a smaller one is mostly noise. [1]"""
FEWEST_INSTANTS = 300
"""Of aligned samples, to say how well inputs explain a current: half a minute at 0.1 s."""


@dataclass(frozen=True, kw_only=True)
class NextSteps:
    """Commands that can be run, and for each of the others what is missing."""

    ready: tuple[str, ...]
    not_ready: Mapping[str, str]

    @property
    def lines(self) -> list[str]:
        """What the report ends with."""
        reasons: dict[str, list[str]] = {}
        for name, why in self.not_ready.items():
            reasons.setdefault(why, []).append(name)
        waits = [f"{', '.join(names)} because {why}" for why, names in reasons.items()]
        parts = [f"ready for: {', '.join(self.ready) or 'nothing'}"]
        return parts + ([f"not ready for: {'; '.join(waits)}"] if waits else [])


def next_steps(
    database: VehicleDatabase,
    layout: Layout,
    drives: Sequence[Drive],
    branches: Sequence[str],
    findings: Sequence[Finding],
) -> NextSteps:
    """Tell what can be done next.

    Parameters
    ----------
    database : VehicleDatabase
        DBC and usable part of the layout.
    layout : Layout
        The whole layout.
    drives : sequence of Drive
        What the logs gave.
    branches : sequence of str
        Branches with usable frames.
    findings : sequence of Finding
        All.

    Returns
    -------
    NextSteps
        In the order in which the commands are used.
    """
    errors = [finding for finding in findings if finding.severity is Severity.ERROR]
    missing = {
        "kirchhoff": _for_kirchhoff(branches, errors),
        "import": _for_import(drives, errors),
        "calibrate": _for_calibrate(layout, drives, branches, errors),
        "ecu-node": _for_node(database, layout, Mode.OVERLAY, errors),
        "ecu-node --gateway": _for_node(database, layout, Mode.GATEWAY, errors),
    }
    return NextSteps(
        ready=tuple(name for name, why in missing.items() if not why),
        not_ready={name: why for name, why in missing.items() if why},
    )


def explained_shares(drives: Sequence[Drive], layout: Layout, branches: Sequence[str]) -> dict[str, float]:
    """How much of each current's variation the model inputs explain, as a plain linear model.

    Parameters
    ----------
    drives : sequence of Drive
        Of one vehicle.
    layout : Layout
        Says the model inputs.
    branches : sequence of str
        The branches.

    Returns
    -------
    dict of str to float
        By branch that matters, 1 for all of it; empty if the inputs are not recorded or too little is valid.
    """
    available = set.intersection(*(set(drive.inputs) for drive in drives)) if drives else set()
    recorded = [name for name in layout.model_inputs if base_inputs(layout, [name]) <= available]
    if not recorded:
        return {}
    try:
        samples = [align(drive, layout, branches, inputs=recorded) for drive in drives]
    except DriveError:
        return {}
    inputs = np.concatenate([s.inputs[s.valid] for s in samples])
    currents_a = np.concatenate([s.currents_a[s.valid] for s in samples])
    if len(inputs) < FEWEST_INSTANTS:
        return {}
    spread = inputs.std(axis=0)
    columns = np.column_stack([inputs / np.where(spread > 0.0, spread, 1.0), np.ones(len(inputs))])
    rest = currents_a - columns @ np.linalg.lstsq(columns, currents_a, rcond=1e-8)[0]
    power = currents_a.var(axis=0)
    shares = 1.0 - np.divide(rest.var(axis=0), power, out=np.ones(len(power)), where=power > 0.0)
    return {name: float(shares[k]) for k, name in enumerate(branches) if power[k] > LEAST_SHARE**2 * power.max()}


def _for_kirchhoff(branches: Sequence[str], errors: Sequence[Finding]) -> str:
    if len(branches) < 2:
        return f"a sum needs two branches with usable frames, and there is {', '.join(branches) or 'none'}"
    always_stale = [finding.subject for finding in errors if finding.kind == "rate"]
    return f"{', '.join(always_stale)} is always stale" if always_stale else ""


def _for_import(drives: Sequence[Drive], errors: Sequence[Finding]) -> str:
    if not drives:
        return "no log has a branch"
    return f"of the errors above ({_subjects(errors)})" if errors else ""


def _for_calibrate(layout: Layout, drives: Sequence[Drive], branches: Sequence[str], errors: Sequence[Finding]) -> str:
    if errors:
        return f"of the errors above ({_subjects(errors)})"
    if len(branches) < 2:
        return "it needs two branches with usable frames"
    if not layout.model_inputs:
        return "the layout has no model_inputs ([[input]], [[derived]])"
    available = {name for drive in drives for name in drive.inputs}
    lacking = [name for name in layout.model_inputs if not base_inputs(layout, [name]) <= available]
    if len(lacking) == len(layout.model_inputs):
        return f"none of the model_inputs is recorded ({', '.join(sorted(base_inputs(layout, lacking) - available))})"
    return ""


def _for_node(database: VehicleDatabase, layout: Layout, mode: Mode, errors: Sequence[Finding]) -> str:
    if errors:
        return f"of the errors above ({_subjects(errors)})"
    try:
        wire(database, InForce(parameters=None), 0.0, mode=mode)
    except UserError as error:
        return str(error).removeprefix(f"{layout.path}: ")
    return ""


def _subjects(errors: Sequence[Finding]) -> str:
    return ", ".join(dict.fromkeys(finding.subject for finding in errors))
