"""The calibrator in Python: a fleet of recordings, and :class:`FleetCalibrator`, which learns from them.

What it has learned is in attributes that end in ``_``, as in scikit-learn. It works as ``calibrator calibrate`` does:
drives are summarised into a store, from which a run makes a result folder (:mod:`calibrator.estimator.run`); data
frames become drives first (:mod:`calibrator.estimator.frames`).
"""

import html
import os
import re
import shutil
import warnings
import weakref
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, nullcontext
from dataclasses import Field, dataclass, field, fields, replace
from numbers import Integral
from pathlib import Path
from tempfile import TemporaryDirectory, mkdtemp
from typing import Any, ClassVar, Self, TypeAlias

import pandas as pd

from calibrator.drive import Drive
from calibrator.drives.align import align, choose_inputs
from calibrator.errors import INTERNAL_ERROR, ContradictionError, FleetError
from calibrator.estimator.frames import (
    Junction,
    column_values,
    is_number,
    named_columns,
    names_of,
    path_of,
    require,
    require_columns,
    store_frames,
    summarise_frames,
)
from calibrator.estimator.results import FILES as NODE_FILES
from calibrator.estimator.results import PARTS, ROWS, read_part
from calibrator.estimator.run import calibrate_fleet, require_fleet
from calibrator.estimator.settings import CalibrationSettings
from calibrator.estimator.vehicle_report import explained
from calibrator.files.folders import whole_folder
from calibrator.files.layout_files import vehicle_database
from calibrator.files.storage import open_storage
from calibrator.processes.run_many import Workers
from calibrator.recordings.readers import read_recording
from calibrator.terminal.progress import no_progress
from calibrator.terminal.text import told_once
from ecu_node.database import VehicleDatabase
from ecu_node.errors import UserError
from ecu_node.layout import Layout, UnmeasuredLoad
from ecu_node.parameters import VehicleParameters, decode_parameters

__all__ = ["CalibratedVehicle", "Fleet", "FleetCalibrator", "JunctionCalibrator", "RecordedLog", "read_log"]

Frames: TypeAlias = pd.DataFrame | Sequence[pd.DataFrame]
Recordings: TypeAlias = Frames | Mapping[str, Frames] | str | Path

COLUMNS = {
    "vehicle": "vehicle",
    "branch": "branch",
    "drift": "gain_error",
    "drift_sd": "gain_error_sd",
    "offset_a": "offset_a",
    "offset_sd_a": "offset_sd_a",
    "fault_probability": "fault_probability",
    "harm_probability": "harm_probability",
    "applied": "corrected",
    "held_back": "reason_not_corrected",
    "verdict": "verdict",
    "confidence": "confidence",
    "hardware_probability": "hardware_probability",
}
"""Columns of ``results.parquet`` and their names in ``parameters_``; to most people a drift is a change over time."""
NO_NODE_FILES = (
    "no parameter files for the node are written: they belong to a layout; make the junction by Junction.from_layout"
)


def _with_sd(given: Any, what: str, least: float = -1e6) -> tuple[float, float]:
    """Return an argument that is a pair (value, standard deviation); FleetError, naming ``what``, if it is none."""
    good = isinstance(given, Sequence) and len(given) == 2 and is_number(given[0], least, 1e6)
    above = " from 0" if least == 0.0 else ""
    require(good and is_number(given[1], 0.0, 1e6), what, given, f"a value{above} with its standard deviation")
    return float(given[0]), float(given[1])


def _in_python(text: str) -> str:
    """Replace options of the command in a message by the names of arguments: --harm-limit by harm_limit."""
    text = text.replace("--charge", "charge_ah").replace("another --out", "another folder")
    return re.sub("--([a-z]+)-?([a-z]*)", lambda found: "_".join(filter(None, found.groups())), text)


@contextmanager
def _errors_in_python() -> Iterator[None]:
    try:
        yield
    except UserError as error:
        error.args = (_in_python(str(error)),)
        raise


