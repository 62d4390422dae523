"""The begin of a vehicle's state: whom it trusts."""

from datetime import datetime
from pathlib import Path

from ecu_node.core.status import Reason, TrustError
from ecu_node.errors import UserError
from ecu_node.trust.audit import event_now
from ecu_node.trust.commit import commit
from ecu_node.trust.key_set import MAX_FIRST_VERSION, KeySet
from ecu_node.trust.state import TrustState, state_path
from ecu_node.trust.storage import locked

__all__ = ["provision"]


def provision(folder: Path, vehicle: str, keys: KeySet, now: datetime) -> None:
    """Begin the state of a vehicle: whom it trusts.

    Parameters
    ----------
    folder : Path
        Where; made if it does not exist.
    vehicle : str
        Identity of the vehicle.
    keys : KeySet
        Whom it trusts from now on, until these say otherwise.
    now : datetime
        For the audit log.

    Raises
    ------
    TrustError
        If there is a state already, or no other key set could come after this one.
    UserError
        If it cannot be written.
    """
    if keys.version > MAX_FIRST_VERSION:
        raise TrustError(
            Reason.NONE,
            f"key set {keys.version}: the first one of a vehicle is at most {MAX_FIRST_VERSION}, so that others can "
            f"come after it; make one with 'calibrator keys set', without --version",
        )
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"{folder}: cannot be made: {error.strerror}; choose another --state") from None
    with locked(folder):
        if state_path(folder).exists():
            raise TrustError(
                Reason.NONE, f"{folder}: there is a state already; keys are changed by a signed key set ('activate')"
            )
        event = event_now("provisioned", f"vehicle {vehicle}, key set {keys.version}", now=now)
        commit(folder, TrustState(vehicle=vehicle, keys=keys), event)
