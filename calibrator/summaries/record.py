"""One record of a store: what one reading of a vehicle's drives gave. Records of a vehicle add up."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calibrator.drive import Array
from calibrator.drives.delays import BranchDelays
from calibrator.errors import DriveError
from calibrator.evidence.readings import weighted_mean
from calibrator.evidence.summary import DriveSummary
from calibrator.evidence.vehicle_summary import LEAST_DURATION_S, VehicleSummary
from calibrator.evidence.zero_current import ZeroCurrent

__all__ = ["Record", "joined_records"]


@dataclass(frozen=True, kw_only=True)
class Record:
    """Some drives of one vehicle that were read together.

    Attributes
    ----------
    vehicle : str
        Name.
    drives : tuple of str
        Names of the drives.
    found : VehicleSummary or None
        What they tell; None if they cannot be used.
    problem : str
        Why not; empty if they can.
    """

    vehicle: str
    drives: tuple[str, ...]
    found: VehicleSummary | None
    problem: str = ""


def joined_records(records: Sequence[Record]) -> VehicleSummary:
    """All that the records of one vehicle tell.

    Parameters
    ----------
    records : sequence of Record
        Of one vehicle, at least one.

    Returns
    -------
    VehicleSummary
        With the blocks of all of them; delays are those of the record that tells them best, as drives are aligned with
        their own; readings in zero-current windows are averaged by their precision.

    Raises
    ------
    DriveError
        If none can be used, or they are too short together.
    """
    usable = [record.found for record in records if record.found is not None]
    if not usable:
        raise DriveError(records[-1].problem)
    found = usable[0] if len(usable) == 1 else _added(usable)
    if found.summary.duration_s < LEAST_DURATION_S:
        raise DriveError(
            f"{found.summary.duration_s:.1f} s of usable data in {len(found.drives)} drives; at least "
            f"{LEAST_DURATION_S:.0f} s are needed"
        )
    return found


def _added(parts: Sequence[VehicleSummary]) -> VehicleSummary:
    first = parts[0]
    summaries = [part.summary for part in parts]
    return VehicleSummary(
        vehicle=first.vehicle,
        drives=tuple(name for part in parts for name in part.drives),
        summary=DriveSummary(
            moments=np.concatenate([summary.moments for summary in summaries]),
            noise_a2=np.concatenate([summary.noise_a2 for summary in summaries]),
            branches=first.summary.branches,
            period_s=first.summary.period_s,
        ),
        delays=_best_delays([part.delays for part in parts]),
        zero_current=_mean_reading([part.zero_current for part in parts]),
        recorded=frozenset.intersection(*(part.recorded for part in parts)),
    )


def _best_delays(parts: Sequence[BranchDelays]) -> BranchDelays:
    """Delays of the record that knows most of them, and these best: records may have different reference branches."""
    return max(parts, key=lambda part: (int(part.known.sum()), -float(part.sd_s[part.known].sum())))


def _mean_reading(parts: Sequence[ZeroCurrent]) -> ZeroCurrent:
    pairs: list[tuple[Array, Array]] = [(part.offset_a, part.sd_a) for part in parts]
    offset_a, sd_a = weighted_mean(*pairs)
    return ZeroCurrent(offset_a=offset_a, sd_a=sd_a)
