"""One run of a calibration: from drives, or a store of their summaries, to a result folder.

The first pass learns the reference of the fleet from a fixed sample of the vehicles; the second estimates every vehicle
by itself, bucket by bucket of the store. Buckets that are done are kept: a run that was killed goes on from there. With
an earlier result (``since``), vehicles that have not driven since keep its parameters; of the others a sensor that has
moved is calibrated from the new drives alone.

Faults of the program in single vehicles (:mod:`calibrator.estimator.fleet_task`) end the command with exit code 70.
"""

import hashlib
import shutil
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import msgspec
import numpy as np
from threadpoolctl import threadpool_limits

from calibrator.errors import ContradictionError, DriveError, FleetError
from calibrator.estimator.fleet_estimate import FleetEstimate
from calibrator.estimator.fleet_task import Calibrated, FleetTask, learn_task
from calibrator.estimator.readings import (
    TRUSTED_DRIFT_SD,
    TRUSTED_OFFSET_SD,
    BenchTable,
    check_bench_table,
    read_bench_table,
)
from calibrator.estimator.results import (
    PARTS,
    CalibrationReport,
    ChunkResult,
    RunRecord,
    Written,
    encode_chunk,
    internal_error,
    join_rows,
    left_out_of,
    read_part,
    read_run,
    report_of,
    write_parameter_files,
    write_run,
)
from calibrator.estimator.settings import CalibrationSettings, require_learning
from calibrator.estimator.unfinished import Unfinished, unfinished_run
from calibrator.estimator.workers import Workers
from calibrator.files.folders import require_new_folder
from calibrator.files.parameter_files import RunIdentity
from calibrator.files.storage import Storage, open_storage
from calibrator.options import Method
from calibrator.sources.copies import without_copies
from calibrator.sources.fleet_source import (
    LOGS_FOLDER,
    STORE_FOLDER,
    Equipment,
    FleetSource,
    find_fleet,
    probe_equipment,
)
from calibrator.summaries.add_drives import add_drives
from calibrator.summaries.identity import StoreIdentity, read_identity
from calibrator.summaries.open_store import open_store
from calibrator.summaries.record import Outline, Record, drives_digest, joined_records
from calibrator.summaries.store import SummaryStore
from calibrator.summaries.unity import UNITY_FILE, keep_unity_window
from calibrator.summaries.vehicle_summary import VehicleSummary
from calibrator.terminal.progress import numbered_passes, progress_bar
from calibrator.terminal.text import few, few_reasons
from calibrator.time_of_run import time_of_run
from ecu_node import __version__
from ecu_node.database import VehicleDatabase
from ecu_node.errors import UserError
from ecu_node.layout import file_digest
from ecu_node.parameters import VehicleParameters, decode_parameters
from ecu_node.user_files import write_atomically

__all__ = [
    "Census",
    "calibrate_bucket",
    "calibrate_fleet",
    "read_sample",
    "require_fleet",
    "take_census",
]

MOST_LEARNT = 2000
"""Vehicles that the reference is learnt from. With so many its centre is known to a fortieth of what faultless vehicles
differ by, so more would not tell any vehicle's faults better. [1]"""
MOST_REASONS = 20
"""Reasons of vehicles left out that are kept for messages."""
MOVED_SD = 4.0
"""Standard deviations within which earlier and new faults of a sensor are the same. [1]"""
LEAST_PROBABILITY = 1e-3
"""Of the explanations near the earlier faults: below, a sensor has moved. [1]"""
NOT_THERE = "it is not in this store; its earlier parameters are in the earlier result"


@dataclass(frozen=True, kw_only=True)
class FleetFacts:
    """What a result says of its fleet."""

    name: str
    fleet_ids: tuple[str, ...]
    equipment: Equipment
    left_out: Mapping[str, str]
    notices: tuple[str, ...]


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
    if settings.branches is not None and since is not None:
        raise ContradictionError("--branches and --since exclude each other: the earlier result has decided on that")
    require_new_folder(out)
    storage = open_storage(place)
    identity = require_fleet(storage, place, database)
    if identity is not None:
        _require_summaries_enough(storage, settings)
        store = SummaryStore(storage=storage, identity=identity)
        about = FleetFacts(
            name=identity.fleet,
            fleet_ids=identity.fleet_ids,
            equipment=identity.equipment,
            left_out={},
            notices=identity.notices,
        )
        with unfinished_run(out) as unfinished, numbered_passes(4):  # look, learn, calibrate, write
            run = _Run(unfinished=unfinished, database=database, settings=settings, workers=workers, since=since)
            return run.summaries(store, about)
    fleet = _find_drives(Path(storage.url), settings, everyone=since is None)
    published = settings.method is Method.PUBLISHED
    with unfinished_run(out) as unfinished, numbered_passes(3 if published else 5):
        run = _Run(unfinished=unfinished, database=database, settings=settings, workers=workers, since=since)
        return run.published(fleet) if published else run.drives(fleet)


