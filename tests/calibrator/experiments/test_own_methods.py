"""Methods of one's own beside the built-in ones, or alone: tables are right, and errors name them."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from calibrator.errors import FleetError
from calibrator.experiments.experiments import EXPERIMENTS, ExperimentResult
from calibrator.experiments.methods import PERFECT, POSTERIOR
from calibrator.experiments.pages import headline, result_markdown
from calibrator.experiments.runner import run_experiment
from calibrator.experiments.trial import ComparedMethod, Estimate, Trial
from calibrator.faults import Faults
from tests.calibrator.experiments.small_trials import smooth_drive

N, K = 20, 2
MANY = np.ones((N, K))
Change = Callable[[Estimate], Any]


@dataclass(frozen=True)
class Own:
    """Finds no faults, and says what it is told to say."""

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


def run(*methods: ComparedMethod) -> ExperimentResult:
    return run_experiment(EXPERIMENTS["classifier"].small(), smooth_drive(), methods=methods, repetitions=1)


def test_own_methods_stand_beside_the_paper_and_confidence_is_of_the_first_that_has_one() -> None:
    sure = Own(change=lambda estimate: replace(estimate, confidence=np.full(N, 0.8)))
    result = run(PERFECT, Own("silent"), sure)
    table = headline(result)
    assert list(table.columns[:6]) == ["reading of S", "sparsity S [%]", "paper", PERFECT.name, "silent", "own"]
    assert table.iloc[:, :3].to_numpy().tolist() == [["", "60", "0.91"], ["3 of 6", "60", "0.91"]]
    assert table["confidence"].iloc[0] == "0.800"
    assert "then figures of own:" in result_markdown(result)
    silent = run(Own("silent"))
    assert list(headline(silent).columns[2:]) == ["paper", "silent"]
    assert "with 95 % intervals:" in result_markdown(silent)
    both = run(sure, POSTERIOR)
    default = both.value("confidence", x=60.0, method=POSTERIOR.name)
    assert headline(both)["confidence"].iloc[0] == f"{default:.3f}"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda _: MANY, r"what estimate\(\) returned is float64 of shape \(20, 2\), expected an Estimate; see"),
        (lambda e: replace(e, faults=None), "faults is NoneType, expected Faults of calibrator.faults"),
        (with_faults(drift=None), r"faults.drift is NoneType, expected finite numbers of shape \(20, 2\)"),
        (with_faults(hardware_drift=np.zeros(3)), r"faults.hardware_drift is .*\(3,\), expected .*\(20,\)"),
        (with_faults(drift=MANY * np.nan), "faults.drift .* expected finite numbers .*, 0 where no fault is found"),
        (lambda e: replace(e, hardware=np.zeros(N)), "hardware is float64 .* expected bool"),
        (lambda e: replace(e, confidence=np.full(N, 1.5)), "confidence is .* probabilities from 0 to 1"),
        (lambda e: replace(e, drift_sd=MANY[:3], offset_sd_a=MANY), r"drift_sd is .* \(3, 2\), expected .*\(20, 2\)"),
        (lambda e: replace(e, findings=[["load"]]), "findings of 1 vehicles is list, expected those of 20, or none"),
    ],
)
def test_what_is_no_estimate_is_refused_with_the_name_of_the_method(change: Change, message: str) -> None:
    with pytest.raises(FleetError, match=f"^method 'mine': {message}"):
        run(Own("mine", change))
