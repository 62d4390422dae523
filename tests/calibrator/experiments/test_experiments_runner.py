import json
import platform
import re
from dataclasses import replace
from pathlib import Path

import pytest
from rich.console import Console

from calibrator.errors import FleetError
from calibrator.experiments.baselines import BASELINES
from calibrator.experiments.calibration_experiment import ALL, calibration_experiment
from calibrator.experiments.command import ExperimentName
from calibrator.experiments.delay_experiment import delay_experiment
from calibrator.experiments.judging import Effort
from calibrator.experiments.methods import CEILING, LEFT_IN, PERFECT, POSTERIOR
from calibrator.experiments.paper_experiments import classifier_experiment, snr_experiment
from calibrator.experiments.recorded_experiments import (
    attacks_experiment,
    coverage_experiment,
    data_experiment,
    phase_experiment,
    real_experiment,
)
from calibrator.experiments.recorded_fleet import RecordedFleet
from calibrator.experiments.recorded_trial import RecordedCase
from calibrator.experiments.result import ExperimentResult, Figure, decode_result
from calibrator.experiments.runner import EXPERIMENTS, RunOptions, read_results, run_experiments, write_result
from calibrator.experiments.table import DETAILS, caption, headline, result_markdown, result_table
from calibrator.experiments.trial import FleetLaw
from ecu_node import __version__
from tests.calibrator.experiments.small_trials import LAYOUT, small_fleet, smooth_drive

LAW = FleetLaw(vehicles=16, training_vehicles=400)
ONCE = Effort(repetitions=1)


@pytest.fixture(scope="module")
def fleet() -> RecordedFleet:
    return small_fleet(trips=6, samples=1800)


@pytest.fixture(scope="module")
def snr() -> ExperimentResult:
    return snr_experiment(drive=smooth_drive(), law=LAW, snrs_db=(10.0, 20.0), effort=Effort(repetitions=2))


def test_result_survives_json(snr: ExperimentResult) -> None:
    assert decode_result(snr.to_json(), "here") == snr
    record = json.loads(snr.to_json())
    assert record["settings"]["repetitions"] == 2
    assert record["rows"][2]["figures"]["recovery_rate"]["paper"] == 0.91


def test_damaged_record_is_named() -> None:
    with pytest.raises(FleetError, match=r"here\.json: not a record of an experiment: .*run the experiment again"):
        decode_result(b'{"name": 3}', "here.json")


def test_repetitions_do_not_depend_on_the_number_of_processes(snr: ExperimentResult) -> None:
    effort = Effort(repetitions=2, jobs=2)
    again = snr_experiment(drive=smooth_drive(), law=LAW, methods=[PERFECT], snrs_db=(10.0, 20.0), effort=effort)
    assert again.rows == tuple(row for row in snr.rows if row.method == PERFECT.name)


def test_headline_puts_paper_published_method_and_default_side_by_side(snr: ExperimentResult) -> None:
    header, rows = headline(snr)
    assert header[:5] == ["SNR [dB]", "paper", PERFECT.name, POSTERIOR.name, "confidence"]
    assert [row[:2] for row in rows] == [["10", "-"], ["20", "0.91"]]
    assert rows[1][3] == f"{snr.row(x=20.0, method=POSTERIOR.name).figures['recovery_rate'].mean:.3f}"


def test_console_table_fits_80_columns(fleet: RecordedFleet) -> None:
    classifier = classifier_experiment(drive=smooth_drive(samples=2000), law=LAW, effort=ONCE)
    case = RecordedCase(unmeasured_a=(3.0, 1.0))
    for result in (classifier, real_experiment(fleet=fleet, cases=[case], effort=ONCE)):
        console = Console(width=80)
        with console.capture() as capture:
            console.print(result_table(result))
        assert "…" not in capture.get()
        assert "confidence" in capture.get()


def test_page_holds_all_figures_of_all_methods(snr: ExperimentResult) -> None:
    page = result_markdown(snr)
    tenths = {b.low for row in snr.rows for b in row.bins}
    assert page.count("\n| ") == 2 + 2 + (2 + 2) + 2 + len(snr.rows) + 2 + len(tenths)
    assert "(0.91)" in page
    assert "harmed" in page


def test_captions_explain_the_columns_that_are_there_and_no_others(snr: ExperimentResult) -> None:
    only_published = replace(snr, rows=tuple(row for row in snr.rows if row.method == PERFECT.name))
    page, printed = result_markdown(only_published), _printed(only_published)
    for text in (page, printed):
        assert "the paper's best printed figure and the published method (/ its classifier)." in text
        for absent in ("the default", "confidence", "calibration error", "delays", "law known"):
            assert absent not in text
    assert "in some branch (deployed)" in page
    assert "the figures above" not in page
    pooled = result_markdown(calibration_experiment([snr]))
    assert "within 10 %: the default (posterior). Of the default: mean confidence, of the vehicles above 0.95" in pooled
    assert "count once in 'all together'" in pooled
    for absent in ("paper", "published", "f2", "hardware", "(deployed)", "(harmed)", "25 %"):
        assert absent not in pooled.partition("Settings:")[0]