def require_fleet(storage: Storage, place: str | Path, database: VehicleDatabase) -> StoreIdentity | None:
    """Identity of the store of summaries at a place, None if there are drives; FleetError if it can be neither."""
    path = Path(storage.url)
    if storage.is_local and not path.is_dir():
        if path.exists():
            raise FleetError(
                f"{place}: is a file; give a store of drives or of summaries, or a folder with one folder of logs per "
                f"vehicle"
            )
        raise FleetError(f"{place}: no such folder, store of drives or store of summaries")
    identity = read_identity(storage, database)
    if identity is None and not storage.is_local:
        raise FleetError(f"{storage.url}: no store of summaries there; make one with 'calibrator summarise --out'")
    return identity


def _require_summaries_enough(storage: Storage, settings: CalibrationSettings) -> None:
    """Refuse drives beside summaries, as nobody can tell which are meant, and options that need the drives."""
    drives = [name for name in (STORE_FOLDER, LOGS_FOLDER) if storage.is_local and (Path(storage.url) / name).is_dir()]
    if drives:
        raise FleetError(
            f"{storage.url}: holds drives ({few(drives)}) and summaries (summaries.json); move one of them elsewhere, "
            f"and give the folder of the other"
        )
    needs = {"--method published": settings.method is Method.PUBLISHED, "--branches": settings.branches is not None}
    for option in (option for option, wanted in needs.items() if wanted):
        raise FleetError(f"{storage.url}: a store of summaries, and {option} needs the drives; give the drive store")


def _find_drives(path: Path, settings: CalibrationSettings, *, everyone: bool) -> FleetSource:
    """Drives of a fleet; if they are everyone's, vehicles that the settings name must be among them."""
    fleet = without_copies(find_fleet(path))
    if not fleet.vehicles:
        raise FleetError(f"{path}: no drive that is one vehicle's alone{few_reasons(fleet.left_out)}")
    if not everyone:
        return fleet
    for names, what in ((settings.hold_out, "hold out"), (settings.trusted, "trust")):
        if unknown := sorted(names - fleet.vehicles.keys()):
            reasons = few_reasons({name: fleet.left_out[name] for name in unknown if name in fleet.left_out})
            there = few(sorted(fleet.vehicles))
            raise FleetError(f"{path}: no vehicle {few(unknown)} to {what}{reasons}; there are {there}")
    require_learning(list(fleet.vehicles), settings, fleet.left_out)
    return fleet


def _facts_of_drives(fleet: FleetSource, equipment: Equipment) -> FleetFacts:
    return FleetFacts(
        name=fleet.path.resolve().name,
        fleet_ids=tuple(sorted(fleet.fleet_ids)),
        equipment=equipment,
        left_out=fleet.left_out,
        notices=(*fleet.notices, *equipment.notices),
    )


@dataclass(frozen=True, kw_only=True)
class Census:
    """Who there is in a store: numbers only, as a fleet has millions of names.

    Attributes
    ----------
    usable : mapping of int to int
        How many vehicles can be calibrated, by bucket; of all buckets.
    reasons : mapping of str to str
        Why others cannot; the first few.
    left_out : int
        How many others there are.
    """

    usable: Mapping[int, int]
    reasons: Mapping[str, str]
    left_out: int

    @property
    def size(self) -> int:
        """Number of vehicles that can be calibrated."""
        return sum(self.usable.values())


