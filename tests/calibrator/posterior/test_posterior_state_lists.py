"""Lists of explanations: cut, widened, averaged over hyper-parameters, and of vehicles that differ from their fleet."""

from dataclasses import fields, replace

import numpy as np
import pytest

from calibrator.drive import Array
from calibrator.posterior import states as module
from calibrator.posterior.fault_prior import OUTLIER_VARIANCE, ModelSpread
from calibrator.posterior.states import States, enumerate_states, mean_states
from calibrator.posterior.workspace import MOST_STATES
from tests.calibrator.posterior.simulated_rows import no_spread, prior_of, random_faults, rows_of

K = 2
ROWS = rows_of(random_faults(21, vehicles=5, branches=K, sparsity=60.0), seed=21)
SPREAD = replace(no_spread(K), covariance=1e-6 * np.diag(np.arange(1.0, 5 * K + 1)))


def made(seed: int, vehicles: int, states: int) -> States:
    """Explanations of nothing in particular: no two numbers are equal."""
    rng = np.random.default_rng(seed)
    return States(
        weight=-np.sort(-rng.dirichlet(np.ones(states), size=vehicles), axis=1),
        log_evidence=rng.normal(size=vehicles),
        relative=rng.normal(size=(vehicles, states, K + 1)),
        relative_sd=rng.uniform(size=(vehicles, states, K + 1)),
        constant=rng.normal(size=(vehicles, states, 2 * K - 1)),
        constant_sd=rng.uniform(size=(vehicles, states, 2 * K - 1)),
        outlier=rng.uniform(size=(vehicles, states)) < 0.5,
    )


def numbers(states: States, vehicle: int) -> Array:
    """All that is said of each state of a vehicle but its weight."""
    found = [getattr(states, f.name)[vehicle] for f in fields(States)[2:]]
    return np.column_stack(found)


def assert_equal(states: States, expected: States, *, atol: float = 0.0) -> None:
    for f in fields(States):
        np.testing.assert_allclose(getattr(states, f.name), getattr(expected, f.name), rtol=0.0, atol=atol)


def test_further_states_have_no_weight_and_no_faults() -> None:
    states = made(1, 3, 4)
    wide = states.padded(6)
    for f in fields(States)[2:]:
        values = getattr(wide, f.name)
        assert values.shape[:2] == (3, 6)
        np.testing.assert_array_equal(values[:, :4], getattr(states, f.name))
        assert not values[:, 4:].any()
    np.testing.assert_array_equal(wide.weight, np.pad(states.weight, [(0, 0), (0, 2)]))
    np.testing.assert_array_equal(wide.log_evidence, states.log_evidence)


def test_some_vehicles_are_taken_with_all_that_is_said_of_them() -> None:
    states = made(2, 4, 3)
    some = states.take(np.array([3, 1]))
    assert len(some) == 2
    for place, vehicle in enumerate((3, 1)):
        np.testing.assert_array_equal(some.weight[place], states.weight[vehicle])
        np.testing.assert_array_equal(numbers(some, place), numbers(states, vehicle))
    np.testing.assert_array_equal(some.log_evidence, states.log_evidence[[3, 1]])


def test_faults_are_counted_by_their_kind() -> None:
    relative = np.array([[[0.1, 0.0, 0.0], [0.0, 0.1, 0.2], [0.0, 0.0, 0.0], [0.1, 0.1, 0.0]]])
    constant = np.array([[[0.1, 0.0, 0.0], [0.0, 0.0, 0.1], [0.0, 0.0, 0.0], [0.0, 0.2, 0.1]]])
    states = replace(made(3, 1, 4), relative=relative, constant=constant)
    np.testing.assert_array_equal(states.hardware_count, [[2, 0, 0, 1]])
    np.testing.assert_array_equal(states.hardware, [[True, False, False, True]])
    np.testing.assert_array_equal(states.sensor_count, [[0, 3, 0, 3]])
    np.testing.assert_array_equal(states.drift, relative[:, :, 1:])
    np.testing.assert_array_equal(states.offset, constant[:, :, 1:])


