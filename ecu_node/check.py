"""Commands without a bus: what ``ecu-node check`` reports, and the file that ``ecu-node template`` prints."""

import json
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from ecu_node import __version__
from ecu_node.bus.guard import Mode, needs_fd
from ecu_node.bus.in_force import InForce, branch_plan, choose_parameters, not_published, sensor_fault
from ecu_node.bus.wiring import wire
from ecu_node.database import VehicleDatabase, node_database
from ecu_node.errors import LayoutError, printable
from ecu_node.layout import Branch

__all__ = ["check_report", "report_text", "template_text", "warnings_of"]


_WHY_NOT_PUBLISHED = "the parameters apply a fault to it, but the layout has no 'corrected' for it"


def check_report(params: Path, layout: Path, vehicle: str | None, mode: Mode = Mode.OVERLAY) -> dict[str, Any]:
    """Check parameters against layout, DBC and vehicle.

    Parameters
    ----------
    params, layout : Path
        Parameter file and layout.
    vehicle : str or None
        Identity of the vehicle; None: not checked.
    mode : Mode
        Where corrected values go.

    Returns
    -------
    dict
        ``fit`` [bool], ``reason`` (name in the status message), ``message`` (why not, or None), ``vehicle``,
        ``parameter_set``, ``warnings`` (texts), and ``branches``: per branch drift [1], offset_a [A] and apply, as the
        file says (0 and None where it does not name the branch), applied (whether it is corrected), target, and plan: a
        dict with gain, voltage_gain, bias and shift; None where the branch is not written.

    Raises
    ------
    LayoutError, DatabaseError
        If layout or DBC cannot be used at all, by which ``ecu-node run`` would be refused too.
    """
    database = node_database(layout)
    in_force, why_not = choose_parameters(params, database, vehicle)
    wire(database, in_force, start_s=0.0, mode=mode)
    parameters = in_force.parameters
    return {
        "fit": why_not is None,
        "reason": in_force.reason.name,
        "message": why_not,
        "vehicle": parameters.vehicle if parameters is not None else None,
        "parameter_set": parameters.number if parameters is not None else None,
        "warnings": warnings_of(database, in_force, mode),
        "branches": {branch.name: _branch(database, branch, in_force, mode) for branch in database.layout.branch},
    }


def report_text(report: dict[str, Any]) -> str:
    """Show a report of :func:`check_report` as text."""
    head = f"vehicle {report['vehicle']}, parameter set {report['parameter_set']}: fit"
    lines = [head if report["fit"] else f"NOT FIT ({report['reason']}): {printable(report['message'])}"]
    width = max(map(len, ["branch", *report["branches"]]))
    lines.append(f"{'branch':<{width}}{'drift':>11}{'offset':>13}")
    for name, branch in report["branches"].items():
        has_fault = branch["drift"] or branch["offset_a"]
        held_back = ', "apply" is false' if has_fault and branch["apply"] is False else ""
        mark = "corrected" if branch["applied"] else f"passed through{held_back}"
        numbers = f"{name:<{width}}{branch['drift']:>+11.4%}{branch['offset_a']:>+11.3f} A"
        lines.append(f"{numbers}  {mark if branch['target'] is not None else f'not published{held_back}'}")
        if branch["target"] is not None:
            lines.append(f"  target {branch['target']}")
            lines += [f"  {_numbers(branch['plan'])}"] if branch["applied"] else []
    lines.append("corrected code = (measured code * gain + bias + 2^(shift - 1)) >> shift")
    if any("voltage gain" in line for line in lines):
        lines.append("  of a power: + voltage code * voltage gain in the parentheses")
    return "\n".join([*lines, *(f"warning: {text}" for text in report["warnings"])])


def warnings_of(database: VehicleDatabase, in_force: InForce, mode: Mode, *, fd: bool = False) -> list[str]:
    """What a user should know of parameters that fit: what of them is not done, and what the bus must be able to do."""
    hidden = not_published(database, in_force) if mode is Mode.OVERLAY else []
    texts = [f"branch {name} is not published: {_WHY_NOT_PUBLISHED}" for name in hidden]
    if not fd and (names := needs_fd(database, mode)):
        texts.append(f"CAN FD messages ({', '.join(names)}): 'ecu-node run' needs --fd")
    return texts


def _numbers(plan: dict[str, int]) -> str:
    shown = {name: value for name, value in plan.items() if value or name != "voltage_gain"}
    return ", ".join(f"{name.replace('_', ' ')} {value}" for name, value in shown.items())


def _branch(database: VehicleDatabase, branch: Branch, in_force: InForce, mode: Mode) -> dict[str, Any]:
    found = in_force.parameters.branches.get(branch.name) if in_force.parameters is not None else None
    fault = sensor_fault(in_force, branch.name)
    target = branch.corrected if mode is Mode.OVERLAY else branch.source
    plan = branch_plan(database, branch, fault, mode) if target is not None else None
    return {
        "drift": found.drift if found is not None else 0.0,
        "offset_a": found.offset_a if found is not None else 0.0,
        "apply": found.apply if found is not None else None,
        "applied": fault.applied,
        "target": target,
        "plan": None
        if plan is None
        else {"gain": plan.gain, "voltage_gain": plan.voltage_gain, "bias": plan.bias, "shift": plan.shift},
    }


def template_text(database: "VehicleDatabase", vehicle: str, now: datetime) -> str:
    """Make a parameter file that corrects nothing yet.

    Parameters
    ----------
    database : VehicleDatabase
        Layout and DBC of the vehicle.
    vehicle : str
        Its identity.
    now : datetime
        Time of day.

    Returns
    -------
    str
        JSON without what can be left out. The sum that right sensors show is the layout's unmeasured load: it takes
        current out of the junction, so what the branches measure sums to as much above 0 A. The verdict is that of a
        file that corrects, as it is to be once it is filled in.
    """
    layout = database.layout
    load = layout.unmeasured_load
    if load is not None and load.mean_a > layout.offset_limit_a:
        raise LayoutError(
            f"{layout.path}: [unmeasured_load] mean_a = {load.mean_a:g} is beyond the layout's limit of "
            f"{layout.offset_limit_a:g} A ([limits] offset_a), so that no parameters would fit; correct one of them"
        )
    document = {
        "schema_version": 1,
        "vehicle": vehicle,
        "number": 1,
        "layout": {"name": layout.path.name, "sha256": layout.digest},
        "dbc": {"name": layout.dbc_path.name, "sha256": database.digest},
        "verdict": "corrected",
        "branches": {name: {"drift": 0.0, "offset_a": 0.0, "apply": False} for name in layout.branch_names},
        "hardware_fault": {"suspected": False},
        "junction_residual": {
            "measured_a": 0.0,
            "corrected_a": 0.0,
            "expected_a": load.mean_a if load is not None else 0.0,
        },
        "provenance": {
            "tool": f"ecu-node template {__version__}",
            "method": "by hand",
            "created": now.astimezone(UTC).strftime("%Y-%m-%dT%H:%M:%SZ"),
            "fleet": "none",
            "fleet_size": 1,
            "drives": [],
            "duration_s": 0.0,
        },
    }
    return json.dumps(document, indent=2)
