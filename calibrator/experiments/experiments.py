"""The table of experiments, those of the paper [1]_ and ours, and the record of a result.

An experiment is a row of ``TABLE`` (by name: :data:`EXPERIMENTS`). It has settings (how fleets are made, and the place
in the tables), the methods that are compared, and how the result is shown. To add an experiment, add a row;
:func:`~calibrator.experiments.runner.run_experiment` runs them all.

.. [1] "Measurement Correction for Electric Vehicles Based on Compressed Sensing".
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import pandas as pd

from calibrator.errors import FleetError
from calibrator.experiments.attacks import WORLDS
from calibrator.experiments.common_drive import CommonCase, CommonDrive, builtin_common_drive
from calibrator.experiments.methods import BASELINES, CEILING, PERFECT, POSTERIOR, THRESHOLD, TREE
from calibrator.experiments.recorded_trips import RecordedCase, RecordedFleet, builtin_fleet, read_fleet
from calibrator.experiments.trial import ComparedMethod
from calibrator.files.layout_files import vehicle_database

__all__ = ["ALL", "EXPERIMENTS", "KEYS", "REAL", "Experiment", "ExperimentResult", "Setting", "fleet_for"]

KEYS = ["series", "x", "method"]
"""Columns of a result that say to which setting and method a row belongs."""
ALL = "all together"
"""Series of the rows of a result in which all settings count together; their x is NaN."""

BUILTIN_TRIPS, BUILTIN_DURATION_S = 27, 1500.0
"""Number of built-in trips [1] and their length [s]: as many as usable summer trips of the BMW i3, of median length."""
QUICK_VEHICLES, QUICK_TRIPS, QUICK_DURATION_S, QUICK_REPETITIONS = 20, 8, 300.0, 2
DEFAULT_LAYOUT = Path("dbc/hv_powertrain.toml")
"""Layout of the examples that come with the source; it fits the built-in vehicle."""


@dataclass(frozen=True, kw_only=True)
class Setting:
    """One setting of an experiment: how its fleets are made, and its place in the tables.

    Attributes
    ----------
    x : float
        Value of what the experiment varies, such as 60.0 for a sparsity of 60 %.
    series : str
        Value of what else it varies, as text, such as ``K=2, 5-25 %``.
    case : CommonCase or RecordedCase
        How the fleets are made.
    """

    x: float
    series: str = ""
    case: CommonCase | RecordedCase


@dataclass(frozen=True, kw_only=True)
class Experiment:
    """One experiment, a row of ``TABLE``.

    Attributes
    ----------
    name, title : str
        Name on the command line, and heading of its page.
    x_label, series_label : str
        What x and series of its settings are, with the unit, such as ``sparsity S [%]``.
    methods : tuple of ComparedMethod
        Methods that it compares.
    settings : tuple of Setting
        All on the common drive, or all on recorded trips.
    repetitions : int
        Trials per setting, if a run does not say how many.
    drive_s : float
        Length of the common drive. Its last 20 % are the unity drive: 7,200 samples at 10 Hz of an hour. The paper does
        not say how many it had. [s]
    paper : mapping
        What the paper prints: ``{(60.0, "published/tree"): {"f2": 0.84}}`` by (x, method), then figure.
    note : str
        Remark on the settings.
    shown : tuple of str
        Figures of the default method that stand beside the recovery rates of all methods, by the names of
        :data:`calibrator.experiments.figures.FIGURES`.
    panels : tuple of str
        Figures that its picture shows, a panel each.
    """

    name: str
    title: str
    x_label: str
    series_label: str = ""
    methods: tuple[ComparedMethod, ...]
    settings: tuple[Setting, ...]
    repetitions: int = 2
    drive_s: float = 3600.0
    paper: Mapping[tuple[float, str], Mapping[str, float]] = field(default_factory=dict)
    note: str = ""
    shown: tuple[str, ...] = ("confidence", "sure_wrong", "ece", "ece_by_chance", "deployed", "harmed", "delay_rmse_ms")
    panels: tuple[str, ...] = ("recovery_rate", "confidence")

    @property
    def recorded(self) -> bool:
        """Whether its vehicles drive recorded trips."""
        return any(isinstance(setting.case, RecordedCase) for setting in self.settings)

    def small(self, vehicles: int = QUICK_VEHICLES) -> "Experiment":
        """Return the experiment with its first and last setting, and small fleets, only to show that it runs."""
        settings = []
        for setting in (self.settings[0], *self.settings[1:][-1:]):
            case = setting.case
            if case.vehicles is not None:
                case = replace(case, vehicles=min(case.vehicles, vehicles))
            if isinstance(case, RecordedCase) and case.minutes is not None:
                case = replace(case, minutes=min(case.minutes, QUICK_DURATION_S / 60.0))
            settings.append(replace(setting, case=case))
        note = (
            f"Small fleets, at most {vehicles} vehicles or {QUICK_TRIPS} trips, and short drives: no figures to quote."
        )
        return replace(self, settings=tuple(settings), repetitions=QUICK_REPETITIONS, note=note)

    def only(self, text: str) -> "Experiment":
        """Return the experiment with those settings whose series has a text in it; FleetError if there are none."""
        kept = tuple(setting for setting in self.settings if text in setting.series)
        if not kept:
            names = ", ".join(dict.fromkeys(setting.series or "(without a name)" for setting in self.settings))
            raise FleetError(f"{self.name}: no setting has {text!r} in its name; there are {names}")
        return replace(self, settings=kept)


READINGS = (("", 60.0), ("3 of 6", 50.0))
"""(series, S) of the two readings of S = 60 with two branches: 2 of 6 parameters are not zero, or 3, here S = 50."""
LEVELS = ((20.0, "", 20.0), (40.0, "", 40.0), *((60.0, *reading) for reading in READINGS), (80.0, "", 80.0))
"""(x, series, S) of the paper's levels of sparsity x, with both readings of 60."""
TWO_READINGS = (
    "S = 60 can be read as 2 or 3 of 6 parameters that are not zero: 3 of 6 where the table says so, else 2. The "
    "paper's share of hardware faults fits 3, its recovery fits 2; its figure stands beside both."
)
SPARSITY, READING = "sparsity S [%]", "reading of S"
BALANCED = "Half of the vehicles have no hardware fault; where 'any vehicle' is said, each may have one."


