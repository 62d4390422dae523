"""Calibration of a fleet: drives or their summaries -> what a method makes of them -> parameter files and report.

One bad vehicle never stops the fleet; who was left out stands in the report. What a run that was killed has done is
kept, and the next run to the same place goes on from it.
"""

import hashlib
import os
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

import msgspec

from calibrator.calibration.in_order import Workers
from calibrator.calibration.posterior_run import calibrate_store
from calibrator.calibration.previous import PreviousResult, require_previous
from calibrator.calibration.report import MOST_NAMED, CalibrationReport, report_of
from calibrator.calibration.unfinished import Unfinished, unfinished_run
from calibrator.calibration_settings import CalibrationSettings
from calibrator.errors import ContradictionError, FleetError
from calibrator.files.folders import require_new_folder
from calibrator.files.parameter_files import RunIdentity
from calibrator.files.storage import Storage, open_storage
from calibrator.options import Method
from calibrator.posterior.bench import read_bench
from calibrator.posterior.fleet import FindModels
from calibrator.published.fleet import calibrate_fleet_published
from calibrator.results.chunk import encode_chunk
from calibrator.results.left_out import left_out_of
from calibrator.results.parameter_parts import write_parameter_files
from calibrator.results.rows import join_rows
from calibrator.results.run_record import RunRecord, read_run, write_run
from calibrator.sensor_models.fleet import SensorFindings, find_sensor_models
from calibrator.sources.copies import without_copies
from calibrator.sources.fleet_source import (
    LOGS_FOLDER,
    STORE_FOLDER,
    Equipment,
    FleetSource,
    find_fleet,
    probe_equipment,
)
from calibrator.summaries.identity import read_identity
from calibrator.summaries.store import SummaryStore
from calibrator.summaries.summarise import add_drives, open_store
from calibrator.summaries.unity import UNITY_FILE, keep_unity_window
from calibrator.terminal.progress import numbered_passes, progress_bar
from calibrator.terminal.text import few, few_reasons
from ecu_node import __version__
from ecu_node.database import VehicleDatabase
from ecu_node.layout import file_digest
from ecu_node.user_files import write_atomically

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
    _require_consistent(settings, since)
    require_new_folder(out)
    storage = open_storage(place)
    _require_folder(storage, place)
    stored = read_identity(storage, database)
    if stored is None and not storage.is_local:
        raise FleetError(f"{storage.url}: no store of summaries there; make one with 'calibrator summarise --out'")
    if stored is not None:
        _require_summaries_alone(storage)
        _require_drives_unneeded(settings, storage.url)
        store = SummaryStore(storage=storage, identity=stored)
        with unfinished_run(out) as unfinished, numbered_passes(PASSES_OF_STORE):
            return _calibrate_store(
                unfinished, store, _Fleet.of_store(store), database, settings, workers=workers, since=since
            )
    fleet = _find_drives(Path(storage.url), settings, everyone=since is None)
    with unfinished_run(out) as unfinished, numbered_passes(_passes(settings)):
        if settings.method is Method.PUBLISHED:
            return _calibrate_published(unfinished, fleet, database, settings, workers=workers)
        return _calibrate_drives(unfinished, fleet, database, settings, workers=workers, since=since)