@dataclass(frozen=True, kw_only=True)
class Fleet:
    """Recordings of identical vehicles; made by :meth:`from_frames` or :meth:`from_folder`.

    Attributes
    ----------
    place : str
        Path or URL of the drives, or of a store of their summaries.
    database : VehicleDatabase
        Layout and DBC; without a layout one that is made from the branches and inputs of the frames.
    has_layout : bool
        Whether the user gave a layout: without it no parameter files for the node are written.
    in_memory : bool
        Whether it was made of data frames; its place is then a temporary folder that is deleted with the fleet.
    """

    place: str
    database: VehicleDatabase = field(repr=False)
    has_layout: bool
    in_memory: bool = False

    @classmethod
    def from_folder(cls, path: str | Path, layout: str | Path) -> "Fleet":
        """Make a fleet of recorded drives, as ``calibrator calibrate`` takes it; none of them is read yet.

        Parameters
        ----------
        path : str or Path
            Drive store, folder with a folder of logs per vehicle, or summaries (path or URL).
        layout : str or Path
            Layout (TOML) that says what the signals mean.

        Returns
        -------
        Fleet
            For :meth:`FleetCalibrator.fit`.

        Raises
        ------
        UserError
            If there is no such place, or the layout cannot be used.
        """
        path_of(path, "path", "a drive store, a folder of logs, or summaries")
        database, storage = vehicle_database(path_of(layout, "layout")), open_storage(path)
        require_fleet(storage, path, database)
        return cls(place=storage.url, database=database, has_layout=True)

    @classmethod
    def from_frames(
        cls,
        frames: Mapping[str, pd.DataFrame | Sequence[pd.DataFrame]],
        junction: Junction,
        *,
        inputs: Sequence[str] | None = None,
    ) -> "Fleet":
        """Make a fleet of data frames.

        Parameters
        ----------
        frames : mapping of str to DataFrame, or to a sequence of them
            Drives by vehicle. Index: seconds, or a DatetimeIndex, rising; gaps over 60 s count as 60 s. Columns: every
            branch of the junction, positive into it [A], and the inputs; NaN where a sample is bad.
        junction : Junction
            Says which columns are branches. One of :meth:`calibrator.Junction.from_layout` also has derived inputs.
        inputs : sequence of str or None
            Columns that the currents depend on (speed, torque, demands of auxiliaries ...). None: those of the layout,
            or all columns that are no branches, which all vehicles must have.

        Returns
        -------
        Fleet
            For :meth:`FleetCalibrator.fit`, which leaves out vehicles whose drives are too short.

        Raises
        ------
        FleetError, DriveError
            If the frames are no recordings of such a fleet; the message names vehicle and column.
        """
        require(isinstance(junction, Junction), "junction", junction, "a Junction")
        inputs = None if inputs is None else names_of(inputs, "inputs")
        with ExitStack() as stack:
            folder = mkdtemp(prefix="calibrator-")
            stack.callback(shutil.rmtree, folder, ignore_errors=True)
            database = summarise_frames(Path(folder), frames, junction, inputs=inputs)
            fleet = cls(place=folder, database=database, has_layout=junction.layout is not None, in_memory=True)
            weakref.finalize(fleet, stack.pop_all().close)  # the summaries are deleted with the fleet
        return fleet

    def __getstate__(self) -> dict[str, Any]:
        if self.in_memory:
            raise FleetError("a Fleet of data frames cannot be pickled or copied; pickle the frames, or what it gave")
        return vars(self)


@dataclass(frozen=True, kw_only=True)
class CalibratedVehicle:
    """What was found for one vehicle.

    Attributes
    ----------
    parameters : VehicleParameters
        Content of its parameter file.
    """

    parameters: VehicleParameters

    def correct(self, frame: pd.DataFrame) -> pd.DataFrame:
        """Correct the currents of a recording of this vehicle: i = (i_m - o) / (1 + d) on its corrected branches.

        Parameters
        ----------
        frame : DataFrame
            Columns of the corrected branches, positive into the junction [A]; others may be there.

        Returns
        -------
        DataFrame
            The same with these branches corrected, everything else as it is.

        Raises
        ------
        DriveError
            If a corrected branch is missing or holds no numbers.
        """
        where = f"vehicle {self.parameters.vehicle}"
        named = named_columns(frame, where)
        corrected = {name: branch for name, branch in self.parameters.branches.items() if branch.apply}
        require_columns(named, list(corrected), where)
        currents = {name: column_values(named, name, where) for name in corrected}
        return named.assign(
            **{name: (i_m - corrected[name].offset_a) / (1.0 + corrected[name].drift) for name, i_m in currents.items()}
        ).set_axis(frame.columns, axis=1)

    def explain(self) -> str:
        """Describe what was found for each sensor and why, other explanations, findings, and what would decide."""
        return _in_python(explained(self.parameters))

    def _repr_html_(self) -> str:
        return f"<pre>{html.escape(self.explain())}</pre>"


