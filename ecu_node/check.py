"""What ``ecu-node check`` reports: whether parameters fit, and what the node would compute with them."""

from pathlib import Path
from typing import Any

from ecu_node.database import VehicleDatabase, read_database
from ecu_node.guard import check_output
from ecu_node.layout import Branch, read_layout
from ecu_node.node import choose_parameters
from ecu_node.wiring import InForce, branch_plan, sensor_fault

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
        ``parameter_set``, and ``branches``: per branch drift [1], offset_a [A], applied, target, and plan with gain,
        bias, shift, or None where the branch is not republished.

    Raises
    ------
    LayoutError, DatabaseError
        If layout or DBC cannot be used at all.
    """
    database = read_database(read_layout(layout))
    check_output(database)
    in_force, why_not = choose_parameters(params, database, vehicle)
    parameters = in_force.parameters
    return {
        "fit": why_not is None,
        "reason": in_force.reason.name,
        "message": why_not,
        "vehicle": parameters.vehicle if parameters is not None else None,
        "parameter_set": parameters.number if parameters is not None else None,
        "branches": {branch.name: _branch(database, branch, in_force) for branch in database.layout.branch},
    }


def report_text(report: dict[str, Any]) -> str:
    """Show a report of :func:`check_report` as text."""
    head = f"vehicle {report['vehicle']}, parameter set {report['parameter_set']}: fit"
    lines = [head if report["fit"] else f"NOT FIT ({report['reason']}): {report['message']}"]
    lines.append(f"{'branch':<12}{'drift':>11}{'offset':>13}  target: (code * gain + bias + half) >> shift")
    for name, branch in report["branches"].items():
        mark = "" if branch["applied"] else " (passed through)"
        lines.append(
            f"{name:<12}{branch['drift']:>+11.4%}{branch['offset_a']:>+11.3f} A  {branch['target'] or 'none'}{mark}"
        )
        plan = branch["plan"]
        if plan is not None and branch["applied"]:
            lines.append(f"{'':<38}gain {plan['gain']}, bias {plan['bias']}, shift {plan['shift']}")
    return "\n".join(lines)


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