def _calibrate_drives(
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
    return _calibrate_store(
        unfinished,
        store,
        _Fleet.of_drives(fleet, store.identity.equipment),
        database,
        settings,
        workers=workers,
        find_models=find_models,
        since=since,
    )


@dataclass(frozen=True, kw_only=True)
class _Fleet:
    """What a result says of its fleet."""

    name: str
    fleet_ids: tuple[str, ...]
    equipment: Equipment
    left_out: Mapping[str, str]
    notices: tuple[str, ...]

    @classmethod
    def of_drives(cls, fleet: FleetSource, equipment: Equipment) -> "_Fleet":
        return cls(
            name=fleet.path.resolve().name,
            fleet_ids=tuple(sorted(fleet.fleet_ids)),
            equipment=equipment,
            left_out=fleet.left_out,
            notices=(*fleet.notices, *equipment.notices),
        )

    @classmethod
    def of_store(cls, store: SummaryStore) -> "_Fleet":
        identity = store.identity
        return cls(
            name=identity.fleet,
            fleet_ids=identity.fleet_ids,
            equipment=identity.equipment,
            left_out={},
            notices=identity.notices,
        )


def _require_consistent(settings: CalibrationSettings, since: Path | None) -> None:
    """Refuse settings that contradict each other."""
    both = settings.hold_out & settings.trusted
    if both:
        raise ContradictionError(
            f"vehicle {few(sorted(both))} is both held out and trusted: the reference would be learnt from it"
        )
    for option, wanted in (("--branches", settings.branches is not None), ("--sensor-models", settings.sensor_models)):
        if wanted and since is not None:
            raise ContradictionError(f"{option} and --since exclude each other: the earlier result has decided on that")


def _require_folder(storage: Storage, place: str | Path) -> None:
    """Refuse a place that cannot be a fleet; of a URL its storage tells."""
    if storage.is_local and not Path(storage.url).is_dir():
        if Path(storage.url).exists():
            raise FleetError(
                f"{place}: is a file; give a store of drives or of summaries, or a folder with one folder of logs per "
                f"vehicle"
            )
        raise FleetError(f"{place}: no such folder, store of drives or store of summaries")


def _require_summaries_alone(storage: Storage) -> None:
    """Refuse a store of summaries in which there are drives as well: which are meant, nobody can tell."""
    drives = [name for name in (STORE_FOLDER, LOGS_FOLDER) if storage.is_local and (Path(storage.url) / name).is_dir()]
    if drives:
        raise FleetError(
            f"{storage.url}: holds drives ({few(drives)}) and summaries (summaries.json); move one of them elsewhere, "
            f"and give the folder of the other"
        )


def _require_drives_unneeded(settings: CalibrationSettings, where: str) -> None:
    """Refuse what summaries do not tell."""
    needs = {
        "--method published": settings.method is Method.PUBLISHED,
        "--sensor-models": settings.sensor_models,
        "--branches": settings.branches is not None,
    }
    for option, wanted in needs.items():
        if wanted:
            raise FleetError(f"{where}: a store of summaries, and {option} needs the drives; give the drive store")


def _passes(settings: CalibrationSettings) -> int:
    """Passes of a calibration from drives, for who waits for it."""
    if settings.method is Method.PUBLISHED:
        return PASSES_PUBLISHED
    return PASSES_OF_STORE + 1 + settings.sensor_models


def _find_drives(path: Path, settings: CalibrationSettings, *, everyone: bool) -> FleetSource:
    """Drives of a fleet; if they are everyone's, vehicles that the settings name must be among them."""
    fleet = without_copies(find_fleet(path))
    if not fleet.vehicles:
        raise FleetError(f"{path}: no drive that is one vehicle's alone{few_reasons(fleet.left_out)}")
    for names, what in ((settings.hold_out, "hold out"), (settings.trusted, "trust")):
        unknown = sorted(names - fleet.vehicles.keys()) if everyone else []
        if unknown:
            reasons = few_reasons({name: fleet.left_out[name] for name in unknown if name in fleet.left_out})
            there = few(sorted(fleet.vehicles))
            raise FleetError(f"{path}: no vehicle {few(unknown)} to {what}{reasons}; there are {there}")
    return fleet


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


def _calibrate_store(
    unfinished: Unfinished,
    store: SummaryStore,
    fleet: _Fleet,
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
    identity = _identity(fleet, database, settings, created=unfinished.begin(plan, _now()))
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
    return _finish(
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


def _calibrate_published(
    unfinished: Unfinished,
    fleet: FleetSource,
    database: VehicleDatabase,
    settings: CalibrationSettings,
    *,
    workers: Workers,
) -> CalibrationReport:
    """The published method needs all models at once; its result is one chunk."""
    equipment = probe_equipment(fleet, database, settings.branches, limit_s=settings.time_limit_s)
    about = _Fleet.of_drives(fleet, equipment)
    identity = _identity(about, database, settings, created=unfinished.begin(None, _now()))
    outcome = calibrate_fleet_published(fleet, equipment, identity, settings, workers=workers.processes)
    unfinished.chunks.put(0, encode_chunk(outcome.parameters, outcome.left_out))
    about = replace(about, left_out={})
    return _finish(unfinished, about, identity, settings, details=outcome.details, notices=outcome.notices)


def _now() -> str:
    """The time, ISO 8601; that of SOURCE_DATE_EPOCH, if it is set, makes results alike to the bit."""
    epoch = os.environ.get("SOURCE_DATE_EPOCH")
    if epoch is not None and not epoch.isdecimal():
        raise FleetError(f"SOURCE_DATE_EPOCH is {epoch!r}; expected seconds since 1970, or leave it unset")
    now = datetime.now(UTC) if epoch is None else datetime.fromtimestamp(int(epoch), UTC)
    return now.isoformat(timespec="seconds")


def _identity(fleet: _Fleet, database: VehicleDatabase, settings: CalibrationSettings, *, created: str) -> RunIdentity:
    return RunIdentity(database=database, method=settings.method, fleet=fleet.name, created=created)


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


def _finish(
    unfinished: Unfinished,
    fleet: _Fleet,
    identity: RunIdentity,
    settings: CalibrationSettings,
    *,
    details: Mapping[str, object],
    notices: Sequence[str],
    summaries: Path | None = None,
    window: bytes | None = None,
    buckets: int = 0,
) -> CalibrationReport:
    """Put the chunks together."""
    chunks, folder = unfinished.chunks, unfinished.result()
    numbers = chunks.numbers()
    vehicles = join_rows(folder, [chunks.rows(number) for number in numbers], fleet.left_out)
    left_out, left_out_count = left_out_of(folder, most=MOST_NAMED)
    if not vehicles:
        why = next(iter(left_out.values()), "there is none")
        raise FleetError(f"{fleet.name}: no vehicle can be calibrated; the first: {why}")
    with progress_bar("write the result", None):
        where = write_parameter_files(folder, {n: chunks.parameters(n) for n in numbers}, vehicles=vehicles)
    if summaries is not None:
        shutil.copytree(summaries, folder / summaries.name, ignore=shutil.ignore_patterns(".*"))
    if window is not None:
        write_atomically(folder / UNITY_FILE, window)
    run = RunRecord(
        tool=identity.tool,
        method=identity.method.value,
        fleet=identity.fleet,
        fleet_ids=list(fleet.fleet_ids),
        layout=identity.database.layout.name,
        branches=list(fleet.equipment.branches),
        model_inputs=list(fleet.equipment.inputs),
        settings=settings.record(),
        created=identity.created,
        details=dict(details),
        vehicles=vehicles,
        buckets=buckets,
        left_out=left_out,
        left_out_count=left_out_count,
        full_scale_a=identity.database.layout.full_scale_a,
        layout_sha256=identity.database.layout.digest,
        dbc_sha256=identity.database.digest,
        notices=[*fleet.notices, *notices],
    )
    write_run(folder, run)
    report = report_of(folder, run, parameters=where, shown=unfinished.shown)
    unfinished.finish()
    return report
