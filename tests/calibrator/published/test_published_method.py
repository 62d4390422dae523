"""The published method: evidence, classifiers, recovery, and the notice on a small fleet."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calibrator.artificial.random_fleet import FaultSettings
from calibrator.drive import Array
from calibrator.faults import Faults, slopes_and_intercepts
from calibrator.published import classify
from calibrator.published.evidence import FleetEvidence, collect_evidence, fleet_mean
from calibrator.published.recovery import recover_fleet
from calibrator.published.state_space import StateSpaceModel, VehicleModel, evidence_of_models
from calibrator.score import f2_score, recovered
from tests.calibrator.command_here import calibrator
from tests.calibrator.conftest import LAYOUT
from tests.calibrator.estimator.simulated_rows import random_faults

FULL_SCALE_A = 400.0


def ideal_currents(samples: int = 400) -> Array:
    rng = np.random.default_rng(1)
    battery = 60.0 + np.cumsum(rng.normal(0.0, 8.0, size=samples)) % 120.0
    auxiliary = -10.0 - 5.0 * (np.arange(samples) % 100 > 50)
    return np.column_stack([battery, -battery - auxiliary, auxiliary])


def fleet(vehicles: int) -> Faults:
    return random_faults(2, vehicles=vehicles, branches=3, full_scale_a=FULL_SCALE_A, symmetric=True)


def simulated(faults: Faults, noise_a: float) -> Array:
    a, b = slopes_and_intercepts(faults)
    clean = a[:, None, :] * ideal_currents() + b[:, None, :]
    return np.asarray(clean + noise_a * np.random.default_rng(3).normal(size=clean.shape))


def exact_model(name: str, samples: int, slope: Array, intercept_a: Array) -> VehicleModel:
    """A model that gives the measured currents if its inputs are the ideal currents."""
    i_s, zero = ideal_currents(samples), np.zeros(3)
    n: dict[str, Any] = {"A": np.zeros((0, 0)), "B": np.zeros((0, 3)), "C": np.zeros((3, 0)), "x0": np.zeros(0)}
    return VehicleModel(
        vehicle=name,
        drives=(),
        duration_s=0.0,
        model=StateSpaceModel(**n, D=np.diag(slope), offset_a=intercept_a, snr_db=zero),
        snr_db=zero,
        simulation_error_a=zero,
        mean_a=zero,
        moment_a2=np.cov(slope * i_s, rowvar=False),
        held_out_inputs=i_s,
        lead_in=10,
    )


def evidence_of(x: Array) -> tuple[FleetEvidence, Faults]:
    """Evidence without noise of vehicles with parameters (d_h, o_h,1 .. o_h,K-1, D_m, o_m)."""
    truth = Faults.of_parameters(x, FULL_SCALE_A)
    a, b = slopes_and_intercepts(truth)
    zero = np.zeros(a.shape)
    evidence = FleetEvidence(
        slopes=a,
        intercepts_a=b,
        slope_variances=zero,
        intercept_variances_a2=zero,
        deviation_a2=zero,
        junction_a2=zero[:, 0],
    )
    return evidence, truth


def test_variances_of_slopes_and_intercepts_match_white_noise() -> None:
    faults = fleet(400)
    evidence = collect_evidence(simulated(faults, 5.0), ideal_currents(), np.zeros(len(faults)))
    a, b = slopes_and_intercepts(faults)
    assert ((evidence.slopes - a) / np.sqrt(evidence.slope_variances)).std() == pytest.approx(1.0, abs=0.06)
    intercept_score = (evidence.intercepts_a - b) / np.sqrt(evidence.intercept_variances_a2)
    assert intercept_score.std() == pytest.approx(1.0, abs=0.06)


def test_threshold_of_hardware_faults_is_a_third_of_the_sd_of_the_criterion_over_the_fleet() -> None:
    eta = np.array([0.0, 1.0, 2.0, 9.0])
    found = classify.classify_by_threshold(np.column_stack([eta, np.zeros(4), np.zeros(4)]))
    np.testing.assert_array_equal(found.hardware, eta > eta.std(ddof=1) / 3.0)
    assert found.sensor.all()


@pytest.mark.parametrize("branches", [2, 4])
def test_single_faults_are_recovered_exactly_without_noise(branches: int) -> None:
    x = 0.15 * np.eye(3 * branches)
    evidence, truth = evidence_of(x)
    both = classify.Classification(hardware=np.ones(len(x), bool), sensor=np.ones(len(x), bool))
    found = recover_fleet(evidence, both, full_scale_a=FULL_SCALE_A)
    assert not found.failed
    np.testing.assert_allclose(found.faults.drift, truth.drift, atol=1e-6)
    np.testing.assert_allclose(found.faults.offset_a, truth.offset_a, atol=1e-4)
    np.testing.assert_allclose(found.faults.hardware_drift, truth.hardware_drift, atol=1e-6)


def test_failed_optimisation_of_a_vehicle_does_not_stop_the_fleet() -> None:
    evidence, truth = evidence_of(np.tile([0.1, 0.0, 0.0, 0.0, 0.1, 0.0], (2, 1)))
    evidence.slopes[0, 0] = np.nan
    found = recover_fleet(evidence, classify.classify_by_truth(truth), full_scale_a=FULL_SCALE_A)
    assert list(found.failed) == [0]
    assert "basis pursuit" in found.failed[0]
    assert not found.faults.offset_a[0].any()
    np.testing.assert_allclose(found.faults.offset_a[1], truth.offset_a[1], atol=1e-4)


def test_decision_trees_recover_most_vehicles_of_a_symmetric_fleet_through_noise() -> None:
    faults = fleet(120)
    currents = simulated(faults, 0.05)
    reference = fleet_mean(currents)
    evidence = collect_evidence(currents, reference, np.mean(currents.sum(axis=2) ** 2, axis=1))
    classes = classify.classify_by_expected_trees(
        evidence.features,
        reference,
        np.full(3, 0.05),
        full_scale_a=FULL_SCALE_A,
        expected=FaultSettings(sparsity=80.0, balanced=True),
        reference_vehicles=len(faults),
    )
    found = recover_fleet(evidence, classes, full_scale_a=FULL_SCALE_A)
    assert recovered(found.faults, faults, full_scale_a=FULL_SCALE_A, smallest_fault=0.05).mean() >= 0.8
    assert f2_score(classes.hardware, faults.has_hardware_fault) >= 0.8


def test_held_out_vehicle_affects_neither_reference_nor_unity_drive() -> None:
    a, b = slopes_and_intercepts(fleet(4))
    vehicles = [exact_model(f"{j}", 400 + j, a[j], b[j]) for j in range(4)]
    evidence, reference, unity = evidence_of_models(vehicles, [True, True, True, False])
    assert unity.vehicle == "2"
    assert len(reference) == 392, "without the lead-in"
    i_s = ideal_currents(402)[10:]
    np.testing.assert_allclose(reference, a[:3].mean(axis=0) * i_s + b[:3].mean(axis=0))
    np.testing.assert_allclose(evidence.slopes, a / a[:3].mean(axis=0))


def test_notice_on_a_small_fleet_is_printed_and_recorded(two_vehicles: Path, tmp_path: Path) -> None:
    options = ("--method", "published", "--layout", LAYOUT, "--workers", 1)
    run = calibrator("calibrate", two_vehicles, *options, "--out", tmp_path / "result")
    record = json.loads((tmp_path / "result" / "run.json").read_text())
    (notice,) = (each for each in record["notices"] if each.startswith("2 vehicles are few"))
    assert f"notice: {notice}" in run.stdout