def take_census(store: SummaryStore, workers: Workers) -> Census:
    """Look at every bucket of a store; UserError if one cannot be read, or there is no vehicle."""
    buckets, usable, reasons, seen = store.buckets(), dict[int, int](), dict[str, str](), 0
    with progress_bar("look at vehicles", len(buckets), "chunks") as progress:
        for done, (bucket, outlines) in enumerate(zip(buckets, workers.map(store.outlines, buckets), strict=True), 1):
            seen += len(outlines)
            problems = {item.vehicle: item.problem for item in outlines if item.problem}
            usable[bucket] = len(outlines) - len(problems)
            reasons |= dict(list(problems.items())[: MOST_REASONS - len(reasons)])
            progress(done)
    if not seen:
        raise FleetError(f"{store.url}: the store of summaries is empty; add drives with 'calibrator summarise'")
    return Census(usable=usable, reasons=reasons, left_out=seen - sum(usable.values()))


def _outlines_of(store: SummaryStore, census: Census, names: Collection[str]) -> dict[str, Outline]:
    """What there is of some vehicles, by name; those that are not in the store are not."""
    found: dict[str, Outline] = {}
    for bucket, wanted in store.by_bucket(names).items():
        if bucket in census.usable:
            found |= {item.vehicle: item for item in store.outlines(bucket) if item.vehicle in wanted}
    return found


def read_sample(
    store: SummaryStore, census: Census, settings: CalibrationSettings, checked: Collection[str]
) -> list[VehicleSummary]:
    """Read the vehicles to learn from.

    Parameters
    ----------
    store : SummaryStore
        The store.
    census : Census
        Who there is in it.
    settings : CalibrationSettings
        Says which vehicles are held out, and which are trusted.
    checked : collection of str
        Vehicles that were checked on a bench.

    Returns
    -------
    list of VehicleSummary
        Trusted and checked ones, and others, by hash of their names, up to :data:`MOST_LEARNT` that may be learnt from.

    Raises
    ------
    FleetError
        If there are too few to learn from.
    """
    wanted = settings.trusted | frozenset(checked)
    apart = {store.bucket_of(name) for name in wanted}
    found: list[VehicleSummary] = []
    learners = 0
    for bucket in census.usable:
        if learners >= MOST_LEARNT and bucket not in apart:
            continue
        for name, records in store.read(bucket).items():
            learns = name not in settings.hold_out
            if name in wanted or (learns and learners < MOST_LEARNT):
                try:
                    found.append(joined_records(records))
                except DriveError:  # left out, with the reason, in the second pass
                    continue
                learners += learns
    require_learning([item.vehicle for item in found], settings, census.reasons, left_out_count=census.left_out)
    return found


