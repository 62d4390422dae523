import numpy as np
import pytest

from calibrator.drive import Array
from calibrator.faults import Faults, slopes_and_intercepts
from calibrator.published.classify import Classification, classify_by_truth
from calibrator.published.evidence import FleetEvidence
from calibrator.published.recovery import (
    recover_fleet,
)
from calibrator.score import recovered
from tests.calibrator.estimator.simulated_rows import random_faults

FULL_SCALE_A = 400.0


def faults_from(x: Array) -> Faults:
    """Fault parameters of rows (d_h, o_h,1 .. o_h,K-1, D_m, o_m), offsets in fractions of full scale."""
    K = x.shape[1] // 3
    free = FULL_SCALE_A * x[:, 1:K]
    return Faults(
        hardware_drift=x[:, 0],
        hardware_offset_a=np.column_stack([free, -free.sum(axis=1)]),
        drift=x[:, K : 2 * K],
        offset_a=FULL_SCALE_A * x[:, 2 * K :],
    )


def evidence_of(faults: Faults, *, slope_sd: float = 0.0, offset_sd: float = 0.0, seed: int = 0) -> FleetEvidence:
    a, b = slopes_and_intercepts(faults)
    rng = np.random.default_rng(seed)
    return FleetEvidence(
        slopes=a + slope_sd * rng.normal(size=a.shape),
        intercepts_a=b + offset_sd * FULL_SCALE_A * rng.normal(size=b.shape),
        slope_variances=np.full(a.shape, slope_sd**2),
        intercept_variances_a2=np.full(b.shape, (offset_sd * FULL_SCALE_A) ** 2),
        deviation_a2=np.zeros(a.shape),
        junction_a2=np.zeros(len(a)),
    )


@pytest.mark.parametrize("branches", [2, 3, 4])
def test_single_faults_are_recovered_exactly_without_noise(branches: int) -> None:
    x = 0.15 * np.eye(3 * branches)
    truth = faults_from(x)
    both = Classification(hardware=np.ones(len(x), bool), sensor=np.ones(len(x), bool))
    found = recover_fleet(evidence_of(truth), both, full_scale_a=FULL_SCALE_A)
    assert not found.failed
    np.testing.assert_allclose(found.faults.drift, truth.drift, atol=1e-6)
    np.testing.assert_allclose(found.faults.offset_a, truth.offset_a, atol=1e-4)
    np.testing.assert_allclose(found.faults.hardware_drift, truth.hardware_drift, atol=1e-6)


def test_fleet_of_sparse_faults_is_recovered_through_noise() -> None:
    truth = random_faults(1, vehicles=120, branches=2, full_scale_a=FULL_SCALE_A)
    evidence = evidence_of(truth, slope_sd=0.001, offset_sd=0.0002)
    found = recover_fleet(evidence, classify_by_truth(truth), full_scale_a=FULL_SCALE_A)
    assert recovered(found.faults, truth, full_scale_a=FULL_SCALE_A, smallest_fault=0.05).mean() > 0.99


def test_result_does_not_depend_on_the_unit_of_current() -> None:
    truth = faults_from(np.array([[0.1, 0.0, 0.2, 0.0, 0.1, 0.0], [0.0, 0.2, 0.0, -0.1, 0.0, 0.0]]))
    plain = evidence_of(truth, slope_sd=0.001, offset_sd=0.001)
    milli = FleetEvidence(
        slopes=plain.slopes,
        intercepts_a=1e3 * plain.intercepts_a,
        slope_variances=plain.slope_variances,
        intercept_variances_a2=1e6 * plain.intercept_variances_a2,
        deviation_a2=1e6 * plain.deviation_a2,
        junction_a2=1e6 * plain.junction_a2,
    )
    in_a = recover_fleet(plain, classify_by_truth(truth), full_scale_a=FULL_SCALE_A)
    in_ma = recover_fleet(milli, classify_by_truth(truth), full_scale_a=1e3 * FULL_SCALE_A)
    np.testing.assert_allclose(in_ma.faults.offset_a, 1e3 * in_a.faults.offset_a, atol=1e-3)
    np.testing.assert_allclose(in_ma.faults.drift, in_a.faults.drift, atol=1e-9)


def test_a_failed_optimisation_is_named_and_the_fleet_goes_on() -> None:
    truth = faults_from(np.array([[0.1, 0.0, 0.0, 0.0, 0.1, 0.0], [0.1, 0.0, 0.0, 0.0, 0.1, 0.0]]))
    evidence = evidence_of(truth)
    evidence.slopes[0, 0] = np.nan
    found = recover_fleet(evidence, classify_by_truth(truth), full_scale_a=FULL_SCALE_A)
    assert list(found.failed) == [0]
    assert "basis pursuit" in found.failed[0]
    assert not found.faults.offset_a[0].any()
    np.testing.assert_allclose(found.faults.offset_a[1], truth.offset_a[1], atol=1e-4)
