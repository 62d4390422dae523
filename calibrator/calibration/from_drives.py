"""Calibration from drives by the default method: summarised, and if asked read again."""

import shutil
from functools import partial
from pathlib import Path
from typing import Any

from calibrator.calibration.from_summaries import calibrate_summaries
from calibrator.calibration.in_order import Workers
from calibrator.calibration.report import CalibrationReport
from calibrator.calibration.run_facts import FleetFacts
from calibrator.calibration.unfinished import Unfinished
from calibrator.calibration_settings import CalibrationSettings
from calibrator.errors import FleetError
from calibrator.files.storage import open_storage
from calibrator.posterior.bench import read_bench
from calibrator.results.run_record import read_run
from calibrator.sensor_models.fleet import SensorFindings, find_sensor_models
from calibrator.sources.fleet_source import FleetSource, probe_equipment
from calibrator.summaries.add_drives import add_drives
from calibrator.summaries.identity import read_identity
from calibrator.summaries.open_store import open_store
from calibrator.summaries.store import SummaryStore
from calibrator.summaries.unity import keep_unity_window
from ecu_node.database import VehicleDatabase

__all__ = ["calibrate_drives"]


def calibrate_drives(
    unfinished: Unfinished,
    fleet: FleetSource,
    database: VehicleDatabase,
    settings: CalibrationSettings,
    *,
    workers: Workers,
    since: Path | None,
) -> CalibrationReport:
    """Summarise drives, and calibrate from the summaries."""
    store = _summaries_of(unfinished, fleet, database, settings, since)
    if since is None:  # a slip is told before the drives are read
        read_bench(
            settings,
            fleet.vehicles.keys(),
            store.identity.branches,
            left_out=fleet.left_out,
            full_scale_a=database.layout.full_scale_a,
        )
    limit_s = settings.time_limit_s
    add_drives(store, fleet, database, workers=workers.processes, time_limit_s=limit_s, exactly=since is None)
    keep_unity_window(store, fleet, database, time_limit_s=limit_s)
    find_models = None
    if settings.sensor_models:
        find_models = partial(
            _find_models, fleet=fleet, database=database, settings=settings, store=store, workers=workers
        )
    return calibrate_summaries(
        unfinished,
        store,
        FleetFacts.of_drives(fleet, store.identity.equipment),
        database,
        settings,
        workers=workers,
        find_models=find_models,
        since=since,
    )


def _summaries_of(
    unfinished: Unfinished,
    fleet: FleetSource,
    database: VehicleDatabase,
    settings: CalibrationSettings,
    since: Path | None,
) -> SummaryStore:
    """Store of the summaries read so far; one that was begun with other branches or another layout is begun anew."""
    folder = unfinished.summaries
    storage = open_storage(folder)
    if since is not None and not (since / folder.name).is_dir():
        read_run(since)
        raise FleetError(
            f"{since}: holds no summaries; add the new drives to the store it was made from, with 'calibrator "
            f"summarise', and give that store"
        )
    unfinished.summaries_since(since)
    if since is not None:
        identity = read_identity(storage, database)
        assert identity is not None
        return SummaryStore(storage=storage, identity=identity)
    equipment = probe_equipment(fleet, database, settings.branches, limit_s=settings.time_limit_s)
    try:
        return open_store(storage, equipment, database, fleet)
    except FleetError:
        shutil.rmtree(folder, ignore_errors=True)
        return open_store(storage, equipment, database, fleet)


def _find_models(
    *found: Any,
    fleet: FleetSource,
    store: SummaryStore,
    database: VehicleDatabase,
    settings: CalibrationSettings,
    workers: Workers,
) -> SensorFindings:
    """Second pass over the drives."""
    vehicles, zero_a, learning, trusted = found
    return find_sensor_models(
        vehicles,
        zero_a,
        fleet,
        store.identity.equipment,
        database,
        learning=learning,
        trusted=trusted,
        workers=workers.processes,
        limit_s=settings.time_limit_s,
    )
