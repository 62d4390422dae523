"""Laws that explain a fleet: its faults, its centre and its spread, and what its vehicles share."""

from dataclasses import replace

import numpy as np
import pytest

from calibrator.drive import Array
from calibrator.estimator import learning
from calibrator.estimator.evidence import UNKNOWN_VARIANCE, EvidenceRows, RowPlaces
from calibrator.estimator.learning import learn_fault_models
from calibrator.estimator.posterior import FaultModel, Spread, explain, weigh
from calibrator.estimator.prior import Prior, first_prior
from calibrator.faults import Faults
from tests.calibrator.estimator.simulated_drives import no_faults
from tests.calibrator.estimator.simulated_rows import Errors, random_faults, rows_of


def moved(rows: EvidenceRows, by: Array) -> EvidenceRows:
    """Rows (N, 5K) that differ by so much more, known ones only."""
    return replace(rows, values=rows.values + by * rows.known)


def learned(rows: EvidenceRows) -> FaultModel:
    """The most probable model."""
    models = learn_fault_models(rows, feed=0)
    assert sum(model.probability for model in models) == pytest.approx(1.0)
    assert [model.probability for model in models] == sorted((model.probability for model in models), reverse=True)
    assert all(sum(share for share, _ in model.priors) == pytest.approx(1.0) for model in models)
    return models[0]


def shared_by(models: list[FaultModel]) -> dict[tuple[int, ...], float]:
    """Probabilities of what all vehicles share: places of offsets, gains and of a group's offset."""
    found: dict[tuple[int, ...], float] = {}
    for model in models:
        cause = tuple(np.flatnonzero(np.abs(model.spread.shared) > learning.LEAST_SHARED).tolist())
        found[cause] = found.get(cause, 0.0) + model.probability
    return found


def same(one: FaultModel, other: FaultModel, rtol: float) -> None:
    np.testing.assert_allclose(one.spread.mean, other.spread.mean, rtol=rtol, atol=1e-9)
    np.testing.assert_allclose(one.spread.covariance, other.spread.covariance, rtol=rtol, atol=1e-12)
    np.testing.assert_allclose(one.prior.counts, other.prior.counts, rtol=rtol, atol=1e-9)
    np.testing.assert_allclose(one.prior.gain.density, other.prior.gain.density, rtol=rtol, atol=1e-9)
    assert one.log_evidence == pytest.approx(other.log_evidence, rel=rtol)


@pytest.mark.parametrize("magnitude", [(0.05, 0.25), pytest.param((0.3, 0.6), marks=pytest.mark.long)])
@pytest.mark.parametrize("K", [2, pytest.param(3, marks=pytest.mark.long)])
def test_sizes_and_numbers_are_those_that_the_fleet_was_drawn_with(K: int, magnitude: tuple[float, float]) -> None:
    faults = random_faults(1, vehicles=48, branches=K, magnitude=magnitude)
    model = learned(rows_of(faults, seed=1))
    for slab, values in ((model.prior.gain, faults.drift), (model.prior.offset, faults.offset_a)):
        sizes = np.abs(values[values != 0.0])
        assert 0.8 * magnitude[0] < slab.low < 1.05 * sizes.min()
        assert 0.95 * sizes.max() < slab.high < 1.3 * magnitude[1]
    assert model.prior.counts[1:].sum() == pytest.approx(faults.has_hardware_fault.mean(), abs=0.08)
    many = np.count_nonzero(np.hstack([faults.drift, faults.offset_a]), axis=1)
    expected = np.bincount(many, minlength=2 * K + 1) / 48.0
    np.testing.assert_allclose(model.prior.counts.sum(axis=0), expected, atol=0.08)
    assert not model.spread.shared.any()
    assert np.abs(model.spread.mean).max() < 0.002
    assert model.prior.load_share < 0.02


