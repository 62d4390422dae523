import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console
from scipy.signal import lfilter

from calibrator.drive import Array
from calibrator.errors import DriveError, FleetError
from calibrator.experiments.common_drive import CommonDrive, builtin_common_drive
from calibrator.experiments.judging import judge
from calibrator.experiments.methods import PERFECT, THRESHOLD, TREE
from calibrator.experiments.paper_experiments import (
    classifier_experiment,
    snr_experiment,
    sparsity_experiment,
    statespace_experiment,
)
from calibrator.experiments.runner import run_experiment
from calibrator.experiments.table import result_table
from calibrator.experiments.trial import FleetLaw, artificial_trial, noise_sd_a, state_space_trial
from calibrator.faults import slopes_and_intercepts

LAW = FleetLaw(vehicles=100, training_vehicles=1000)


def smooth_drive(branches: int = 2, samples: int = 6000) -> CommonDrive:
    """Currents that follow smooth random inputs through a lag; the last branch takes the balance."""
    rng = np.random.default_rng(0)
    inputs = lfilter([0.05], [1.0, -0.95], rng.normal(size=(samples, branches)), axis=0) * 200.0
    free = lfilter([0.2], [1.0, -0.8], inputs[:, : branches - 1], axis=0) + 5.0
    i_s: Array = np.column_stack([free, -free.sum(axis=1)])
    return CommonDrive(name="smooth", i_s=i_s, inputs=inputs, full_scale_a=400.0)


def test_artificial_trial_has_the_signal_to_noise_ratio_asked_for() -> None:
    drive = smooth_drive()
    law = replace(LAW, vehicles=400, snr_db=20.0)
    trial = artificial_trial(drive, law, seed=0)
    noise_a2 = np.mean(trial.evidence.slope_variances * np.sum((drive.unity - drive.unity.mean(axis=0)) ** 2, axis=0))
    assert noise_a2 == pytest.approx(0.01 * np.mean(drive.unity[:, 0] ** 2), rel=0.02)
    assert noise_sd_a(drive, 20.0) == pytest.approx(np.sqrt(noise_a2), rel=0.01)


def test_trial_is_the_same_for_the_same_seed_and_differs_from_its_training_fleet() -> None:
    drive = smooth_drive()
    law = replace(LAW, training_vehicles=LAW.vehicles)
    first, second = artificial_trial(drive, law, seed=3), artificial_trial(drive, law, seed=3)
    np.testing.assert_array_equal(first.evidence.slopes, second.evidence.slopes)
    training, _ = first.training()
    assert not np.array_equal(training.slopes, first.evidence.slopes)


def test_state_space_models_of_a_symmetric_fleet_give_the_slopes_of_the_faults() -> None:
    trial = state_space_trial(smooth_drive(), replace(LAW, vehicles=40), seed=0)
    a, b = slopes_and_intercepts(trial.truth)
    np.testing.assert_allclose(trial.evidence.slopes, a, atol=1e-5)
    np.testing.assert_allclose(trial.evidence.intercepts_a, b, atol=1e-3)


def test_perfect_classifier_beats_the_tree_and_the_tree_the_threshold() -> None:
    result = classifier_experiment(drive=smooth_drive(), law=LAW, repetitions=3)
    rates = [result.row(x=60.0, method=m.name).figures["f2"].mean for m in (PERFECT, TREE, THRESHOLD)]
    assert rates[0] == 1.0
    assert rates == sorted(rates, reverse=True)
    perfect = result.row(x=60.0, method=PERFECT.name).figures
    assert perfect["recovery_rate"].mean > 0.85
    assert perfect["recovery_rate"].paper == 0.91
    assert perfect["failed"].mean == 0.0


def test_sparser_faults_are_recovered_more_often() -> None:
    result = sparsity_experiment(drive=smooth_drive(), law=LAW, methods=(PERFECT,), repetitions=2)
    rates = [row.figures["recovery_rate"].mean for row in result.rows]
    assert [row.x for row in result.rows] == [20.0, 40.0, 60.0, 80.0]
    assert rates == sorted(rates)
    assert rates[-1] > 0.9