def test_the_mean_of_posteriors_has_the_states_of_all_of_them() -> None:
    first, second, third = made(4, 3, 4), made(5, 3, 2), made(6, 3, 5)
    mean = mean_states([first, second, third])
    for j in range(3):
        weight = np.concatenate([states.weight[j] for states in (first, second, third)]) / 3.0
        every = np.concatenate([numbers(states, j) for states in (first, second, third)])
        order = np.argsort(-weight)
        np.testing.assert_allclose(mean.weight[j], weight[order])
        np.testing.assert_array_equal(numbers(mean, j), every[order])
        evidence = np.mean([np.exp(states.log_evidence[j]) for states in (first, second, third)])
        assert np.exp(mean.log_evidence[j]) == pytest.approx(evidence)


def test_of_many_states_the_most_probable_are_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MOST_AVERAGED", 5)
    first, second = made(7, 2, 4), made(8, 2, 4)
    few = mean_states([first, second])
    monkeypatch.setattr(module, "MOST_AVERAGED", 512)
    every = mean_states([first, second])
    np.testing.assert_array_equal(few.weight, every.weight[:, :5])
    np.testing.assert_array_equal(few.relative, every.relative[:, :5])
    np.testing.assert_array_equal(few.outlier, every.outlier[:, :5])


@pytest.mark.parametrize("chunk", [1, 2, 4, 5])
def test_vehicles_that_are_worked_on_together_do_not_matter(monkeypatch: pytest.MonkeyPatch, chunk: int) -> None:
    expected = enumerate_states(ROWS, prior_of(K), SPREAD)
    monkeypatch.setattr(module, "CHUNK", chunk)
    assert_equal(enumerate_states(ROWS, prior_of(K), SPREAD), expected, atol=1e-12)


def test_vehicles_that_differ_more_are_explained_both_ways() -> None:
    """As usual vehicles, and as outliers: with the evidence of either, and its share."""
    share = 0.3
    usual = enumerate_states(ROWS, prior_of(K), SPREAD)
    wide = enumerate_states(ROWS, prior_of(K), replace(SPREAD, covariance=OUTLIER_VARIANCE * SPREAD.covariance))
    both = enumerate_states(ROWS, prior_of(K), replace(SPREAD, outlier_share=share))
    assert not usual.outlier.any()
    evidence = (1.0 - share) * np.exp(usual.log_evidence), share * np.exp(wide.log_evidence)
    np.testing.assert_allclose(np.exp(both.log_evidence), sum(evidence))
    for j in range(len(ROWS)):
        parts = [usual.weight[j] * evidence[0][j], wide.weight[j] * evidence[1][j]]
        weight = np.concatenate(parts) / (evidence[0][j] + evidence[1][j])
        of_wide = np.repeat([False, True], [len(part) for part in parts])
        order = np.argsort(-weight, kind="stable")[:MOST_STATES]
        np.testing.assert_allclose(both.weight[j], weight[order], rtol=1e-9)
        likely = both.weight[j] > 1e-6
        np.testing.assert_array_equal(both.outlier[j, likely], of_wide[order][likely])
        for name in ("relative", "relative_sd", "constant", "constant_sd"):
            every = np.concatenate([getattr(usual, name)[j], getattr(wide, name)[j]])[order]
            np.testing.assert_allclose(getattr(both, name)[j, likely], every[likely], rtol=1e-9)


@pytest.mark.parametrize(("share", "looked_for"), [(0.0, False), (0.001, False), (0.0011, True)])
def test_outliers_are_not_looked_for_where_there_are_next_to_none(share: float, looked_for: bool) -> None:
    spread: ModelSpread = replace(SPREAD, outlier_share=share)
    assert enumerate_states(ROWS.take(slice(0, 1)), prior_of(K), spread).outlier.any() == looked_for
