"""The store of summaries at a place: opened, or made for a fleet."""

from pathlib import Path

from calibrator.errors import FleetError
from calibrator.files.storage import Storage
from calibrator.sources.fleet_source import Equipment, FleetSource
from calibrator.summaries.filter_bank import FilterBank
from calibrator.summaries.identity import read_identity, store_identity, write_identity
from calibrator.summaries.store import SummaryStore
from calibrator.terminal.text import few
from ecu_node.database import VehicleDatabase

__all__ = ["open_store", "require_store_or_nothing"]


def require_store_or_nothing(storage: Storage) -> None:
    """Refuse a place for summaries, before any drive is read, that is not empty and no store of them.

    Raises
    ------
    FleetError
        If it is another folder, a file, or one that does not last.
    """
    if storage.is_local and Path(storage.url).is_file():
        raise FleetError(f"{storage.url}: is a file; name a folder for the summaries, or a URL")
    if not storage.lasts:
        raise FleetError(
            f"{storage.url}: is gone when the command ends; name a folder for the summaries, or another URL"
        )
    there = storage.names()  # before its identity: another machine may make the store just now
    if there and read_identity(storage) is None:
        raise FleetError(
            f"{storage.url}: no store of summaries, and not empty: {few(there)}; choose an empty or new folder"
        )


def open_store(
    storage: Storage,
    equipment: Equipment,
    database: VehicleDatabase,
    fleet: FleetSource,
    *,
    bank: FilterBank | None = None,
) -> SummaryStore:
    """Open the store at a place, or make one for a fleet.

    Parameters
    ----------
    storage : Storage
        Where it is, or will be.
    equipment, database, fleet : Equipment, VehicleDatabase, FleetSource
        Whose drives are to be added.
    bank : FilterBank or None
        Filters of their inputs; None: those of the store, or the plain inputs for a new one.

    Returns
    -------
    SummaryStore
        To add to.

    Raises
    ------
    FleetError
        If there is a store of another layout, other branches or other inputs.
    """
    identity = read_identity(storage, database)
    if bank is None and identity is not None and identity.fleet_inputs == equipment.fleet_inputs:
        bank = identity.bank
    if bank is not None and bank.input_names != equipment.fleet_inputs:
        raise FleetError(
            f"the filter bank is for the inputs {', '.join(bank.input_names)}, this fleet has "
            f"{', '.join(equipment.fleet_inputs)}; choose a bank for it with 'calibrator identify'"
        )
    wanted = store_identity(
        equipment,
        database,
        bank=bank,
        vehicles=len(fleet.vehicles),
        fleet=fleet.path.resolve().name,
        fleet_ids=fleet.fleet_ids,
    )
    if identity is None:
        write_identity(storage, wanted)
        identity = read_identity(storage, database)  # another process may have made the store just now
        assert identity is not None
    if difference := identity.difference(wanted):
        raise FleetError(f"{storage.url}: these drives cannot be added to this store: {difference}; use another store")
    return SummaryStore(storage=storage, identity=identity)