@dataclass(frozen=True, kw_only=True)
class _Run:
    """One run: where it keeps what is done, and how it computes."""

    unfinished: Unfinished
    database: VehicleDatabase
    settings: CalibrationSettings
    workers: Workers
    since: Path | None

    def published(self, fleet: FleetSource) -> CalibrationReport:
        """Calibrate by the published method, which needs all models at once; its result is one chunk."""
        from calibrator.estimator.published_fleet import calibrate_fleet_published  # noqa: PLC0415 (takes a second to import)

        settings = self.settings
        equipment = probe_equipment(fleet, self.database, settings.branches, limit_s=settings.time_limit_s)
        about = _facts_of_drives(fleet, equipment)
        identity = self._identity(about, None)
        found = calibrate_fleet_published(fleet, equipment, identity, settings, workers=self.workers.processes)
        self.unfinished.put(0, encode_chunk(found.parameters, found.left_out))
        return self._result(replace(about, left_out={}), identity, details=found.details, notices=found.notices)

    def drives(self, fleet: FleetSource) -> CalibrationReport:
        """Summarise drives, and calibrate from the summaries."""
        store, limit_s = self._own_store(fleet), self.settings.time_limit_s
        if self.since is None:  # a slip in the table is reported before the drives are read
            self._bench(store.identity.branches, fleet.vehicles.keys(), fleet.left_out)
        add_drives(
            store,
            fleet,
            self.database,
            workers=self.workers.processes,
            time_limit_s=limit_s,
            exactly=self.since is None,
        )
        keep_unity_window(store, fleet, self.database, time_limit_s=limit_s)
        return self.summaries(store, _facts_of_drives(fleet, store.identity.equipment))

    def _own_store(self, fleet: FleetSource) -> SummaryStore:
        """Store of the summaries read so far; one that was begun with other branches or another layout is made anew."""
        folder, since = self.unfinished.summaries, self.since
        if since is not None and not (since / folder.name).is_dir():
            read_run(since)
            raise FleetError(
                f"{since}: holds no summaries; add the new drives to the store it was made from, with 'calibrator "
                f"summarise', and give that store"
            )
        self.unfinished.summaries_since(since)
        storage = open_storage(folder)
        if since is not None:
            identity = read_identity(storage, self.database)
            assert identity is not None
            return SummaryStore(storage=storage, identity=identity)
        settings = self.settings
        equipment = probe_equipment(fleet, self.database, settings.branches, limit_s=settings.time_limit_s)
        try:
            return open_store(storage, equipment, self.database, fleet)
        except FleetError:
            shutil.rmtree(folder, ignore_errors=True)
            return open_store(storage, equipment, self.database, fleet)

    def summaries(self, store: SummaryStore, about: FleetFacts) -> CalibrationReport:
        """Calibrate every vehicle of a store; summaries that were read by this run become part of its result."""
        previous = None if self.since is None else self.since.absolute()
        if self.since is not None:
            _require_previous(self.since, self.database, store.identity)
        versions = store.versions()
        identity = self._identity(about, self._plan(store, versions, previous))
        census = take_census(store, self.workers)
        self._require_named(store, census, fleet=about.name)
        with threadpool_limits(1):  # so that the reference is the same wherever it is learnt
            task, notices = self._learn(store, census, identity)
        done = self.unfinished.done()
        todo = [bucket for bucket in census.usable if bucket not in done]
        calibrate = partial(calibrate_bucket, store=store, task=task, previous=previous)
        seen = census.size - sum(census.usable[bucket] for bucket in todo)
        with progress_bar("calibrate", census.size, "vehicles", begun=seen) as progress:
            progress(seen)
            for bucket, chunk in zip(todo, self.workers.map(calibrate, todo), strict=True):
                self.unfinished.put(bucket, chunk)
                seen += census.usable[bucket]
                progress(seen)
        if store.versions() != versions:
            raise FleetError(f"{store.url}: the summaries were changed during the run; run the same command again")
        window, buckets = store.storage.read_if_there(UNITY_FILE), store.identity.buckets
        details = task.reference.details()
        return self._result(about, identity, details=details, notices=notices, window=window, buckets=buckets)

    def _plan(self, store: SummaryStore, versions: Mapping[str, str], previous: Path | None) -> str:
        """Digest of all that decides what is computed."""
        decides = (
            __version__,
            store.identity,
            versions,
            self.database.layout.digest,
            self.database.digest,
            self.settings.record(),
            None if previous is None else (str(previous), file_digest(previous / "run.json")),
        )
        return hashlib.blake2b(msgspec.json.encode(decides, order="sorted"), digest_size=16).hexdigest()

    def _identity(self, about: FleetFacts, plan: str | None) -> RunIdentity:
        created = self.unfinished.begin(plan, time_of_run())
        return RunIdentity(database=self.database, method=self.settings.method, fleet=about.name, created=created)

    def _require_named(self, store: SummaryStore, census: Census, *, fleet: str) -> None:
        """Refuse names of vehicles that there are not."""
        hold_out, trusted = self.settings.hold_out, self.settings.trusted
        there = _outlines_of(store, census, hold_out | trusted)
        for names, what in ((hold_out, "hold out"), (trusted, "trust")):
            missing = [name for name in sorted(names) if name not in there or (there[name].problem and what == "trust")]
            if missing:
                reasons = few_reasons({name: there[name].problem for name in missing if name in there})
                raise FleetError(f"fleet {fleet}: no usable vehicle {few(missing)} to {what}{reasons}")

    def _learn(self, store: SummaryStore, census: Census, identity: RunIdentity) -> tuple[FleetTask, list[str]]:
        """Read the bench table and the sample, and learn from them."""
        branches = store.identity.branches
        bench: BenchTable = {}
        if self.settings.readings is not None:
            named = {vehicle for vehicle, _ in self._bench_table(branches)}
            there = _outlines_of(store, census, named)
            some = {item.vehicle for bucket in list(census.usable)[:1] for item in store.outlines(bucket)}  # to name
            usable = {name for name, item in there.items() if not item.problem} | some - there.keys()
            bench = self._bench(branches, usable, {name: item.problem for name, item in there.items() if item.problem})
        with progress_bar("learn the fleet", None):
            vehicles = read_sample(store, census, self.settings, {vehicle for vehicle, _ in bench})
            return learn_task(
                vehicles, self.settings, bench, branches=branches, identity=identity, fleet_size=census.size
            )

    def _bench_table(self, branches: Collection[str]) -> BenchTable:
        path = self.settings.readings
        return {} if path is None else read_bench_table(path, branches, full_scale_a=self.database.layout.full_scale_a)

    def _bench(self, branches: Collection[str], vehicles: Collection[str], left_out: Mapping[str, str]) -> BenchTable:
        """Bench readings, all of vehicles that there are and none against the trust in one."""
        bench, scale_a = self._bench_table(branches), self.database.layout.full_scale_a
        check_bench_table(bench, vehicles, left_out=left_out, trusted=self.settings.trusted, full_scale_a=scale_a)
        return bench

    def _result(
        self,
        about: FleetFacts,
        identity: RunIdentity,
        *,
        details: Mapping[str, object],
        notices: Sequence[str],
        window: bytes | None = None,
        buckets: int = 0,
    ) -> CalibrationReport:
        """Put the chunks together to the result."""
        unfinished = self.unfinished
        folder, numbers = unfinished.result(), unfinished.done()
        vehicles = join_rows(folder, [unfinished.rows(number) for number in numbers], about.left_out)
        left_out, left_out_count = left_out_of(folder)
        if not vehicles:
            why = next(iter(left_out.values()), "there is none")
            raise FleetError(f"{about.name}: no vehicle can be calibrated; the first: {why}")
        with progress_bar("write the result", None):
            where = write_parameter_files(folder, {n: unfinished.parameters(n) for n in numbers}, vehicles=vehicles)
        if unfinished.summaries.exists():
            copy = folder / unfinished.summaries.name
            shutil.copytree(unfinished.summaries, copy, ignore=shutil.ignore_patterns(".*"))
        if window is not None:
            write_atomically(folder / UNITY_FILE, window)
        layout = self.database.layout
        run = RunRecord(
            tool=identity.tool,
            method=identity.method.value,
            fleet=identity.fleet,
            fleet_ids=list(about.fleet_ids),
            layout=layout.name,
            branches=list(about.equipment.branches),
            model_inputs=list(about.equipment.inputs),
            settings=self.settings.record(),
            created=identity.created,
            details=dict(details),
            vehicles=vehicles,
            buckets=buckets,
            left_out=left_out,
            left_out_count=left_out_count,
            full_scale_a=layout.full_scale_a,
            layout_sha256=layout.digest,
            dbc_sha256=self.database.digest,
            notices=[*about.notices, *notices],
        )
        write_run(folder, run)
        report = report_of(folder, run, parameters=where, shown=unfinished.shown)
        unfinished.finish()
        return report


