"""How far signed parameters may be from those in force, unless their signers allow more."""

from pathlib import Path

from ecu_node.database import VehicleDatabase
from ecu_node.errors import TrustError
from ecu_node.parameters import BranchParameters, VehicleParameters
from ecu_node.sensor_models import GainBySign
from ecu_node.status import Reason
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
        old, next_ = _applied(before.branches.get(name)), _applied(new.branches.get(name))
        drift = max(abs(a - b) for a, b in zip(old[:2], next_[:2], strict=True))
        offset_a = abs(old[2] - next_[2])
        if drift > layout.activation.step_drift or offset_a > layout.step_offset_a:
            raise TrustError(
                Reason.IMPLAUSIBLE_PARAMETERS,
                f"{where}: branch {name}: differs from the set in force by {drift:.3g} in drift and "
                f"{offset_a:.3g} A in offset, at most {layout.activation.step_drift:g} and "
                f"{layout.step_offset_a:g} A are allowed; if that is meant, sign with --allow-large-step",
            )


def _applied(branch: BranchParameters | None) -> tuple[float, float, float]:
    """Drifts for currents into and out of the junction, and offset, as they are applied. [1, 1, A]"""
    if branch is None or not branch.apply:
        return 0.0, 0.0, 0.0
    model = branch.sensor_model
    if isinstance(model, GainBySign):
        return model.drift_positive, model.drift_negative, branch.offset_a
    return branch.drift, branch.drift, branch.offset_a