def _paper(method: ComparedMethod, names: str, *rows: tuple[float, ...]) -> dict[tuple[float, str], dict[str, float]]:
    """Build the figures of the paper for a method: ``names`` with blanks between, and rows of x and their values."""
    return {(x, method.name): dict(zip(names.split(), values, strict=True)) for x, *values in rows}


def _sizes(magnitude: tuple[float, float]) -> str:
    return f"{100.0 * magnitude[0]:g}-{100.0 * magnitude[1]:g}"


def _named(case: RecordedCase) -> Setting:
    """Make a setting with the sparsity as x, and as series what else it has, such as ``K=2, 5-25 %, load 3+-1 A``."""
    load = "" if not any(case.unmeasured_a) else ", load {:g}+-{:g} A".format(*case.unmeasured_a)
    hardware = "" if case.balanced else ", any vehicle"
    named = "own prior" if case.own_prior is not None else f"{_sizes(case.magnitude)} %{hardware}{load}"
    return Setting(x=case.sparsity, series=f"K={case.branches}, {named}", case=case)


MAIN = tuple(RecordedCase(branches=K, sparsity=S) for K in (2, 3) for S in (80.0, 60.0))
LOAD_A = (3.0, 1.0)
"""Mean and standard deviation of a load: control units and the like take 1 to 4 A that no branch measures. [A]"""
REAL = tuple(
    map(
        _named,
        (
            *MAIN,
            *(replace(case, balanced=False) for case in MAIN),
            *(RecordedCase(magnitude=size) for size in ((0.02, 0.10), (0.01, 0.05), (0.005, 0.02), (0.3, 0.6))),
            RecordedCase(magnitude=(0.3, 0.6), branches=3),
            *(RecordedCase(sparsity=S, unmeasured_a=LOAD_A) for S in (80.0, 60.0)),
        ),
    )
)
"""Settings on recorded trips: ``MAIN``, with hardware faults in half of the vehicles and in any; other sizes of faults;
with a load that no branch measures."""