def calibrate_bucket(bucket: int, *, store: SummaryStore, task: FleetTask, previous: Path | None = None) -> ChunkResult:
    """Calibrate the vehicles of a bucket; one bad vehicle never stops the others.

    Parameters
    ----------
    bucket : int
        Which.
    store : SummaryStore
        The store.
    task : FleetTask
        What was learnt.
    previous : Path or None
        Earlier result to go on from.

    Returns
    -------
    ChunkResult
        Parameters, and who was left out and why.
    """
    records, found = store.read(bucket), Calibrated()
    before = {} if previous is None else _earlier_part(previous, bucket)
    digests = {name: drives_digest(items) for name, items in records.items()}
    todo: list[VehicleSummary] = []
    for name, items in records.items():
        written = before.get(name)
        earlier = None if written is None else decode_parameters(written.text, f"earlier parameters of {name}")
        if earlier is not None and written is not None and written.drives == digests[name]:
            found.parameters.append(earlier)  # its evidence was found against another reference, and is not kept
            continue
        try:
            todo.append(_what_holds(items, earlier, task, found))
        except DriveError as error:
            found.left_out[name] = str(error)
        except UserError:
            raise
        except Exception as error:  # noqa: BLE001 (a fault of the program is reported with its vehicle)
            found.left_out[name] = internal_error(error)
    found.left_out |= dict.fromkeys(before.keys() - records.keys(), NOT_THERE)
    task.calibrate(todo, found)
    return encode_chunk(found.parameters, found.left_out, moved=found.moved, drives=digests, evidence=found.evidence)


def _earlier_part(previous: Path, bucket: int) -> dict[str, Written]:
    """Parameters of the vehicles of a bucket in an earlier result; FleetError if they cannot be read."""
    if not (previous / PARTS).is_dir():
        raise FleetError(
            f"{previous / PARTS}: the earlier result cannot be reached from here; put it where every worker reaches it "
            f"by this path"
        )
    return read_part(previous / PARTS / f"{bucket:05d}.parquet")


