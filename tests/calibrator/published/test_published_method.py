"""The published method: evidence, classifiers, recovery, and what it says of a small fleet."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calibrator.drive import Array
from calibrator.faults import Faults, slopes_and_intercepts
from calibrator.options import Classifier
from calibrator.published.classify import (
    Classification,
    ExpectedFaults,
    FaultTrees,
    classify_by_threshold,
    classify_by_truth,
    decision_criterion,
    expected_features,
)
from calibrator.published.evidence import FleetEvidence, collect_evidence
from calibrator.published.recovery import Recovery, calibrate_published, recover_fleet
from calibrator.score import f2_score, recovered
from tests.calibrator.command_here import calibrator
from tests.calibrator.estimator.simulated_rows import random_faults

FULL_SCALE_A = 400.0
EXPECTED = ExpectedFaults(sparsity=80.0, magnitude=(0.05, 0.25), symmetric=True, seed=0)


def ideal_currents(samples: int = 400) -> Array:
    rng = np.random.default_rng(1)
    battery = 60.0 + np.cumsum(rng.normal(0.0, 8.0, size=samples)) % 120.0
    auxiliary = -10.0 - 5.0 * (np.arange(samples) % 100 > 50)
    return np.column_stack([battery, -battery - auxiliary, auxiliary])


def fleet(vehicles: int, *, symmetric: bool = True) -> Faults:
    return random_faults(2, vehicles=vehicles, branches=3, full_scale_a=FULL_SCALE_A, symmetric=symmetric)


def simulated(faults: Faults, noise_a: float = 0.0) -> Array:
    a, b = slopes_and_intercepts(faults)
    clean = a[:, None, :] * ideal_currents() + b[:, None, :]
    return np.asarray(clean + noise_a * np.random.default_rng(3).normal(size=clean.shape))


def calibrated(currents: Array, faults: Faults, **settings: Any) -> Recovery:
    usual: dict[str, Any] = {"in_reference": np.ones(len(currents), bool), "classifier": Classifier.PERFECT}
    usual["truth"] = faults
    return calibrate_published(
        list(currents),
        junction_a2=np.mean(currents.sum(axis=2) ** 2, axis=1),
        full_scale_a=FULL_SCALE_A,
        expected=EXPECTED,
        simulation_error_a=np.full(3, 0.05),
        **usual | settings,
    )


def evidence_of(x: Array, *, noise: float = 0.0, unit: float = 1.0) -> tuple[FleetEvidence, Faults]:
    """Evidence of vehicles with parameters (d_h, o_h,1 .. o_h,K-1, D_m, o_m), currents in a unit of so many ampere."""
    truth = Faults.of_parameters(x, FULL_SCALE_A)
    a, b = slopes_and_intercepts(truth)
    rng, noise_a = np.random.default_rng(0), noise * FULL_SCALE_A
    evidence = FleetEvidence(
        slopes=a + noise * rng.normal(size=a.shape),
        intercepts_a=(b + noise_a * rng.normal(size=b.shape)) / unit,
        slope_variances=np.full(a.shape, noise**2),
        intercept_variances_a2=np.full(b.shape, (noise_a / unit) ** 2),
        deviation_a2=np.zeros(a.shape),
        junction_a2=np.zeros(len(a)),
    )
    return evidence, truth


def test_variances_of_the_evidence_are_those_of_white_noise() -> None:
    faults = fleet(400)
    evidence = collect_evidence(simulated(faults, 5.0), ideal_currents(), np.zeros(len(faults)))
    a, b = slopes_and_intercepts(faults)
    assert ((evidence.slopes - a) / np.sqrt(evidence.slope_variances)).std() == pytest.approx(1.0, abs=0.06)
    intercept_score = (evidence.intercepts_a - b) / np.sqrt(evidence.intercept_variances_a2)
    assert intercept_score.std() == pytest.approx(1.0, abs=0.06)


def test_criterion_is_the_squared_distance_of_the_projections() -> None:
    """(7) equals (8) and (9): project the measured current on the plane of zero sum."""
    i_s, rng = ideal_currents(), np.random.default_rng(0)
    i_m = 1.1 * i_s + rng.normal(size=i_s.shape) + 0.5
    features = np.append(np.mean((i_m - i_s) ** 2, axis=0), np.mean(i_m.sum(axis=1) ** 2))
    projected = i_m - i_m.mean(axis=1, keepdims=True)
    expected = np.mean(np.sum((projected - i_s) ** 2, axis=1))
    assert decision_criterion(features[None])[0] == pytest.approx(expected)


def test_threshold_is_a_third_of_the_fleets_spread() -> None:
    eta = np.array([0.0, 1.0, 2.0, 9.0])
    found = classify_by_threshold(np.column_stack([eta, np.zeros(4), np.zeros(4)]))
    np.testing.assert_array_equal(found.hardware, eta > eta.std(ddof=1) / 3.0)
    assert found.sensor.all()


def test_trees_learn_what_separates_the_classes() -> None:
    rng = np.random.default_rng(2)
    hardware, sensor = rng.random(2000) < 0.5, rng.random(2000) < 0.5
    zero = np.zeros((2000, 2))
    truth = Faults(hardware_drift=0.1 * hardware, hardware_offset_a=zero, drift=0.2 * sensor[:, None], offset_a=zero)
    features = np.column_stack([10.0 * hardware, 10.0 * hardware + 5.0 * sensor, 5.0 * sensor]) + rng.random((2000, 3))
    found = FaultTrees(features[:1000], truth.take(slice(0, 1000))).classify(features[1000:])
    np.testing.assert_array_equal(found.hardware, hardware[1000:])
    np.testing.assert_array_equal(found.sensor, sensor[1000:])


def test_expected_features_follow_the_mean_of_a_fleet_that_is_not_symmetric() -> None:
    faults = fleet(40, symmetric=False)
    currents = simulated(faults)
    evidence = collect_evidence(currents, currents.mean(axis=0), np.mean(currents.sum(axis=2) ** 2, axis=1))
    expected = expected_features(faults, ideal_currents(), np.zeros(3), reference_vehicles=40)
    np.testing.assert_allclose(evidence.features, expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("branches", [2, 3, 4])
def test_single_faults_are_recovered_exactly_without_noise(branches: int) -> None:
    x = 0.15 * np.eye(3 * branches)
    evidence, truth = evidence_of(x)
    both = Classification(hardware=np.ones(len(x), bool), sensor=np.ones(len(x), bool))
    found = recover_fleet(evidence, both, full_scale_a=FULL_SCALE_A)
    assert not found.failed
    np.testing.assert_allclose(found.faults.drift, truth.drift, atol=1e-6)
    np.testing.assert_allclose(found.faults.offset_a, truth.offset_a, atol=1e-4)
    np.testing.assert_allclose(found.faults.hardware_drift, truth.hardware_drift, atol=1e-6)


def test_result_does_not_depend_on_the_unit_of_current() -> None:
    x = np.array([[0.1, 0.0, 0.2, 0.0, 0.1, 0.0], [0.0, 0.2, 0.0, -0.1, 0.0, 0.0]])
    found = []
    for unit in (1.0, 1e-3):
        evidence, truth = evidence_of(x, noise=0.001, unit=unit)
        found.append(recover_fleet(evidence, classify_by_truth(truth), full_scale_a=FULL_SCALE_A / unit).faults)
    np.testing.assert_allclose(found[1].offset_a, 1e3 * found[0].offset_a, atol=1e-3)
    np.testing.assert_allclose(found[1].drift, found[0].drift, atol=1e-9)


def test_a_failed_optimisation_is_named_and_the_fleet_goes_on() -> None:
    evidence, truth = evidence_of(np.tile([0.1, 0.0, 0.0, 0.0, 0.1, 0.0], (2, 1)))
    evidence.slopes[0, 0] = np.nan
    found = recover_fleet(evidence, classify_by_truth(truth), full_scale_a=FULL_SCALE_A)
    assert list(found.failed) == [0]
    assert "basis pursuit" in found.failed[0]
    assert not found.faults.offset_a[0].any()
    np.testing.assert_allclose(found.faults.offset_a[1], truth.offset_a[1], atol=1e-4)


@pytest.mark.parametrize(("classifier", "least"), [(Classifier.PERFECT, 0.9), (Classifier.TREE, 0.8)])
def test_symmetric_fleet_is_recovered_through_noise(classifier: Classifier, least: float) -> None:
    faults = fleet(120)
    truth = faults if classifier is Classifier.PERFECT else None
    found = calibrated(simulated(faults, 0.05), faults, classifier=classifier, truth=truth)
    assert recovered(found.faults, faults, full_scale_a=FULL_SCALE_A, smallest_fault=0.05).mean() >= least
    assert f2_score(found.classification.hardware, faults.has_hardware_fault) >= least


def test_vehicle_held_out_of_the_reference_does_not_move_the_others() -> None:
    faults, others = fleet(40), np.arange(40) != 7
    currents = simulated(faults)
    wild = np.where(others[:, None, None], currents, 3.0 * currents)
    plain, moved = (calibrated(some, faults, in_reference=others).faults.drift for some in (currents, wild))
    np.testing.assert_array_equal(plain[others], moved[others])


def test_small_fleet_is_noticed_on_the_screen_and_in_the_record(tmp_path: Path) -> None:
    files = ("--layout", Path(__file__).parents[3] / "dbc" / "hv_powertrain.toml", "--workers", 1)
    drawn = ("--vehicles", 3, "--minutes", 2.2, "--unseen-minutes", 0.1, "--common-drive")
    calibrator("simulate", *drawn, *files, "--out", tmp_path / "fleet")
    method = ("--method", "published", "--classifier", "threshold")
    run = calibrator("calibrate", tmp_path / "fleet", *method, "--out", tmp_path / "result", *files)
    record = json.loads((tmp_path / "result" / "run.json").read_text())
    (notice,) = (each for each in record["notices"] if each.startswith("3 vehicles are few"))
    assert f"notice: {notice}" in run.stdout
