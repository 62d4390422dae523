"""Turn data frames of a junction into drives, and those of a fleet into summaries as ``calibrator summarise`` does.

Whatever cannot be a recording of such a fleet is refused, with the vehicle and the column: nothing is guessed.
"""

import hashlib
import math
import os
import sys
from collections.abc import Collection, Mapping, Sequence, Set
from dataclasses import dataclass, field
from numbers import Real
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from calibrator.drive import Array, Channel, Drive, Equipment, good_values
from calibrator.drives.align import choose_inputs
from calibrator.drives.computed_inputs import computed_inputs, shared_noise, why_computed
from calibrator.drives.store import require_plain_name, write_drive
from calibrator.errors import DriveError, FleetError
from calibrator.estimator.settings import FEWEST_VEHICLES
from calibrator.files.layout_files import vehicle_database
from calibrator.files.storage import open_storage
from calibrator.recordings.frame_arrays import CLOCK_GAP_S
from calibrator.sources.fleet_source import PROBED_VEHICLES
from calibrator.summaries.filter_bank import FilterBank
from calibrator.summaries.identity import store_identity, write_identity
from calibrator.summaries.record import Record
from calibrator.summaries.summary_store import SummaryStore
from calibrator.summaries.vehicle_summary import COARSEST_PERIOD_S, summarise_drives
from calibrator.terminal.text import few
from ecu_node.database import VehicleDatabase
from ecu_node.layout import LONGEST_PERIOD_S, Branch, Input, Layout
from ecu_node.summary import TIME_RESOLUTION_S

__all__ = [
    "Junction",
    "column_values",
    "is_number",
    "named_columns",
    "names_of",
    "path_of",
    "require",
    "require_columns",
    "store_frames",
    "summarise_frames",
]

MOST_BRANCHES = 16
MOST_MISSED, LEAST_AGE_S = 2.5, 0.5
"""Rows of a data frame that are farther apart than this many periods, and than this time, leave a gap. [1], [s]"""
EXPECTED_INPUTS = (
    "expected one or more different columns, other than the branches, that the currents depend on, such as speed, "
    "torque, or the demands of heater and air conditioning"
)
FINEST_PERIOD_S = 0.1
"""Shortest time base of data frames without a layout: that of logs. [s]"""
LEAST_OF_SCALE, MOST_OF_SCALE = 0.002, 10.0
"""Currents that never reach the former share of full scale, or go beyond the latter, are in another unit. [1]"""
LEAST_WHOLE = 100.0
"""Spacing of an index of whole numbers from which on it is not taken for seconds unasked. [s]"""
OTHER_SPACING = 20.0
"""Row spacing of the fleet over that of a frame from which on the latter's time is in another unit. [1]"""
OTHER_UNIT = 100.0
"""Largest current of the median vehicle over that of this one, from which on the latter is in another unit. [1]"""


def require(good: Any, what: str, given: Any, expected: str) -> None:
    """Raise FleetError unless ``good``; the message begins with ``what`` and shows ``given`` if that is short."""
    if not good:
        shown = text if len(text := repr(given)) < 80 and "\n" not in text else f"of type {type(given).__name__}"
        raise FleetError(f"{what} {shown}: expected {expected}")


def path_of(given: Any, what: str, expected: str = "the path of a layout (TOML)") -> Path:
    """Return an argument that names a file or folder as a path; FleetError, naming ``what``, if it is no path."""
    require(isinstance(given, (str, os.PathLike)) and os.fspath(given), what, given, expected)
    return Path(given)


def is_number(given: Any, low: float, high: float, kind: Any = Real) -> bool:
    """Check whether an argument is a number of this kind from ``low`` to ``high``; a bool is no number."""
    return isinstance(given, kind) and not isinstance(given, bool) and low <= float(given) <= high


def names_of(given: Any, what: str) -> tuple[str, ...]:
    """Return the names in a list or the like (a set is sorted), numbers as strings; FleetError on anything else."""
    listed = isinstance(given, Collection) and not isinstance(given, (str, bytes, Mapping))
    names = tuple(map(str, sorted(map(str, given)) if isinstance(given, Set) else given)) if listed else ("",)
    require(all(name.strip() for name in names), what, given, "a list of names, such as ['one', 'other']")
    return names


