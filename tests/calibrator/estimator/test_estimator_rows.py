"""Evidence rows: the faults that they state are those that the vehicles have, within their covariance."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from calibrator.artificial.random_fleet import draw_faults
from calibrator.drive import Array
from calibrator.estimator.evidence import (
    UNKNOWN_VARIANCE,
    EvidenceRows,
    RowPlaces,
    collect_rows,
    evidence_names,
    row_design,
    stack_summaries,
)
from calibrator.estimator.posterior import row_residuals
from calibrator.faults import Faults
from calibrator.summaries.moments import DriveSummary
from tests.calibrator.estimator.simulated_drives import Conditions, no_faults, read_out_of, summaries_of
from tests.calibrator.estimator.simulated_rows import parameters_of, plain_evidence, plain_residual

K, FULL_SCALE_A = 3, 400.0
AT = RowPlaces(K)
MEASURED = AT.measured
TRUE_MODEL = np.vstack([read_out_of(K), np.zeros(K)])
BRANCHES = pytest.mark.parametrize("branches", [2, 3, 5])


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
    summaries: Sequence[DriveSummary], read_out: Array = TRUE_MODEL, scale_a: float = FULL_SCALE_A
) -> EvidenceRows:
    return collect_rows(stack_summaries(summaries), read_out, full_scale_a=scale_a)[0]


def errors(rows: EvidenceRows, faults: Faults) -> Array:
    """Rows less what they are without error, as seen in true currents, shape (N, 5K)."""
    hardware_offset, offset = faults.hardware_offset_a / FULL_SCALE_A, faults.offset_a / FULL_SCALE_A
    theta = parameters_of(replace(faults, hardware_offset_a=hardware_offset, offset_a=offset))
    vehicles = [slice(j, j + 1) for j in range(len(rows))]
    return np.concatenate([plain_residual(rows.take(one), theta[one]) for one in vehicles])


@pytest.mark.parametrize(
    "conditions",
    [
        pytest.param(Conditions(), marks=pytest.mark.long),
        Conditions(noise_a=1.0, memory=0.8),
        pytest.param(Conditions(model_error_a=1.0), marks=pytest.mark.long),
    ],
)
def test_standardised_errors_are_standard_normal(conditions: Conditions) -> None:
    faults = random_faults(1, 150)
    rows = rows_of(summaries_of(faults, conditions, seed=1))
    L = np.linalg.cholesky(rows.covariance[:, MEASURED][:, :, MEASURED])
    z = np.linalg.solve(L, errors(rows, faults)[:, MEASURED, None])[..., 0]
    rms = np.sqrt(np.mean(z**2, axis=0))
    assert 0.75 < np.sqrt(np.mean(z**2)) < 1.25, rms
    # The last, the junction constant, is the sum of the intercepts but for rounding: stated too wide, others are not.
    assert ((rms[:-1] > 0.35) & (rms[:-1] < 1.45)).all(), rms
    assert 0.15 < rms[-1] < 1.45, rms
    assert (np.abs(z.mean(axis=0)) < 0.45).all(), z.mean(axis=0)


def test_readings_and_reversed_branches_are_unknown() -> None:
    faults = no_faults(4, K)
    faults.drift[2, 1] = -2.0
    rows = rows_of(summaries_of(faults))
    assert rows.known[0].tolist() == [row in MEASURED for row in range(5 * K)]
    assert np.flatnonzero(rows.known[0] != rows.known[2]).tolist() == [AT.slope(1), AT.ratio(1)]
    assert rows.covariance[2, 1, 1] == pytest.approx(UNKNOWN_VARIANCE)
    assert (rows.values[~rows.known] == 0.0).all()


@BRANCHES
def test_every_row_stands_where_its_name_says(branches: int) -> None:
    at, names = RowPlaces(branches), evidence_names([f"{k}" for k in range(branches)])
    assert names[at.slopes] == [f"slope {k}" for k in range(branches)]
    assert names[at.ratios] == [f"gain ratio 0 / {k}" for k in range(1, branches)]
    assert names[at.gain_reads] == [f"gain read {k}" for k in range(branches)]
    assert names[at.intercepts] == [f"intercept {k}" for k in range(branches)]
    assert names[at.junction] == "junction constant"
    assert names[at.offset_reads] == [f"offset read {k}" for k in range(branches)]
    assert [names[row] for row in at.measured] == [name for name in names if "read" not in name]
    assert names[at.relative] + names[at.constant] == names
    assert names[at.constant][0] == "intercept 0"
    for k in range(1, branches):
        assert names[at.slope(k)] == f"slope {k}"
        assert names[at.ratio(k)] == f"gain ratio 0 / {k}"
        assert names[at.intercept(k)] == f"intercept {k}"


@pytest.mark.parametrize("feed", [0, 1])
@BRANCHES
def test_design_is_logarithms_and_true_currents_of_what_is_measured(branches: int, feed: int) -> None:
    rng = np.random.default_rng(branches)
    d, o, o_h = rng.uniform(-0.2, 0.2, (3, branches))
    d_h, o_h, load = 0.1, o_h - o_h.mean(), 0.03
    carried = load * (np.arange(branches) == feed)
    slopes, ratios = (1.0 + d) * (1.0 + d_h), (1.0 + d[0]) / (1.0 + d[1:])
    b, c = (1.0 + d) * (o_h + carried) + o, (1.0 + d[0]) * (np.sum(o / (1.0 + d)) + load)
    relative = np.log(np.concatenate([slopes, ratios, 1.0 + d]))
    constant = np.concatenate([b / (1.0 + d), [c / (1.0 + d[0])], o / (1.0 + d)])
    theta = np.concatenate([np.log1p([d_h, *d]), o_h[:-1], o / (1.0 + d), [load]])
    made = row_design(branches, feed) @ theta
    np.testing.assert_allclose(made, np.append(relative, constant), atol=1e-12)


@BRANCHES
def test_constants_pivot_with_their_ratios_about_the_means(branches: int) -> None:
    """Given the truth the constants are exact but for what is linear in the errors of slopes and gain ratios."""
    n, rng = branches, np.random.default_rng(branches)
    d_h, d, o, o_h, true = 0.1, *rng.uniform(-0.2, 0.2, (4, n))
    o_h, true = o_h - o_h.mean(), true - true.mean()
    measured = (1.0 + d) * ((1.0 + d_h) * true + o_h) + o
    exact = np.log(np.concatenate([(1.0 + d) * (1.0 + d_h), (1.0 + d[0]) / (1.0 + d[1:]), 1.0 + d]))
    theta = np.concatenate([np.log1p([d_h, *d]), o_h[:-1], o / (1.0 + d), [0.0]])

    def off(error: Array) -> Array:
        """Constants as seen less what they are, for errors of the ratios."""
        relative = exact + np.append(error, np.zeros(n))
        b = measured - np.exp(relative[:n]) * true
        c = measured[0] + np.exp(relative[n : 2 * n - 1]) @ measured[1:]
        rows = EvidenceRows(
            relative=relative[None],
            constant=np.concatenate([b, [c], o])[None],
            covariance=np.eye(5 * n)[None],
            means=np.stack([true, measured])[None],
        )
        left = row_residuals(plain_evidence(rows), theta[None, None])[0, 0]
        np.testing.assert_allclose(left[: 3 * n - 1], relative - exact, atol=1e-12)
        np.testing.assert_allclose(left[4 * n :], 0.0, atol=1e-12)
        return np.asarray(left[3 * n - 1 : 4 * n])

    np.testing.assert_allclose(off(np.zeros(2 * n - 1)), 0.0, atol=1e-12)
    slope_error, ratio_error = rng.normal(0.0, 0.3, (2, 2 * n - 1))
    slope_error[n:], ratio_error[:n] = 0.0, 0.0
    # What is linear turns the intercepts by -f, and the constant by the measured currents over 1 + d, about 1 / a.
    np.testing.assert_allclose(off(slope_error), np.append(-true * slope_error[:n], 0.0), atol=1e-12)
    turned = np.sum(measured[1:] * np.exp(-exact[1:n]) * ratio_error[n:])
    np.testing.assert_allclose(off(ratio_error), np.append(np.zeros(n), turned), atol=1e-12)


def test_dispersion_widens_intercepts_at_their_means_alone_and_a_load_the_constant() -> None:
    rows = rows_of(summaries_of(random_faults(3, 10), seed=3))
    whole, added = rows.dispersed(np.array([4.0, 1.0, 1.0]))
    b = AT.intercepts
    np.testing.assert_allclose(whole[:, b, b] - rows.covariance[:, b, b], added, atol=1e-15)
    np.testing.assert_allclose(added[:, 0, 0], 3.0 * rows.intercept_covariance()[:, 0, 0])
    assert not added[:, 1:].any()
    wider = rows.with_load_spread(0.01).covariance - rows.covariance
    np.testing.assert_allclose(wider[:, AT.junction, AT.junction], 1e-4)
    assert np.count_nonzero(wider) == len(rows)