TABLE = (
    Experiment(
        name="classifier",
        title="Effect of the classifier (table 1)",
        x_label=SPARSITY,
        series_label=READING,
        repetitions=3,
        methods=(THRESHOLD, TREE, PERFECT, POSTERIOR),
        settings=tuple(Setting(x=60.0, series=series, case=CommonCase(sparsity=S)) for series, S in READINGS),
        paper=_paper(THRESHOLD, "f2 recovery_rate complexity", (60.0, 0.68, 0.84, 0.93))
        | _paper(TREE, "f2 recovery_rate complexity", (60.0, 0.84, 0.86, 0.41))
        | _paper(PERFECT, "f2 recovery_rate complexity", (60.0, 1.00, 0.91, 0.40)),
        note=TWO_READINGS,
    ),
    Experiment(
        name="snr",
        title="Effect of the simulation noise (figure 7)",
        x_label="SNR [dB]",
        repetitions=2,
        methods=(PERFECT, POSTERIOR),
        settings=tuple(
            Setting(x=x, case=CommonCase(snr_db=x))
            for x in (-20.0, -10.0, 0.0, 5.0, 10.0, 15.0, 20.0, 30.0, 40.0, 60.0)
        ),
        paper=_paper(PERFECT, "recovery_rate", (15.0, 0.80), (20.0, 0.91)),
        note="K = 2, S = 60.",
    ),
    Experiment(
        name="sparsity",
        title="Effect of the sparsity level (figure 8)",
        x_label=SPARSITY,
        series_label=READING,
        repetitions=3,
        methods=(TREE, PERFECT, POSTERIOR),
        settings=tuple(Setting(x=x, series=series, case=CommonCase(sparsity=S)) for x, series, S in LEVELS),
        paper=_paper(TREE, "recovery_rate", (20.0, 0.47), (40.0, 0.49), (60.0, 0.86), (80.0, 0.96)),
        note=TWO_READINGS,
    ),
    Experiment(
        name="statespace",
        title="End to end with state-space models (table 2)",
        x_label=SPARSITY,
        series_label=READING,
        repetitions=2,
        methods=(TREE, POSTERIOR),
        settings=tuple(
            Setting(x=x, series=series, case=CommonCase(vehicles=500, state_space=True, sparsity=S))
            for x, series, S in LEVELS
        ),
        drive_s=1200.0,  # the models are exact there: a longer drive shows the same and takes three times as long
        paper=_paper(
            TREE,
            "f2 recovery_rate recovery_rate_25",
            (20.0, 0.76, 0.45, 0.63),
            (40.0, 0.75, 0.49, 0.71),
            (60.0, 0.91, 0.75, 0.85),
            (80.0, 0.91, 0.96, 0.98),
        ),
        note=TWO_READINGS,
    ),
    Experiment(
        name="asymmetry",
        title="Fleets that are not symmetric",
        x_label="vehicles",
        series_label="sign bias",
        repetitions=3,
        methods=(PERFECT, POSTERIOR),
        settings=tuple(
            Setting(x=N, series=f"{bias:g}", case=CommonCase(vehicles=N, symmetric=False, sign_bias=bias))
            for bias in (0.0, 0.2, 0.4, 0.5)
            for N in (20, 100, 400, 2000)
        ),
        note="K = 2, S = 60.",
    ),
    Experiment(
        name="real",
        title="Each trip a vehicle with faults of its own",
        x_label=SPARSITY,
        series_label="branches, faults",
        repetitions=4,
        methods=(PERFECT, *BASELINES, POSTERIOR, CEILING),
        settings=REAL,
        note=BALANCED,
    ),
    Experiment(
        name="delay",
        title="Delays between the branches",
        x_label="largest delay [ms]",
        series_label="delays",
        repetitions=2,
        methods=(PERFECT, POSTERIOR),
        settings=tuple(
            Setting(x=x, series=series, case=RecordedCase(delay_max_s=x / 1e3, delays_left_in=left_in))
            for series, left_in in (("left in", True), ("taken out", False))
            for x in (0.0, 100.0, 200.0, 300.0)
        ),
        note="K = 2, S = 80.",
    ),
    Experiment(
        name="data",
        title="How much must be recorded",
        x_label="minutes per vehicle",
        series_label="vehicles",
        repetitions=2,
        methods=(PERFECT, POSTERIOR),
        settings=tuple(
            Setting(x=minutes, series=f"{N}", case=RecordedCase(sparsity=60.0, vehicles=N, minutes=minutes))
            for N in (10, 30, 100)
            for minutes in (1.0, 2.0, 5.0, 10.0, 20.0, 30.0)
        ),
        note="K = 2, S = 60.",
    ),
    Experiment(
        name="phase",
        title="Phase diagram: success over sparsity and size of the faults",
        x_label=SPARSITY,
        series_label="faults [% of full scale]",
        repetitions=2,
        methods=(PERFECT, POSTERIOR),
        settings=tuple(  # with two branches 5, 4, 3, 2 and 1 of 6 parameters are not zero
            Setting(x=S, series=_sizes(magnitude), case=RecordedCase(sparsity=S, magnitude=magnitude))
            for magnitude in ((0.005, 0.02), (0.01, 0.05), (0.02, 0.10), (0.05, 0.25))
            for S in (20.0, 40.0, 50.0, 60.0, 80.0)
        ),
        note="K = 2.",
    ),
    Experiment(
        name="attacks",
        title="Attacks: what the estimator does not expect",
        x_label="K",
        series_label="world",
        repetitions=2,
        methods=(POSTERIOR,),
        settings=tuple(
            Setting(x=K, series=world, case=RecordedCase(branches=K, world=world)) for world in WORLDS for K in (2, 3)
        ),
        note="S = 80; where no share is named, 30 % of the vehicles have what the world does.",
        shown=("corrected", "harmed", "worst_a", "named", "misnamed", "sure_wrong"),
        panels=("harmed", "named"),
    ),
    Experiment(
        name="small",
        title="Small fleets",
        x_label="vehicles",
        series_label="branches, world",
        repetitions=10,
        methods=(POSTERIOR, CEILING),
        settings=tuple(
            Setting(
                x=N,
                series=f"K={K}" + (f", {world}" if world else ""),
                case=RecordedCase(branches=K, balanced=False, world=world, vehicles=N, minutes=40.0),
            )
            for K in (2, 3)
            for world in ("", "battery +12 A in 60%", "load 10 A in 15%", "second variant x1.10 in 50%")
            for N in (6, 12)
        ),
        note="S = 80, hardware faults in any vehicle.",
        shown=("confidence", "deployed", "harmed", "worst_a", "sure_wrong"),
        panels=("recovery_rate", "harmed"),
    ),
    Experiment(
        name="coverage",
        title="Coverage: standard deviations of the parameters",
        x_label=SPARSITY,
        series_label="branches, faults",
        repetitions=3,
        methods=(POSTERIOR,),
        settings=(*REAL, *(_named(replace(case, own_prior=POSTERIOR)) for case in MAIN)),
        note="Of a normal distribution 0.683 are within 1 standard deviation, and 0.0027 beyond 3. 'own prior': faults "
        f"drawn from what the default has learnt of the balanced fleet with this K and S. {BALANCED}",
        shown=("gain_within_1", "gain_beyond_3", "offset_within_1", "offset_beyond_3"),
        panels=("gain_within_1", "offset_within_1"),
    ),
)
EXPERIMENTS = {experiment.name: experiment for experiment in TABLE}
"""The table by name."""


