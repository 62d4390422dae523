"""Each baseline finds what it is made for."""

import numpy as np
import pytest

from calibrator.experiments.common_drive import CommonCase, common_trial
from calibrator.experiments.figures import judge
from calibrator.experiments.methods import BASELINES, MethodRow
from calibrator.experiments.recorded_trips import RecordedCase, recorded_trial
from calibrator.experiments.trial import Trial
from tests.calibrator.experiments.small_trials import small_fleet, smooth_drive


def rate(method: MethodRow, trial: Trial) -> float:
    return float(judge(method.estimate(trial), trial)["recovery_rate"].mean())


def test_best_subset_lasso_and_median_recover_single_faults() -> None:
    trial = recorded_trial(small_fleet(), RecordedCase(), 0)
    best, lasso, median, *_ = BASELINES
    assert rate(best, trial) >= 0.8
    assert np.mean(best.estimate(trial).hardware == trial.truth.has_hardware_fault) >= 0.8
    assert rate(lasso, trial) >= 0.6
    assert rate(median, trial) >= 0.4
    case = CommonCase(vehicles=60, sparsity=80.0)
    assert rate(best, common_trial(smooth_drive(), case, 0)) >= 0.9


@pytest.mark.parametrize("baseline", BASELINES[3:], ids=lambda baseline: baseline.name)
def test_methods_on_the_junction_law_alone_know_ratios_of_gains(baseline: MethodRow) -> None:
    trial = common_trial(smooth_drive(), CommonCase(vehicles=40, sparsity=80.0), 0)
    found = baseline.estimate(trial)
    np.testing.assert_array_equal(found.hardware, False)
    corrected = np.all(found.corrected, axis=1)
    gains, true = (1.0 + found.faults.drift, 1.0 + trial.truth.drift)
    ratio, wanted = ((own[:, 0] / own[:, 1])[corrected] for own in (gains, true))
    np.testing.assert_allclose(ratio, wanted, rtol=1e-3)
