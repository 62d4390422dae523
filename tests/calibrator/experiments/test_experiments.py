"""The table of experiments, its runner, and what is written of a result."""

import json
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from rich.console import Console

from calibrator.errors import FleetError
from calibrator.experiments.common_drive import CommonCase
from calibrator.experiments.experiments import ALL, EXPERIMENTS, Experiment, ExperimentResult, Setting, fleet_for
from calibrator.experiments.methods import PERFECT, POSTERIOR, MethodRow
from calibrator.experiments.pages import headline, result_markdown, result_table, write_page
from calibrator.experiments.recorded_trips import RecordedCase, RecordedFleet
from calibrator.experiments.runner import run_experiment
from calibrator.experiments.trial import CommonEvidence, ComparedMethod, Estimate, Trial
from calibrator.faults import Faults
from tests.calibrator.command_here import refused, succeeded
from tests.calibrator.conftest import LAYOUT
from tests.calibrator.experiments.small_trials import small_fleet, smooth_drive


@pytest.fixture(scope="module")
def fleet() -> RecordedFleet:
    return small_fleet(trips=6, samples=1800)


@pytest.fixture(scope="module")
def snr() -> ExperimentResult:
    settings = tuple(Setting(x=x, case=CommonCase(vehicles=16, snr_db=x)) for x in (10.0, 20.0))
    return run_experiment(replace(EXPERIMENTS["snr"], settings=settings), smooth_drive(), repetitions=1)


def only(result: ExperimentResult, column: str, value: object) -> ExperimentResult:
    """The result with only those rows that have this value in a column."""
    figures, tenths = (table[table[column] == value] for table in (result.figures, result.tenths))
    return replace(result, figures=figures, tenths=tenths)


def printed(result: ExperimentResult, width: int = 200) -> str:
    console = Console(width=width)
    with console.capture() as capture:
        console.print(result_table(result))
    return capture.get()


def test_new_experiment_needs_one_table_row_and_is_checked_before_it_runs(fleet: RecordedFleet, tmp_path: Path) -> None:
    row = Experiment(
        name="loads",
        title="Loads without a sensor",
        x_label="load [A]",
        methods=(POSTERIOR,),
        settings=tuple(Setting(x=a, case=RecordedCase(unmeasured_a=(a, 0.0))) for a in (0.0, 5.0)),
    )
    result = run_experiment(row, fleet, repetitions=1)
    write_page(tmp_path / "results", result)
    assert result.figures["x"].dropna().unique().tolist() == [0.0, 5.0]
    page = (tmp_path / "results" / "loads.md").read_text()
    assert "| load [A] | posterior |" in page
    assert re.search(r"\| 5 \| [01]\.\d{3} \([01]\.\d{3} to [01]\.\d{3}\)", page), "each rate with its interval"
    assert "(results/loads.md)" in (tmp_path / "results.md").read_text()
    many = replace(row, settings=(*row.settings, Setting(x=9.0, case=RecordedCase(branches=9))))
    with pytest.raises(FleetError, match="9 currents asked for"):
        run_experiment(many, fleet, methods=[MethodRow("none", lambda _: pytest.fail("a trial was run"))])