def test_order_of_the_vehicles_does_not_matter_even_if_some_are_learned_from(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(learning, "MOST_LEARNT", 25)
    rows = rows_of(random_faults(6, vehicles=40, branches=2), seed=6)
    same(learned(rows.take(np.random.default_rng(6).permutation(40))), learned(rows), rtol=1e-6)


@pytest.mark.parametrize("K", [2, pytest.param(3, marks=pytest.mark.long)])
def test_constant_that_no_load_can_be_is_an_offset_of_all_sensors_of_a_branch(K: int) -> None:
    """Currents that sum to less than zero: no load gives current."""
    faults = random_faults(12, vehicles=24, branches=K)
    faults.offset_a[:, 0] -= 0.03
    causes = shared_by(learn_fault_models(rows_of(faults, seed=12), feed=0))
    assert causes.get((), 0.0) < 0.01
    assert max(causes, key=causes.__getitem__) == (0,)


@pytest.mark.parametrize("seed", [8, 10])
def test_intercepts_that_two_vehicles_share_by_chance_are_no_reference(seed: int) -> None:
    """Where most vehicles are faulty: a whole fleet's sensors were then off by 15 % of full scale, for certain."""
    faults = random_faults(seed, vehicles=24, branches=3, sparsity=50.0, balanced=False)
    spread, at = learned(rows_of(faults, seed=seed)).spread, RowPlaces(3)
    assert np.abs(spread.mean[[*np.arange(15)[at.intercepts], at.junction]]).max() < 0.003
    assert not spread.shared.any()


def test_vehicle_does_not_confirm_its_own_number_of_faults() -> None:
    """One vehicle is judged by the guess alone, whatever numbers it has made likely before."""
    errors = Errors(slope=0.1, ratio=0.03, intercept=0.05, junction=0.03)
    rows = rows_of(random_faults(3, vehicles=1, branches=2), seed=3, errors=errors)
    draws, guess = explain(rows, law_of(2), feed=0), first_prior(2)

    def numbers(prior: Prior) -> Array:
        tally = np.zeros(prior.counts.shape)
        np.add.at(tally, (draws.fits.hardware, draws.fits.sensor), weigh(draws, prior)[0].sum(axis=(2, 3)))
        return tally

    alone, C = numbers(guess), learning.COUNT_VEHICLES
    learnt = replace(guess, counts=(alone + C * guess.counts) / (1.0 + C))
    confirmed, found = numbers(learnt), learning._tally(draws, weigh(draws, learnt)[0], learnt)
    assert np.abs(confirmed - alone).max() > 0.05
    np.testing.assert_allclose(found, alone, atol=0.01)


@pytest.mark.parametrize("of_sensor", [False, True])
def test_vehicles_that_share_a_constant_are_a_group_and_its_cause_is_left_open(of_sensor: bool) -> None:
    faults, some = random_faults(13, vehicles=24, branches=2), np.arange(24) < 8
    faults.offset_a[some, 0] += 0.03 * of_sensor
    models = learn_fault_models(rows_of(faults, seed=13, load=0.0 if of_sensor else 0.03 * some), feed=0)
    (share,), (centre,) = models[0].prior.group_share, models[0].prior.group_centre
    assert share == pytest.approx(0.3, abs=0.1)
    assert centre == pytest.approx(0.03, abs=0.001)
    assert {model.spread.shared[-1] for model in models} == {0.0, 1.0}


@pytest.mark.parametrize(("K", "branch"), [(3, 0), pytest.param(3, 2, marks=pytest.mark.long), (2, 1)])
def test_shared_gain_is_found_but_not_which_of_two_branches_has_it(K: int, branch: int) -> None:
    gain, faults = 0.08, random_faults(14, vehicles=16, branches=K)
    faults.drift[:, branch] = (1.0 + gain) * (1.0 + faults.drift[:, branch]) - 1.0
    rows = rows_of(faults, seed=14)
    rows.relative[:, branch] -= np.log1p(gain)  # the fleet's model has the same error
    causes = shared_by(learn_fault_models(rows, feed=0))
    if K == 2:
        assert causes == pytest.approx({(2,): 0.5, (3,): 0.5}, abs=0.01)
    else:
        assert causes.get((K + branch,), 0.0) > 0.99


def law_of(K: int, prior: Prior | None = None) -> FaultModel:
    """FaultModel of vehicles that are alike but for their faults."""
    spread = Spread(
        mean=np.zeros(5 * K), covariance=1e-10 * np.eye(5 * K), dispersion=np.ones(K), shared=np.zeros(2 * K + 1)
    )
    return FaultModel(spread=spread, priors=((1.0, prior or first_prior(K)),))


def test_vehicle_that_no_explanation_fits_is_known_less_well_and_others_are_as_before() -> None:
    K = 2
    rows = rows_of(random_faults(15, vehicles=6, branches=K), seed=15)
    by = np.zeros((6, 5 * K))
    by[2, 0], by[2, 1], by[2, 2] = 0.2, -0.3, 0.15  # three ratios that agree with no two gains ...
    by[2, 5], by[2, 6], by[2, 7] = 0.1, 0.2, -0.4
    read = rows.covariance.copy()
    read[2, [3, 4, 8, 9], [3, 4, 8, 9]] = 1e-6  # ... while readings say that all sensors are right
    rows = replace(rows, covariance=read)
    plain, odd = (explain(each, law_of(K), feed=0) for each in (rows, moved(rows, by)))
    wide = [np.sqrt((draws.fits.root[2, : draws.fits.number[2]] ** 2).max()) for draws in (plain, odd)]
    assert wide[1] > 3.0 * wide[0]
    for j in (0, 1, 3, 4, 5):
        n = plain.fits.number[j]
        np.testing.assert_array_equal(odd.fits.theta[j, :n], plain.fits.theta[j, :n])


def test_one_vehicle_and_a_branch_that_nobody_used_are_learned_from_without_failing() -> None:
    K = 3
    rows = rows_of(Faults(**{name: values[:1] for name, values in vars(no_faults(2, K)).items()}), seed=17)
    assert len(learn_fault_models(rows, feed=0)) >= 1
    rows = rows_of(no_faults(8, K), seed=17, currents=np.array([0.1, -0.1, 0.0]))
    at = RowPlaces(K)
    for row in (at.slope(K - 1), at.ratio(K - 1)):
        rows.covariance[:, row], rows.covariance[:, :, row] = 0.0, 0.0
        rows.covariance[:, row, row] = 100.0
        rows.relative[:, row] = 0.0
    model = learned(rows)
    assert np.isfinite(model.spread.covariance).all()
    assert model.spread.mean[K - 1] == pytest.approx(0.0, abs=1e-3)


def test_intercepts_that_err_more_than_their_blocks_show_are_trusted_less() -> None:
    K = 2
    rows = rows_of(random_faults(4, vehicles=30, branches=K), seed=4, errors=Errors(intercept=0.004))
    stated = rows.covariance.copy()
    at = RowPlaces(K).intercepts
    stated[:, at, at] -= np.diag([0.004**2 - 0.001**2] * K)
    wide, plain = (learned(each).spread for each in (replace(rows, covariance=stated), rows))
    variance = 0.001**2 * wide.dispersion + np.diag(wide.covariance)[at]
    np.testing.assert_allclose(variance, 0.004**2, rtol=0.5)
    assert (wide.dispersion > 2.0 * plain.dispersion).all()


def test_loads_that_differ_between_vehicles_are_no_offsets_of_sensors() -> None:
    K, load = 2, np.random.default_rng(15).normal(0.0075, 0.0025, 30).clip(0.0)
    errors = Errors(intercept=0.0003, junction=0.0001)  # as on recorded trips
    model = learned(rows_of(random_faults(15, vehicles=30, branches=K), seed=15, errors=errors, load=load))
    carried = [model.spread.covariance[row, 4 * K - 1] for row in (3 * K - 1, 4 * K - 1)]
    np.testing.assert_allclose(np.sqrt(carried), load.std(), rtol=0.3)
    assert not model.spread.shared.any()


def test_fleet_of_which_no_slope_is_known_is_learnt_all_the_same() -> None:
    """As drives of a minute are: it was an error of the program."""
    rows = rows_of(random_faults(1, vehicles=12, branches=2), seed=1)
    covariance = rows.covariance.copy()
    for row in np.arange(10)[RowPlaces(2).slopes]:
        covariance[:, row], covariance[:, :, row] = 0.0, 0.0
        covariance[:, row, row] = UNKNOWN_VARIANCE
    assert np.isfinite(learned(replace(rows, covariance=covariance)).log_evidence)
