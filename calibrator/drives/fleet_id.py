"""Which artificial fleets drives come from: a file ``fleet.id`` beside their logs, and in the store they came into.

One line per fleet, the same that stands in its ``truth.json``. It says nothing of the truth, only which truth belongs
to the drives: two artificial fleets have vehicles of the same names. Recorded fleets have no such file.
"""

from collections.abc import Collection
from pathlib import Path

from calibrator.errors import FleetError
from calibrator.files.storage import StorageError, open_storage

__all__ = ["read_fleet_ids", "require_same_fleet", "write_fleet_ids"]

FILE = "fleet.id"


def write_fleet_ids(folder: str | Path, fleet_ids: Collection[str]) -> None:
    """Note the fleets that the drives of a folder come from."""
    open_storage(folder).write(FILE, "".join(f"{item}\n" for item in sorted(fleet_ids)).encode("ascii"))


def read_fleet_ids(folder: str | Path) -> frozenset[str]:
    """Fleets that the drives of a folder, path or URL, come from; empty if nothing is noted."""
    storage = open_storage(folder)
    try:
        return frozenset((storage.read_if_there(FILE) or b"").decode("ascii").split())
    except (StorageError, UnicodeDecodeError):
        raise FleetError(f"{storage.url}/{FILE}: cannot be read; remove it, or simulate the fleet again") from None


def require_same_fleet(fleet_ids: Collection[str], truth_id: str, *, drives: str | Path, truth: Path) -> None:
    """Refuse a truth that is not that of the drives.

    Parameters
    ----------
    fleet_ids : collection of str
        Fleets that the drives come from; empty if unknown, which passes.
    truth_id : str
        Fleet of the truth.
    drives, truth : str or Path
        Where both are, for the message.

    Raises
    ------
    FleetError
        If the drives come from another fleet, or from more than this one.
    """
    if fleet_ids and set(fleet_ids) != {truth_id}:
        raise FleetError(
            f"{truth}: the truth of fleet {truth_id}, but {drives} is of fleet {' and '.join(sorted(fleet_ids))}; "
            "give the truth.json that lies beside the logs of this fleet"
        )