class _Calibrator:
    """Base of the two calibrators: scikit-learn's methods, and what was learned in attributes that end in ``_``."""

    __dataclass_fields__: ClassVar[dict[str, Field[Any]]]
    parameters_: pd.DataFrame
    vehicles_: dict[str, CalibratedVehicle]
    left_out_: dict[str, str]
    notices_: list[str]

    # scikit-learn's BaseEstimator does the next three as well, but takes more than a second to import

    def get_params(self, deep: bool = True) -> dict[str, Any]:  # noqa: ARG002 (scikit-learn's signature)
        """Return the parameters of the constructor by name."""
        return {each.name: getattr(self, each.name) for each in fields(self)}

    def set_params(self, **parameters: Any) -> Self:
        """Set parameters of the constructor, and return the calibrator."""
        for name, value in parameters.items():
            if name not in self.get_params():
                raise ContradictionError(f"no parameter {name!r}; there are {', '.join(self.get_params())}")
            setattr(self, name, value)
        return self

    def __repr__(self) -> str:
        given = [(each.name, repr(getattr(self, each.name)), repr(each.default)) for each in fields(self)]
        changed = (f"{name}={value}" for name, value, default in given if value != default)
        return f"{type(self).__name__}({', '.join(changed)})"

    def _settings(self, *, alone: bool) -> CalibrationSettings:
        """Convert the parameters of the constructor to settings of the command; FleetError if one makes no sense."""
        given = self.get_params()
        for name in ("harm_limit", "expected_faults"):
            value = given.get(name)
            none = value is None and name == "expected_faults"
            require(none or is_number(value, 0, 1), name, value, "a number from 0 to 1")
        for name in given.keys() & {"trusted", "hold_out"}:
            names = [given[name]] if isinstance(given[name], str) else () if given[name] is None else given[name]
            given[name] = frozenset(names_of(names, name))
        readings = given["readings"]
        if hasattr(readings, "to_csv"):
            given["readings"] = str(readings.to_csv(index=False))
        elif readings is not None:
            given["readings"] = path_of(readings, "readings", "a DataFrame or the path of a CSV table")
            require(given["readings"].is_file(), "readings", readings, "a file that exists")
        if alone:
            meter, charge_ah = given["meter"], given["charge_ah"] or {}
            require(meter is None or isinstance(meter, str), "meter", meter, "the name of a branch")
            require(isinstance(charge_ah, Mapping), "charge_ah", charge_ah, "charges by branch")
            given["charge_ah"] = {str(name): _with_sd(pair, "charge_ah") for name, pair in charge_ah.items()}
        if given["load"] is not None:
            mean_a, sd_a = _with_sd(given["load"], "load", least=0.0)
            given["load"] = UnmeasuredLoad(mean_a=mean_a, sd_a=sd_a)
        used = CalibrationSettings.__dataclass_fields__.keys() & given.keys()
        return CalibrationSettings(alone=alone, **{name: given[name] for name in used})

    def _calibrate(
        self, place: str | Path, database: VehicleDatabase, *, alone: bool, has_layout: bool, workers: Workers
    ) -> None:
        """Calibrate as the command does, and keep the content of the result folder."""
        with TemporaryDirectory(prefix="calibrator-") as folder:
            out = Path(folder) / "result"
            report = calibrate_fleet(place, database, out, self._settings(alone=alone), workers=workers)
            files = {str(path.relative_to(out)): path for path in sorted(out.rglob("*")) if path.is_file()}
            parts = [read_part(path) for path in files.values() if path.parent.name == PARTS]
            rows = pd.read_parquet(out / ROWS)
            self._files = {
                name: path.read_bytes() for name, path in files.items() if has_layout or path.parent.name != NODE_FILES
            }
        self._report, self._has_layout = replace(report, result=""), has_layout
        written = {name: item.text for part in parts for name, item in part.items()}
        self.vehicles_ = {
            name: CalibratedVehicle(parameters=decode_parameters(written[name], f"parameters of {name}"))
            for name in sorted(written)
        }
        left_out = rows[rows["branch"].isna()]
        self.left_out_ = dict(zip(left_out["vehicle"], left_out["reason"], strict=True))
        self.parameters_ = rows[rows["branch"].notna()][list(COLUMNS)].rename(columns=COLUMNS).reset_index(drop=True)
        self.parameters_["corrected"] = self.parameters_["corrected"].astype(bool)
        self.notices_ = [_in_python(notice) for notice in report.run.notices]
        failed = {name: why for name, why in self.left_out_.items() if why.startswith(INTERNAL_ERROR)}
        if failed:
            said = "; ".join(told_once(failed.items()))
            warnings.warn(f"left out: {said}", RuntimeWarning, stacklevel=3)

    def _require_fitted(self) -> None:
        if not hasattr(self, "parameters_"):
            raise FleetError(f"this {type(self).__name__} has learned nothing yet; call fit first")

    def summary(self) -> str:
        """Describe what was found, as ``calibrator calibrate`` prints it."""
        self._require_fitted()
        return self._report.as_text()

    def _repr_html_(self) -> str:
        if not hasattr(self, "parameters_"):
            return f"<pre>{html.escape(repr(self))}</pre>"
        table: str = self.parameters_.to_html(index=False, max_rows=60, float_format="{:.4g}".format)
        return f"<pre>{html.escape(self.summary())}</pre>{table}"

    def write(self, folder: str | Path) -> Path:
        """Write the result folder, the same that ``calibrator calibrate`` writes.

        Without a layout (data frames of a bare junction) it has no parameter files for the node; a warning says so.

        Parameters
        ----------
        folder : str or Path
            New or empty folder; it appears only when it is complete.

        Returns
        -------
        Path
            The folder.

        Raises
        ------
        FleetError
            If nothing was learned yet, or the folder is not empty or cannot be made.
        """
        self._require_fitted()
        with _errors_in_python(), whole_folder(path_of(folder, "folder", "the path of a new folder")) as partial:
            for name, content in self._files.items():
                (partial / name).parent.mkdir(parents=True, exist_ok=True)
                (partial / name).write_bytes(content)
        if not self._has_layout:
            warnings.warn(NO_NODE_FILES, stacklevel=2)
        return Path(folder)