@pytest.mark.parametrize(
    "name", ["delay", *(pytest.param(n, marks=pytest.mark.long) for n in EXPERIMENTS if n not in {"delay", "snr"})]
)
def test_each_experiment_runs_and_writes_json_page_and_picture(name: str, fleet: RecordedFleet, tmp_path: Path) -> None:
    row = EXPERIMENTS[name].small()
    result = run_experiment(row, fleet if row.recorded else smooth_drive(samples=2000), repetitions=1)
    result = replace(result, made="calibrator 1.0")
    write_page(tmp_path / "results", result)
    single = result.figures[result.figures["series"] != ALL]
    found = dict.fromkeys(zip(single["series"], single["x"], single["method"], strict=True))
    assert list(found) == [(s.series, s.x, method.name) for s in row.settings for method in row.methods]
    record = json.loads((tmp_path / "results" / f"{name}.json").read_text())
    for name_, table in (("figures", result.figures), ("tenths", result.tenths)):
        read = pd.DataFrame(record[name_], columns=table.columns).astype({"x": float})
        pd.testing.assert_frame_equal(read, table, check_dtype=False)
    assert (record["settings"], record["made"]) == (result.settings, result.made)
    page = (tmp_path / "results" / f"{name}.md").read_text()
    assert f"`calibrator experiment {name}`: 1 repetition, seed 0, drive" in page
    assert ("minus the sum of the others" in page) == row.recorded
    assert (tmp_path / "results" / f"{name}.png").read_bytes().startswith(b"\x89PNG")
    for line in printed(result, width=80).splitlines():
        assert len(line) <= 80
        assert "…" not in line
    if name == "delay":
        estimated = result.figures.loc[result.figures["figure"] == "delay_rmse_ms", "series"]
        assert {*estimated} == {"taken out", ALL}
        assert result.value("delay_rmse_ms", x=300.0, series="taken out", method=POSTERIOR.name) < 5.0
    if name == "coverage":
        counts = result.figures[result.figures["figure"].str.endswith("beyond_3")].groupby("series")["of"].sum()
        assert result.tenths.groupby("series")["pit"].sum().to_dict() == counts.to_dict()


def test_results_depend_on_the_seed_but_not_on_the_number_of_processes(snr: ExperimentResult) -> None:
    row = replace(snr.experiment, methods=(PERFECT,), repetitions=1)
    again = run_experiment(row, smooth_drive(), workers=2)
    before = only(snr, "method", PERFECT.name).figures.reset_index(drop=True)
    pd.testing.assert_frame_equal(again.figures, before)
    other = run_experiment(row, smooth_drive(), seed=100)
    assert not other.figures["value"].equals(again.figures["value"])


def test_all_repetitions_of_a_setting_count_in_its_figures(snr: ExperimentResult) -> None:
    row = replace(snr.experiment, methods=(PERFECT,))
    once, twice = (run_experiment(row, smooth_drive(), repetitions=number) for number in (1, 2))
    assert twice.figures["of"].max() == 2 * once.figures["of"].max()


def test_tables_compare_the_paper_with_methods_and_explain_columns(snr: ExperimentResult) -> None:
    table = headline(snr)
    assert list(table.columns[:5]) == ["SNR [dB]", "paper", PERFECT.name, POSTERIOR.name, "confidence"]
    assert table[["SNR [dB]", "paper"]].to_numpy().tolist() == [["10", "-"], ["20", "0.91"], ["all", "-"]]
    rate = snr.value("recovery_rate", x=20.0, method=POSTERIOR.name)
    assert re.fullmatch(rf"{rate:.3f} \(\d\.\d{{3}} to \d\.\d{{3}}\)", table[POSTERIOR.name].iloc[1])
    only_published = only(snr, "method", PERFECT.name)
    for text in (result_markdown(only_published), printed(only_published)):
        assert " / 0.91" in text
        assert "harmed: share of the corrected vehicles" in text
        assert not any(absent in text for absent in ("confidence", "calibration error", "delays", "failed:"))


def test_row_all_together_pools_the_trials_of_all_settings(snr: ExperimentResult) -> None:
    rows = snr.figures[snr.figures["method"] == POSTERIOR.name].set_index(["series", "figure"])
    rates = [snr.value("recovery_rate", x=x, method=POSTERIOR.name) for x in (10.0, 20.0)]
    assert rows.loc[(ALL, "recovery_rate"), "value"] == pytest.approx(np.mean(rates))
    assert rows.loc[(ALL, "recovery_rate"), "of"] == 32
    tenths = snr.tenths[snr.tenths["method"] == POSTERIOR.name]
    assert tenths.groupby("series")["vehicles"].sum().to_dict() == {"": 32.0, ALL: 32.0}