@dataclass(frozen=True)
class Junction:
    """Where the high-voltage currents of a vehicle meet; the sum of the K branch currents is 0 A (Kirchhoff).

    Parameters
    ----------
    branches : sequence of str
        Names of the K branches, two or more.
    full_scale_a : float
        Nominal maximum current; offsets are compared in fractions of it. [A]

    Raises
    ------
    FleetError
        If there are not 2 to 16 branches with different names, or the full scale is not a positive number.

    Examples
    --------
    >>> Junction(branches=["battery", "motor", "heater"], full_scale_a=400.0).branches
    ('battery', 'motor', 'heater')
    """

    branches: Sequence[str]
    full_scale_a: float
    database: VehicleDatabase | None = field(default=None, repr=False, compare=False)
    """Layout and DBC, set by :meth:`from_layout`."""

    def __post_init__(self) -> None:
        names = names_of(self.branches, "branches")
        require(
            len(set(names)) == len(names), "branches", self.branches, "different names, such as ['battery', 'motor']"
        )
        if not 2 <= len(names) <= MOST_BRANCHES:
            raise FleetError(
                f"branches {self.branches!r}: a junction has 2 to {MOST_BRANCHES} branches; name all currents that are "
                f"measured, as nothing tells what a single sensor does wrong"
            )
        good = is_number(self.full_scale_a, math.ulp(0.0), sys.float_info.max)
        require(good, "full_scale_a", self.full_scale_a, "the nominal maximum current in A, such as 400.0")
        object.__setattr__(self, "branches", names)

    @classmethod
    def from_layout(cls, path: str | Path, *, branches: Sequence[str] | None = None) -> "Junction":
        """Make the junction that a layout (TOML) describes, with its limits, derived inputs and DBC.

        Parameters
        ----------
        path : str or Path
            The layout.
        branches : sequence of str or None
            Those of its branches that the vehicles have; None: all.

        Returns
        -------
        Junction
            For :meth:`calibrator.estimator.fleet.Fleet.from_frames`.

        Raises
        ------
        LayoutError, DatabaseError
            If layout or DBC cannot be used, or the layout has no such branch.
        """
        database = vehicle_database(path_of(path, "path"))
        layout = database.layout
        chosen = layout.branch_names if branches is None else names_of(branches, "branches")
        for name in chosen:
            layout.find_branch(name)
        return cls(branches=chosen, full_scale_a=layout.full_scale_a, database=database)

    @property
    def layout(self) -> Layout | None:
        """The layout; None if there is none."""
        return None if self.database is None else self.database.layout

    def as_database(self, inputs: Sequence[str], period_s: float) -> VehicleDatabase:
        """Return layout and DBC; without them make a layout of these branches, inputs and period [s], and no DBC."""
        if self.database is not None:
            return self.database

        age_s = max(MOST_MISSED * period_s, LEAST_AGE_S)
        layout = Layout(
            schema=1,
            name="frames",
            full_scale_a=float(self.full_scale_a),
            branch=[Branch(name=name, sign=1, timeout_s=age_s) for name in self.branches],
            input=[Input(name=name, signal=f"frame.{name}") for name in inputs],
            model_inputs=list(inputs),
            period_s=period_s,
            max_age_s=age_s,
            path=Path("the junction"),
            digest=hashlib.sha256(repr(self).encode()).hexdigest(),
        )
        return VehicleDatabase(layout=layout, databases={}, digest=hashlib.sha256(b"").hexdigest())


def summarise_frames(
    folder: Path, frames: Mapping[str, Any], junction: Junction, *, inputs: Sequence[str] | None
) -> VehicleDatabase:
    """Summarise the data frames of a fleet into a new store of summaries.

    Parameters
    ----------
    folder : Path
        Empty folder for the store.
    frames, junction, inputs
        As in :meth:`calibrator.Fleet.from_frames`.

    Returns
    -------
    VehicleDatabase
        Layout of the store.

    Raises
    ------
    FleetError, DriveError
        If the frames are no recordings of such a fleet.
    """
    recordings = _recordings(frames)
    if len(names := {each.vehicle for each in recordings}) < 2:
        raise FleetError(
            f"a single vehicle, {names.pop()}: a fleet that is compared with itself needs {FEWEST_VEHICLES} or more; "
            f"JunctionCalibrator takes one, with a sensor that you trust"
        )
    chosen, columns = _chosen_inputs(recordings, junction, inputs)
    drives, database = _drives(recordings, junction, columns, inputs=chosen)
    still = [[not np.ptp(value) for value in _currents_a(mine, junction)] for mine in drives.values()]
    if (stuck := np.mean(still, axis=0) > 0.5).any():  # in few vehicles a heater is off
        raise DriveError(
            f"branch {junction.branches[int(np.argmax(stuck))]} never changes in most vehicles: stuck, or not "
            f"connected; leave it out if the junction has none"
        )
    layout, first = database.layout, [mine[0] for mine in drives.values()]
    recorded = sorted(layout.base_inputs(chosen))
    computed = computed_inputs([shared_noise(drive, recorded, layout) for drive in first[:PROBED_VEHICLES]])
    used, _ = choose_inputs(layout, {*columns} - computed.keys(), names=chosen)
    if not used:
        raise FleetError(f"inputs {why_computed(computed)}; {EXPECTED_INPUTS}")
    notices = (f"inputs left out: {why_computed(computed)}",) if computed else ()
    equipment = Equipment(branches=tuple(junction.branches), inputs=used, fleet_inputs=used, notices=notices)
    identity = store_identity(equipment, database, vehicles=len(drives), fleet="frames")
    store = SummaryStore(storage=open_storage(folder), identity=identity)
    write_identity(store.storage, identity)
    for bucket, vehicles in store.by_bucket(drives).items():
        store.append(bucket, [_record(drives[name], equipment, database, identity.bank) for name in vehicles])
    return database