@dataclass(kw_only=True, repr=False, eq=False)
class FleetCalibrator(_Calibrator):
    """Learns from a fleet of identical vehicles what each one's current sensors do wrong.

    Parameters
    ----------
    harm_limit : float
        A branch is corrected if the correction does harm with a probability below this. [1]
    trusted : collection of str
        Vehicles with bench-checked sensors; three or more of them are what the others are compared with.
    readings : path or DataFrame or None
        Bench readings of single sensors: columns vehicle, branch, drift, drift_sd, offset_a, offset_sd_a.
    load : tuple of (float, float), or None
        Load that no branch measures and its standard deviation; None: as the layout says, else not known. [A]
    hold_out : collection of str
        Vehicles that are calibrated, but from which nothing is learnt for others.
    expected_faults : float or None
        Share of vehicles with a sensor fault, if it is known. [1]
    workers : int
        Number of processes; the result does not depend on it.
    scheduler : str or None
        Address of a Dask scheduler whose workers are used instead of processes of this computer.
    verbose : bool
        Whether progress is shown on standard error.

    Attributes
    ----------
    parameters_ : DataFrame
        One row per vehicle and branch: ``vehicle``, ``branch``, ``gain_error`` and ``gain_error_sd`` [1], ``offset_a``
        and ``offset_sd_a`` [A], ``fault_probability``, ``harm_probability``, ``corrected``, ``reason_not_corrected``,
        and of the vehicle ``verdict``, ``confidence``, ``hardware_probability``.
    vehicles_ : dict of str to CalibratedVehicle
        By name: corrects recordings, explains what was found.
    left_out_ : dict of str to str
        Vehicles that could not be calibrated, and why.
    notices_ : list of str
        What may be wrong about the fleet as a whole, its readings or trusted vehicles, and signals that were not used.

    Examples
    --------
    >>> FleetCalibrator(harm_limit=0.01)
    FleetCalibrator(harm_limit=0.01)
    """

    harm_limit: float = 0.001
    trusted: Collection[str] = ()
    readings: str | Path | pd.DataFrame | None = None
    load: tuple[float, float] | None = None
    hold_out: Collection[str] = ()
    expected_faults: float | None = None
    workers: int = 2
    scheduler: str | None = None
    verbose: bool = False

    def fit(self, fleet: Fleet, y: None = None) -> "FleetCalibrator":  # noqa: ARG002 (scikit-learn's signature)
        """Learn from a fleet, and estimate the sensor faults of every vehicle.

        Parameters
        ----------
        fleet : Fleet
            Recordings of two vehicles or more.
        y : None
            Not used.

        Returns
        -------
        FleetCalibrator
            This one.

        Raises
        ------
        UserError
            If the fleet as a whole cannot be calibrated, or a parameter makes no sense.
        """
        require(isinstance(fleet, Fleet), "fleet", fleet, "Fleet.from_frames(...) or Fleet.from_folder(...)")
        require(is_number(self.workers, 1, 256, Integral), "workers", self.workers, "a whole number from 1 to 256")
        require(isinstance(self.scheduler, str | None), "scheduler", self.scheduler, "the address of a Dask scheduler")
        # frames are so few that another process takes longer to start than they take here
        processes = 1 if fleet.in_memory else self.workers
        with nullcontext() if self.verbose else no_progress(), _errors_in_python():
            workers = Workers(processes=processes, scheduler=self.scheduler)
            self._calibrate(fleet.place, fleet.database, alone=False, has_layout=fleet.has_layout, workers=workers)
        return self


