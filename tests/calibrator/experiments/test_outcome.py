"""Figures of merit against what they are by definition."""

from dataclasses import fields, replace

import numpy as np
import pytest
from scipy.stats import binomtest, chisquare

from calibrator.drive import Array, Mask
from calibrator.experiments.methods import Estimate
from calibrator.experiments.outcome import (
    Outcome,
    calibration_figures,
    confidence_bins,
    figures_of,
    judge,
    pit_counts,
    pooled,
)
from calibrator.experiments.result import Bin, Figure, share
from calibrator.experiments.trial import Trial, UnseenDrive
from calibrator.faults import Faults, corrected_currents, measured_currents, true_currents

N = 1000
SWINGING_A = np.array([[11.0, -11.0], [-9.0, 9.0]])
"""Ideal currents with a root mean square of about 10 A. [A]"""


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
        worsening_a=np.zeros(len(recovered)),
        attacked=np.zeros(0, bool),
        named=np.zeros(0, bool),
        failed=np.zeros(len(recovered)),
        delay_error_s=np.zeros(0),
        gain_z=np.zeros(0),
        offset_z=np.zeros(0),
        pit=np.zeros(0),
    )


def means_of(outcome: Outcome) -> dict[str, float]:
    return {name: figure.mean for name, figure in figures_of(outcome).items()}


def two_vehicles(*, drift: float, harm_second: float) -> tuple[Estimate, Trial]:
    """Two vehicles with a drift of 0.1 in their first branch, and an estimate."""
    zero, real = np.zeros((2, 2)), np.array([[0.1, 0.0], [0.1, 0.0]])
    truth = Faults(hardware_drift=np.zeros(2), hardware_offset_a=zero, drift=real, offset_a=zero)
    found = replace(truth, drift=np.array([[drift, 0.0], [drift, harm_second]]))
    trial = Trial(
        smallest_fault=0.05,
        full_scale_a=400.0,
        truth=truth,
        unseen=UnseenDrive.of_linear_sensors(SWINGING_A, truth),
        record=lambda: pytest.fail("not needed"),
        collect=lambda: pytest.fail("not needed"),
    )
    estimate = Estimate(
        faults=found, hardware=np.zeros(2, bool), corrected=found.drift != 0.0, confidence=np.ones(2), failed=0
    )
    return estimate, trial


def test_honest_confidence_has_a_small_calibration_error() -> None:
    rng = np.random.default_rng(0)
    confidence = rng.random(100 * N)
    figures = means_of(outcome(confidence, rng.random(100 * N) < confidence))
    assert figures["ece"] < 0.01
    assert figures["sure_recovered"] == pytest.approx(figures["sure_confidence"], abs=0.01)
    assert figures["sure"] == pytest.approx(0.05, abs=0.005)


def test_calibration_error_by_chance_is_the_usual_one_of_an_exact_confidence() -> None:
    rng = np.random.default_rng(1)
    confidence = rng.beta(4.0, 1.0, 300)
    drawn = [means_of(outcome(confidence, rng.random(300) < confidence)) for _ in range(400)]
    assert drawn[0]["ece_by_chance"] == pytest.approx(np.mean([figures["ece"] for figures in drawn]), rel=0.1)


def test_calibration_error_of_boasting_is_the_excess() -> None:
    figures = means_of(outcome(np.full(N, 0.9), np.arange(N) < 0.6 * N))
    assert figures["ece"] == pytest.approx(0.3)
    assert "sure_recovered" not in figures


def test_method_without_confidence_has_no_figures_of_it() -> None:
    silent = replace(outcome(np.zeros(N), np.ones(N)), confidence=np.zeros(0))
    assert {"confidence", "ece", "sure", "harmed", "delay_rmse_ms"}.isdisjoint(means_of(silent))
    assert confidence_bins(silent) == ()


def test_bins_hold_every_vehicle_once_and_pooling_adds_them() -> None:
    first, second = outcome(np.linspace(0.0, 1.0, N), np.ones(N)), outcome(np.ones(N), np.zeros(N))
    together = confidence_bins(pooled([first, second]))
    assert sum(b.count for b in together) == 2 * N
    assert together[-1].count == confidence_bins(first)[-1].count + N


def test_calibration_error_of_no_vehicle_is_not_a_number() -> None:
    assert all(np.isnan(figure.mean) for figure in calibration_figures([]).values())
    assert calibration_figures([Bin(low=0.9, count=3, confidence=0.95, recovered=0.95)])["ece"].mean == 0.0


def test_true_faults_are_recovered_deployed_and_harm_nobody() -> None:
    figures = means_of(judge(*two_vehicles(drift=0.1, harm_second=0.0)))
    assert (figures["recovery_rate"], figures["deployed"], figures["harmed"]) == (1.0, 1.0, 0.0)


def test_correction_of_a_sound_branch_counts_as_harm() -> None:
    figures = means_of(judge(*two_vehicles(drift=0.1, harm_second=0.2)))
    assert (figures["recovery_rate"], figures["deployed"], figures["harmed"]) == (0.5, 1.0, 0.5)


def test_drift_that_cannot_be_corrected_counts_as_harm_and_warns_of_nothing() -> None:
    assert means_of(judge(*two_vehicles(drift=0.1, harm_second=-1.0)))["harmed"] == 0.5


