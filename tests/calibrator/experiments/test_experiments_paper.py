from dataclasses import replace

import numpy as np
import pytest

from calibrator.errors import DriveError
from calibrator.experiments.common_drive import CommonDrive, builtin_common_drive
from calibrator.experiments.common_trial import (
    artificial_trial,
    common_rows,
    measured_moments,
    noise_sd_a,
    state_space_trial,
)
from calibrator.experiments.judging import Effort
from calibrator.experiments.methods import PERFECT, POSTERIOR, THRESHOLD, TREE
from calibrator.experiments.outcome import figures_of, judge
from calibrator.experiments.paper_experiments import (
    asymmetry_experiment,
    classifier_experiment,
    snr_experiment,
    sparsity_experiment,
    statespace_experiment,
)
from calibrator.experiments.table import result_markdown
from calibrator.experiments.trial import FleetLaw
from calibrator.faults import slopes_and_intercepts
from tests.calibrator.experiments.small_trials import smooth_drive

LAW = FleetLaw(vehicles=100, training_vehicles=1000)


def test_artificial_trial_has_the_signal_to_noise_ratio_asked_for() -> None:
    drive = smooth_drive()
    law = replace(LAW, vehicles=400, snr_db=20.0)
    trial = artificial_trial(drive, law, 0)
    noise_a2 = np.mean(trial.evidence.slope_variances * np.sum((drive.unity - drive.unity.mean(axis=0)) ** 2, axis=0))
    assert noise_a2 == pytest.approx(0.01 * np.mean(drive.unity[:, 0] ** 2), rel=0.02)
    assert noise_sd_a(drive, 20.0) == pytest.approx(np.sqrt(noise_a2), rel=0.01)


def test_trial_is_the_same_for_the_same_seed_and_differs_from_its_training_fleet() -> None:
    drive = smooth_drive()
    law = replace(LAW, training_vehicles=LAW.vehicles)
    first, second = artificial_trial(drive, law, 3), artificial_trial(drive, law, 3)
    np.testing.assert_array_equal(first.evidence.slopes, second.evidence.slopes)
    assert first.training is not None
    training, _ = first.training()
    assert not np.array_equal(training.slopes, first.evidence.slopes)


def test_state_space_models_of_a_symmetric_fleet_give_the_slopes_of_the_faults() -> None:
    trial = state_space_trial(smooth_drive(), replace(LAW, vehicles=40), 0)
    a, b = slopes_and_intercepts(trial.truth)
    np.testing.assert_allclose(trial.evidence.slopes, a, atol=1e-5)
    np.testing.assert_allclose(trial.evidence.intercepts_a, b, atol=1e-3)


@pytest.mark.parametrize("branches", [2, 3])
def test_junction_rows_of_a_common_drive_are_those_of_the_faults(branches: int) -> None:
    drive = smooth_drive(branches=branches)
    trial = artificial_trial(drive, LAW, 0)
    moments = measured_moments(drive.unity, trial.truth)
    rows = common_rows(trial.evidence, drive.unity.mean(axis=0), *moments, full_scale_a=drive.full_scale_a)
    factor, offset = 1.0 + trial.truth.drift, trial.truth.offset_a / drive.full_scale_a
    gains = np.log(factor[:, :1] / factor[:, 1:])
    constant = factor[:, 0] * np.sum(offset / factor, axis=1)
    np.testing.assert_allclose(rows.relative[:, branches : 2 * branches - 1], gains, atol=1e-9)
    np.testing.assert_allclose(rows.constant[:, branches], constant, atol=1e-9)


def test_rows_over_the_densest_cluster_do_not_feel_that_the_fleet_is_not_symmetric() -> None:
    drive = smooth_drive()
    law = replace(LAW, vehicles=300, symmetric=False, sign_bias=0.4)
    trial = artificial_trial(drive, law, 0)
    a, b = slopes_and_intercepts(trial.truth)
    reference_mean_a = np.median(
        (a * drive.unity.mean(axis=0) + b - trial.evidence.intercepts_a) / trial.evidence.slopes, 0
    )
    moments = measured_moments(drive.unity, trial.truth)
    rows = common_rows(trial.evidence, reference_mean_a, *moments, full_scale_a=drive.full_scale_a)
    sd = np.sqrt(np.einsum("nii->ni", rows.covariance))
    assert np.abs(trial.evidence.slopes - a).max() > 10.0 * sd[:, :2].max()
    slope_error = (rows.relative[:, :2] - np.log(a)) / sd[:, :2]
    intercept_error = (rows.constant[:, :2] - b / drive.full_scale_a) / (a * sd[:, 5:7])
    for error in (slope_error, intercept_error):
        assert error.std() == pytest.approx(1.0, abs=0.1)
        assert np.abs(error.mean(axis=0)).max() < 0.5


def test_moments_of_measured_currents_are_those_of_their_samples() -> None:
    drive = smooth_drive(branches=3)
    truth = artificial_trial(drive, LAW, 0).truth
    mean_a, covariance_a2 = measured_moments(drive.unity, truth)
    slope, intercept = slopes_and_intercepts(truth)
    samples = slope[7] * drive.unity + intercept[7]
    np.testing.assert_allclose(mean_a[7], samples.mean(axis=0))
    np.testing.assert_allclose(covariance_a2[7], np.cov(samples.T, bias=True))