def store_frames(folder: Path, frames: Mapping[str, Any], junction: Junction) -> VehicleDatabase:
    """Write the data frames of single junctions into a drive store.

    Parameters
    ----------
    folder : Path
        Folder of the store.
    frames : mapping of str to DataFrame, or to a sequence of them
        Drives by vehicle, with the branches of the junction; of the inputs only that of the contactor is used.
    junction : Junction
        Says which columns are branches.

    Returns
    -------
    VehicleDatabase
        Layout of the store.

    Raises
    ------
    FleetError, DriveError
        If the frames are no recordings of this junction.
    """
    recordings = _recordings(frames)
    for each in recordings:
        require_columns(each.frame, junction.branches, each.where)
    contactor = None if junction.layout is None else junction.layout.contactor
    inputs = [] if contactor is None else [contactor.input]
    there = [name for name in inputs if all(name in each.frame.columns for each in recordings)]
    drives, database = _drives(recordings, junction, [*junction.branches, *there])
    for drive in (drive for mine in drives.values() for drive in mine):
        write_drive(folder, drive, database.layout)
    return database


class _Recording(NamedTuple):
    """One frame of a vehicle, and what messages call it."""

    vehicle: str
    number: int
    frame: pd.DataFrame

    @property
    def where(self) -> str:
        return f"vehicle {self.vehicle}, frame {self.number}"


def _recordings(frames: Mapping[str, Any]) -> list[_Recording]:
    """List the frames of all vehicles."""
    if not isinstance(frames, Mapping) or not frames:
        raise FleetError(f"{type(frames).__name__} without vehicles: expected data frames by vehicle, {{'V1': frame}}")
    found: list[_Recording] = []
    for vehicle, given in ((str(key), given) for key, given in frames.items()):
        require_plain_name(vehicle, "vehicle")
        if any(vehicle == each.vehicle for each in found):
            raise FleetError(f"vehicle {vehicle} is there twice; give all of its frames as one list")
        drives = [given] if isinstance(given, pd.DataFrame) else given
        if not isinstance(drives, Sequence) or not drives:
            raise FleetError(f"vehicle {vehicle}: {type(given).__name__} given; expected a DataFrame or a list of them")
        named = [named_columns(frame, f"vehicle {vehicle}") for frame in drives]
        found += [_Recording(vehicle, number, frame) for number, frame in enumerate(named, start=1)]
    return found


def _chosen_inputs(
    recordings: Sequence[_Recording], junction: Junction, inputs: Sequence[str] | None
) -> tuple[tuple[str, ...], list[str]]:
    """Return the inputs of the model, and the columns for these and the branches, which every frame must have."""
    branches, layout, first = list(junction.branches), junction.layout, recordings[0]
    if layout is not None:
        known = {item.name for item in layout.input} | {item.name for item in layout.derived}
        if unknown := sorted(set(inputs or ()) - known):
            raise FleetError(f"inputs {few(unknown)}: not in the layout; it has {few(sorted(known))}")
        common = set.intersection(*(set(each.frame.columns) for each in recordings))
        usual = choose_inputs(layout, common, names=layout.fleet_inputs or layout.model_inputs)[0]
    else:
        usual = tuple(name for name in first.frame.columns if name not in branches)
    chosen = usual if inputs is None else tuple(inputs)
    columns = [*branches, *(chosen if layout is None else sorted(layout.base_inputs(chosen)))]
    for each in recordings:
        require_columns(each.frame, columns, each.where)
        more = sorted(set(each.frame.columns) - set(columns))
        if more and layout is None and inputs is None:
            raise FleetError(
                f"{each.where}: column {few(more)}, which {first.where} has not; all vehicles need the same columns, "
                f"or name those to use with inputs=[...]"
            )
    if not chosen or len({*chosen, *branches}) < len(chosen) + len(branches):
        raise FleetError(f"inputs {few(chosen) or 'none'}: {EXPECTED_INPUTS}")
    return chosen, columns


