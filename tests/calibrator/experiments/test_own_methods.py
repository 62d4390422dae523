"""Methods of one's own beside the built-in ones, or alone: tables are right, and errors name them."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from calibrator.errors import FleetError
from calibrator.experiments.judging import Effort
from calibrator.experiments.methods import PERFECT, POSTERIOR, Estimate, Method
from calibrator.experiments.paper_experiments import classifier_experiment
from calibrator.experiments.result import ExperimentResult
from calibrator.experiments.table import headline, result_markdown, result_table
from calibrator.experiments.trial import FleetLaw, Trial
from calibrator.faults import Faults
from tests.calibrator.experiments.small_trials import smooth_drive

N, K = 20, 2


def no_faults() -> Estimate:
    zero = np.zeros((N, K))
    faults = Faults(hardware_drift=np.zeros(N), hardware_offset_a=zero, drift=zero, offset_a=zero)
    return Estimate(faults=faults, hardware=np.zeros(N, bool), corrected=zero > 0.0, confidence=None, failed=0)


@dataclass(frozen=True)
class Own:
    """Says what it is told to say."""

    name: str = "own"
    change: Callable[[Estimate], Any] = lambda estimate: estimate

    def estimate(self, trial: Trial) -> Estimate:
        assert len(trial.truth) == N
        return self.change(no_faults())  # type: ignore[no-any-return]


def with_faults(**changed: Any) -> Callable[[Estimate], Estimate]:
    return lambda estimate: replace(estimate, faults=replace(estimate.faults, **changed))


def sure(estimate: Estimate) -> Estimate:
    return replace(estimate, confidence=np.full(N, 0.8))


def run(*methods: Method) -> ExperimentResult:
    law = FleetLaw(vehicles=N, training_vehicles=400)
    return classifier_experiment(drive=smooth_drive(), law=law, methods=methods, effort=Effort(repetitions=1))


def printed(result: ExperimentResult) -> str:
    console = Console(width=200)
    with console.capture() as capture:
        console.print(result_table(result))
    return " ".join(capture.get().split())


def test_own_methods_alone_are_named_beside_the_paper() -> None:
    result = run(Own(), Own("other"))
    header, rows = headline(result)
    assert header == ["reading of S", "sparsity S [%]", "paper", "own", "other"]
    assert [row[:3] for row in rows] == [["", "60", "0.91"], ["3 of 6", "60", "0.91"]]
    for text in (printed(result), result_markdown(result)):
        names = "own (a method of one's own) and other (a method of one's own)."
        assert f"within 10 %: the paper's best printed figure, {names}" in text
        for absent in ("Of the default", "in brackets"):
            assert absent not in text


def test_best_figure_of_the_paper_does_not_depend_on_the_methods() -> None:
    best = {methods: headline(run(*methods))[1][0][2] for methods in ((PERFECT,), (Own(), PERFECT), (Own(),))}
    assert set(best.values()) == {"0.91"}


def test_confidence_of_an_own_method_is_shown_where_the_default_is_not_run() -> None:
    result = run(PERFECT, Own("silent"), Own(change=sure))
    header, rows = headline(result)
    assert rows[0][header.index("confidence")] == "0.800"
    assert "Of own: mean confidence" in printed(result)
    assert "by tenths of own's confidence" in result_markdown(result)


def test_confidence_beside_the_default_is_the_defaults_and_each_has_its_own_on_the_page() -> None:
    result = run(Own(change=sure), POSTERIOR)
    header, rows = headline(result)
    default = result.row(x=60.0, method=POSTERIOR.name).figures["confidence"].mean
    assert rows[0][header.index("confidence")] == f"{default:.3f}"
    assert "Of the default: mean confidence" in printed(result)
    assert "| own | 0." in result_markdown(result)
    assert "| 0.800 |" in result_markdown(result)


def test_methods_of_one_name_are_refused() -> None:
    with pytest.raises(FleetError, match=r"^2 methods are called 'own'; give each method a name of its own$"):
        run(Own(), POSTERIOR, Own(change=with_faults(drift=np.full((N, K), np.nan))))


MANY = np.ones((N, K))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda _: None, r"estimate\(\) returned None, expected an Estimate; see"),
        (lambda _: MANY, r"estimate\(\) returned an object of type ndarray, expected an Estimate; see"),
        (lambda e: replace(e, faults=None), "faults are None, expected Faults of calibrator.faults; see"),
        (
            with_faults(drift=None),
            r"faults.drift is None, expected an array of numbers of shape \(20, 2\): vehicles and",
        ),
        (
            with_faults(offset_a=np.zeros(3)),
            r"faults.offset_a is an array of float64 of shape \(3,\), expected .*\(20, 2\)",
        ),
        (
            with_faults(hardware_drift=np.zeros(3)),
            r"faults.hardware_drift is .*\(3,\), expected .*\(20,\): vehicles; see",
        ),
        (
            with_faults(hardware_offset_a=MANY[:3]),
            r"faults.hardware_offset_a is .* shape \(3, 2\), expected .*\(20, 2\)",
        ),
        (with_faults(drift=MANY * np.nan), "faults.drift has 40 values that are not finite; expected 0 where no fault"),
        (with_faults(hardware_drift=np.full(N, np.inf)), "faults.hardware_drift has 20 values that are not finite"),
        (lambda e: replace(e, hardware=np.zeros(N)), r"hardware is an array of float64 .* expected an array of bool"),
        (
            lambda e: replace(e, corrected=np.zeros(N, bool)),
            r"corrected is an array of bool of shape \(20,\), expected",
        ),
        (lambda e: replace(e, confidence=0.8), "confidence is an object of type float, expected an array of numbers"),
        (
            lambda e: replace(e, confidence=np.full(N, 1.5)),
            "confidence has 20 values that are no probability; expected 0",
        ),
        (lambda e: replace(e, confidence=np.full(N, np.nan)), "confidence has 20 values that are no probability"),
        (
            lambda e: replace(e, failed=None),
            "failed is None, expected a number of vehicles; see Estimate of calibrator",
        ),
    ],
)
def test_what_is_no_estimate_is_refused_with_the_name_of_the_method(
    change: Callable[[Estimate], Any], message: str
) -> None:
    with pytest.raises(FleetError, match=f"^method 'mine': {message}"):
        run(Own("mine", change))