def test_perfect_classifier_beats_the_tree_and_the_tree_the_threshold() -> None:
    methods = (THRESHOLD, TREE, PERFECT)
    result = classifier_experiment(drive=smooth_drive(), law=LAW, methods=methods, effort=Effort(repetitions=3))
    rates = [result.row(x=60.0, method=m.name).figures["f2"].mean for m in (PERFECT, TREE, THRESHOLD)]
    assert rates[0] == 1.0
    assert rates == sorted(rates, reverse=True)
    perfect = result.row(x=60.0, method=PERFECT.name).figures
    assert perfect["recovery_rate"].mean > 0.85
    assert perfect["recovery_rate"].paper == 0.91
    assert perfect["failed"].mean == 0.0


def test_default_without_a_classifier_recovers_as_many_as_the_published_method_with_a_perfect_one() -> None:
    trial = artificial_trial(smooth_drive(), LAW, 0)
    default, published = (figures_of(judge(m.estimate(trial), trial)) for m in (POSTERIOR, PERFECT))
    assert default["recovery_rate"].mean > published["recovery_rate"].mean - 0.1
    assert default["sure_recovered"].mean > 0.95
    assert default["harmed"].mean < 0.05


def test_sparser_faults_are_recovered_more_often() -> None:
    effort = Effort(repetitions=2)
    result = sparsity_experiment(drive=smooth_drive(), law=LAW, methods=(PERFECT,), effort=effort)
    rates = [row.figures["recovery_rate"].mean for row in result.rows if not row.series]
    assert [row.x for row in result.rows] == [20.0, 40.0, 60.0, 60.0, 80.0]
    assert rates == sorted(rates)
    assert rates[-1] > 0.9


def test_both_readings_of_the_level_at_which_the_paper_is_quoted_stand_side_by_side() -> None:
    result = classifier_experiment(drive=smooth_drive(), law=LAW, methods=(PERFECT,), effort=Effort(repetitions=2))
    two, three = (result.row(x=60.0, series=series, method=PERFECT.name).figures for series in ("", "3 of 6"))
    assert two["complexity"].mean < three["complexity"].mean
    assert two["recovery_rate"].mean > three["recovery_rate"].mean
    assert two["recovery_rate"].paper == three["recovery_rate"].paper == 0.91
    assert "S = 60 can be read as 2 or 3 of 6 parameters that are not zero" in result_markdown(result)


def test_with_three_branches_both_readings_are_the_same() -> None:
    effort = Effort(repetitions=1)
    result = classifier_experiment(drive=smooth_drive(branches=3), law=LAW, methods=(PERFECT,), effort=effort)
    assert [row.series for row in result.rows] == [""]
    assert not result.note


def test_less_noise_recovers_more_and_noise_alone_recovers_nearly_nothing() -> None:
    snrs_db, effort = (-20.0, 10.0, 60.0), Effort(repetitions=2)
    result = snr_experiment(drive=smooth_drive(), law=LAW, methods=(PERFECT,), snrs_db=snrs_db, effort=effort)
    rates = [row.figures["recovery_rate"].mean for row in result.rows]
    assert rates[0] < 0.2
    assert rates[0] < rates[1] < rates[2]


def test_state_space_experiment_recovers_sparse_faults() -> None:
    law, effort = replace(LAW, vehicles=40), Effort(repetitions=1)
    result = statespace_experiment(drive=smooth_drive(), law=law, sparsities=(80.0,), effort=effort)
    assert all(row.figures["recovery_rate"].mean > 0.9 for row in result.rows)
    assert result.methods == (TREE.name, POSTERIOR.name)


def test_fleet_that_is_not_symmetric_defeats_the_mean_and_not_the_default() -> None:
    result = asymmetry_experiment(
        drive=smooth_drive(), law=LAW, fleet_sizes=(60,), sign_biases=(0.4,), effort=Effort(repetitions=1)
    )
    published, default = (result.row(x=60.0, series="0.4", method=m.name) for m in (PERFECT, POSTERIOR))
    assert published.figures["recovery_rate"].mean < 0.3
    assert default.figures["recovery_rate"].mean > 0.8


def test_three_branches_work_as_two_do() -> None:
    trial = artificial_trial(smooth_drive(branches=3), replace(LAW, sparsity=80.0), 0)
    assert figures_of(judge(PERFECT.estimate(trial), trial))["recovery_rate"].mean > 0.7


def test_builtin_drive_has_the_branches_asked_for_and_an_unseen_drive() -> None:
    drive = builtin_common_drive(branches=3, seed=1, duration_s=120.0)
    assert drive.i_s.shape[1] == drive.unseen.shape[1] == 3
    np.testing.assert_allclose(drive.i_s.sum(axis=1), 0.0, atol=1e-9)
    np.testing.assert_allclose(drive.unseen.sum(axis=1), 0.0, atol=1e-9)
    assert not np.array_equal(drive.i_s[:500], drive.unseen[:500])


def test_drive_that_breaks_the_junction_law_is_refused() -> None:
    currents = np.ones((10, 2))
    with pytest.raises(DriveError, match="must sum to zero; the worst sum is 2 A"):
        CommonDrive(name="broken", i_s=currents, inputs=np.ones((10, 1)), full_scale_a=400.0, unseen=currents)


def test_drive_of_unequal_lengths_is_refused() -> None:
    currents = np.zeros((10, 2))
    with pytest.raises(DriveError, match="do not fit"):
        CommonDrive(name="broken", i_s=currents, inputs=np.ones((9, 1)), full_scale_a=400.0, unseen=currents)