@dataclass(kw_only=True, repr=False, eq=False)
class JunctionCalibrator(_Calibrator):
    """Learns from recordings of one junction, and what is known of it, what its current sensors do wrong.

    No fleet is needed. The junction law gives every ratio of gains; a sensor that is known gives their scale, and a
    zero-current window, a bench reading or a declared load gives the offsets. What stays open is reported with its
    standard deviation.

    Parameters
    ----------
    trusted : collection of str
        Branches whose sensor is right, to 0.2 % in gain and 0.05 % of full scale in offset; for another accuracy, give
        ``readings``.
    readings : path or DataFrame or None
        Bench readings of single sensors: columns vehicle, branch, drift, drift_sd, offset_a, offset_sd_a.
    load : tuple of (float, float), or None
        Load that no branch measures and its standard deviation; None: as the layout says, else not known. [A]
    charge_ah : mapping of str to (float, float), or None
        Charge into the junction through a branch over the recordings of one vehicle, and its standard deviation. [Ah]
    meter : str or None
        Branch that has another sensor in each "vehicle": these are recordings of one car, as at different chargers.
    harm_limit : float
        A branch is corrected if the correction does harm with a probability below this. [1]

    Attributes
    ----------
    parameters_, vehicles_, left_out_, notices_
        As in :class:`FleetCalibrator`; gain errors and offsets are reported also of sensors in which no fault is
        suspected.

    Examples
    --------
    >>> JunctionCalibrator(trusted=["battery"])
    JunctionCalibrator(trusted=['battery'])
    """

    trusted: Collection[str] = ()
    readings: str | Path | pd.DataFrame | None = None
    load: tuple[float, float] | None = None
    charge_ah: Mapping[str, tuple[float, float]] | None = None
    meter: str | None = None
    harm_limit: float = 0.001

    def fit(self, recordings: Recordings, junction: Junction | str | Path, y: None = None) -> "JunctionCalibrator":  # noqa: ARG002 (scikit-learn's signature)
        """Estimate the sensor faults of one junction, or of several, each by itself.

        Parameters
        ----------
        recordings : DataFrame, sequence of DataFrame, mapping of str to these, or path
            Index: seconds or a DatetimeIndex; columns: every branch, positive into the junction [A]. The keys of a
            mapping are names of vehicles. A path is a log, a table, or a folder of them.
        junction : Junction, or path of a layout
            Says which columns or signals are branches; recordings on disk need a layout.
        y : None
            Not used.

        Returns
        -------
        JunctionCalibrator
            This one.

        Raises
        ------
        UserError
            If the recordings cannot be of this junction, or a parameter makes no sense.
        """
        if not isinstance(junction, Junction):
            junction = Junction.from_layout(path_of(junction, "junction", "a Junction, or the path of a layout (TOML)"))
        with TemporaryDirectory(prefix="calibrator-") as folder, no_progress(), _errors_in_python():
            if isinstance(recordings, (str, os.PathLike)):
                require(junction.database is not None, "junction", junction, "a layout, as the recordings are on disk")
                place, database = Path(recordings), junction.as_database((), 0.1)
            else:
                several = isinstance(recordings, Mapping) and not isinstance(recordings, pd.DataFrame)
                named: Any = recordings if several else {"vehicle": recordings}
                place = Path(folder) / "recordings"
                database = store_frames(place, named, junction)
            self._calibrate(place, database, alone=True, has_layout=junction.layout is not None, workers=Workers())
        return self


