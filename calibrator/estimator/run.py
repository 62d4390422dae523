"""Run a calibration: from drives, or a store of their summaries, to a result folder.

Drives are summarised first, into a store that is deleted when the run ends. The first pass over a store learns the
reference of the fleet from a fixed sample of the vehicles; the second estimates every vehicle by itself, bucket by
bucket. With an earlier result (``since``), vehicles that have not driven since keep its parameters; one whose sensors
have moved is calibrated from its new drives alone.

Faults of the program in single vehicles (:mod:`calibrator.estimator.fleet_task`) end the command with exit code 70.
"""

from collections.abc import Callable, Collection, Mapping, Sequence, Set
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TypeAlias

from threadpoolctl import threadpool_limits

from calibrator.compiled import is_compiled
from calibrator.drive import Equipment, FleetSource
from calibrator.drives.store import DRIVES_FOLDER
from calibrator.errors import ContradictionError, DriveError, FleetError
from calibrator.estimator.fleet_task import calibrate_bucket, learn_task
from calibrator.estimator.readings import BenchTable, check_bench_table, read_bench_table
from calibrator.estimator.results import (
    MOST_NAMED,
    PARTS,
    CalibrationReport,
    RunRecord,
    join_rows,
    left_out_of,
    part_file,
    parts_of,
    read_run,
    report_of,
    write_parameter_files,
    write_run,
)
from calibrator.estimator.settings import CalibrationSettings, Method, require_learning
from calibrator.estimator.vehicle_parameters import RunIdentity, time_of_run
from calibrator.files.folders import require_new_folder, whole_folder
from calibrator.files.storage import Storage, open_storage
from calibrator.processes.run_many import Workers, run_many
from calibrator.sources.fleet_source import LOGS_FOLDER, find_fleet, probe_equipment
from calibrator.summaries.identity import FEWEST_BUCKETS, StoreIdentity, read_identity
from calibrator.summaries.record import joined_records
from calibrator.summaries.summarise_fleet import add_drives
from calibrator.summaries.summary_store import SummaryStore, open_store
from calibrator.summaries.vehicle_summary import VehicleSummary
from calibrator.terminal.progress import numbered_passes, progress_bar
from calibrator.terminal.text import few, few_reasons
from ecu_node.database import VehicleDatabase
from ecu_node.documents import write_atomically
from ecu_node.layout import Layout

__all__ = ["Census", "calibrate_fleet", "read_sample", "require_fleet", "take_census"]