def _what_holds(
    records: Sequence[Record], earlier: VehicleParameters | None, task: FleetTask, found: Calibrated
) -> VehicleSummary:
    """Summary of all drives of a vehicle, or of the new ones alone if they show that a sensor has moved.

    Records stand in the order in which they came. Those before the first one that the earlier parameters were found
    from are of a time before a sensor moved.
    """
    drives = set() if earlier is None else set(earlier.provenance.drives)
    known = [place for place, record in enumerate(records) if record.drives and set(record.drives) <= drives]
    if earlier is None or not known:
        return joined_records(records)
    everything, new = joined_records(records[known[0] :]), records[known[-1] + 1 :]
    if not any(record.found for record in new):
        return everything
    try:
        recent = joined_records(new)
        changes = moved_sensors(earlier, task.estimate([recent]), task)
    except UserError:  # the new drives alone do not suffice
        return everything
    found.moved |= {(earlier.vehicle, branch): text for branch, text in changes.items()}
    return recent if changes else everything


def moved_sensors(before: VehicleParameters, now: FleetEstimate, task: FleetTask) -> dict[str, str]:
    """Sensors that have moved: the earlier faults of a vehicle are none of the explanations of its new drives.

    Parameters
    ----------
    before : VehicleParameters
        Earlier parameters of the vehicle.
    now : FleetEstimate
        Of the vehicle, from drives that came since and from these alone.
    task : FleetTask
        What was learnt.

    Returns
    -------
    dict of str to str
        What has moved from where to where, by branch; nothing if the earlier faults still explain the vehicle.
    """
    branches, scale_a = task.branches, task.identity.database.layout.full_scale_a
    old = [before.branches[name] for name in branches]
    value = np.array([[item.drift for item in old], [item.offset_a for item in old]])
    old_sd = np.array([[item.drift_sd or 0.0 for item in old], [item.offset_sd_a or 0.0 for item in old]])
    accuracy = np.array([[TRUSTED_DRIFT_SD], [TRUSTED_OFFSET_SD * scale_a]])
    sd = np.sqrt(np.array([now.drift_sd[0], now.offset_sd_a[0]]) ** 2 + old_sd**2 + accuracy**2)
    near = 0.0
    for each in now.explanations[0]:
        found = np.array([[part.get(name, 0.0) for name in branches] for part in (each.drift, each.offset_a)])
        near += each.probability * bool((np.abs(found - value) <= MOVED_SD * sd).all())
    if near >= LEAST_PROBABILITY:
        return {}
    found = np.array([now.drift[0], now.offset_a[0]])
    moved = (np.abs(found - value) > MOVED_SD * sd).any(axis=0)
    return {
        branches[k]: (
            f"drift {old[k].drift:+.2%} -> {found[0, k]:+.2%}, offset {old[k].offset_a:+.2f} A -> {found[1, k]:+.2f} A"
        )
        for k in np.flatnonzero(moved).tolist()
    }


def _require_previous(folder: Path, database: VehicleDatabase, store: StoreIdentity) -> None:
    """Refuse an earlier result that a run cannot go on from."""
    run = read_run(folder)
    if run.method != Method.POSTERIOR.value:
        raise FleetError(f"{folder}: a result of the method {run.method}; --since goes on from one of the posterior")
    if run.branches != list(store.branches):
        raise FleetError(
            f"{folder}: a result with branches {', '.join(run.branches)}; this fleet has {', '.join(store.branches)}: "
            f"calibrate it without --since"
        )
    if not (folder / PARTS).is_dir():
        raise FleetError(
            f"{folder / PARTS}: no such folder; expected the parameters of the earlier result: give the whole folder "
            f"that 'calibrator calibrate' wrote, or calibrate without --since"
        )
    if (run.layout_sha256, run.dbc_sha256) != (database.layout.digest, database.digest):
        raise FleetError(
            f"{folder}: made with another version of layout or DBC than {database.layout.path}; the node would not "
            f"accept its parameters: calibrate without --since"
        )
    if run.buckets != store.buckets:
        raise FleetError(
            f"{folder}: made from a store of {run.buckets} buckets, and this one has {store.buckets}; give the same "
            f"store, with the new drives added, or calibrate without --since"
        )