def test_captions_name_every_column(snr: ExperimentResult) -> None:
    methods = (CEILING.name, LEFT_IN.name)
    more = tuple(replace(row, method=name) for name in methods for row in snr.rows if row.method == POSTERIOR.name)
    figures = {name: Figure(mean=0.5, sd=0.0) for name in DETAILS}
    result = replace(snr, rows=tuple(replace(row, figures=figures) for row in (*snr.rows, *more)))
    text = caption([result])
    columns = ("law known", "delays left in")
    sure = ("mean confidence", "above 0.95 those not recovered, and how many they expect")
    for words in (*columns, *sure, "ECE", "by chance", "(deployed)", "(harmed)", "error of the estimated delays"):
        assert words in text
    details = result_markdown(result).partition("Of each method: ")[2].partition("\n")[0]
    for words in ("within 10 %", "within 25 %", "f2", "(hardware)", "the figures above"):
        assert words in details


def test_page_names_command_and_picture_only_where_there_are_any(snr: ExperimentResult, tmp_path: Path) -> None:
    by_hand = result_markdown(snr)
    for absent in ("calibrator experiment", ".png", "--out"):
        assert absent not in by_hand + _printed(snr)
    assert "result_markdown shows all figures." in _printed(snr)
    made = replace(snr, made="calibrator 1.0")
    assert "--out writes all figures." in _printed(made)
    write_result(tmp_path / "results", made, tuple(EXPERIMENTS))
    page = (tmp_path / "results" / "snr.md").read_text()
    assert "Written by `calibrator experiment snr --out FOLDER`. Share" in page
    assert "](snr.png)" in page


def test_harm_of_the_published_method_is_explained_where_it_is_shown(snr: ExperimentResult) -> None:
    page = result_markdown(snr)
    assert "gets worse on an unseen drive, however little (harmed)" in page
    assert "counts as harmed although it is recovered." in page
    only_default = replace(snr, rows=tuple(row for row in snr.rows if row.method == POSTERIOR.name))
    assert "The published method corrects" not in result_markdown(only_default)


def test_flags_are_booleans_in_records_and_words_on_pages(snr: ExperimentResult) -> None:
    settings = json.loads(snr.to_json())["settings"]
    assert (settings["balanced"], settings["symmetric"]) == (True, True)
    assert "balanced true, symmetric true." in result_markdown(snr)


def test_records_of_before_version_1_are_read_and_show_the_same(snr: ExperimentResult) -> None:
    record = json.loads(snr.to_json())
    del record["paper"], record["made"]
    record["settings"].update(balanced="true", symmetric="true")
    old = decode_result(json.dumps(record).encode(), "here")
    assert headline(old) == headline(snr)
    assert result_markdown(old) == result_markdown(snr)


def test_one_repetition_is_one(snr: ExperimentResult, tmp_path: Path) -> None:
    once = replace(snr, settings={**snr.settings, "repetitions": 1})
    write_result(tmp_path / "results", once, tuple(EXPERIMENTS))
    for text in (_printed(once), (tmp_path / "results.md").read_text()):
        assert "1 repetition, seed 0" in text
    assert "2 repetitions, seed 0" in _printed(snr)
    assert "2 or 10 repetitions" in _printed(replace(snr, settings={**snr.settings, "repetitions": "2 or 10"}))


def test_index_explains_what_some_of_its_tables_show(snr: ExperimentResult, tmp_path: Path) -> None:
    only_published = replace(snr, rows=tuple(row for row in snr.rows if row.method == PERFECT.name))
    write_result(tmp_path / "results", only_published, tuple(EXPERIMENTS))
    assert "confidence" not in (tmp_path / "results.md").read_text()
    write_result(tmp_path / "results", replace(snr, name="classifier"), tuple(EXPERIMENTS))
    assert "mean confidence" in (tmp_path / "results.md").read_text()


def _printed(result: ExperimentResult) -> str:
    console = Console(width=200)
    with console.capture() as capture:
        console.print(result_table(result))
    return " ".join(capture.get().split())


def test_folder_gets_record_page_picture_and_an_index_of_all_results(snr: ExperimentResult, tmp_path: Path) -> None:
    folder = tmp_path / "new" / "results"
    order = tuple(EXPERIMENTS)
    write_result(folder, snr, order)
    write_result(folder, replace(snr, name="classifier", title="Second"), order)
    for name in ("snr", "classifier"):
        assert (folder / f"{name}.md").is_file()
        assert (folder / f"{name}.png").read_bytes().startswith(b"\x89PNG")
    assert [result.name for result in read_results(folder, order)] == ["classifier", "snr"]
    index = (tmp_path / "new" / "results.md").read_text()
    assert index.index("[Second](results/classifier.md)") < index.index("(results/snr.md)")
    assert "2 repetitions, seed 0, drive smooth" in index