MOST_LEARNT, MOST_BLOCKS = 2000, 50_000
"""Most vehicles that the reference is learnt from, and about the most blocks of their drives. With so many vehicles its
centre is known to a fortieth of the spread of faultless vehicles, so more would not tell any vehicle's faults better;
so many blocks take about half a GiB, and are 200 vehicles with two hours of driving or more. [1]"""
MOST_REASONS = 20
"""Largest number of reasons for leaving vehicles out that are kept for messages."""
WORTH_PROCESSES = 200
"""Number of vehicles from which on `workers` are used. Other processes take 3 s to start; with 600 vehicles of two
branches two of them are no faster yet, but with more branches each vehicle takes longer. [1]"""
Calibrate: TypeAlias = Callable[..., tuple[Equipment, bytes, dict[str, object], Sequence[str]]]
"""Function that calibrates all vehicles in one go; returns equipment, content of a part file, details and notices."""


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
        The user's choices.
    workers : Workers
        Processes or cluster that compute it.
    since : Path or None
        Earlier result to go on from: vehicles without new drives keep its parameters. The fleet is then a store of
        summaries that holds the earlier drives as well.

    Returns
    -------
    CalibrationReport
        What was found; everything is on disk by then.

    Raises
    ------
    UserError
        If the fleet as a whole cannot be calibrated.
    """
    if settings.branches is not None and since is not None:
        raise ContradictionError("--branches and --since exclude each other: the earlier result has decided on that")
    require_new_folder(out)
    storage = open_storage(place)
    identity, fleet, passes = require_fleet(storage, place, database), None, 4  # look, learn, calibrate, write
    calibrate: Calibrate | None = None
    if identity is not None:
        _require_summaries_enough(storage, settings, database.layout)
        name = identity.fleet
    elif since is not None:
        raise FleetError(
            f"{place}: drives, and --since goes on with summaries; add the new drives to the store that {since} was "
            f"made from, with 'calibrator summarise', and give that store"
        )
    else:
        fleet = find_fleet(storage.url)
        name = fleet.name
        calibrate = _at_once(fleet, settings, database.layout)
        passes = 5 if calibrate is None else 3 if settings.method is Method.PUBLISHED else 2
        if calibrate is None or settings.method is Method.PUBLISHED:
            _require_named(settings, set(fleet.vehicles), fleet.left_out, f"fleet {name}")
            require_learning(list(fleet.vehicles), settings, fleet.left_out)
    run_identity = RunIdentity(database=database, method=settings.method, fleet=name, created=time_of_run())
    with whole_folder(out) as result, TemporaryDirectory(dir=result) as summaries, numbered_passes(passes):
        (result / PARTS).mkdir()
        run = _Run(result=result, shown=out, identity=run_identity, settings=settings, workers=workers)
        if identity is not None:
            return run.summaries(SummaryStore(storage=storage, identity=identity), {}, since)
        assert fleet is not None
        if calibrate is not None:
            equipment, part, details, notices = calibrate(fleet, run_identity, settings, workers=workers)
            write_atomically(part_file(result, 0), part)
            return run.finished(equipment, {}, details=details, notices=notices)
        found = probe_equipment(fleet, database, settings.branches, limit_s=settings.time_limit_s)
        store = open_store(open_storage(summaries), found, database, fleet)
        # a slip in the table is reported before the drives are read
        run.check(run.bench_table(store), fleet.vehicles, fleet.left_out)
        add_drives(store, fleet, database, workers=workers, time_limit_s=settings.time_limit_s)
        return run.summaries(store, fleet.left_out, None)


def require_fleet(storage: Storage, place: str | Path, database: VehicleDatabase) -> StoreIdentity | None:
    """Return the identity of a store of summaries, None if the place has drives; FleetError if it can be neither."""
    path = Path(storage.url)
    if storage.is_local and path.is_file():
        return None
    if storage.is_local and not path.is_dir():
        raise FleetError(f"{place}: no such folder, store of drives or store of summaries")
    return read_identity(storage, database)


def _require_summaries_enough(storage: Storage, settings: CalibrationSettings, layout: Layout) -> None:
    """Refuse drives beside summaries, as nobody can tell which are meant, and options that need the drives."""
    drives = [name for name in (DRIVES_FOLDER, LOGS_FOLDER) if storage.is_local and (Path(storage.url) / name).is_dir()]
    if drives:
        raise FleetError(
            f"{storage.url}: holds drives ({few(drives)}) and summaries (summaries.json); move one of them elsewhere, "
            f"and give the folder of the other"
        )
    needs = {
        "--method published": settings.method is Method.PUBLISHED,
        "--branches": settings.branches is not None,
        "--meter": settings.meter is not None,
        "--trusted with a branch": settings.trusted & set(layout.branch_names),
        "a junction without a fleet": settings.alone,
    }
    for option in (option for option, wanted in needs.items() if wanted):
        raise FleetError(f"{storage.url}: a store of summaries, and {option} needs the drives; give the drive store")


def _at_once(fleet: FleetSource, settings: CalibrationSettings, layout: Layout) -> Calibrate | None:
    """Return the function of the published method or of single junctions; None if the fleet is compared with itself.

    Each vehicle is calibrated by itself if there is only one, if what is known is about branches, or if the user asks.
    """
    if settings.method is Method.PUBLISHED:
        from calibrator.estimator.published_fleet import calibrate_fleet_published  # noqa: PLC0415 (takes a second)

        return calibrate_fleet_published
    of_branches = bool(settings.trusted) and not settings.trusted & fleet.vehicles.keys()
    of_branches = of_branches and settings.trusted <= set(layout.branch_names)
    alone = settings.alone or settings.meter is not None
    if not (alone or of_branches or len(fleet.vehicles) == 1):
        return None
    fleets = {"--hold-out": settings.hold_out, "--expected-faults": settings.expected_faults is not None}
    for option in (option for option, given in fleets.items() if given):
        raise ContradictionError(f"{option} is for a fleet that is compared with itself, not for single junctions")
    from calibrator.estimator.junction_run import calibrate_junctions  # noqa: PLC0415 (a fleet does not need it)

    return partial(calibrate_junctions, trusted=settings.trusted)  # here these are branches


def _require_named(settings: CalibrationSettings, usable: Set[str], problems: Mapping[str, str], place: str) -> None:
    """Refuse names of vehicles that do not exist or cannot be used, with the reason if there is one."""
    for names, what in ((settings.hold_out - problems.keys(), "hold out"), (settings.trusted, "trust")):
        if missing := sorted(names - usable):
            reasons = few_reasons({name: problems[name] for name in missing if name in problems})
            raise FleetError(f"{place}: no usable vehicle {few(missing)} to {what}{reasons}")


@dataclass(frozen=True, kw_only=True)
class Census:
    """Numbers of vehicles in a store, and hardly any of their names, as a fleet may have millions.

    Attributes
    ----------
    usable : mapping of int to int
        Number of vehicles that can be calibrated, by bucket; for all buckets.
    left_out : int
        Number of vehicles that cannot be calibrated.
    reasons : mapping of str to str
        Why they cannot, for the first few and for those that were asked for.
    named : frozenset of str
        Names of vehicles that can be calibrated, of those that were asked for and those of the first bucket.
    """

    usable: Mapping[int, int]
    left_out: int
    reasons: Mapping[str, str]
    named: frozenset[str]

    @property
    def size(self) -> int:
        """Number of vehicles that can be calibrated."""
        return sum(self.usable.values())


def take_census(store: SummaryStore, workers: Workers, asked: Collection[str] = ()) -> Census:
    """Count the vehicles in every bucket of a store; UserError if one cannot be read, or there is no vehicle."""
    buckets, usable, reasons, named, seen = store.buckets(), dict[int, int](), dict[str, str](), set[str](), 0
    with progress_bar("look at vehicles", len(buckets), "chunks") as progress:
        found = run_many(store.outlines, buckets, workers)
        for done, (bucket, outlines) in enumerate(zip(buckets, found, strict=True), 1):
            seen += len(outlines)
            problems = {item.vehicle: item.problem for item in outlines if item.problem}
            usable[bucket] = len(outlines) - len(problems)
            first = list(problems)[: max(MOST_REASONS - len(reasons), 0)]
            reasons |= {name: problems[name] for name in problems if name in asked or name in first}
            named |= {item.vehicle for item in outlines if done == 1 or item.vehicle in asked} - problems.keys()
            progress(done)
    if not seen:
        raise FleetError(f"{store.url}: the store of summaries is empty; add drives with 'calibrator summarise'")
    left_out = seen - sum(usable.values())
    return Census(usable=usable, left_out=left_out, reasons=reasons, named=frozenset(named))


def read_sample(
    store: SummaryStore, census: Census, settings: CalibrationSettings, checked: Collection[str]
) -> list[VehicleSummary]:
    """Read the vehicles to learn from; FleetError if they are too few.

    Parameters
    ----------
    store, census : SummaryStore, Census
        The store, and which vehicles are in it.
    settings : CalibrationSettings
        Says which vehicles are held out, and which are trusted.
    checked : collection of str
        Vehicles that were checked on a bench.

    Returns
    -------
    list of VehicleSummary
        Trusted and checked vehicles, and others by the hash of their names until :data:`MOST_LEARNT` may be learnt
        from, or their drives have :data:`MOST_BLOCKS` blocks.
    """
    wanted = settings.trusted | frozenset(checked)
    apart = {store.bucket_of(name) for name in wanted}
    found: list[VehicleSummary] = []
    learners = blocks = 0
    for bucket in census.usable:
        if (learners >= MOST_LEARNT or blocks >= MOST_BLOCKS) and bucket not in apart:
            continue
        for name, records in store.read(bucket).items():
            learns = name not in settings.hold_out
            if name in wanted or (learns and learners < MOST_LEARNT and blocks < MOST_BLOCKS):
                try:
                    found.append(joined_records(records))
                except DriveError:  # left out, with the reason, in the second pass
                    continue
                learners += learns
                blocks += learns * len(found[-1].summary.moments)
    require_learning([item.vehicle for item in found], settings, census.reasons, left_out_count=census.left_out)
    return found


@dataclass(frozen=True, kw_only=True)
class _Run:
    """One run: settings, where it is computed, and the result: ``result`` is its folder now, ``shown`` the user's."""

    result: Path
    shown: Path
    identity: RunIdentity
    settings: CalibrationSettings
    workers: Workers

    def workers_if(self, many: bool) -> Workers:
        """Return the user's workers if there are many vehicles, or if they are a cluster; else one process."""
        return self.workers if many or self.workers.scheduler else Workers()

    def bench_table(self, store: SummaryStore) -> BenchTable:
        """Read the bench readings, if there are any."""
        given, scale_a = self.settings.readings, self.identity.database.layout.full_scale_a
        return {} if given is None else read_bench_table(given, store.identity.equipment.branches, full_scale_a=scale_a)

    def check(self, bench: BenchTable, vehicles: Collection[str], left_out: Mapping[str, str]) -> None:
        """Refuse bench readings of vehicles that do not exist, or that contradict the trust in one."""
        scale_a = self.identity.database.layout.full_scale_a
        check_bench_table(bench, vehicles, left_out=left_out, trusted=self.settings.trusted, full_scale_a=scale_a)

    def summaries(self, store: SummaryStore, others: Mapping[str, str], since: Path | None) -> CalibrationReport:
        """Calibrate every vehicle of a store, complete the result; ``others``: why vehicles are not in the store."""
        previous = None if since is None else since.absolute()
        if since is not None:
            _require_previous(since, self.identity.database, store.identity)
        versions, settings, bench = store.versions(), self.settings, self.bench_table(store)
        checked = {vehicle for vehicle, _ in bench}
        is_large = len(store.buckets()) > FEWEST_BUCKETS
        census = take_census(store, self.workers_if(is_large), settings.hold_out | settings.trusted | checked)
        _require_named(settings, census.named, census.reasons, f"fleet {self.identity.fleet}")
        self.check(bench, census.named, census.reasons)
        first = "" if is_compiled("posterior") else " (compiled before its first use: half a minute more)"
        with progress_bar(f"learn the fleet{first}", None), threadpool_limits(1):  # one thread: same result anywhere
            task, notices = learn_task(
                read_sample(store, census, settings, checked),
                settings,
                bench,
                branches=store.identity.equipment.branches,
                identity=self.identity,
                fleet_size=census.size,
            )
        where = self.workers_if(is_large or census.size >= WORTH_PROCESSES)
        calibrate, seen = partial(calibrate_bucket, store=store, task=task, previous=previous), 0
        earlier = () if previous is None else parts_of(previous)  # also for vehicles that are gone
        buckets = sorted({*census.usable, *earlier})
        with progress_bar("calibrate", census.size, "vehicles") as progress:
            for bucket, part in zip(buckets, run_many(calibrate, buckets, where), strict=True):
                write_atomically(part_file(self.result, bucket), part)
                seen += census.usable.get(bucket, 0)
                progress(seen)
        if store.versions() != versions:
            raise FleetError(f"{store.url}: the summaries were changed during the run; run the same command again")
        return self.finished(
            store.identity.equipment,
            others,
            details=task.reference.details(),
            notices=notices,
            buckets=store.identity.buckets,
        )

    def finished(
        self,
        equipment: Equipment,
        others: Mapping[str, str],
        *,
        details: Mapping[str, object],
        notices: Sequence[str],
        buckets: int = 0,
    ) -> CalibrationReport:
        """Complete the result folder from its parts, and report; ``others``: why vehicles are in none of the parts."""
        identity, layout, folder = self.identity, self.identity.database.layout, self.result
        vehicles, left_out = join_rows(folder, others), left_out_of(folder)
        if not vehicles:
            why = next(iter(left_out.values()), "there is none")
            raise FleetError(f"{identity.fleet}: no vehicle can be calibrated; the first: {why}")
        with progress_bar("write the result", None):
            where = write_parameter_files(folder, vehicles=vehicles)
        run = RunRecord(
            tool=identity.tool,
            method=identity.method.value,
            fleet=identity.fleet,
            layout=layout.name,
            branches=list(equipment.branches),
            model_inputs=list(equipment.inputs),
            settings=self.settings.record(),
            created=identity.created,
            details=dict(details),
            vehicles=vehicles,
            buckets=buckets,
            left_out=dict(list(left_out.items())[:MOST_NAMED]),
            left_out_count=len(left_out),
            full_scale_a=layout.full_scale_a,
            layout_sha256=layout.digest,
            dbc_sha256=identity.database.digest,
            notices=[*equipment.notices, *notices],
        )
        write_run(folder, run)
        return report_of(folder, run, parameters=where, shown=self.shown)


def _require_previous(folder: Path, database: VehicleDatabase, store: StoreIdentity) -> None:
    """Raise FleetError if an earlier result was made otherwise than this run, so that the run cannot go on from it."""
    run, layout = read_run(folder), database.layout
    for what, was, now in (
        ("method", run.method, Method.POSTERIOR.value),
        ("list of branches", ", ".join(run.branches), ", ".join(store.equipment.branches)),
        (f"version of {layout.path}", run.layout_sha256[:8], layout.digest[:8]),
        ("version of the DBC", run.dbc_sha256[:8], database.digest[:8]),
        ("number of buckets", run.buckets, store.buckets),
    ):
        if was != now:
            raise FleetError(f"{folder}: its {what} is {was}, that of this run {now}; calibrate without --since")
    if not (folder / PARTS).is_dir():
        raise FleetError(
            f"{folder / PARTS}: no such folder; expected the parameters of the earlier result: give the whole folder "
            f"that 'calibrator calibrate' wrote, or calibrate without --since"
        )
