from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from calibrator.artificial.random_fleet import draw_faults
from calibrator.drive import Array
from calibrator.evidence.collect import collect_rows
from calibrator.evidence.fleet_model import FleetModel, fit_fleet_model
from calibrator.evidence.fleet_moments import stack_summaries
from calibrator.evidence.rows import UNKNOWN_VARIANCE, FleetRows, constant_design, relative_design
from calibrator.faults import Faults
from calibrator.summaries.moments import DriveSummary
from tests.calibrator.evidence.simulated_drives import Conditions, no_faults, read_out_of, summaries_of

K, FULL_SCALE_A = 3, 400.0
TOLD = [*range(2 * K - 1), *range(3 * K - 1, 4 * K)]
TRUE_MODEL = FleetModel(read_out=np.vstack([read_out_of(K), np.zeros(K)]))


def random_faults(seed: int, vehicles: int) -> Faults:
    return draw_faults(
        np.random.default_rng(seed),
        vehicles=vehicles,
        branches=K,
        sparsity=70.0,
        magnitude=(0.05, 0.25),
        full_scale_a=FULL_SCALE_A,
        balanced=True,
    )


def rows_of(
    summaries: Sequence[DriveSummary], model: FleetModel = TRUE_MODEL, scale_a: float = FULL_SCALE_A
) -> FleetRows:
    raw = collect_rows(stack_summaries(summaries), model, full_scale_a=scale_a)
    return raw.steadied(raw.usual_correlation())


def expected_rows(faults: Faults) -> Array:
    """Rows without error, as seen in true currents, shape (N, 5K)."""
    relative = np.column_stack([faults.hardware_drift, faults.drift])
    omega = faults.offset_a / (1.0 + faults.drift)
    constant = np.concatenate([faults.hardware_offset_a[:, :-1], omega], axis=1) / FULL_SCALE_A
    return np.concatenate([np.log1p(relative) @ relative_design(K).T, constant @ constant_design(K).T], axis=1)


def errors(rows: FleetRows, faults: Faults) -> Array:
    """Rows less what they are without error, as seen in true currents, shape (N, 5K)."""
    expected = expected_rows(faults)
    relative = rows.relative - expected[:, : 3 * K - 1]
    parameters = np.column_stack([faults.hardware_drift, faults.drift])
    seen = rows.constant_seen(parameters[:, None], relative[:, None])[:, 0]
    return np.concatenate([relative, seen - expected[:, 3 * K - 1 :]], axis=1)


def standardised(rows: FleetRows, faults: Faults) -> Array:
    """Errors of the told rows through the root of their precision: N(0, 1) each, and independent, if all is right."""
    error = errors(rows, faults)[:, TOLD]
    L = np.linalg.cholesky(rows.covariance[:, TOLD][:, :, TOLD])
    return np.linalg.solve(L, error[..., None])[..., 0]


@pytest.mark.parametrize(
    "conditions", [Conditions(), Conditions(noise_a=1.0, memory=0.8), Conditions(model_error_a=1.0)]
)
def test_standardised_residuals_are_standard_normal(conditions: Conditions) -> None:
    faults = random_faults(1, 150)
    rows = rows_of(summaries_of(faults, conditions, seed=1))
    z = standardised(rows, faults)
    rms = np.sqrt(np.mean(z**2, axis=0))
    assert 0.75 < np.sqrt(np.mean(z**2)) < 1.25, rms
    # The last, the junction constant, is the sum of the intercepts but for rounding: told too wide, as others are not.
    assert ((rms[:-1] > 0.35) & (rms[:-1] < 1.45)).all(), rms
    assert 0.15 < rms[-1] < 1.45, rms
    assert (np.abs(z.mean(axis=0)) < 0.45).all(), z.mean(axis=0)


def test_rows_are_as_right_over_the_model_learnt_from_the_fleet() -> None:
    faults = random_faults(2, 100)
    summaries = summaries_of(faults, seed=2)
    rows = rows_of(summaries, fit_fleet_model(stack_summaries(summaries)))
    error = errors(rows, faults)[:, TOLD]
    assert np.abs(np.median(error[:, : 2 * K - 1], axis=0)).max() < 0.003
    assert np.abs(np.median(error[:, 2 * K - 1 :], axis=0)).max() < 0.002
    assert np.abs(error).max() < 0.05


def test_full_scale_is_only_the_unit_of_the_constant_rows() -> None:
    summaries = summaries_of(random_faults(3, 10), seed=3)
    plain, half = (rows_of(summaries, scale_a=scale) for scale in (400.0, 200.0))
    np.testing.assert_allclose(half.relative, plain.relative)
    np.testing.assert_allclose(half.constant, 2.0 * plain.constant)


def test_bench_readings_are_unknown() -> None:
    rows = rows_of(summaries_of(no_faults(3, K)))
    readings = [i for i in range(5 * K) if i not in TOLD]
    assert (np.diagonal(rows.covariance, axis1=1, axis2=2)[:, readings] == UNKNOWN_VARIANCE).all()
    assert not rows.relative[:, 2 * K - 1 :].any()
    assert not rows.constant[:, K + 1 :].any()


def test_a_reversed_branch_is_unknown_not_a_logarithm_of_a_negative_number() -> None:
    faults = no_faults(4, K)
    drift = faults.drift.copy()
    drift[2, 1] = -2.0
    rows = rows_of(summaries_of(replace(faults, drift=drift)))
    assert np.isfinite(rows.relative).all()
    assert rows.covariance[2, 1, 1] == pytest.approx(UNKNOWN_VARIANCE)
    assert rows.relative[2, 1] == 0.0
    assert rows.covariance[0, 1, 1] < 1e-3


def test_covariances_are_positive_definite_with_few_blocks() -> None:
    summaries = summaries_of(random_faults(5, 6), Conditions(samples=90), seed=5)
    rows = rows_of(summaries)
    assert (np.linalg.eigvalsh(rows.covariance) > 0.0).all()


def test_twice_the_driving_halves_the_variance() -> None:
    faults = no_faults(40, K)
    variances = [
        np.median(
            np.diagonal(
                rows_of(summaries_of(faults, Conditions(samples=samples, noise_a=3.0))).covariance,
                axis1=1,
                axis2=2,
            )[:, TOLD],
            axis=0,
        )
        for samples in (1800, 3600)
    ]
    np.testing.assert_allclose(variances[1] / variances[0], 0.5, atol=0.12)