def test_less_noise_recovers_more_and_noise_alone_recovers_nearly_nothing() -> None:
    result = snr_experiment(drive=smooth_drive(), law=LAW, snrs_db=(-20.0, 10.0, 60.0), repetitions=2)
    rates = [row.figures["recovery_rate"].mean for row in result.rows]
    assert rates[0] < 0.2
    assert rates[0] < rates[1] < rates[2]


def test_state_space_experiment_recovers_sparse_faults() -> None:
    law = replace(LAW, vehicles=40)
    result = statespace_experiment(drive=smooth_drive(), law=law, sparsities=(80.0,), repetitions=1)
    assert result.rows[0].figures["recovery_rate"].mean > 0.9


def test_three_branches_work_as_two_do() -> None:
    trial = artificial_trial(smooth_drive(branches=3), replace(LAW, sparsity=80.0), seed=0)
    assert judge(PERFECT.recover(trial), trial)["recovery_rate"] > 0.7


def test_result_survives_json() -> None:
    result = classifier_experiment(drive=smooth_drive(), law=LAW, methods=(PERFECT,), repetitions=1, seed=7)
    record = json.loads(result.to_json())
    assert record["settings"]["seed"] == 7
    assert record["rows"][0]["figures"]["f2"] == {"mean": 1.0, "sd": 0.0, "paper": 1.0}


def test_table_shows_the_papers_figure_beside_ours() -> None:
    result = snr_experiment(drive=smooth_drive(), law=LAW, snrs_db=(20.0,), repetitions=1)
    console = Console(width=160)
    with console.capture() as capture:
        console.print(result_table(result))
    assert "(0.91)" in capture.get()
    assert "SNR [dB]" in capture.get()


@pytest.mark.parametrize("name", ["classifier", "snr"])
def test_runner_writes_page_record_and_picture(name: str, tmp_path: Path) -> None:
    drive = smooth_drive(samples=2000)
    result = run_experiment(name, quick=True, repetitions=1, out=tmp_path / "new", drive=drive, jobs=1)
    page = (tmp_path / "new" / f"{name}.md").read_text()
    assert f"calibrator experiment {name}" in page
    assert page.count("\n| ") == 2 + len(result.rows)
    assert json.loads((tmp_path / "new" / f"{name}.json").read_text())["settings"]["repetitions"] == 1
    assert (tmp_path / "new" / f"{name}.png").read_bytes().startswith(b"\x89PNG")


def test_runner_takes_the_builtin_drive() -> None:
    drive = builtin_common_drive(branches=3, seed=1, duration_s=120.0)
    assert drive.i_s.shape[1] == 3
    np.testing.assert_allclose(drive.i_s.sum(axis=1), 0.0, atol=1e-9)
    result = run_experiment("classifier", quick=True, repetitions=1, jobs=1)
    assert result.settings["drive"] == "builtin-0"


def test_unknown_experiment_is_refused_with_the_known_ones() -> None:
    with pytest.raises(FleetError, match="no experiment 'noise'; choose one of classifier, snr, sparsity, statespace"):
        run_experiment("noise")


def test_no_repetition_is_refused() -> None:
    with pytest.raises(FleetError, match="at least 1 repetition, not 0"):
        run_experiment("snr", repetitions=0)


def test_drive_that_breaks_the_junction_law_is_refused() -> None:
    with pytest.raises(DriveError, match="must sum to zero; the worst sum is 2 A"):
        CommonDrive(name="broken", i_s=np.ones((10, 2)), inputs=np.ones((10, 1)), full_scale_a=400.0)


def test_drive_of_unequal_lengths_is_refused() -> None:
    with pytest.raises(DriveError, match="do not fit"):
        CommonDrive(name="broken", i_s=np.zeros((10, 2)), inputs=np.ones((9, 1)), full_scale_a=400.0)
