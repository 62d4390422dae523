"""What stands in the rows of a result, counted: what counts once per vehicle, and what per branch."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from calibrator.drive import Array, Mask

__all__ = ["Counts", "count_rows", "deployed_rms_a"]


@dataclass(frozen=True, kw_only=True)
class Counts:
    """Numbers of some vehicles of a result; those of others can be added.

    Attributes
    ----------
    verdicts : Counter of str
        Vehicles per verdict, in the order in which verdicts first come.
    held_back : Counter of str
        Branches in which a fault was found that is not applied, by reason, in the same order.
    hardware_suspected : int
        Vehicles of which a hardware fault is suspected.
    moved_vehicles, moved_sensors : int
        Vehicles with sensors that have moved since an earlier result, and these sensors.
    """

    verdicts: Counter[str] = field(default_factory=Counter)
    held_back: Counter[str] = field(default_factory=Counter)
    hardware_suspected: int = 0
    moved_vehicles: int = 0
    moved_sensors: int = 0

    def __add__(self, other: "Counts") -> "Counts":
        """Return the numbers of the vehicles of both."""
        return Counts(
            verdicts=self.verdicts + other.verdicts,
            held_back=self.held_back + other.held_back,
            hardware_suspected=self.hardware_suspected + other.hardware_suspected,
            moved_vehicles=self.moved_vehicles + other.moved_vehicles,
            moved_sensors=self.moved_sensors + other.moved_sensors,
        )


def count_rows(rows: pa.Table, branches: Sequence[str]) -> Counts:
    """Count rows of ``results.parquet``.

    Parameters
    ----------
    rows : pyarrow.Table
        All rows of each of some vehicles, one per branch.
    branches : sequence of str
        Names of the branches; what is said of a vehicle as a whole is taken from its row of the first.

    Returns
    -------
    Counts
        Of these vehicles.
    """
    vehicles = rows.filter(pc.field("branch") == branches[0])
    moved = rows.filter(pc.field("moved").is_valid())
    return Counts(
        verdicts=_counted(vehicles["verdict"]),
        held_back=_counted(rows["held_back"].drop_null()),
        hardware_suspected=vehicles.filter(pc.field("hardware_fault")).num_rows,
        moved_vehicles=len(pc.unique(moved["vehicle"])),
        moved_sensors=moved.num_rows,
    )


def deployed_rms_a(applied: Mask, *, measured_a: Array, corrected_a: Array) -> Array:
    """Root mean square of the Kirchhoff sum with what the node applies.

    Parameters
    ----------
    applied : ndarray of bool, shape (N, K)
        Branches that the node corrects.
    measured_a, corrected_a : ndarray of shape (N,)
        The same as measured, and with what is applied. [A]

    Returns
    -------
    ndarray of shape (N,)
        As measured where nothing is applied. [A]
    """
    return np.where(applied.any(axis=1), corrected_a, measured_a)


def _counted(values: pa.ChunkedArray) -> Counter[str]:
    return Counter({item["values"]: item["counts"] for item in pc.value_counts(values).to_pylist()})
