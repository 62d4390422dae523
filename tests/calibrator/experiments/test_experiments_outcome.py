"""Figures of merit against what they are by definition."""

from dataclasses import replace

import numpy as np
import pytest

from calibrator.drive import Array, Mask
from calibrator.experiments.methods import Estimate
from calibrator.experiments.outcome import Outcome, calibration_figures, confidence_bins, figures_of, judge, pooled
from calibrator.experiments.result import Bin
from calibrator.experiments.trial import Trial, unseen_drive
from calibrator.faults import Faults, true_currents

N = 1000


def outcome(confidence: Array, recovered: Array | Mask) -> Outcome:
    never = np.zeros(len(recovered), bool)
    return Outcome(
        recovered=recovered.astype(bool),
        recovered_25=recovered.astype(bool),
        confidence=confidence,
        hardware_found=never,
        hardware=never,
        faulty=~never,
        corrected=never,
        harmed=never,
        failed=np.zeros(len(recovered)),
        delay_error_s=np.zeros(0),
    )


def two_vehicles(*, drift: float, harm_second: float) -> tuple[Estimate, Trial]:
    """Two vehicles with a drift of 0.1 in their first branch, and an estimate."""
    zero, real = np.zeros((2, 2)), np.array([[0.1, 0.0], [0.1, 0.0]])
    truth = Faults(hardware_drift=np.zeros(2), hardware_offset_a=zero, drift=real, offset_a=zero)
    found = replace(truth, drift=np.array([[drift, 0.0], [drift, harm_second]]))
    trial = Trial(
        smallest_fault=0.05,
        full_scale_a=400.0,
        truth=truth,
        unseen=unseen_drive(np.array([1.0, -1.0]), np.array([100.0, 100.0]), truth),
        posterior=lambda _: pytest.fail("not needed"),
        collect=lambda: pytest.fail("not needed"),
    )
    estimate = Estimate(
        faults=found, hardware=np.zeros(2, bool), corrected=found.drift != 0.0, confidence=np.ones(2), failed=0
    )
    return estimate, trial


def test_honest_confidence_has_a_small_calibration_error() -> None:
    rng = np.random.default_rng(0)
    confidence = rng.random(100 * N)
    figures = figures_of(outcome(confidence, rng.random(100 * N) < confidence))
    assert figures["ece"] < 0.01
    assert figures["sure_recovered"] == pytest.approx(figures["sure_confidence"], abs=0.01)
    assert figures["sure"] == pytest.approx(0.05, abs=0.005)


def test_calibration_error_by_chance_is_the_usual_one_of_an_exact_confidence() -> None:
    rng = np.random.default_rng(1)
    confidence = rng.beta(4.0, 1.0, 300)
    drawn = [figures_of(outcome(confidence, rng.random(300) < confidence)) for _ in range(400)]
    assert drawn[0]["ece_by_chance"] == pytest.approx(np.mean([figures["ece"] for figures in drawn]), rel=0.1)


def test_calibration_error_of_boasting_is_the_excess() -> None:
    figures = figures_of(outcome(np.full(N, 0.9), np.arange(N) < 0.6 * N))
    assert figures["ece"] == pytest.approx(0.3)
    assert "sure_recovered" not in figures


def test_method_without_confidence_has_no_figures_of_it() -> None:
    silent = replace(outcome(np.zeros(N), np.ones(N)), confidence=np.zeros(0))
    assert {"confidence", "ece", "sure", "harmed", "delay_rmse_ms"}.isdisjoint(figures_of(silent))
    assert confidence_bins(silent) == ()


def test_bins_hold_every_vehicle_once_and_pooling_adds_them() -> None:
    first, second = outcome(np.linspace(0.0, 1.0, N), np.ones(N)), outcome(np.ones(N), np.zeros(N))
    together = confidence_bins(pooled([first, second]))
    assert sum(b.count for b in together) == 2 * N
    assert together[-1].count == confidence_bins(first)[-1].count + N


def test_calibration_error_of_no_vehicle_is_not_a_number() -> None:
    assert all(np.isnan(value) for value in calibration_figures([]).values())
    assert calibration_figures([Bin(low=0.9, count=3, confidence=0.95, recovered=0.95)])["ece"] == 0.0


def test_true_faults_are_recovered_deployed_and_harm_nobody() -> None:
    figures = figures_of(judge(*two_vehicles(drift=0.1, harm_second=0.0)))
    assert (figures["recovery_rate"], figures["deployed"], figures["harmed"]) == (1.0, 1.0, 0.0)


def test_correction_of_a_sound_branch_counts_as_harm() -> None:
    figures = figures_of(judge(*two_vehicles(drift=0.1, harm_second=0.2)))
    assert (figures["recovery_rate"], figures["deployed"], figures["harmed"]) == (0.5, 1.0, 0.5)


def test_drift_that_cannot_be_corrected_counts_as_harm_and_warns_of_nothing() -> None:
    assert figures_of(judge(*two_vehicles(drift=0.1, harm_second=-1.0)))["harmed"] == 0.5


def test_branch_that_passes_through_can_do_no_harm() -> None:
    estimate, trial = two_vehicles(drift=0.1, harm_second=0.2)
    only_first = replace(estimate, corrected=estimate.corrected & np.array([True, False]))
    assert figures_of(judge(only_first, trial))["harmed"] == 0.0
    nothing = replace(estimate, corrected=np.zeros((2, 2), bool))
    figures = figures_of(judge(nothing, trial))
    assert figures["deployed"] == 0.0
    assert "harmed" not in figures


def test_unseen_moments_are_those_of_the_true_currents() -> None:
    rng = np.random.default_rng(0)
    i_s = rng.normal(size=(N, 2)) * 50.0
    truth = Faults(
        hardware_drift=np.array([0.2]),
        hardware_offset_a=np.array([[10.0, -10.0]]),
        drift=np.zeros((1, 2)),
        offset_a=np.zeros((1, 2)),
    )
    i = true_currents(i_s, truth.take(0))
    i[:, 0] += 3.0
    load_a = np.array([3.0])
    unseen = unseen_drive(i_s.mean(axis=0), np.mean(i_s**2, axis=0), truth, unmeasured_a=load_a)
    np.testing.assert_allclose(unseen.mean_a[0], i.mean(axis=0))
    np.testing.assert_allclose(unseen.mean_square_a2[0], np.mean(i**2, axis=0))
