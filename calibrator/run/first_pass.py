"""First pass over a fleet's summaries: who there is, and the reference, learnt from a fixed sample of the vehicles."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass

from calibrator.calibration_settings import CalibrationSettings, require_learning
from calibrator.evidence.vehicle_summary import VehicleSummary
from calibrator.report.progress import progress_bar
from calibrator.run.in_order import Workers
from calibrator.summaries.record import joined_records
from calibrator.summaries.store import SummaryStore

__all__ = ["MOST_LEARNT", "Census", "read_sample", "take_census"]

MOST_LEARNT = 2000
"""Vehicles that the reference is learnt from. With so many its centre is known to a fortieth of what faultless vehicles
differ by, so more would not tell any vehicle's faults better. [1]"""


@dataclass(frozen=True, kw_only=True)
class Census:
    """Who there is in a store.

    Attributes
    ----------
    usable : mapping of int to tuple of str
        Names of the vehicles that can be calibrated, by bucket.
    left_out : mapping of str to str
        Why the others cannot.
    """

    usable: Mapping[int, tuple[str, ...]]
    left_out: Mapping[str, str]

    @property
    def size(self) -> int:
        """Number of vehicles that can be calibrated."""
        return sum(map(len, self.usable.values()))

    def holds(self, vehicle: str, bucket: int) -> bool:
        """Whether a vehicle, in its bucket, can be calibrated."""
        return vehicle in self.usable.get(bucket, ())


def take_census(store: SummaryStore, workers: Workers) -> Census:
    """Look at every bucket of a store.

    Parameters
    ----------
    store : SummaryStore
        The store.
    workers : Workers
        Where.

    Returns
    -------
    Census
        Of all its vehicles.

    Raises
    ------
    UserError
        If a bucket cannot be read.
    """
    buckets = store.buckets()
    usable: dict[int, tuple[str, ...]] = {}
    left_out: dict[str, str] = {}
    with progress_bar("look at vehicles", len(buckets), "chunks") as progress:
        for done, (bucket, outlines) in enumerate(zip(buckets, workers.map(store.outlines, buckets), strict=True), 1):
            usable[bucket] = tuple(item.vehicle for item in outlines if not item.problem)
            left_out |= {item.vehicle: item.problem for item in outlines if item.problem}
            progress(done)
    return Census(usable=usable, left_out=left_out)


def read_sample(
    store: SummaryStore, census: Census, settings: CalibrationSettings, checked: Collection[str], *, everyone: bool
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
    everyone : bool
        Whether all vehicles are needed, as for sensor models.

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
    usable = [name for names in census.usable.values() for name in names]
    require_learning(usable, settings, census.left_out)
    apart = {store.bucket_of(name) for name in wanted}
    found: list[VehicleSummary] = []
    learners = 0
    for bucket, names in census.usable.items():
        full = learners >= MOST_LEARNT and not everyone
        if full and bucket not in apart:
            continue
        records = store.read(bucket)
        for name in names:
            learns = name not in settings.hold_out
            if name in wanted or everyone or (learns and learners < MOST_LEARNT):
                found.append(joined_records(records[name]))
                learners += learns
    return found