def test_only_experiments_on_recorded_trips_need_a_layout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert fleet_for(EXPERIMENTS["snr"], quick=True).full_scale_a == 400.0
    with pytest.raises(FleetError, match=r"hv_powertrain\.toml: not in this folder.*name it with --layout$"):
        fleet_for(EXPERIMENTS["real"], quick=True)
    assert fleet_for(EXPERIMENTS["real"], quick=True, layout=LAYOUT).record["trips"] == 8


TWICE = (Setting(x=1.0, case=CommonCase()),) * 2
NO_TABLE = "^snr: methods .*; expected methods with names of their own, and settings that differ in x or series$"


@pytest.mark.parametrize(("change", "message"), [
    ({"settings": (Setting(x=1.0, case=RecordedCase()),)}, "^snr: cannot be run on a CommonDrive; see fleet_for"),
    ({"settings": ()}, NO_TABLE),
    ({"settings": TWICE}, NO_TABLE),
    ({"methods": ()}, NO_TABLE),
    ({"methods": (PERFECT, POSTERIOR, PERFECT)}, "^snr: methods published/perfect, posterior, published/perfect;"),
])  # fmt: skip
def test_experiment_with_unfit_drives_settings_or_methods_is_refused(change: dict[str, Any], message: str) -> None:
    with pytest.raises(FleetError, match=message):
        run_experiment(replace(EXPERIMENTS["snr"], **change), smooth_drive())


@pytest.mark.parametrize("repetitions", [0, 1.5])
def test_experiment_without_whole_repetitions_is_refused(repetitions: Any) -> None:
    with pytest.raises(FleetError, match=f"snr: {repetitions} repetitions; expected a whole number, 1 or more"):
        run_experiment(EXPERIMENTS["snr"], smooth_drive(), repetitions=repetitions)


def test_quick_experiment_has_few_settings_and_small_fleets() -> None:
    small = EXPERIMENTS["asymmetry"].small()
    assert [(each.series, each.x) for each in small.settings] == [("0", 20.0), ("0.5", 2000.0)]
    assert {each.case.vehicles for each in small.settings} == {20}
    assert (EXPERIMENTS["asymmetry"].repetitions, small.repetitions) == (3, 2)


def test_option_only_selects_settings_by_a_part_of_their_name_and_refuses_an_unknown_one() -> None:
    kept = EXPERIMENTS["attacks"].only("cubic").small().settings
    assert [(each.series, each.x) for each in kept] == [("cubic 5-20 %", 2.0), ("cubic 5-20 %", 3.0)]
    said = refused("experiment", "asymmetry", "--only", "0.3")
    assert "asymmetry: no setting has '0.3' in its name; there are 0, 0.2, 0.4, 0.5" in said


def test_number_of_vehicles_without_a_drive_length_is_refused_for_recorded_trips() -> None:
    with pytest.raises(FleetError, match="40 vehicles, and each trip is one: give minutes as well"):
        RecordedCase(vehicles=40)


def test_experiment_command_writes_json_page_and_picture_or_lists_all_experiments(tmp_path: Path) -> None:
    succeeded("experiment", "snr", "--quick", "--repetitions", 1, "--workers", 1, "--out", tmp_path / "results")
    assert {path.name for path in (tmp_path / "results").iterdir()} == {"snr.json", "snr.md", "snr.png"}
    assert [line.split()[0] for line in succeeded("experiment").splitlines()] == list(EXPERIMENTS)


# Methods of one's own beside the built-in ones, or alone


N, K = 20, 2
MANY = np.ones((N, K))
Change = Callable[[Estimate], Any]


@dataclass(frozen=True)
class Own:
    """A method that finds no faults, and whose estimate can be changed."""

    name: str = "own"
    change: Change = lambda estimate: estimate

    def estimate(self, trial: Trial) -> Estimate:
        assert len(trial.truth) == N
        zero = np.zeros((N, K))
        faults = Faults(hardware_drift=np.zeros(N), hardware_offset_a=zero, drift=zero, offset_a=zero)
        found = Estimate(faults=faults, hardware=np.zeros(N, bool), corrected=zero > 0.0, confidence=None, failed=0)
        return self.change(found)  # type: ignore[no-any-return]