def test_calibration_pools_the_confidences_of_the_default_alone(snr: ExperimentResult) -> None:
    result = calibration_experiment([snr, _with_seed(replace(snr, name="sparsity"), 100)])
    assert [row.series for row in result.rows] == ["snr", "sparsity", ALL]
    one, _, both = result.rows
    assert (one.x, both.x) == (64.0, 128.0)
    assert both.figures["ece"].mean == pytest.approx(one.figures["ece"].mean)
    rates = [row.figures["recovery_rate"].mean for row in snr.rows if row.method == POSTERIOR.name]
    assert one.figures["recovery_rate"].mean == pytest.approx(sum(rates) / 2.0)
    assert one.figures["sure_recovered"].mean <= 1.0


def test_trials_that_experiments_share_count_once_all_together(snr: ExperimentResult) -> None:
    shared = replace(snr, name="classifier", rows=tuple(row for row in snr.rows if row.x == 20.0))
    result = calibration_experiment([shared, snr])
    classifier, whole, together = result.rows
    assert (classifier.x, whole.x, together.x) == (32.0, 64.0, 64.0)
    assert together.bins == whole.bins
    assert together.figures == whole.figures
    assert sum(int(line.split("|")[2]) for line in _tenths(result_markdown(result))) == 64


def test_trials_of_other_seeds_or_figures_are_not_taken_for_the_same(snr: ExperimentResult) -> None:
    other = replace(snr, name="sparsity")
    assert calibration_experiment([snr, _with_seed(other, 100)]).rows[-1].x == 128.0
    first = next(row for row in snr.rows if row.bins)
    figures = {**first.figures, "deployed": replace(first.figures["deployed"], mean=0.123)}
    changed = replace(other, rows=(replace(first, figures=figures),))
    assert calibration_experiment([snr, changed]).rows[-1].x == 96.0


def _with_seed(result: ExperimentResult, seed: int) -> ExperimentResult:
    return replace(result, settings={**result.settings, "seed": seed})


def _tenths(page: str) -> list[str]:
    """Rows of the last table of a page."""
    return page.rpartition("| --- |\n")[2].partition("\n\n")[0].splitlines()


def test_calibration_of_nothing_is_refused() -> None:
    with pytest.raises(FleetError, match="no experiment has a confidence"):
        calibration_experiment([])


def test_calibration_takes_the_records_of_the_folder(snr: ExperimentResult, tmp_path: Path) -> None:
    write_result(tmp_path / "results", snr, tuple(EXPERIMENTS))
    (result,) = run_experiments(["calibration"], RunOptions(), out=tmp_path / "results")
    assert result.settings["experiments"] == "snr"
    assert (tmp_path / "results" / "calibration.png").is_file()


def test_calibration_without_records_says_what_to_run_first_and_runs_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("calibrator.experiments.runner.EXPERIMENTS", dict.fromkeys(EXPERIMENTS, _must_not_run))
    folder = tmp_path / "results"
    with pytest.raises(
        FleetError, match=f"{folder}: no experiment is recorded .* 'calibrator experiment all --out {folder}'"
    ):
        run_experiments(["calibration"], RunOptions(), out=folder)
    assert not folder.exists()
    with pytest.raises(FleetError, match="'calibrator experiment all --out FOLDER'"):
        run_experiments(["calibration"], RunOptions())


def _must_not_run(options: RunOptions) -> ExperimentResult:
    raise AssertionError("an experiment was run")


def test_experiments_on_recorded_trips_write_their_pictures(fleet: RecordedFleet, tmp_path: Path) -> None:
    results = (
        real_experiment(fleet=fleet, cases=(RecordedCase(),), effort=ONCE),
        phase_experiment(fleet=fleet, sparsities=(80.0,), magnitudes=((0.05, 0.25),), effort=ONCE),
        data_experiment(fleet=fleet, minutes=(2.0,), fleet_sizes=(6,), effort=ONCE),
    )
    for result in results:
        write_result(tmp_path / "results", result, tuple(EXPERIMENTS))
        ceiling = (CEILING.name,) if result.name == "real" else ()
        more = tuple(method.name for method in BASELINES) if result.name == "real" else ()
        assert result.methods == (PERFECT.name, *more, POSTERIOR.name, *ceiling)
        assert (tmp_path / "results" / f"{result.name}.png").is_file()
    same = [
        result.row(x=80.0, series=series, method=POSTERIOR.name).figures["recovery_rate"]
        for result, series in zip(results, ("K=2, 5-25 %", "5-25"), strict=False)
    ]
    assert same[0] == same[1]


