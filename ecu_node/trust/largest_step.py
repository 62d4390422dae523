"""How far signed parameters may be from those in force, unless their signers allow more."""

from pathlib import Path

from ecu_node.core.status import Reason, TrustError
from ecu_node.database import VehicleDatabase
from ecu_node.parameters import BranchParameters, VehicleParameters
from ecu_node.trust.state import TrustState, signed_parameters

__all__ = ["require_small_step"]


def require_small_step(
    folder: Path, state: TrustState, new: VehicleParameters, database: VehicleDatabase, where: str
) -> None:
    """Check that parameters differ from the set in force by the layout's largest step at most.

    Parameters
    ----------
    folder : Path
        State of the vehicle.
    state : TrustState
        Of the same.
    new : VehicleParameters
        What is to come.
    database : VehicleDatabase
        Layout and DBC of the vehicle.
    where : str
        Where the new ones are from, for messages.

    Raises
    ------
    TrustError
        With reason IMPLAUSIBLE_PARAMETERS.
    """
    layout = database.layout
    if state.in_force is None:
        return
    try:
        before = signed_parameters(folder, state, state.in_force).parameters
    except TrustError:
        return  # what is damaged is not in force, and must not keep its successor out
    for name in layout.branch_names:
        (old_drift, old_a), (new_drift, new_a) = (_applied(item.branches.get(name)) for item in (before, new))
        drift, offset_a = abs(old_drift - new_drift), abs(old_a - new_a)
        if drift > layout.activation.step_drift or offset_a > layout.step_offset_a:
            raise TrustError(
                Reason.IMPLAUSIBLE_PARAMETERS,
                f"{where}: branch {name}: differs from the set in force by {drift:.3g} in drift and "
                f"{offset_a:.3g} A in offset, at most {layout.activation.step_drift:g} and "
                f"{layout.step_offset_a:g} A are allowed; if that is meant, sign with --allow-large-step",
            )


def _applied(branch: BranchParameters | None) -> tuple[float, float]:
    """Drift [1] and offset [A] as they are applied."""
    return (branch.drift, branch.offset_a) if branch is not None and branch.apply else (0.0, 0.0)