def with_faults(**changed: Any) -> Change:
    return lambda estimate: replace(estimate, faults=replace(estimate.faults, **changed))


def run(*methods: ComparedMethod, reading: str = "") -> ExperimentResult:
    row = EXPERIMENTS["classifier"].only(reading).small()
    return run_experiment(row, smooth_drive(), methods=methods, repetitions=1)


def test_table_shows_own_methods_and_one_confidence_preferably_of_the_default_method() -> None:
    sure = Own(change=lambda estimate: replace(estimate, confidence=np.full(N, 0.8)))
    result = run(PERFECT, Own("silent"), sure)
    table = headline(result)
    assert list(table.columns[:6]) == ["reading of S", "sparsity S [%]", "paper", PERFECT.name, "silent", "own"]
    assert table.iloc[:, :3].to_numpy().tolist() == [["", "60", "0.91"], ["3 of 6", "60", "0.91"], [ALL, "all", "-"]]
    assert table["confidence"].iloc[0] == "0.800"
    assert "then figures of own." in result_markdown(result)
    silent = run(Own("silent"))
    assert list(headline(silent).columns[2:]) == ["paper", "silent"]
    assert "with 95 % intervals.\n" in result_markdown(silent)
    both = run(sure, POSTERIOR)
    default = both.value("confidence", x=60.0, method=POSTERIOR.name)
    assert headline(both)["confidence"].iloc[0] == f"{default:.3f}"


class Spoiling(Own):
    """A method that overwrites what it is given."""

    def estimate(self, trial: Trial) -> Estimate:
        assert isinstance(trial.recorded, CommonEvidence)
        for part in (trial.truth, trial.unseen, trial.evidence, trial.recorded.rows, trial.recorded):
            for values in vars(part).values():
                if isinstance(values, np.ndarray):
                    values[...] = 0
        return super().estimate(trial)


def test_method_that_overwrites_its_trial_does_not_change_the_figures_of_others() -> None:
    spoilt, clean = (run(method, PERFECT, POSTERIOR, reading="3 of 6") for method in (Spoiling(), Own()))
    pd.testing.assert_frame_equal(spoilt.figures, clean.figures)


@pytest.mark.parametrize(("change", "message"), [
    (lambda _: MANY, r"estimate\(\) returned ndarray, expected an Estimate"),
    (with_faults(drift=None), "drift is NoneType, expected an array of numpy"),
    (lambda e: replace(e, faults=None), "faults is NoneType, expected Faults"),
    (lambda e: replace(e, confidence=[0.5] * N), "confidence is list, expected an array of numpy"),
    (with_faults(hardware_drift=np.zeros(3)), r"hardware_drift is .*\(3,\), expected .*\(20,\)"),
    (with_faults(drift=MANY * np.nan), "drift .* expected finite numbers .*, 0 where no fault is found"),
    (lambda e: replace(e, hardware=np.zeros(N)), r"hardware is float64 .* bool of shape \(20,\) \(vehicles\)$"),
    (lambda e: replace(e, failed=None), "failed is None, expected a number of vehicles, 0 to 20"),
    (lambda e: replace(e, failed=-1), "failed is -1, expected"),
    (lambda e: replace(e, drift_sd=MANY[:3], offset_sd_a=MANY), r"drift_sd is .* \(3, 2\), expected .*\(20, 2\)"),
    (lambda e: replace(e, confidence=np.linspace(0.0, 1.5, N)), "confidence is 0 to 1.5, expected 0 to 1"),
    (lambda e: replace(e, findings=[["load"]]), "findings of 1 vehicles, expected those of 20, or none"),
])  # fmt: skip
def test_invalid_estimate_is_refused_with_the_name_of_the_method(change: Change, message: str) -> None:
    with pytest.raises(FleetError, match=f"^method 'mine': {message}"):
        run(Own("mine", change))
