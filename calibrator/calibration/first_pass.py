"""First pass over a fleet's summaries: who there is, and the reference, learnt from a fixed sample of the vehicles."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass

from calibrator.calibration.in_order import Workers
from calibrator.calibration_settings import CalibrationSettings, require_learning
from calibrator.errors import DriveError, FleetError
from calibrator.summaries.record import Outline, joined_records
from calibrator.summaries.store import SummaryStore
from calibrator.summaries.vehicle_summary import VehicleSummary
from calibrator.terminal.progress import progress_bar

__all__ = ["MOST_LEARNT", "Census", "named_outlines", "read_sample", "take_census"]

MOST_LEARNT = 2000
"""Vehicles that the reference is learnt from. With so many its centre is known to a fortieth of what faultless vehicles
differ by, so more would not tell any vehicle's faults better. [1]"""


MOST_REASONS = 20
"""Reasons that are kept for messages."""


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
        If a bucket cannot be read, or there is no vehicle.
    """
    buckets = store.buckets()
    usable: dict[int, int] = {}
    reasons: dict[str, str] = {}
    seen = 0
    with progress_bar("look at vehicles", len(buckets), "chunks") as progress:
        for done, (bucket, outlines) in enumerate(zip(buckets, workers.map(store.outlines, buckets), strict=True), 1):
            seen += len(outlines)
            usable[bucket] = sum(not item.problem for item in outlines)
            for item in outlines:
                if item.problem and len(reasons) < MOST_REASONS:
                    reasons[item.vehicle] = item.problem
            progress(done)
    if not seen:
        raise FleetError(f"{store.url}: the store of summaries is empty; add drives with 'calibrator summarise'")
    return Census(usable=usable, reasons=reasons, left_out=seen - sum(usable.values()))


def named_outlines(store: SummaryStore, census: Census, names: Collection[str]) -> dict[str, Outline]:
    """What there is of some vehicles, by name; those that are not in the store are not."""
    found: dict[str, Outline] = {}
    for bucket, wanted in store.by_bucket(names).items():
        if bucket in census.usable:
            found |= {item.vehicle: item for item in store.outlines(bucket) if item.vehicle in wanted}
    return found


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
    apart = {store.bucket_of(name) for name in wanted}
    found: list[VehicleSummary] = []
    learners = 0
    for bucket in census.usable:
        if learners >= MOST_LEARNT and not everyone and bucket not in apart:
            continue
        for name, records in store.read(bucket).items():
            learns = name not in settings.hold_out
            if name in wanted or everyone or (learns and learners < MOST_LEARNT):
                try:
                    found.append(joined_records(records))
                except DriveError:  # left out, with the reason, in the second pass
                    continue
                learners += learns
    require_learning([item.vehicle for item in found], settings, census.reasons, left_out_count=census.left_out)
    return found
