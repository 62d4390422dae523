from dataclasses import replace

import numpy as np
import pytest

from calibrator.errors import FleetError
from calibrator.experiments.common_drive import CommonCase, builtin_common_drive, common_trial
from calibrator.experiments.figures import figure_rows, judge
from calibrator.experiments.methods import BASELINES, CEILING, PERFECT, POSTERIOR, THRESHOLD, TREE, MethodRow
from calibrator.experiments.recorded_trips import RecordedCase, recorded_trial
from calibrator.experiments.trial import ComparedMethod, Trial
from calibrator.faults import slopes_and_intercepts
from tests.calibrator.experiments.small_trials import small_fleet, smooth_drive

CASE = CommonCase(vehicles=100)


def rates(case: CommonCase, *methods: ComparedMethod, figure: str = "recovery_rate") -> list[float]:
    """Value of a figure for each method, all on the same trial."""
    trial = common_trial(smooth_drive(), case, 0)
    judged = [figure_rows([judge(method.estimate(trial), trial)])[0].set_index("figure") for method in methods]
    return [float(figures.loc[figure, "value"]) for figures in judged]


def test_artificial_trial_has_the_requested_signal_to_noise_ratio() -> None:
    drive = smooth_drive()
    trial = common_trial(drive, replace(CASE, vehicles=400, snr_db=20.0), 0)
    noise_a2 = np.mean(trial.evidence.slope_variances * np.sum((drive.unity - drive.unity.mean(axis=0)) ** 2, axis=0))
    assert noise_a2 == pytest.approx(0.01 * np.mean(drive.unity[:, 0] ** 2), rel=0.02)


def test_state_space_models_of_a_symmetric_fleet_give_the_slopes_of_the_faults() -> None:
    trial = common_trial(smooth_drive(), replace(CASE, vehicles=40, state_space=True), 0)
    a, b = slopes_and_intercepts(trial.truth)
    np.testing.assert_allclose(trial.evidence.slopes, a, atol=1e-5)
    np.testing.assert_allclose(trial.evidence.intercepts_a, b, atol=1e-3)


def test_common_drive_with_more_branches_than_the_builtin_vehicle_has_is_refused() -> None:
    with pytest.raises(FleetError, match="9 branches: the built-in vehicle has 2 to 5"):
        builtin_common_drive(60.0, branches=9)


@pytest.mark.long
def test_f2_rises_with_better_classifiers_and_recovery_with_sparsity_and_snr() -> None:
    f2 = rates(CASE, PERFECT, TREE, THRESHOLD, figure="f2")
    assert f2[0] == 1.0
    assert f2 == sorted(f2, reverse=True)
    by_sparsity = [rates(replace(CASE, sparsity=S), PERFECT)[0] for S in (20.0, 50.0, 60.0, 80.0)]
    assert by_sparsity == sorted(by_sparsity)
    assert by_sparsity[-1] > 0.9
    by_noise = [rates(replace(CASE, snr_db=snr_db), PERFECT)[0] for snr_db in (-20.0, 10.0, 60.0)]
    assert by_noise[0] < min(by_noise[1], 0.2)
    assert by_noise[1] < by_noise[2]
    assert min(rates(replace(CASE, vehicles=40, sparsity=80.0, state_space=True), TREE, POSTERIOR)) > 0.9
    default, published = rates(CASE, POSTERIOR, PERFECT)
    assert published > 0.85
    assert default > published - 0.1
    assert rates(CASE, POSTERIOR, figure="sure_recovered") > [0.95]
    assert rates(CASE, POSTERIOR, figure="harmed") < [0.05]


def test_asymmetric_fleet_defeats_the_published_method_but_not_the_default() -> None:
    published, default = rates(replace(CASE, vehicles=60, symmetric=False, sign_bias=0.4), PERFECT, POSTERIOR)
    assert published < 0.3
    assert default > 0.8


def test_method_with_known_prior_is_refused_if_the_distribution_of_the_faults_is_unknown() -> None:
    case = replace(CASE, vehicles=12)
    trial = common_trial(smooth_drive(), case, 0)
    ceiling, default = (method.estimate(trial).confidence for method in (CEILING, POSTERIOR))
    assert not np.array_equal(ceiling, default)  # type: ignore[arg-type]
    biased = common_trial(smooth_drive(), replace(case, symmetric=False, sign_bias=0.4), 0)
    with pytest.raises(FleetError, match="nobody can say what the faults of these trials were drawn from"):
        CEILING.estimate(biased)


def test_builtin_drive_has_the_requested_branches_and_a_different_unseen_drive() -> None:
    builtin, drive = (builtin_common_drive(120.0, branches) for branches in (5, 3))
    for currents, all_branches in ((drive.i_s, builtin.i_s), (drive.unseen, builtin.unseen)):
        np.testing.assert_array_equal(currents[:, [0, 2]], all_branches[:, [0, 2]])
        np.testing.assert_allclose(currents.sum(axis=1), 0.0, atol=1e-9)
    assert not np.array_equal(drive.i_s[:500], drive.unseen[:500])


# Baselines: each finds what it is made for

METHODS = {method.name: method for method in BASELINES}


def rate(method: MethodRow, trial: Trial) -> float:
    return float(judge(method.estimate(trial), trial)["recovery_rate"].mean())


def test_best_subset_lasso_and_median_recover_single_faults() -> None:
    trial = recorded_trial(small_fleet(), RecordedCase(), 0)
    best, lasso, median = (METHODS[name] for name in ("best subset", "LASSO", "fleet median"))
    assert rate(best, trial) >= 0.8
    assert np.mean(best.estimate(trial).hardware == trial.truth.has_hardware_fault) >= 0.8
    assert rate(lasso, trial) >= 0.6
    assert rate(median, trial) >= 0.4
    case = CommonCase(vehicles=60, sparsity=80.0)
    assert rate(best, common_trial(smooth_drive(), case, 0)) >= 0.9


@pytest.mark.parametrize("name", ["best subset", "LASSO"])
def test_faults_outside_the_support_are_exactly_zero(name: str) -> None:
    trial = common_trial(smooth_drive(branches=3), CommonCase(vehicles=20, sparsity=80.0), 0)
    found = METHODS[name].estimate(trial)
    for values in (found.faults.drift, found.faults.offset_a / trial.full_scale_a):
        assert not np.any((values != 0.0) & (np.abs(values) < 1e-12)), "rounding is no fault"
    assert not found.corrected.all()


@pytest.mark.parametrize("name", ["total least squares", "VDI 2048"])
def test_methods_using_only_the_junction_law_find_the_gain_ratio(name: str) -> None:
    trial = common_trial(smooth_drive(), CommonCase(vehicles=40, sparsity=80.0), 0)
    found = METHODS[name].estimate(trial)
    np.testing.assert_array_equal(found.hardware, False)
    corrected = np.all(found.corrected, axis=1)
    gains, true = (1.0 + found.faults.drift, 1.0 + trial.truth.drift)
    ratio, wanted = ((own[:, 0] / own[:, 1])[corrected] for own in (gains, true))
    np.testing.assert_allclose(ratio, wanted, rtol=1e-3)
