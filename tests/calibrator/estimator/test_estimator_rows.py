"""Evidence rows: the faults that they state are those that the vehicles have, within their covariance."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from calibrator.drive import Array
from calibrator.estimator import evidence
from calibrator.estimator.evidence import EvidenceRows, RowPlaces, collect_rows, row_design, stack_summaries
from calibrator.faults import Faults
from calibrator.summaries.moments import DriveSummary
from tests.calibrator.estimator import simulated_rows
from tests.calibrator.estimator.simulated_drives import Conditions, read_out_of, summaries_of
from tests.calibrator.estimator.simulated_rows import parameters_of, plain_residual

K, FULL_SCALE_A = 3, 400.0
AT = RowPlaces(K)
MEASURED = AT.measured
TRUE_MODEL = np.vstack([read_out_of(K), np.zeros(K)])
BRANCHES = pytest.mark.parametrize("branches", [2, 3, 5])


def random_faults(seed: int, vehicles: int) -> Faults:
    return simulated_rows.random_faults(seed, vehicles=vehicles, branches=K, sparsity=70.0, full_scale_a=FULL_SCALE_A)


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
def test_standardised_errors_are_standard_normal(conditions: Conditions, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(evidence, "LEAST_SD", np.array([5e-5, 1e-5]))  # these sensors are exact
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
