"""Drives of a fleet into a store of summaries, as a command."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from calibrator.files.storage import open_storage
from calibrator.processes.reading import TIME_LIMIT_S
from calibrator.sources.copies import without_copies
from calibrator.sources.fleet_source import find_fleet, probe_equipment
from calibrator.summaries.add_drives import add_drives
from calibrator.summaries.filter_bank import FilterBank
from calibrator.summaries.open_store import open_store, require_store_or_nothing
from calibrator.terminal.text import counted, dumps, left_out_text
from ecu_node.database import VehicleDatabase

__all__ = ["SummariseReport", "summarise_fleet"]


@dataclass(frozen=True, kw_only=True)
class SummariseReport:
    """What was summarised."""

    store: str
    vehicles: int
    drives: int
    left_out: Mapping[str, str]
    notices: tuple[str, ...]

    def as_json(self) -> str:
        """The report as JSON."""
        return dumps(vars(self))

    def as_text(self) -> str:
        """The report for people."""
        parts = [
            "\n".join(f"notice: {notice}" for notice in self.notices),
            left_out_text(self.left_out),
            f"{counted(self.drives, 'drive')} of {counted(self.vehicles, 'vehicle')} summarised in {self.store}",
        ]
        return "\n\n".join(part for part in parts if part)


def summarise_fleet(
    fleet: Path,
    database: VehicleDatabase,
    out: str,
    *,
    branches: tuple[str, ...] | None,
    bank: FilterBank | None = None,
    workers: int,
    time_limit_s: float = TIME_LIMIT_S,
    part: tuple[int, int] = (1, 1),
) -> SummariseReport:
    """Summarise the drives of a fleet that a store does not have yet.

    Parameters
    ----------
    fleet : Path
        The drives, see :func:`calibrator.sources.fleet_source.find_fleet`.
    database : VehicleDatabase
        DBC and layout.
    out : str
        Path or URL of the store; made if there is none.
    branches : tuple of str or None
        Branches to use; None: those that the fleet has.
    bank : FilterBank or None
        Filters of their inputs; None: those of the store, or the plain inputs for a new one.
    workers : int
        Number of processes.
    time_limit_s : float
        Longest time for the drives of one vehicle. [s]
    part : tuple of int
        Number and count: which part of the vehicles, where several machines share the work.

    Returns
    -------
    SummariseReport
        What was read; it is in the store then.

    Raises
    ------
    UserError
        If the drives do not fit the store, or it cannot be written.
    """
    storage = open_storage(out)
    require_store_or_nothing(storage)
    source = without_copies(find_fleet(fleet))
    equipment = probe_equipment(source, database, branches, limit_s=time_limit_s)
    store = open_store(storage, equipment, database, source, bank=bank)
    added = add_drives(store, source, database, workers=workers, time_limit_s=time_limit_s, part=part)
    return SummariseReport(
        store=out,
        vehicles=added.vehicles,
        drives=added.drives,
        left_out={**source.left_out, **added.problems},
        notices=(*source.notices, *equipment.notices),
    )
