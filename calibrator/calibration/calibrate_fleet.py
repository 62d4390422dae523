"""Calibration of a fleet: drives or their summaries -> what a method makes of them -> parameter files and report.

One bad vehicle never stops the fleet; who was left out stands in the report. What a run that was killed has done is
kept, and the next run to the same place goes on from it.
"""

from pathlib import Path

from calibrator.calibration.from_drives import calibrate_drives
from calibrator.calibration.from_summaries import calibrate_summaries
from calibrator.calibration.in_order import Workers
from calibrator.calibration.place import (
    find_drives,
    require_consistent,
    require_drives_unneeded,
    require_folder,
    require_summaries_alone,
)
from calibrator.calibration.published_run import calibrate_published
from calibrator.calibration.report import CalibrationReport
from calibrator.calibration.run_facts import FleetFacts
from calibrator.calibration.unfinished import unfinished_run
from calibrator.calibration_settings import CalibrationSettings
from calibrator.errors import FleetError
from calibrator.files.folders import require_new_folder
from calibrator.files.storage import open_storage
from calibrator.options import Method
from calibrator.summaries.identity import read_identity
from calibrator.summaries.store import SummaryStore
from calibrator.terminal.progress import numbered_passes
from ecu_node.database import VehicleDatabase

__all__ = ["calibrate_fleet"]

PASSES_OF_STORE = 4
"""Look at the vehicles, learn the fleet, calibrate, write the result."""
PASSES_PUBLISHED = 3
"""Read the drives, estimate the faults, write the result."""


def calibrate_fleet(
    place: str | Path,
    database: VehicleDatabase,
    out: Path,
    settings: CalibrationSettings,
    *,
    workers: Workers,
    since: Path | None = None,
) -> CalibrationReport:
    """Calibrate every vehicle of a fleet and write the result folder.

    Parameters
    ----------
    place : str or Path
        The fleet: its drives, see :func:`calibrator.sources.fleet_source.find_fleet`, or path or URL of a store of
        their summaries.
    database : VehicleDatabase
        DBC and layout.
    out : Path
        Folder of the result, new or empty; it appears only when it is complete.
    settings : CalibrationSettings
        How.
    workers : Workers
        Where it is computed.
    since : Path or None
        Earlier result to go on from: vehicles without new drives keep its parameters. A store must hold the earlier
        drives as well; of a folder of drives, those that the earlier result has are not read again.

    Returns
    -------
    CalibrationReport
        What was found; everything is on disk then.

    Raises
    ------
    UserError
        If the fleet as a whole cannot be calibrated.
    """
    require_consistent(settings, since)
    require_new_folder(out)
    storage = open_storage(place)
    require_folder(storage, place)
    stored = read_identity(storage, database)
    if stored is None and not storage.is_local:
        raise FleetError(f"{storage.url}: no store of summaries there; make one with 'calibrator summarise --out'")
    if stored is not None:
        require_summaries_alone(storage)
        require_drives_unneeded(settings, storage.url)
        store = SummaryStore(storage=storage, identity=stored)
        with unfinished_run(out) as unfinished, numbered_passes(PASSES_OF_STORE):
            return calibrate_summaries(
                unfinished, store, FleetFacts.of_store(store), database, settings, workers=workers, since=since
            )
    fleet = find_drives(Path(storage.url), settings, everyone=since is None)
    with unfinished_run(out) as unfinished, numbered_passes(_passes(settings)):
        if settings.method is Method.PUBLISHED:
            return calibrate_published(unfinished, fleet, database, settings, workers=workers)
        return calibrate_drives(unfinished, fleet, database, settings, workers=workers, since=since)


def _passes(settings: CalibrationSettings) -> int:
    """Passes of a calibration from drives, for who waits for it."""
    if settings.method is Method.PUBLISHED:
        return PASSES_PUBLISHED
    return PASSES_OF_STORE + 1 + settings.sensor_models