def test_branch_that_passes_through_can_do_no_harm() -> None:
    estimate, trial = two_vehicles(drift=0.1, harm_second=0.2)
    only_first = replace(estimate, corrected=estimate.corrected & np.array([True, False]))
    assert means_of(judge(only_first, trial))["harmed"] == 0.0
    nothing = replace(estimate, corrected=np.zeros((2, 2), bool))
    figures = means_of(judge(nothing, trial))
    assert figures["deployed"] == 0.0
    assert "harmed" not in figures


def test_unseen_moments_are_those_of_the_samples() -> None:
    rng = np.random.default_rng(0)
    i_s = rng.normal(size=(N, 2)) * 50.0 + 10.0
    truth = Faults(
        hardware_drift=np.array([0.2]),
        hardware_offset_a=np.array([[10.0, -10.0]]),
        drift=np.array([[0.1, -0.2]]),
        offset_a=np.array([[5.0, -3.0]]),
    )
    i = true_currents(i_s, truth.take(0))
    i_m = measured_currents(i, truth.take(0))
    unseen, sampled = UnseenDrive.of_linear_sensors(i_s, truth), UnseenDrive.of_samples([(i, i_m)])
    for field in fields(UnseenDrive):
        np.testing.assert_allclose(getattr(unseen, field.name), getattr(sampled, field.name))
    drift, offset_a = np.array([[0.15, -0.1]]), np.array([[2.0, 1.0]])
    error_a = corrected_currents(i_m, drift=drift[0], offset_a=offset_a[0]) - i
    np.testing.assert_allclose(unseen.rms_a(drift, offset_a)[0], np.sqrt(np.mean(error_a**2, axis=0)))


def test_worsening_is_that_of_the_worst_branch() -> None:
    figures = figures_of(judge(*two_vehicles(drift=0.1, harm_second=0.2)))
    rms_a = np.sqrt(np.mean(SWINGING_A[:, 1] ** 2))  # of the second branch, whose sensor is sound
    assert figures["worst_a"].mean == pytest.approx(rms_a * (1.0 - 1.0 / 1.2))


def test_inverted_sensor_can_be_corrected() -> None:
    estimate, trial = two_vehicles(drift=0.1, harm_second=0.0)
    truth = replace(trial.truth, drift=np.full((2, 2), -2.0))
    inverted = replace(trial, truth=truth, unseen=UnseenDrive.of_linear_sensors(SWINGING_A, truth))
    whole = replace(estimate, faults=truth, corrected=np.ones((2, 2), bool))
    assert means_of(judge(whole, inverted))["harmed"] == 0.0


def test_shares_have_their_counts_and_an_exact_interval() -> None:
    figures = figures_of(judge(*two_vehicles(drift=0.1, harm_second=0.2)))
    assert (figures["harmed"].hits, figures["harmed"].of) == (1, 2)
    for hits, of in ((0, 100), (3, 175), (5, 5)):
        assert share(hits, of).interval == pytest.approx(binomtest(hits, of).proportion_ci(0.95, method="exact"))
    assert share(0, 0).interval is None
    assert Figure(mean=0.3).interval is None


def test_confident_vehicles_that_are_wrong_are_counted_beside_those_expected() -> None:
    figures = figures_of(outcome(np.full(N, 0.99), np.arange(N) >= 15))
    wrong = figures["sure_wrong"]
    assert (wrong.hits, wrong.of) == (15, N)
    assert wrong.expected == pytest.approx(10.0)


def test_standard_deviations_that_are_right_have_normal_scores() -> None:
    rng, vehicles = np.random.default_rng(0), 4000
    zero, sd = np.zeros((vehicles, 2)), rng.uniform(0.01, 0.03, (vehicles, 2))
    truth = Faults(hardware_drift=zero[:, 0], hardware_offset_a=zero, drift=0.2 + zero, offset_a=zero)
    found = replace(truth, drift=truth.drift + sd * rng.standard_normal(sd.shape))
    estimate = Estimate(
        faults=found,
        hardware=zero[:, 0] > 0.0,
        corrected=np.ones((vehicles, 2), bool),
        confidence=None,
        failed=0,
        drift_sd=sd,
        offset_sd_a=sd,
    )
    unseen = UnseenDrive.of_linear_sensors(SWINGING_A, truth)
    trial = replace(two_vehicles(drift=0.1, harm_second=0.0)[1], truth=truth, unseen=unseen)
    judged = judge(estimate, trial)
    figures = figures_of(judged)
    assert figures["gain_within_1"].mean == pytest.approx(0.683, abs=0.02)
    assert figures["gain_beyond_3"].of == 2 * vehicles
    assert "offset_within_1" not in figures  # no offset was found, so none is deployed
    counts = pit_counts(judged)
    assert sum(counts) == 2 * vehicles
    assert chisquare(counts).pvalue > 0.01
    own = replace(estimate, pit=lambda truth: (np.full(truth.drift.shape, 0.55), np.zeros(truth.drift.shape)))
    assert pit_counts(judge(own, trial))[5] == 2 * vehicles


def test_causes_that_findings_name_are_counted_where_there_is_an_attack() -> None:
    estimate, trial = two_vehicles(drift=0.1, harm_second=0.0)
    attacked = replace(trial, attacked=np.array([True, False]), causes=("inverted",))
    for findings, named, misnamed in (((["inverted"], []), 1, 0), (([], ["step"]), 0, 1), ((), 0, 0)):
        figures = figures_of(judge(replace(estimate, findings=findings), attacked))
        assert (figures["named"].hits, figures["misnamed"].hits) == (named, misnamed)
    assert "named" not in figures_of(judge(estimate, trial))