def test_attacks_are_counted_with_bounds_and_drawn(fleet: RecordedFleet, tmp_path: Path) -> None:
    worlds = ("load 5 A in 30%", "second variant x1.10 in 50%")
    more = replace(fleet, trips=fleet.trips + small_fleet(trips=12, samples=1800).trips[6:])
    result = attacks_experiment(fleet=more, worlds=worlds, branches=(2,), effort=ONCE)
    write_result(tmp_path / "results", result, tuple(EXPERIMENTS))
    header, rows = headline(result)
    assert header[:4] == ["world", "K", POSTERIOR.name, "corrected"]
    assert {"worst [A]", "named", "misnamed"} < set(header)
    assert [row[0] for row in rows] == list(worlds)
    assert re.search(r"\d of \d+, at most 0\.\d+\)", (tmp_path / "results" / "attacks.md").read_text())
    assert (tmp_path / "results" / "attacks.png").is_file()


def test_coverage_has_the_settings_of_real_and_the_own_prior(fleet: RecordedFleet, tmp_path: Path) -> None:
    cases = (RecordedCase(), RecordedCase(balanced=False))
    few = coverage_experiment(fleet=fleet, cases=cases[:1], effort=ONCE)  # so few that nothing is deployed
    write_result(tmp_path / "results", few, tuple(EXPERIMENTS))
    result = coverage_experiment(fleet=small_fleet(samples=1800), cases=cases, effort=ONCE)
    scores = ("gain_beyond_3", "offset_beyond_3")
    assert [row.series for row in result.rows] == ["K=2, 5-25 %", "K=2, 5-25 %, any vehicle", "K=2, own prior"]
    assert all(
        sum(row.pit) == sum(row.figures[name].of or 0 for name in scores if name in row.figures) for row in result.rows
    )
    write_result(tmp_path / "results", result, tuple(EXPERIMENTS))
    page = (tmp_path / "results" / "coverage.md").read_text()
    assert "by tenths of their probability integral transform" in page
    assert (tmp_path / "results" / "coverage.png").is_file()


def test_delay_experiment_shows_the_default_with_and_without_compensation(fleet: RecordedFleet) -> None:
    result = delay_experiment(fleet=fleet, delays_ms=(0.0, 300.0), methods=(POSTERIOR,), effort=ONCE)
    assert [(row.x, row.method) for row in result.rows] == [
        (0.0, POSTERIOR.name), (0.0, LEFT_IN.name), (300.0, POSTERIOR.name), (300.0, LEFT_IN.name),
    ]  # fmt: skip
    assert result.row(x=300.0, method=POSTERIOR.name).figures["delay_rmse_ms"].mean < 5.0


def test_runner_runs_quick_experiments_of_both_kinds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "1700000000")
    options = RunOptions(quick=True, repetitions=1, layout=LAYOUT, drive=smooth_drive(samples=2000))
    snr, real = run_experiments(["snr", "real"], options, out=tmp_path / "results")
    assert decode_result((tmp_path / "results" / "snr.json").read_bytes(), "here") == snr
    assert snr.settings["drive"] == "smooth"
    assert real.settings["drive"] == "8 built-in trips, no recordings"
    page = (tmp_path / "results" / "real.md").read_text()
    assert "In every trip the current of motor is minus the sum of the other branches: it is not independent" in page
    assert "minus the sum" not in (tmp_path / "results" / "snr.md").read_text()
    made = f"calibrator {__version__}, Python {platform.python_version()}"
    for page in ("results.md", "results/snr.md", "results/real.md"):
        assert made in (tmp_path / page).read_text()
        assert "2023-11-14" in (tmp_path / page).read_text()


def test_only_experiments_on_recorded_trips_need_a_layout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    options = RunOptions(quick=True, repetitions=1, drive=smooth_drive(samples=2000))
    assert run_experiments(["snr"], options)[0].name == "snr"
    with pytest.raises(FleetError, match=r"hv_powertrain\.toml: not in this folder.*name it with --layout$"):
        run_experiments(["snr", "real"], options)


def test_every_experiment_has_a_name_on_the_command_line() -> None:
    assert [*EXPERIMENTS, "calibration", "all"] == list(ExperimentName)


def test_unknown_experiment_is_refused_with_the_known_ones() -> None:
    with pytest.raises(FleetError, match="no experiment 'noise'; choose one of classifier, snr, sparsity, statespace"):
        run_experiments(["noise"], RunOptions())


def test_no_repetition_is_refused() -> None:
    with pytest.raises(FleetError, match="at least 1 repetition, not 0"):
        run_experiments(["snr"], RunOptions(repetitions=0, drive=smooth_drive(samples=2000)))