def named_columns(frame: pd.DataFrame, where: str) -> pd.DataFrame:
    """Return a frame with its column labels, which may be numbers, as strings; DriveError if it is no frame."""
    if not isinstance(frame, pd.DataFrame):
        raise DriveError(f"{where}: {type(frame).__name__} given; expected a DataFrame")
    return frame.set_axis([str(label) for label in frame.columns], axis=1)


def require_columns(frame: pd.DataFrame, names: Sequence[str], where: str) -> None:
    """Raise DriveError if a frame lacks one of the columns ``names``; ``where`` is what the message calls it."""
    if missing := [name for name in names if name not in frame.columns]:
        raise DriveError(f"{where}: no column {few(missing)}; it has {few(list(frame.columns)) or 'none'}")


def _seconds(frame: pd.DataFrame, where: str) -> Array:
    """Return the instants of a frame, rising from 0; DriveError if its index is no such time. [s]"""
    index = frame.index
    if (isinstance(index, pd.RangeIndex) and index.name is None) or not (
        isinstance(index, (pd.DatetimeIndex, pd.TimedeltaIndex)) or pd.api.types.is_any_real_numeric_dtype(index)
    ):
        what = "counts rows" if isinstance(index, pd.RangeIndex) else f"is of {index.dtype}"
        raise DriveError(
            f"{where}: its index {what}; expected the time: floating-point seconds, or a DatetimeIndex; use set_index"
        )
    if len(index) < 2:
        raise DriveError(f"{where}: {len(index)} rows; leave the frame out")
    if isinstance(index, (pd.DatetimeIndex, pd.TimedeltaIndex)):
        index = (index - index[0]).total_seconds()
    time_s = index.to_numpy(np.float64)
    if not np.isfinite(time_s).all():
        raise DriveError(f"{where}: {int((~np.isfinite(time_s)).sum())} rows without a time; remove them")
    rises = np.diff(time_s) > 0.0
    if not rises.all():
        row = int(np.argmin(rises))
        raise DriveError(
            f"{where}: the time does not rise at row {row + 1} ({index[row]} -> {index[row + 1]}); expected rising "
            f"times: sort by time, one row each, or give drives as frames of their own"
        )
    if pd.api.types.is_integer_dtype(index) and np.median(np.diff(time_s)) >= LEAST_WHOLE:
        raise DriveError(
            f"{where}: its index is whole numbers, {np.median(np.diff(time_s)):g} apart, which may be milliseconds; "
            f"expected seconds as floating-point numbers: divide the index by 1000.0, or by 1.0 if it is seconds"
        )
    return np.asarray(time_s - time_s[0])


def _period_s(times: Mapping[str, Array], junction: Junction, *, coarsest_s: float) -> float:
    """Return the time base: that of the layout, or the usual spacing of rows, which must not be too wide. [s]"""
    layout = junction.layout
    spacing_s = {where: float(np.median(np.diff(time_s))) for where, time_s in times.items()}
    usual_s = float(np.median([*spacing_s.values()]))
    most_s, why = coarsest_s, f"expected {coarsest_s:g} s at most; if the index is not in seconds, convert it"
    if layout is not None:
        most_s = min(layout.max_age_s, *(branch.timeout_s for branch in layout.branch))
        why = (
            f"and in {layout.path.name} a value is stale after {most_s:g} s; give the signals as recorded, or "
            f"Junction(branches=..., full_scale_a=...)"
        )
    for where, row_s in spacing_s.items():
        if OTHER_SPACING * row_s < usual_s:
            why = f"and those of the fleet {usual_s:.3g} s; if the index is not in seconds, convert it"
        if row_s > most_s + TIME_RESOLUTION_S or OTHER_SPACING * row_s < usual_s:
            raise FleetError(f"{where}: rows are {row_s:.3g} s apart, {why}")
    return max(round(usual_s, 6), FINEST_PERIOD_S) if layout is None else layout.period_s