@dataclass(frozen=True, kw_only=True)
class RecordedLog:
    """Signals of one log of a vehicle, and the layout that names them.

    Attributes
    ----------
    drive : Drive
        Every signal at its own instants: ``drive.branches`` and ``drive.inputs`` by name.
    layout : Layout
        Layout that says what the signals of the log mean.
    """

    drive: Drive
    layout: Layout

    def to_frame(self) -> pd.DataFrame:
        """Return all signals on one time base, in the form that :meth:`Fleet.from_frames` takes.

        Returns
        -------
        DataFrame
            Index: seconds since the start of the log, spaced by the layout's period. Columns: branches [A], positive
            into the junction, inputs, and derived inputs; a row is NaN where any of them is missing.

        Raises
        ------
        DriveError
            If the signals have no instant in common.
        """
        branches = [name for name, channel in self.drive.branches.items() if channel.good.any()]
        recorded = [name for name, channel in self.drive.inputs.items() if channel.good.any()]
        derived = choose_inputs(self.layout, recorded, names=[item.name for item in self.layout.derived])[0]
        samples = align(self.drive, self.layout, branches, inputs=[*recorded, *derived])
        columns = dict(zip(samples.branch_names, samples.currents_a.T, strict=True))
        columns |= dict(zip(samples.input_names, samples.inputs.T, strict=True))
        return pd.DataFrame(columns, index=pd.Index(samples.time_s, name="time_s"))

    def __repr__(self) -> str:
        channels = ", ".join([*self.drive.branches, *self.drive.inputs])
        return f"RecordedLog({self.drive.vehicle} {self.drive.name}, {self.drive.duration_s:.0f} s: {channels})"


def read_log(path: str | Path, layout: str | Path) -> RecordedLog:
    """Read one CAN log (candump, BLF, ASC, TRC, MF4).

    Parameters
    ----------
    path : str or Path
        The log; the name of its folder is taken for that of the vehicle.
    layout : str or Path
        Layout (TOML) that says what the signals mean.

    Returns
    -------
    RecordedLog
        The log; its ``to_frame()`` makes a data frame.

    Raises
    ------
    LogError, LayoutError, DatabaseError
        If the log, the layout or its DBC cannot be used.
    """
    log = path_of(path, "path", "the path of a log")
    database = vehicle_database(path_of(layout, "layout"))
    found = read_recording(log, database, vehicle=log.absolute().parent.name, name=log.name.partition(".")[0])
    return RecordedLog(drive=found.drive, layout=database.layout)
