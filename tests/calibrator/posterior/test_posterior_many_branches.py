"""More than three branches: the sum over supports is approximate, and close."""

import numpy as np
import pytest

from calibrator.posterior import workspace
from calibrator.posterior.states import States, enumerate_states
from tests.calibrator.posterior.simulated_rows import (
    Errors,
    faults_of,
    no_spread,
    parameters_of,
    prior_of,
    random_faults,
    rows_of,
)


def limited_and_exact(monkeypatch: pytest.MonkeyPatch, sparsity: float, errors: Errors) -> tuple[States, States]:
    rows = rows_of(random_faults(3, vehicles=48, branches=4, sparsity=sparsity), errors=errors)
    limited = enumerate_states(rows, prior_of(4), no_spread(4))
    monkeypatch.setattr(workspace, "EXACT_BRANCHES", 4)
    return limited, enumerate_states(rows, prior_of(4), no_spread(4))


@pytest.mark.parametrize("errors", [Errors(), Errors(slope=0.02, ratio=0.005, intercept=0.01, junction=0.005)])
@pytest.mark.parametrize("sparsity", [80.0, 60.0])
def test_four_branches_lose_next_to_nothing_against_all_supports(
    monkeypatch: pytest.MonkeyPatch, sparsity: float, errors: Errors
) -> None:
    limited, exact = limited_and_exact(monkeypatch, sparsity, errors)
    lost = exact.log_evidence - limited.log_evidence
    assert lost.min() > -1e-6
    assert np.quantile(lost, 0.9) < 0.05
    np.testing.assert_allclose(limited.relative[:, 0], exact.relative[:, 0], atol=1e-9)
    np.testing.assert_allclose(limited.constant[:, 0], exact.constant[:, 0], atol=1e-9)


@pytest.mark.parametrize("faults", [2, 3])
def test_faults_of_eight_branches_are_found(faults: int) -> None:
    K, vehicles, rng = 8, 32, np.random.default_rng(faults)
    values = np.zeros((vehicles, 3 * K))
    for row in values:
        size = rng.choice([-1.0, 1.0], faults) * rng.uniform(0.05, 0.25, faults)
        row[rng.choice(3 * K, faults, replace=False)] = size
    truth = faults_of(values[:, : K + 1], values[:, K + 1 :])
    found = enumerate_states(rows_of(truth, seed=faults), prior_of(K, decay=2.0), no_spread(K))
    explanations = np.concatenate([found.relative, found.constant], axis=2)
    close = np.abs(explanations - values[:, None]).max(axis=2) < 0.01
    assert close[:, 0].mean() > 0.9
    assert close[:, :2].any(axis=1).all(), "where another explanation is as sparse, the truth comes second"


@pytest.mark.parametrize("kind", ["drift", "offset"])
def test_six_faults_of_one_kind_are_found_among_eight_branches(kind: str) -> None:
    K, rng = 8, np.random.default_rng(6)
    sensors = rng.permuted(np.tile(np.r_[np.ones(6), np.zeros(2)], (8, 1)), axis=1)
    sizes = sensors * rng.choice([-1.0, 1.0], sensors.shape) * rng.uniform(0.08, 0.25, sensors.shape)
    relative, constant = np.zeros((8, K + 1)), np.zeros((8, 2 * K - 1))
    if kind == "drift":
        relative[:, 1:] = sizes
    else:
        constant[:, K - 1 :] = sizes
    truth = faults_of(relative, constant)
    prior = prior_of(K, decay=0.3, hardware=0.02, low=0.08)
    found = enumerate_states(rows_of(truth, noise=0.3), prior, no_spread(K))
    first, second = parameters_of(truth)
    error = np.concatenate([found.relative[:, 0] - first, found.constant[:, 0] - second], axis=1)
    assert (np.abs(error).max(axis=1) < 0.01).all()