def fleet_for(
    experiment: Experiment, *, quick: bool = False, drives: Path | None = None, layout: Path | None = None
) -> CommonDrive | RecordedFleet:
    """Return the drives of an experiment: the built-in vehicle's, or those of a store if it is on recorded trips.

    Parameters
    ----------
    experiment : Experiment
        The experiment.
    quick : bool
        Whether to take only few and short drives.
    drives : Path or None
        Drive store with recorded trips; None: the built-in vehicle.
    layout : Path or None
        Layout of the trips; None: that of the built-in vehicle, if the current folder is a checkout.

    Raises
    ------
    UserError
        If layout or drives cannot be read, there are too few trips, or there is no default layout.
    """
    if not experiment.recorded:
        return builtin_common_drive(QUICK_DURATION_S if quick else experiment.drive_s)
    if layout is None and not DEFAULT_LAYOUT.is_file():
        raise FleetError(
            f"{DEFAULT_LAYOUT}: not in this folder, which is no checkout of the source; experiments on recorded trips "
            "need a layout, also for built-in ones: name it with --layout"
        )
    database = vehicle_database(layout or DEFAULT_LAYOUT)
    if drives is None:
        trips, duration_s = (QUICK_TRIPS, QUICK_DURATION_S) if quick else (BUILTIN_TRIPS, BUILTIN_DURATION_S)
        return builtin_fleet(database, trips=trips, duration_s=duration_s)
    fleet = read_fleet(drives, database)
    return fleet.take(QUICK_TRIPS, duration_s=QUICK_DURATION_S) if quick else fleet


