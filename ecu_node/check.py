"""What ``ecu-node check`` reports: whether parameters fit, and what the node would compute with them.

The node is built as ``ecu-node run`` builds it, so that what is accepted here is accepted there.
"""

from pathlib import Path
from typing import Any

from ecu_node.database import VehicleDatabase, read_database
from ecu_node.guard import needs_fd
from ecu_node.layout import Branch, read_layout
from ecu_node.node import choose_parameters
from ecu_node.wiring import (
    WHY_NOT_LINEAR,
    WHY_NOT_PUBLISHED,
    InForce,
    branch_plan,
    not_linear,
    not_published,
    sensor_fault,
    wire,
)

__all__ = ["check_report", "report_text"]


def check_report(params: Path, layout: Path, vehicle: str | None) -> dict[str, Any]:
    """Check parameters against layout, DBC and vehicle.

    Parameters
    ----------
    params, layout : Path
        Parameter file and layout.
    vehicle : str or None
        Identity of the vehicle; None: not checked.

    Returns
    -------
    dict
        ``fit`` [bool], ``reason`` (name in the status message), ``message`` (why not, or None), ``vehicle``,
        ``parameter_set``, ``warnings`` (texts), and ``branches``: per branch drift [1], offset_a [A], applied, target,
        and plan with gain, bias, shift, or None where the branch is not republished.

    Raises
    ------
    LayoutError, DatabaseError
        If layout or DBC cannot be used at all, by which ``ecu-node run`` would be refused too.
    """
    database = read_database(read_layout(layout))
    in_force, why_not = choose_parameters(params, database, vehicle)
    wire(database, in_force, start_s=0.0)
    parameters = in_force.parameters
    return {
        "fit": why_not is None,
        "reason": in_force.reason.name,
        "message": why_not,
        "vehicle": parameters.vehicle if parameters is not None else None,
        "parameter_set": parameters.number if parameters is not None else None,
        "warnings": _warnings(database, in_force),
        "branches": {branch.name: _branch(database, branch, in_force) for branch in database.layout.branch},
    }


def report_text(report: dict[str, Any]) -> str:
    """Show a report of :func:`check_report` as text."""
    head = f"vehicle {report['vehicle']}, parameter set {report['parameter_set']}: fit"
    lines = [head if report["fit"] else f"NOT FIT ({report['reason']}): {report['message']}"]
    width = max(map(len, ["branch", *report["branches"]]))
    lines.append(f"{'branch':<{width}}{'drift':>11}{'offset':>13}")
    for name, branch in report["branches"].items():
        plan = branch["plan"]
        mark = "corrected" if branch["applied"] else "passed through"
        numbers = f"{name:<{width}}{branch['drift']:>+11.4%}{branch['offset_a']:>+11.3f} A"
        lines.append(f"{numbers}  {mark if plan is not None else 'not published'}")
        if plan is not None:
            lines.append(f"  target {branch['target']}")
        if plan is not None and branch["applied"]:
            lines.append(f"  gain {plan['gain']}, bias {plan['bias']}, shift {plan['shift']}")
    lines.append("corrected code = (measured code * gain + bias + 2^(shift - 1)) >> shift")
    return "\n".join([*lines, *(f"warning: {text}" for text in report["warnings"])])


def _warnings(database: VehicleDatabase, in_force: InForce) -> list[str]:
    texts = [f"branch {name} is not published: {WHY_NOT_PUBLISHED}" for name in not_published(database, in_force)]
    texts += [f"branch {name} is passed through: {WHY_NOT_LINEAR}" for name in not_linear(in_force)]
    if names := needs_fd(database):
        texts.append(f"CAN FD messages ({', '.join(names)}): 'ecu-node run' needs --fd")
    return texts


def _branch(database: VehicleDatabase, branch: Branch, in_force: InForce) -> dict[str, Any]:
    fault = sensor_fault(in_force, branch.name)
    plan = branch_plan(database, branch, fault)
    return {
        "drift": fault.drift,
        "offset_a": fault.offset_a,
        "applied": fault.applied,
        "target": branch.corrected,
        "plan": {"gain": plan.gain, "bias": plan.bias, "shift": plan.shift} if plan is not None else None,
    }
