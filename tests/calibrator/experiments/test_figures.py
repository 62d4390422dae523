"""Figures of merit compared with their definitions."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.stats import binomtest, chisquare

from calibrator.drive import Array, Mask
from calibrator.experiments.figures import Values, figure_rows, judge, tenths_of
from calibrator.experiments.trial import Estimate, Trial
from calibrator.faults import Faults
from calibrator.score import UnseenDrive

N = 1000
SWINGING_A = np.array([[11.0, -11.0], [-9.0, 9.0]])
"""Ideal currents with a root mean square of about 10 A. [A]"""


def figures_of(*trials: Values) -> dict[str, Any]:
    figures, _ = figure_rows(trials)
    return {row.figure: row for row in figures.itertuples()}


def confident(confidence: Array, recovered: Array | Mask) -> Values:
    """Values of a method with these confidences, which recovers some vehicles."""
    within = recovered.astype(bool)
    zero = np.zeros((len(within), 2))
    estimate, trial = one_of(drift=np.where(within, 0.0, 1.0)[:, None] + zero, truth=zero)
    return judge(replace(estimate, confidence=confidence), trial)


def one_of(*, drift: Array, truth: Array) -> tuple[Estimate, Trial]:
    """An estimate of drifts alone, shape (N, K), all of which are corrected, and its trial."""
    zero = np.zeros(truth.shape)
    faults = Faults(hardware_drift=zero[:, 0], hardware_offset_a=zero, drift=truth, offset_a=zero)
    trial = Trial(
        smallest_fault=0.05,
        full_scale_a=400.0,
        truth=faults,
        unseen=UnseenDrive.of_linear_sensors(SWINGING_A.mean(axis=0), np.mean(SWINGING_A**2, axis=0), faults),
        record=lambda: pytest.fail("not needed"),
        collect=lambda: pytest.fail("not needed"),
    )
    sound = np.zeros(len(truth), bool)
    found = replace(faults, drift=drift)
    return Estimate(faults=found, hardware=sound, corrected=drift != 0.0, confidence=None, failed=0), trial


def two_vehicles(*, drift: float, harm_second: float) -> tuple[Estimate, Trial]:
    """An estimate of two vehicles whose first branch has a drift of 0.1, and their trial.

    It finds ``drift`` there, and ``harm_second`` in the second branch of the second vehicle, whose sensor is sound.
    """
    found = np.array([[drift, 0.0], [drift, harm_second]])
    return one_of(drift=found, truth=np.array([[0.1, 0.0], [0.1, 0.0]]))


def test_calibration_error_equals_the_excess_of_confidence_over_recovery() -> None:
    rng = np.random.default_rng(0)
    confidence = rng.random(100 * N)
    honest = figures_of(confident(confidence, rng.random(100 * N) < confidence))
    assert honest["ece"].value < 0.01
    assert honest["sure_recovered"].value == pytest.approx(honest["sure_confidence"].value, abs=0.01)
    assert honest["sure"].value == pytest.approx(0.05, abs=0.005)
    boasting = figures_of(confident(np.full(N, 0.9), np.arange(N) < 0.6 * N))
    assert boasting["ece"].value == pytest.approx(0.3)
    assert "sure_recovered" not in boasting


@pytest.mark.parametrize(
    ("drift", "harm_second", "recovery_rate", "harmed"),
    [(0.1, 0.0, 1.0, 0.0), (0.1, 0.2, 0.5, 0.5), (0.1, -1.0, 0.5, 0.5)],
    ids=["true correction", "sound branch is corrected", "gain of zero"],
)
def test_worse_branch_harms_the_vehicle(drift: float, harm_second: float, recovery_rate: float, harmed: float) -> None:
    figures = figures_of(judge(*two_vehicles(drift=drift, harm_second=harm_second)))
    assert (figures["recovery_rate"].value, figures["harmed"].value) == (recovery_rate, harmed)
    assert figures["deployed"].value == 1.0
    if harm_second == 0.2:
        rms_a = np.sqrt(np.mean(SWINGING_A[:, 1] ** 2))  # of the second branch, whose sensor is sound
        assert figures["worst_a"].value == pytest.approx(rms_a * (1.0 - 1.0 / 1.2))


def test_uncorrected_branch_does_not_count_as_harmed() -> None:
    estimate, trial = two_vehicles(drift=0.1, harm_second=0.2)
    only_first = replace(estimate, corrected=estimate.corrected & np.array([True, False]))
    assert figures_of(judge(only_first, trial))["harmed"].value == 0.0
    nothing = figures_of(judge(replace(estimate, corrected=np.zeros((2, 2), bool)), trial))
    assert nothing["deployed"].value == 0.0
    assert "harmed" not in nothing


def test_shares_have_exact_binomial_intervals() -> None:
    for hits, of in ((0, 100), (3, 175), (5, 5)):
        row = figures_of({"harmed": np.arange(of) < hits})["harmed"]
        assert (round(row.value * row.of), row.of) == (hits, of)
        assert (row.low, row.high) == pytest.approx(binomtest(hits, of).proportion_ci(0.95, method="exact"))
    assert np.isnan(figures_of({"confidence": np.array([0.3])})["confidence"].low)


def test_correct_standard_deviations_give_the_coverage_of_a_normal_distribution() -> None:
    rng, true = np.random.default_rng(0), np.full((4000, 2), 0.2)
    sd = rng.uniform(0.01, 0.03, true.shape)
    estimate, trial = one_of(drift=true + sd * rng.standard_normal(sd.shape), truth=true)
    estimate = replace(estimate, drift_sd=sd, offset_sd_a=sd)
    values = judge(estimate, trial)
    figures, counts = figures_of(values), tenths_of(values)["pit"]
    assert figures["gain_within_1"].value == pytest.approx(0.683, abs=0.02)
    assert figures["gain_beyond_3"].of == sum(counts) == true.size
    assert "offset_within_1" not in figures  # no offset was found, so none is deployed
    assert chisquare(counts).pvalue > 0.01
    own = replace(estimate, pit=lambda truth: (np.full(truth.drift.shape, 0.55), np.zeros(truth.drift.shape)))
    assert tenths_of(judge(own, trial))["pit"][5] == true.size


def test_rightly_and_wrongly_named_causes_are_counted_in_attacked_trials() -> None:
    estimate, trial = two_vehicles(drift=0.1, harm_second=0.0)
    attacked = replace(trial, attacked=np.array([True, False]), causes=("inverted",))
    for findings, named, misnamed in (((["inverted"], []), 1, 0), (([], ["step"]), 0, 1), ((), 0, 0)):
        values = judge(replace(estimate, findings=findings), attacked)
        assert (values["named"].sum(), values["misnamed"].sum()) == (named, misnamed)
    assert "named" not in judge(estimate, trial)