@dataclass(frozen=True, kw_only=True, eq=False)
class ExperimentResult:
    """Figures of an experiment, and what is needed to repeat it.

    Attributes
    ----------
    experiment : Experiment
        The row that was run.
    settings : mapping
        By name: seed, repetitions, and facts of the drives.
    figures : DataFrame
        A row per setting (columns ``series``, ``x``), ``method`` and ``figure``, with the columns of
        :func:`~calibrator.experiments.figures.figure_rows`; of several settings also those of :data:`ALL`.
    tenths : DataFrame
        Rows of :func:`~calibrator.experiments.figures.tenths_of` for the same settings and methods.
    made : str
        Version, machine and day, as :func:`~calibrator.experiments.runner.made_now` says; empty for an experiment that
        was called as a function.
    """

    experiment: Experiment
    settings: Mapping[str, int | float | str]
    figures: pd.DataFrame
    tenths: pd.DataFrame
    made: str = ""

    @property
    def methods(self) -> tuple[str, ...]:
        """Names of the methods, in the order of their first rows."""
        return tuple(dict.fromkeys(self.figures["method"]))

    def value(self, figure: str, *, x: float, method: str, series: str = "") -> float:
        """Return a figure of a method under a setting; KeyError if there is none."""
        return float(self.figures.set_index([*KEYS, "figure"])["value"].to_dict()[series, x, method, figure])

    def to_json(self) -> str:
        """Return it as one JSON object: names and labels, settings, made, and both tables as lists of rows."""
        tables = {
            name: json.loads(table.to_json(orient="records", double_precision=15))
            for name, table in (("figures", self.figures), ("tenths", self.tenths))
        }
        named = {name: getattr(self.experiment, name) for name in ("name", "title", "x_label", "series_label")}
        return json.dumps({**named, "settings": dict(self.settings), "made": self.made, **tables}, ensure_ascii=False)
