from typing import Any

import cvxpy
import numpy as np
import pytest
from scipy.optimize import linprog

from calibrator.drive import Array
from calibrator.errors import FleetError
from calibrator.published.basis_pursuit import quadratic_forms
from calibrator.published.enumeration import l1_norm, l1_optimum

cp: Any = cvxpy
TRACE_WEIGHT = 0.01
"""Trace against l1 norm (lambda = 100): enough for rank one, too little to move the optimum."""
RANK_ONE = 1e-5
"""Second eigenvalue over the first."""


def slopes_and_intercepts_of(x: Array) -> tuple[Array, Array]:
    K = x.shape[1] // 3
    values = np.concatenate([x, np.ones((len(x), 1))], axis=1)
    y = np.einsum("ni,kij,nj->nk", values, quadratic_forms(K), values)
    return y[:, :K], y[:, K:]


def sparse_faults(seed: int, *, vehicles: int, branches: int, nonzero: int) -> Array:
    rng = np.random.default_rng(seed)
    x = rng.choice([-1.0, 1.0], (vehicles, 3 * branches)) * rng.uniform(0.05, 0.25, (vehicles, 3 * branches))
    x[np.argsort(np.argsort(rng.random(x.shape), axis=1), axis=1) >= nonzero] = 0.0
    return x


def lifted_optimum(slopes: Array, intercepts: Array) -> tuple[float, Array, float]:
    """Solve the lifted (18) without noise: its optimum, x, and the second eigenvalue of X over the first."""
    K = len(slopes)
    X = cp.Variable((3 * K + 1, 3 * K + 1), PSD=True)
    forms = quadratic_forms(K).reshape(2 * K, -1)
    constraints = [forms @ cp.vec(X, order="C") == np.append(slopes, intercepts), X[-1, -1] == 1.0]
    problem = cp.Problem(cp.Minimize(TRACE_WEIGHT * cp.trace(X) + cp.sum(cp.abs(X))), constraints)
    problem.solve(solver=cp.CLARABEL)
    eigenvalues = np.linalg.eigvalsh(X.value)
    return float(problem.value), np.asarray(X.value[-1, :-1]), float(eigenvalues[-2] / eigenvalues[-1])


def lifted_objective(x: Array) -> float:
    """What x x' costs in the lifted problem."""
    return float(TRACE_WEIGHT * (1.0 + x @ x) + (1.0 + l1_norm(x)) ** 2)


@pytest.mark.parametrize(("branches", "nonzero"), [(2, 1), (2, 2), (3, 1), (3, 2), (3, 3)])
def test_optimum_is_that_of_basis_pursuit_where_its_solution_has_rank_one(branches: int, nonzero: int) -> None:
    truth = sparse_faults(branches + nonzero, vehicles=12, branches=branches, nonzero=nonzero)
    slopes, intercepts = slopes_and_intercepts_of(truth)
    compared = 0
    for a, b, enumerated in zip(slopes, intercepts, l1_optimum(slopes, intercepts), strict=True):
        objective, x, second = lifted_optimum(a, b)
        assert objective <= lifted_objective(enumerated) + 1e-6, "the relaxation lies below"
        if second < RANK_ONE:
            compared += 1
            assert objective == pytest.approx(lifted_objective(x), abs=1e-4)
            assert l1_norm(enumerated) == pytest.approx(l1_norm(x), abs=1e-4)
    assert compared >= 8


def least_norm_on_a_grid(a: Array, b: Array) -> float:
    """Scan of d_h; offsets by linear programming."""
    K, best = len(a), np.inf
    for t in np.unique(np.concatenate([np.linspace(0.6, 1.5, 181), a, [1.0]])):
        c = a / t
        hardware = np.vstack([np.eye(K - 1), -np.ones(K - 1)])
        # variables: o_h (K - 1, free), then bounds on |o_h,k| and |o_k|
        G = np.vstack([np.eye(K - 1), -np.eye(K - 1), -c[:, None] * hardware, c[:, None] * hardware])
        h = np.concatenate([np.zeros(2 * (K - 1)), -b, b])
        bounds = np.vstack([np.eye(2 * K - 1)[: K - 1]] * 2 + [np.eye(2 * K - 1)[K - 1 :]] * 2)
        cost = np.concatenate([np.zeros(K - 1), np.ones(2 * K - 1)])
        free = [(None, None)] * (K - 1) + [(0.0, None)] * (2 * K - 1)
        offsets = linprog(cost, A_ub=np.hstack([G, -bounds]), b_ub=h, bounds=free).fun
        best = min(best, abs(t - 1.0) + np.abs(c - 1.0).sum() + offsets)
    return float(best)


