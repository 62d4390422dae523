"""The part of a layout that its DBC can serve, and what stands in its way: findings instead of the first error."""

from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Any

import msgspec

from calibrator.doctor.findings import Finding, Severity
from calibrator.drives.align import base_inputs
from ecu_node.database import VehicleDatabase, look_everything_up, read_database
from ecu_node.errors import DatabaseError, LayoutError
from ecu_node.layout import Layout

__all__ = ["usable_part"]

_NOTHING: dict[str, Any] = {
    "branch": [], "input": [], "derived": [], "model_inputs": [], "fleet_inputs": [], "contactor": None, "status": None,
    "temperature": None, "e2e": [],
}  # fmt: skip


def usable_part(layout: Layout) -> tuple[VehicleDatabase, list[Finding]]:
    """Leave out of a layout what its DBC does not have.

    Parameters
    ----------
    layout : Layout
        As the user has it.

    Returns
    -------
    database : VehicleDatabase
        DBC, and the layout without the branches and inputs that cannot be looked up, and what depends on them.
    findings : list of Finding
        One for each of these.

    Raises
    ------
    DatabaseError
        If the DBC itself cannot be read.
    """
    try:
        return read_database(layout), []
    except (DatabaseError, LayoutError) as error:
        bare = read_database(_with(layout, **_NOTHING, watch=type(layout.watch)()))
        reason = str(error)
    findings: list[Finding] = []

    def kept(items: Iterable[Any], what: str, part: Callable[[Any], dict[str, Any]]) -> list[Any]:
        good = []
        for item in items:
            why = _why_not(replace(bare, layout=_with(bare.layout, **part(item))))
            if why is None:
                good.append(item)
            else:
                severity = Severity.ERROR if what == "branch" else Severity.WARNING
                findings.append(_missing(severity, what, item.name, why))
        return good

    branches = kept(layout.branch, "branch", lambda item: {"branch": [item]})
    inputs = kept(layout.input, "input", lambda item: {"input": [item]})
    names = {item.name for item in inputs}
    pruned = _with(
        layout,
        branch=branches,
        input=inputs,
        derived=[item for item in layout.derived if base_inputs(layout, [item.name]) <= names],
        model_inputs=[name for name in layout.model_inputs if base_inputs(layout, [name]) <= names],
        fleet_inputs=[name for name in layout.fleet_inputs if base_inputs(layout, [name]) <= names],
        contactor=None,
        status=None,
        temperature=None,
        watch=type(layout.watch)(),
    )
    if not findings:
        findings.append(_missing(Severity.ERROR, "layout", layout.path.name, reason))
    return replace(bare, layout=pruned), findings


def _with(layout: Layout, **keys: Any) -> Layout:
    changed: Layout = msgspec.structs.replace(layout, **keys)
    return changed


def _why_not(vehicle: VehicleDatabase) -> str | None:
    try:
        look_everything_up(vehicle)
    except (DatabaseError, LayoutError) as error:
        return str(error)
    return None


def _missing(severity: Severity, what: str, name: str, why: str) -> Finding:
    return Finding(
        severity=severity,
        kind="not in DBC",
        subject=name,
        text=why,
        remedy=f"correct the signal in the {what} {name}, or take the DBC that belongs to the layout",
    )
