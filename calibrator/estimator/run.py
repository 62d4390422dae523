"""Run a calibration: from drives, or a store of their summaries, to a result folder.

Drives are summarised first, into a store that is deleted when the run ends. The first pass over a store learns the
reference of the fleet from a fixed sample of the vehicles; the second estimates every vehicle by itself, bucket by
bucket. With an earlier result (``since``), vehicles that have not driven since keep its parameters; one whose sensors
have moved is calibrated from its new drives alone.

Faults of the program in single vehicles (:mod:`calibrator.estimator.fleet_task`) end the command with exit code 70.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TypeAlias

import pyarrow.compute as pc
from threadpoolctl import threadpool_limits

from calibrator.compiled import is_compiled
from calibrator.drive import Equipment, FleetSource
from calibrator.drives.store import DRIVES_FOLDER
from calibrator.errors import ContradictionError, DriveError, FleetError
from calibrator.estimator.fleet_task import calibrate_bucket, learn_task
from calibrator.estimator.readings import read_bench_table
from calibrator.estimator.results import (
    PARTS,
    CalibrationReport,
    complete_result,
    part_file,
    parts_of,
    read_run,
    result_rows,
)
from calibrator.estimator.settings import CalibrationSettings, Method, RunIdentity, require_learning, time_of_run
from calibrator.files.folders import require_new_folder, whole_folder
from calibrator.files.storage import Storage, open_storage
from calibrator.processes.run_many import Workers, run_many
from calibrator.sources.fleet_source import LOGS_FOLDER, find_fleet, probe_equipment
from calibrator.summaries.identity import FEWEST_BUCKETS, StoreIdentity, bucket_of, read_identity
from calibrator.summaries.record import joined_records
from calibrator.summaries.summarise_fleet import add_drives
from calibrator.summaries.summary_store import SummaryStore, open_store
from calibrator.summaries.vehicle_summary import VehicleSummary
from calibrator.terminal.progress import progress_bar, shown
from calibrator.terminal.text import counted, few, few_reasons
from ecu_node.database import VehicleDatabase
from ecu_node.documents import write_atomically
from ecu_node.layout import Layout

__all__ = ["calibrate_fleet", "problems_of", "read_sample", "require_fleet"]

MOST_LEARNT, MOST_BLOCKS = 2000, 50_000
"""Most vehicles that the reference is learnt from, and about the most blocks of their drives. With so many vehicles its
centre is known to a fortieth of the spread of faultless vehicles, so more would not tell any vehicle's faults better;
so many blocks take about half a GiB, and are 200 vehicles with two hours of driving or more. [1]"""
WORTH_PROCESSES = 200
"""Number of vehicles from which on `workers` are used. Other processes take 3 s to start; with 600 vehicles of two
branches two of them are no faster yet, but with more branches each vehicle takes longer. [1]"""
AtOnce: TypeAlias = Callable[..., tuple[Equipment, bytes, dict[str, object], Sequence[str]]]
"""Function that calibrates all vehicles in one go; returns equipment, content of a part file, details and notices."""
Problems: TypeAlias = Mapping[str, str]
"""Why a vehicle cannot be used, by vehicle; empty if it can."""


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
        Earlier result: vehicles without new drives keep its parameters, unless a choice of the user that concerns them
        has changed. The fleet is then a store of summaries that holds the earlier drives as well.

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
    layout, stored = database.layout, require_fleet(storage, place, database)
    source: SummaryStore | FleetSource
    if stored is not None:
        _require_summaries_enough(place, settings, layout)
        source, name = SummaryStore(storage=storage, identity=stored), stored.fleet
    elif since is not None:
        raise FleetError(
            f"{place}: drives, and --since goes on with summaries; add the new drives to the store that {since} was "
            f"made from, with 'calibrator summarise', and give that store"
        )
    else:
        source = find_fleet(storage.url)
        name = source.name
    identity = RunIdentity(database=database, settings=settings, fleet=name, created=time_of_run())
    with whole_folder(out) as result, TemporaryDirectory(dir=result) as summaries:
        (result / PARTS).mkdir()
        others: Problems = {}
        lost: Problems = {}
        if isinstance(source, FleetSource):
            if at_once := _at_once(source, settings, layout):
                equipment, part, details, notices = at_once(source, identity, workers=workers)
                write_atomically(part_file(result, 0), part)
                return complete_result(result, out, identity, equipment, details=details, notices=notices)
            others = source.left_out
            source, lost = _summarised(source, summaries, identity, workers)
        details, notices = _calibrate_store(source, result, identity, workers, since)
        if lost:
            notices.append(f"{counted(len(lost), 'log')} left out{few_reasons(lost)}")
        return complete_result(
            result,
            out,
            identity,
            source.identity.equipment,
            details=details,
            notices=notices,
            others=others,
            buckets=source.identity.buckets,
        )


def require_fleet(storage: Storage, place: str | Path, database: VehicleDatabase) -> StoreIdentity | None:
    """Return the identity of a store of summaries, None if the place has drives; FleetError if it can be neither."""
    path = Path(storage.url)
    if storage.is_local and path.is_file():
        return None
    if storage.is_local and not path.is_dir():
        raise FleetError(f"{place}: no such folder, store of drives or store of summaries")
    return read_identity(storage, database)


def _require_summaries_enough(place: str | Path, settings: CalibrationSettings, layout: Layout) -> None:
    """Refuse drives beside summaries, as nobody can tell which are meant, and options that need the drives."""
    if drives := [name for name in (DRIVES_FOLDER, LOGS_FOLDER) if (Path(place) / name).is_dir()]:
        raise FleetError(
            f"{place}: holds drives ({few(drives)}) and summaries (summaries.json); move one of them elsewhere, and "
            f"give the folder of the other"
        )
    needs = {
        "--method published": settings.method is Method.PUBLISHED,
        "--branches": settings.branches is not None,
        "--charge": settings.charge_ah,
        "--meter": settings.meter is not None,
        "--trusted with a branch": settings.trusted & set(layout.branch_names),
        "a junction without a fleet": settings.alone,
    }
    for option in (option for option, wanted in needs.items() if wanted):
        raise FleetError(f"{place}: a store of summaries, and {option} needs the drives; give the drive store")


def _at_once(fleet: FleetSource, settings: CalibrationSettings, layout: Layout) -> AtOnce | None:
    """Return the function of the published method or of single junctions; None if the fleet is compared with itself.

    Each vehicle is calibrated by itself if there is only one, if the user asks for it, or if the user names trusted
    branches, a charge or a meter.
    """
    if settings.method is Method.PUBLISHED:
        from calibrator.estimator.published_fleet import calibrate_fleet_published  # noqa: PLC0415 (takes a second)

        _require_named(settings, _problems(fleet), f"fleet {fleet.name}")
        require_learning([*fleet.vehicles], settings, fleet.left_out)
        return calibrate_fleet_published
    branches = set(layout.branch_names)
    names_branches = bool(settings.trusted) and not settings.trusted & fleet.vehicles.keys()
    names_branches = names_branches and settings.trusted <= branches
    if settings.trusted & fleet.vehicles.keys() and (mixed := settings.trusted & branches - fleet.vehicles.keys()):
        raise ContradictionError(f"--trusted names vehicles and branches ({few(sorted(mixed))}); name one or the other")
    alone = settings.alone or settings.meter is not None or bool(settings.charge_ah)
    if not (alone or names_branches or len(fleet.vehicles) == 1):
        return None
    fleets = {"--hold-out": settings.hold_out, "--expected-faults": settings.expected_faults is not None}
    for option in (option for option, given in fleets.items() if given):
        raise ContradictionError(f"{option} is for a fleet that is compared with itself, not for single junctions")
    from calibrator.estimator.junction_run import calibrate_junctions  # noqa: PLC0415 (a fleet does not need it)

    return calibrate_junctions


def _problems(fleet: FleetSource) -> Problems:
    return {**fleet.left_out, **dict.fromkeys(fleet.vehicles, "")}


def _require_named(settings: CalibrationSettings, problems: Problems, place: str) -> None:
    """Refuse names of vehicles that do not exist or cannot be used, with the reason if there is one."""
    unusable = {name for name in settings.trusted if problems.get(name, "unknown")}
    for names, what in ((settings.hold_out - problems.keys(), "hold out"), (unusable, "trust")):
        if names:
            reasons = few_reasons({name: problems[name] for name in sorted(names) if name in problems})
            raise FleetError(f"{place}: no usable vehicle {few(sorted(names))} to {what}{reasons}")


def _summarised(
    fleet: FleetSource, folder: str, identity: RunIdentity, workers: Workers
) -> tuple[SummaryStore, Problems]:
    """Summarise the drives of a fleet into a new store; return it, and why single drives are left out.

    Wrong names and bench readings are refused before that.
    """
    database, settings, problems = identity.database, identity.settings, _problems(fleet)
    limit_s, scale_a = settings.time_limit_s, database.layout.full_scale_a
    _require_named(settings, problems, f"fleet {fleet.name}")
    require_learning([*fleet.vehicles], settings, fleet.left_out)
    equipment = probe_equipment(fleet, database, settings.branches, limit_s=limit_s)
    read_bench_table(settings.readings, equipment.branches, problems, trusted=settings.trusted, full_scale_a=scale_a)
    store = open_store(open_storage(folder), equipment, database, fleet)
    report = add_drives(store, fleet, database, workers=workers, time_limit_s=limit_s)
    whole = {*fleet.vehicles, *fleet.left_out}
    return store, {name: why for name, why in report.left_out.items() if name not in whole}


def _calibrate_store(
    store: SummaryStore, result: Path, identity: RunIdentity, workers: Workers, since: Path | None
) -> tuple[dict[str, object], list[str]]:
    """Calibrate the vehicles of a store into parts of a result; return details and notices for its record."""
    if since is not None:
        _require_previous(since, identity.database, store.identity)
    settings, versions, buckets = identity.settings, store.versions(), store.buckets()
    here = Workers() if workers.scheduler is None else workers
    problems = problems_of(store, workers if len(buckets) > FEWEST_BUCKETS else here)
    _require_named(settings, problems, f"fleet {identity.fleet}")
    scale_a, branches = identity.database.layout.full_scale_a, store.identity.equipment.branches
    bench = read_bench_table(settings.readings, branches, problems, trusted=settings.trusted, full_scale_a=scale_a)
    left_out = {name: why for name, why in problems.items() if why}
    size = len(problems) - len(left_out)
    first = "" if is_compiled("posterior") else " (compiled before its first use: half a minute more)"
    with progress_bar(f"learn the fleet{first}", None), threadpool_limits(1):  # one thread: same result anywhere
        sample = read_sample(store, settings, {vehicle for vehicle, _ in bench})
        require_learning([item.vehicle for item in sample], settings, left_out)
        task, notices = learn_task(sample, bench, branches=branches, identity=identity, fleet_size=size)
    previous = None if since is None else since.absolute()
    earlier = () if previous is None else parts_of(previous)  # also for vehicles that are gone
    buckets = sorted({*buckets, *earlier})
    calibrate = partial(calibrate_bucket, store=store, task=task, previous=previous)
    parts = run_many(calibrate, buckets, workers if size >= WORTH_PROCESSES else here)
    for bucket, part in shown(zip(buckets, parts, strict=True), "calibrate", len(buckets), "chunks"):
        write_atomically(part_file(result, bucket), part)
    if store.versions() != versions:
        raise FleetError(f"{store.url}: the summaries were changed during the run; run the same command again")
    return task.reference.details(), notices


def problems_of(store: SummaryStore, workers: Workers) -> Problems:
    """Return for each vehicle of a store why it cannot be calibrated, empty if it can.

    Raises
    ------
    UserError
        If a bucket cannot be read, or there is no vehicle.
    """
    buckets = store.buckets()
    found = shown(run_many(store.outlines, buckets, workers), "look at vehicles", len(buckets), "chunks")
    problems = {outline.vehicle: outline.problem for outlines in found for outline in outlines}
    if not problems:
        raise FleetError(f"{store.url}: the store of summaries is empty; add drives with 'calibrator summarise'")
    return problems


def read_sample(
    store: SummaryStore, settings: CalibrationSettings, checked: Collection[str] = ()
) -> list[VehicleSummary]:
    """Read the vehicles to learn from.

    Parameters
    ----------
    store : SummaryStore
        The store.
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
    wanted = settings.trusted | set(checked)
    apart = {store.bucket_of(name) for name in wanted}
    found, learners, blocks = list[VehicleSummary](), 0, 0
    for bucket in store.buckets():
        if (learners >= MOST_LEARNT or blocks >= MOST_BLOCKS) and bucket not in apart:
            continue
        for name, records in store.read(bucket).items():
            learns = name not in settings.hold_out
            if name in wanted or (learns and learners < MOST_LEARNT and blocks < MOST_BLOCKS):
                with suppress(DriveError):  # left out, with the reason, in the second pass
                    found.append(joined_records(records))
                    learners += learns
                    blocks += learns * len(found[-1].summary.moments)
    return found


