"""Parameters in force: what they correct on each branch, and how a node begins to work with them while it runs."""

from dataclasses import dataclass

from ecu_node.branch_plans import branch_plan, passing_plan
from ecu_node.corrector import Corrector
from ecu_node.database import VehicleDatabase
from ecu_node.guard import PARAMETER_SETS, Mode
from ecu_node.parameters import VehicleParameters
from ecu_node.sensor_fault import NO_FAULT, SensorFault
from ecu_node.status import Reason

__all__ = ["InForce", "not_published", "put_in_force", "sensor_fault"]


@dataclass(frozen=True, kw_only=True)
class InForce:
    """Parameters in force, or the reason why there are none and measured values are passed through."""

    parameters: VehicleParameters | None
    reason: Reason = Reason.NONE


def sensor_fault(in_force: InForce, branch: str) -> SensorFault:
    """What is corrected on one branch; NO_FAULT where the parameters apply none."""
    found = in_force.parameters.branches.get(branch) if in_force.parameters is not None else None
    return SensorFault(drift=found.drift, offset_a=found.offset_a) if found is not None and found.apply else NO_FAULT


def not_published(database: VehicleDatabase, in_force: InForce) -> list[str]:
    """Branches with a fault to correct, but no signal to publish the result in; it counts in the status' sum alone."""
    names = [branch.name for branch in database.layout.branch if branch.corrected is None]
    return [name for name in names if sensor_fault(in_force, name).applied]


def put_in_force(
    corrector: Corrector, database: VehicleDatabase, in_force: InForce, now_s: float, *, mode: Mode
) -> None:
    """Let a corrector work with these parameters from now on.

    Parameters
    ----------
    corrector : Corrector
        Built from the same layout and DBC.
    database : VehicleDatabase
        Layout and DBC.
    in_force : InForce
        Checked parameters, or why there are none.
    now_s : float
        Now; branches that the parameters name are waited for from here. [s]
    mode : Mode
        Where corrected values go, as when the corrector was built: what can be wrong with layout and DBC was said then.
    """
    parameters = in_force.parameters
    found = parameters.branches if parameters is not None else {}
    plans = []  # all of them before the first is put in force: either all or none
    for branch in database.layout.branch:
        fault = sensor_fault(in_force, branch.name)
        plans.append((branch, fault, branch_plan(database, branch, fault, mode)))
    for (branch, fault, plan), live in zip(plans, corrector.branches, strict=True):
        delay_s = found[branch.name].delay_s if branch.name in found else None
        live.put_in_force(
            fault=fault,
            plan=plan,
            passing=passing_plan(database, branch, mode),
            delay_s=delay_s or 0.0,
            expected_since_s=now_s if branch.name in found else None,
            counters=corrector.counters,
        )
    if parameters is None:
        corrector.put_in_force(reason=in_force.reason, parameter_set=0)
        return
    measured_a, corrected_a = parameters.junction_residual.about_expected()
    corrector.put_in_force(
        reason=in_force.reason,
        parameter_set=parameters.number % PARAMETER_SETS,
        expected_a=parameters.junction_residual.expected_a,
        predicted_worse_a=corrected_a - measured_a,
    )
