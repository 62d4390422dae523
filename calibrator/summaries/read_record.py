"""Drives of one vehicle become a record, whatever happens to them."""

from collections.abc import Sequence

import numpy as np
from threadpoolctl import threadpool_limits

from calibrator.drive import DriveFile
from calibrator.processes.messages import Unread
from calibrator.summaries.identity import StoreIdentity
from calibrator.summaries.record import Record, source_version
from calibrator.summaries.vehicle_summary import read_vehicle_summary
from ecu_node.database import VehicleDatabase
from ecu_node.errors import UserError

__all__ = ["read_record", "record_of"]


def read_record(entries: tuple[DriveFile, ...], *, store: StoreIdentity, database: VehicleDatabase) -> Record:
    """Record of some drives of one vehicle. One thread: the processes share the cores."""
    sources = _sources(entries)
    with threadpool_limits(1):
        try:
            found = read_vehicle_summary(entries, store.equipment, database, bank=store.bank)
        except UserError as error:
            return _unusable(entries, str(error))
        except (np.linalg.LinAlgError, ArithmeticError, LookupError, ValueError) as error:
            return _unusable(entries, f"its drives cannot be summarised: {error}; look at its recordings")
    return Record(vehicle=found.vehicle, drives=found.drives, sources=sources, found=found)


def record_of(entries: Sequence[DriveFile], outcome: "Record | Unread") -> Record:
    """What a reading gave; the record of drives that could not be read says why."""
    return _unusable(entries, outcome.reason) if isinstance(outcome, Unread) else outcome


def _sources(entries: Sequence[DriveFile]) -> tuple[str, ...]:
    return tuple(source_version(entry.path) for entry in entries)


def _unusable(entries: Sequence[DriveFile], problem: str) -> Record:
    drives = tuple(entry.name for entry in entries)
    return Record(vehicle=entries[0].vehicle, drives=drives, sources=_sources(entries), found=None, problem=problem)
