"""Calibration from a store of summaries by the default method."""

import hashlib
from pathlib import Path

import msgspec

from calibrator.calibration.in_order import Workers
from calibrator.calibration.posterior_run import calibrate_store
from calibrator.calibration.previous import PreviousResult, require_previous
from calibrator.calibration.report import CalibrationReport
from calibrator.calibration.run_facts import FleetFacts, run_identity
from calibrator.calibration.unfinished import Unfinished
from calibrator.calibration.write_result import write_result
from calibrator.calibration_settings import CalibrationSettings
from calibrator.posterior.fleet import FindModels
from calibrator.summaries.store import SummaryStore
from calibrator.summaries.unity import UNITY_FILE
from calibrator.time_of_run import time_of_run
from ecu_node import __version__
from ecu_node.database import VehicleDatabase
from ecu_node.layout import file_digest

__all__ = ["calibrate_summaries"]


def calibrate_summaries(
    unfinished: Unfinished,
    store: SummaryStore,
    fleet: FleetFacts,
    database: VehicleDatabase,
    settings: CalibrationSettings,
    *,
    workers: Workers,
    find_models: FindModels | None = None,
    since: Path | None = None,
) -> CalibrationReport:
    """Calibrate from summaries; those that were read here become part of the result."""
    if since is not None:
        require_previous(since, database, store.identity)
    plan = _plan(store, database, settings, since)
    identity = run_identity(fleet, database, settings, created=unfinished.begin(plan, time_of_run()))
    run = calibrate_store(
        store,
        settings,
        identity,
        unfinished.chunks,
        workers=workers,
        find_models=find_models,
        previous=None if since is None else PreviousResult(folder=since.absolute()),
    )
    own = unfinished.summaries if unfinished.summaries.exists() else None
    return write_result(
        unfinished,
        fleet,
        identity,
        settings,
        details=run.learnt.details,
        notices=run.learnt.notices,
        summaries=own,
        window=store.storage.read_if_there(UNITY_FILE),
        buckets=store.identity.buckets,
    )


def _plan(store: SummaryStore, database: VehicleDatabase, settings: CalibrationSettings, since: Path | None) -> str:
    """Digest of all that decides what a run computes."""
    parts = (
        __version__,
        store.identity,
        store.versions(),
        database.layout.digest,
        database.digest,
        settings.record(),
        None if since is None else (str(since.absolute()), file_digest(since / "run.json")),
    )
    return hashlib.blake2b(msgspec.json.encode(parts, order="sorted"), digest_size=16).hexdigest()
