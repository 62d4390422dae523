"""The default method on a store of summaries: two passes, each chunk kept until the result is whole."""

from dataclasses import dataclass
from functools import partial

from threadpoolctl import threadpool_limits

from calibrator.calibration.first_pass import Census, named_outlines, read_sample, take_census
from calibrator.calibration.in_order import Workers
from calibrator.calibration.previous import PreviousResult
from calibrator.calibration.second_pass import calibrate_bucket
from calibrator.calibration.unfinished import Chunks
from calibrator.calibration_settings import CalibrationSettings
from calibrator.errors import FleetError
from calibrator.files.parameter_files import RunIdentity
from calibrator.posterior.bench import read_bench
from calibrator.posterior.bench_table import vehicles_named
from calibrator.posterior.fleet import FindModels, Learnt, learn_fleet
from calibrator.summaries.store import SummaryStore
from calibrator.terminal.progress import progress_bar
from calibrator.terminal.text import few, few_reasons

__all__ = ["PosteriorRun", "calibrate_store"]


@dataclass(frozen=True, kw_only=True)
class PosteriorRun:
    """What a run found besides its chunks.

    Attributes
    ----------
    census : Census
        Who there was.
    learnt : Learnt
        The reference, with notices and details.
    """

    census: Census
    learnt: Learnt


def calibrate_store(
    store: SummaryStore,
    settings: CalibrationSettings,
    identity: RunIdentity,
    chunks: Chunks,
    *,
    workers: Workers,
    find_models: FindModels | None = None,
    previous: PreviousResult | None = None,
) -> PosteriorRun:
    """Calibrate every vehicle of a store.

    Parameters
    ----------
    store : SummaryStore
        The fleet.
    settings : CalibrationSettings
        How.
    identity : RunIdentity
        Of the run.
    chunks : Chunks
        Those that are done, and where the others are put, one per bucket.
    workers : Workers
        Where it is computed.
    find_models : callable or None
        Second pass over the drives for sensors that are not linear; None: all count as linear.
    previous : PreviousResult or None
        Earlier result, whose parameters stay for vehicles that have not driven since.

    Returns
    -------
    PosteriorRun
        The chunks are all there then.

    Raises
    ------
    UserError
        If the fleet as a whole cannot be calibrated.
    """
    versions, census = store.versions(), take_census(store, workers)
    _require_known(settings, store, census, fleet=identity.fleet)
    learnt = _learn(store, census, settings, identity, find_models)
    todo = [bucket for bucket in census.usable if not chunks.done(bucket)]
    calibrate = partial(calibrate_bucket, store=store, task=learnt.task, previous=previous)
    seen = census.size - sum(census.usable[bucket] for bucket in todo)
    with progress_bar("calibrate", census.size, "vehicles", begun=seen) as progress:
        progress(seen)
        for bucket, result in zip(todo, workers.map(calibrate, todo), strict=True):
            chunks.put(bucket, result)
            seen += census.usable[bucket]
            progress(seen)
    if store.versions() != versions:
        raise FleetError(f"{store.url}: the summaries were changed during the run; run the same command again")
    return PosteriorRun(census=census, learnt=learnt)


def _learn(
    store: SummaryStore,
    census: Census,
    settings: CalibrationSettings,
    identity: RunIdentity,
    find_models: FindModels | None,
) -> Learnt:
    """The reference, in one thread, so that it is the same wherever it is learnt."""
    branches = store.identity.branches
    named = set() if settings.readings is None else vehicles_named(settings.readings)
    there = named_outlines(store, census, named)
    some = [item.vehicle for bucket in list(census.usable)[:1] for item in store.outlines(bucket)]
    bench = read_bench(
        settings,
        {name for name, item in there.items() if not item.problem} | set(some) - there.keys(),
        branches,
        left_out={name: item.problem for name, item in there.items() if item.problem},
        full_scale_a=identity.database.layout.full_scale_a,
    )
    checked = {vehicle for vehicle, _ in bench}
    with threadpool_limits(1), progress_bar("learn the fleet", None):
        return learn_fleet(
            read_sample(store, census, settings, checked, everyone=find_models is not None),
            settings,
            bench,
            branches=branches,
            identity=identity,
            fleet_size=census.size,
            find_models=find_models,
        )


def _require_known(settings: CalibrationSettings, store: SummaryStore, census: Census, *, fleet: str) -> None:
    """Refuse names of vehicles that there are not."""
    there = named_outlines(store, census, settings.hold_out | settings.trusted)
    for names, what in ((settings.hold_out, "hold out"), (settings.trusted, "trust")):
        missing = [name for name in sorted(names) if name not in there or (there[name].problem and what == "trust")]
        if missing:
            reasons = few_reasons({name: there[name].problem for name in missing if name in there})
            raise FleetError(f"fleet {fleet}: no usable vehicle {few(missing)} to {what}{reasons}")