def _require_previous(folder: Path, database: VehicleDatabase, store: StoreIdentity) -> None:
    """Raise FleetError if an earlier result was made otherwise than this run, so that the run cannot go on from it."""
    run, layout = read_run(folder), database.layout
    if not (folder / PARTS).is_dir():
        raise FleetError(f"{folder / PARTS}: no such folder; give the whole folder that 'calibrator calibrate' wrote")
    for what, was, now in (
        ("method", run.method, Method.POSTERIOR.value),
        ("list of branches", ", ".join(run.branches), ", ".join(store.equipment.branches)),
        (f"version of {layout.path}", run.layout_sha256[:8], layout.digest[:8]),
        ("version of the DBC", run.dbc_sha256[:8], database.digest[:8]),
        ("number of buckets", run.buckets, store.buckets),
    ):
        if was != now:
            raise FleetError(f"{folder}: its {what} is {was}, that of this run {now}; calibrate without --since")
    rows = result_rows(folder, ["vehicle", "branch"])
    names = pc.unique(rows.filter(pc.field("branch").is_valid())["vehicle"]).to_pylist()
    if missing := {bucket_of(name, run.buckets) for name in names} - parts_of(folder).keys():
        raise FleetError(f"{part_file(folder, min(missing))}: missing part of a result; calibrate without --since")