def column_values(frame: pd.DataFrame, name: str, where: str, *, is_input: bool = False) -> Array:
    """Return a column as floating-point numbers, NaN where a value is missing; DriveError if it holds no numbers.

    An input may also be true and false, a current not.
    """
    column = frame[name]
    if isinstance(column, pd.DataFrame):
        raise DriveError(f"{where}: column {name} is there twice")
    is_flag = is_input and pd.api.types.is_bool_dtype(column)
    if not is_flag and not pd.api.types.is_any_real_numeric_dtype(column):
        raise DriveError(
            f"{where}: column {name} is of {column.dtype}; expected numbers, with NaN where a sample is bad: "
            f"pandas.to_numeric converts"
        )
    return np.asarray(column.to_numpy(np.float64, na_value=np.nan))


def _drives(
    recordings: Sequence[_Recording], junction: Junction, columns: Sequence[str], inputs: Sequence[str] = ()
) -> tuple[dict[str, list[Drive]], VehicleDatabase]:
    """Make drives by vehicle, and their layout; refuse a frame that two vehicles have, or one vehicle has twice."""
    times = {each.where: _seconds(each.frame, each.where) for each in recordings}
    coarsest_s = COARSEST_PERIOD_S if inputs else LONGEST_PERIOD_S
    database = junction.as_database(inputs, _period_s(times, junction, coarsest_s=coarsest_s))
    found, seen = dict[str, list[Drive]](), dict[bytes, str]()
    for each in recordings:
        where = each.where
        # longer pauses are cut, as in logs whose clock was set: the time base goes on through a pause
        pauses_s = np.maximum(np.diff(times[where]) - CLOCK_GAP_S, 0.0)
        time_s, channels = times[where] - np.append(0.0, np.cumsum(pauses_s)), dict[str, Channel]()
        for name in columns:
            value = column_values(each.frame, name, where, is_input=name not in junction.branches)
            if not (good := np.isfinite(value)).any():
                raise DriveError(f"{where}: column {name} has no number at all; leave the frame or the column out")
            channels[name] = Channel(time_s=time_s, value=value, good=good)
        content = b"".join(part.tobytes() for item in channels.values() for part in (item.time_s, item.value))
        digest = hashlib.blake2b(content).digest()
        if digest in seen:
            raise FleetError(f"{where}: the same as {seen[digest]}; give each recording once")
        seen[digest] = where
        branches = {name: channels.pop(name) for name in junction.branches}
        drive = Drive(vehicle=each.vehicle, name=f"frame {each.number}", branches=branches, inputs=channels)
        found.setdefault(each.vehicle, []).append(drive)
    _require_amperes(found, junction)
    return found, database


def _currents_a(drives: Sequence[Drive], junction: Junction) -> list[Array]:
    """Return the good values of each branch in all drives of a vehicle. [A]"""
    return [good_values(drives, name) for name in junction.branches]


def _require_amperes(drives: Mapping[str, Sequence[Drive]], junction: Junction) -> None:
    """Raise DriveError if values cannot be amperes: beyond full scale, or all of a vehicle, or of its branch, tiny."""
    scale_a = float(junction.full_scale_a)
    largest_a = np.array([[np.abs(value).max() for value in _currents_a(mine, junction)] for mine in drives.values()])
    small = largest_a < LEAST_OF_SCALE * scale_a
    tiny = small & (small.all(axis=1, keepdims=True) | (np.median(largest_a, axis=0) > OTHER_UNIT * largest_a))
    if len(drives) > 1:
        tiny |= small & small.all(axis=0)
    for j, k in np.argwhere(tiny | (largest_a > MOST_OF_SCALE * scale_a)).tolist():
        unit = "kA: multiply by 1000" if tiny[j, k] else "mA: divide by 1000"
        raise DriveError(
            f"vehicle {list(drives)[j]}: the largest {junction.branches[k]} current is {largest_a[j, k]:.3g} A, full "
            f"scale being {scale_a:g} A; expected amperes; perhaps it is in {unit}, or full_scale_a is wrong"
        )


def _record(drives: Sequence[Drive], equipment: Equipment, database: VehicleDatabase, bank: FilterBank) -> Record:
    """Summarise a vehicle's drives, or record why they cannot be used."""
    found, problem, names = None, "", tuple(drive.name for drive in drives)
    try:
        found = summarise_drives(drives, equipment, database, bank=bank)
    except DriveError as error:
        problem = str(error)
    return Record(vehicle=drives[0].vehicle, drives=names, sources=("",) * len(names), found=found, problem=problem)