@pytest.mark.parametrize("branches", [2, 3, 4])
def test_no_scan_of_the_hardware_drift_finds_less(branches: int) -> None:
    rng = np.random.default_rng(branches)
    slopes, intercepts = rng.uniform(0.75, 1.35, (4, branches)), rng.uniform(-0.3, 0.3, (4, branches))
    norms = l1_norm(l1_optimum(slopes, intercepts))
    for a, b, norm in zip(slopes, intercepts, norms, strict=True):
        scanned = least_norm_on_a_grid(a, b)
        assert norm <= scanned + 1e-9
        assert norm == pytest.approx(scanned, abs=0.005)


@pytest.mark.parametrize("branches", [2, 3, 4, 8])
def test_optimum_explains_slopes_and_intercepts(branches: int) -> None:
    rng = np.random.default_rng(branches)
    slopes, intercepts = rng.uniform(0.75, 1.35, (50, branches)), rng.uniform(-0.3, 0.3, (50, branches))
    a, b = slopes_and_intercepts_of(l1_optimum(slopes, intercepts))
    np.testing.assert_allclose(a, slopes, atol=1e-12)
    np.testing.assert_allclose(b, intercepts, atol=1e-12)


@pytest.mark.parametrize("branches", [2, 3, 4])
def test_single_sensor_faults_and_common_drifts_are_found(branches: int) -> None:
    x = 0.15 * np.delete(np.eye(3 * branches), np.s_[1:branches], axis=0)
    np.testing.assert_allclose(l1_optimum(*slopes_and_intercepts_of(x)), x, atol=1e-12)


def test_no_truth_has_a_smaller_norm_than_the_optimum() -> None:
    truth = sparse_faults(9, vehicles=500, branches=3, nonzero=4)
    assert (l1_norm(l1_optimum(*slopes_and_intercepts_of(truth))) <= l1_norm(truth) + 1e-12).all()


def test_a_stationary_point_between_the_kinks_is_not_missed() -> None:
    slopes = np.array([[1.3, 1.3, 0.9]])
    hardware = np.array([[0.1, 0.0, -0.1]])
    x = l1_optimum(slopes, slopes * hardware)
    assert x[0, 0] == pytest.approx(np.sqrt(1.7 / 1.1) - 1.0)


def test_faultless_vehicles_have_no_faults() -> None:
    assert not l1_optimum(np.ones((3, 2)), np.zeros((3, 2))).any()


def test_order_of_vehicles_and_of_all_but_the_last_branch_does_not_matter() -> None:
    slopes, intercepts = slopes_and_intercepts_of(sparse_faults(5, vehicles=20, branches=4, nonzero=3))
    plain = l1_norm(l1_optimum(slopes, intercepts))
    branches, vehicles = [2, 0, 1, 3], np.random.default_rng(5).permutation(20)
    np.testing.assert_allclose(l1_norm(l1_optimum(slopes[:, branches], intercepts[:, branches])), plain, rtol=1e-12)
    np.testing.assert_allclose(l1_norm(l1_optimum(slopes[vehicles], intercepts[vehicles])), plain[vehicles], rtol=1e-12)


@pytest.mark.parametrize(("slope", "intercept"), [(0.0, 0.1), (-0.5, 0.1), (np.nan, 0.0), (1.0, np.inf)])
def test_impossible_evidence_is_refused(slope: float, intercept: float) -> None:
    slopes, intercepts = np.ones((3, 2)), np.zeros((3, 2))
    slopes[2, 1], intercepts[2, 1] = slope, intercept
    with pytest.raises(FleetError, match=r"vehicle 3, branch 2: slope .* expected finite ones and a positive slope"):
        l1_optimum(slopes, intercepts)
