"""Each baseline finds what it is made for."""

import numpy as np
import pytest

from calibrator.experiments.baselines import BASELINES, Baseline
from calibrator.experiments.common_drive import CommonCase, common_trial
from calibrator.experiments.figures import judge
from calibrator.experiments.recorded_trips import RecordedCase, recorded_trial
from calibrator.experiments.trial import Trial
from calibrator.faults import Faults
from tests.calibrator.experiments.small_trials import small_fleet, smooth_drive


@pytest.fixture(scope="module")
def trial() -> Trial:
    return recorded_trial(small_fleet(), RecordedCase(), 0)


def rate(baseline: Baseline, trial: Trial) -> float:
    return float(judge(baseline.estimate(trial), trial)["recovery_rate"].mean())


def test_best_subset_and_lasso_recover_single_faults(trial: Trial) -> None:
    best, lasso, median, *_ = BASELINES
    assert rate(best, trial) >= 0.8
    assert rate(lasso, trial) >= 0.6
    assert rate(median, trial) >= 0.4
    case = CommonCase(vehicles=60, sparsity=80.0)
    assert rate(best, common_trial(smooth_drive(), case, 0)) >= 0.9


def test_best_subset_finds_hardware_faults(trial: Trial) -> None:
    found = BASELINES[0].estimate(trial).hardware
    assert np.mean(found == trial.truth.has_hardware_fault) >= 0.8


@pytest.mark.parametrize("baseline", BASELINES[3:], ids=lambda baseline: baseline.name)
def test_methods_on_the_junction_law_alone_know_ratios_of_gains(baseline: Baseline) -> None:
    trial = common_trial(smooth_drive(), CommonCase(vehicles=40, sparsity=80.0), 0)
    found = baseline.estimate(trial)
    np.testing.assert_array_equal(found.hardware, False)
    corrected = np.all(found.corrected, axis=1)
    ratio, true = (_ratio(faults)[corrected] for faults in (found.faults, trial.truth))
    np.testing.assert_allclose(ratio, true, rtol=1e-3)


def _ratio(faults: Faults) -> np.ndarray:
    return (1.0 + faults.drift[:, 0]) / (1.0 + faults.drift[:, 1])
