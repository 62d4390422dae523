"""Fault models learnt from a fleet: prior, centre and spread, and errors that its vehicles share."""

from dataclasses import replace

import numpy as np
import pytest

from calibrator.drive import Array
from calibrator.estimator import learning
from calibrator.estimator.evidence import UNKNOWN_VARIANCE, EvidenceRows, RowPlaces
from calibrator.estimator.learning import learn_fault_models
from calibrator.estimator.posterior import FaultModel, explain, weigh
from calibrator.estimator.prior import GRID, Prior, first_prior
from calibrator.faults import Faults
from tests.calibrator.estimator.simulated_drives import no_faults
from tests.calibrator.estimator.simulated_rows import Errors, model_of_equals, random_faults, rows_of


def moved(rows: EvidenceRows, by: Array) -> EvidenceRows:
    """Rows shifted by these amounts (N, 5K), where they are known."""
    return replace(rows, values=rows.values + by * rows.known)


def learned(rows: EvidenceRows) -> FaultModel:
    """The most probable model."""
    models = learn_fault_models(rows, feed=0)
    assert sum(model.probability for model in models) == pytest.approx(1.0)
    assert [model.probability for model in models] == sorted((model.probability for model in models), reverse=True)
    assert all(sum(share for share, _ in model.priors) == pytest.approx(1.0) for model in models)
    return models[0]


def shared_by(models: list[FaultModel]) -> dict[tuple[int, ...], float]:
    """Probability of each set of shared errors, given by their places in :attr:`.Spread.shared`."""
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
def test_learnt_prior_matches_sizes_and_numbers_of_the_faults(K: int, magnitude: tuple[float, float]) -> None:
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


def test_learnt_model_is_invariant_to_vehicle_order_even_if_subsampled(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(learning, "MOST_LEARNT", 12)
    rows = rows_of(random_faults(6, vehicles=20, branches=2), seed=6)
    same(learned(rows.take(np.random.default_rng(6).permutation(20))), learned(rows), rtol=1e-6)


@pytest.mark.parametrize("expected", [0.0, 1.0])
def test_expected_faulty_share_of_0_or_1_gives_a_valid_prior(expected: float) -> None:
    faults = no_faults(8, 2)
    faults.drift[0, 1] = 0.1
    models = learn_fault_models(rows_of(faults, seed=3), feed=0, expected_faults=expected)
    for counts in (model.prior.counts for model in models):
        assert (counts[:, 0].sum(), counts.sum()) == pytest.approx((1.0 - expected, 1.0), abs=1e-5)


@pytest.mark.parametrize("bias", [0.0, 0.04])
def test_uncertain_gain_ratios_are_not_taken_for_a_shared_gain_error(bias: float) -> None:
    """A ratio of a branch that hardly moves is biased alike in all vehicles, by less than its standard deviation."""
    rows = rows_of(no_faults(24, 3), seed=4, errors=Errors(ratio=0.1))
    by = np.zeros(15)
    by[rows.places.ratios] = bias
    models = learn_fault_models(moved(rows, by), feed=0)
    assert set(shared_by(models)) == {()}
    np.testing.assert_allclose(models[0].spread.mean[rows.places.slopes], 0.0, atol=0.002)


@pytest.mark.parametrize("vague", [0.0005, 0.04])
def test_shared_gain_error_is_not_attributed_to_a_branch_of_uncertain_gain_ratio(vague: float) -> None:
    faults = no_faults(16, 4)
    faults.drift[:, 0] = 0.05
    faults.drift[3, 1], faults.offset_a[5, 2] = -0.12, 0.1
    rows = rows_of(faults, seed=7)
    row = rows.places.ratio(3)
    rows.covariance[:, row, row] += vague**2
    rows.values[:, row] += vague * np.random.default_rng(7).normal(size=16)
    assert shared_by(learn_fault_models(rows, feed=0)).keys() == {(4,)}


def test_gain_ratios_off_by_another_amount_in_each_vehicle_are_no_shared_gain_error() -> None:
    """As where the signal of one branch is a mean over a second: how far a ratio is off depends on the drive."""
    rows = rows_of(no_faults(16, 3), seed=8)
    by = np.zeros((16, 15))
    by[:, rows.places.ratios] = 0.04 + 0.02 * np.random.default_rng(8).normal(size=(16, 1))
    assert shared_by(learn_fault_models(moved(rows, by), feed=0)).keys() == {()}


def test_doubtful_gain_ratios_reveal_no_shared_gain_error() -> None:
    faults = no_faults(16, 3)
    faults.drift[4, 1] = 0.1
    rows, by = rows_of(faults, seed=9), np.zeros(15)
    by[rows.places.ratio(1)] = 0.05
    doubtful = np.array([True, False])
    models = learn_fault_models(moved(rows, by), feed=0, doubtful=doubtful)
    assert shared_by(models).keys() == {()}
    np.testing.assert_allclose(models[0].spread.mean[rows.places.ratios], [0.05, 0.0], atol=0.002)


def test_prior_is_learnt_from_sensors_that_read_only_a_tenth_of_the_current() -> None:
    """As where half of the vehicles report a branch in another unit."""
    faults = no_faults(12, 3)
    faults.drift[:5, 2] = -0.9
    assert learned(rows_of(faults, seed=10)).prior.gain.high > 0.8


def test_load_in_a_single_vehicle_does_not_make_loads_probable() -> None:
    """What it shows may also be an offset of the feeding sensor; the other vehicles have neither."""
    faults = no_faults(8, 2)
    faults.offset_a[0, 0] = 0.03
    rows = rows_of(faults, seed=11)
    model = learned(rows)
    draws = explain(rows, model, feed=0)
    loaded = (weigh(draws, model.prior)[0] * draws.fits.support[:, :, -1, None, None])[0].sum()
    assert model.prior.load_share < 0.01
    assert loaded < 0.9


def test_constant_shared_by_all_vehicles_is_more_probably_a_load_but_may_be_an_offset() -> None:
    faults = no_faults(12, 3)
    faults.offset_a[:, 0] = 0.015
    causes = shared_by(learn_fault_models(rows_of(faults, seed=12), feed=0))
    assert 0.5 < causes[()] < 0.95


@pytest.mark.parametrize("K", [2, pytest.param(3, marks=pytest.mark.long)])
def test_negative_junction_constant_is_taken_for_an_offset_of_all_sensors_of_a_branch(K: int) -> None:
    """Currents that sum to less than zero: no load gives current."""
    faults = random_faults(12, vehicles=24, branches=K)
    faults.offset_a[:, 0] -= 0.03
    causes = shared_by(learn_fault_models(rows_of(faults, seed=12), feed=0))
    assert causes.get((), 0.0) < 0.01
    assert max(causes, key=causes.__getitem__) == (0,)


@pytest.mark.parametrize(("offset", "load"), [(0.02, 0.0), (0.15, None)])
def test_shared_offset_that_cannot_be_a_load_is_not_attributed_to_one_branch(offset: float, load: float | None) -> None:
    """The load is declared, or the offset is larger than any load that a fleet shares."""
    faults = no_faults(12, 3)
    faults.offset_a[:, 1] += offset
    models = learn_fault_models(rows_of(faults, seed=5), feed=0, load=load)
    by_branch = np.zeros(3)
    for model in models:
        by_branch[np.argmin(model.spread.mean[RowPlaces(3).intercepts])] += model.probability
    assert by_branch.max() < 0.9


def test_offset_of_most_vehicles_is_not_learnt_as_a_group_if_the_load_is_declared() -> None:
    """What eight of twelve sensors share is their offset: the four others show the load that is declared."""
    faults = no_faults(12, 3)
    faults.offset_a[:8, 1] += 0.02
    for model in learn_fault_models(rows_of(faults, seed=5), feed=0, load=0.0):
        assert model.prior.group_share.max(initial=0.0) < 0.1
        np.testing.assert_allclose(model.spread.mean[RowPlaces(3).intercepts], 0.0, atol=0.002)


@pytest.mark.parametrize(("vehicles", "seed"), [
    (10, 3), pytest.param(24, 8, marks=pytest.mark.long), pytest.param(24, 10, marks=pytest.mark.long),
])  # fmt: skip
def test_intercepts_equal_by_chance_in_two_vehicles_set_no_reference(vehicles: int, seed: int) -> None:
    """With mostly faulty vehicles this once gave a whole fleet an offset of 15 % of full scale, with certainty."""
    faults = random_faults(seed, vehicles=vehicles, branches=3, sparsity=50.0, balanced=False)
    spread, at = learned(rows_of(faults, seed=seed)).spread, RowPlaces(3)
    assert np.abs(spread.mean[[*np.arange(15)[at.intercepts], at.junction]]).max() < 0.003
    assert not spread.shared.any()


def test_equally_good_references_of_a_fleet_are_both_kept() -> None:
    """Half of the vehicles share a hardware offset: nothing says which half is right."""
    faults = no_faults(8, 2)
    faults.hardware_offset_a[:4] = [0.1, -0.1]
    models = learn_fault_models(rows_of(faults, seed=3), feed=0)
    zeros = [model.spread.mean[RowPlaces(2).intercepts][0] for model in models]
    np.testing.assert_allclose(sorted(zeros), [0.0, 0.1], atol=0.003)
    assert min(model.probability for model in models) > 0.1


@pytest.mark.parametrize("seed", [0, 2, 3])
def test_scatter_of_half_a_percent_is_not_taken_for_hardware_faults(seed: int) -> None:
    faults = no_faults(8, 3)
    faults.hardware_drift[:] = np.random.default_rng(seed).normal(0.0, 0.005, 8)
    faults.drift[0, 0] = faults.offset_a[1, 1] = 0.1
    model = learned(rows_of(faults, seed=seed, errors=Errors(slope=0.0005)))
    assert model.prior.counts[1:].sum() < 0.05
    spread = np.sqrt(np.diag(model.spread.covariance)[RowPlaces(3).slopes])
    np.testing.assert_allclose(spread, np.std(faults.hardware_drift), rtol=0.6)


def test_vehicle_with_two_equal_gain_errors_does_not_set_the_reference() -> None:
    """Each of the eleven others would have the same hardware fault of 11 %."""
    faults = no_faults(12, 3)
    faults.hardware_drift[:] = np.random.default_rng(0).normal(0.0, 0.005, 12)
    faults.drift[3, 1:], faults.drift[4, 2] = [-0.099, -0.101], 0.12
    models = learn_fault_models(rows_of(faults, seed=0, errors=Errors(slope=0.0005)), feed=0)
    right = [np.abs(model.spread.mean[RowPlaces(3).slopes]).max() < 0.01 for model in models]
    assert sum(model.probability for model, near in zip(models, right, strict=True) if near) > 0.95


def test_single_fault_does_not_determine_the_prior_of_fault_sizes() -> None:
    faults = no_faults(6, 2)
    faults.offset_a[0, 0] = 0.25
    density = learned(rows_of(faults, seed=3)).prior.offset.density
    assert np.interp(0.03, GRID, density) > 0.3 * np.interp(0.25, GRID, density)


def test_single_vehicle_is_judged_by_the_initial_prior_and_not_by_one_learnt_from_itself() -> None:
    errors = Errors(slope=0.1, ratio=0.03, intercept=0.05, junction=0.03)
    rows = rows_of(random_faults(3, vehicles=1, branches=2), seed=3, errors=errors)
    draws, guess = explain(rows, model_of_equals(2), feed=0), first_prior(2)

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
def test_vehicles_sharing_a_constant_form_a_group_of_open_cause(of_sensor: bool) -> None:
    faults, some = random_faults(13, vehicles=24, branches=2), np.arange(24) < 8
    faults.offset_a[some, 0] += 0.03 * of_sensor
    models = learn_fault_models(rows_of(faults, seed=13, load=0.0 if of_sensor else 0.03 * some), feed=0)
    (share,), (centre,) = models[0].prior.group_share, models[0].prior.group_centre
    assert share == pytest.approx(0.3, abs=0.1)
    assert centre == pytest.approx(0.03, abs=0.001)
    assert {model.spread.shared[-1] for model in models} == {0.0, 1.0}


def test_batch_offset_with_different_gains_is_not_taken_for_a_load() -> None:
    """The sensors read the same offset; loads in its place would differ between the vehicles."""
    faults = no_faults(8, 2)
    faults.drift[:3, 0], faults.offset_a[:3, 0] = [-0.2, -0.1, 0.15], 0.03
    faults.drift[3, 1], faults.offset_a[4, 1] = 0.1, 0.2
    (model,) = learn_fault_models(rows_of(faults, seed=3), feed=0)
    assert model.spread.shared[-1]
    assert model.prior.group_centre == pytest.approx([0.03], abs=0.001)
    assert model.prior.load_share < 0.05


@pytest.mark.parametrize(("K", "branch"), [(3, 0), pytest.param(3, 2, marks=pytest.mark.long), (2, 1)])
def test_shared_gain_error_is_attributed_to_one_of_three_branches_but_not_of_two(K: int, branch: int) -> None:
    gain, faults = 0.08, random_faults(14, vehicles=16, branches=K)
    faults.drift[:, branch] = (1.0 + gain) * (1.0 + faults.drift[:, branch]) - 1.0
    rows = rows_of(faults, seed=14)
    rows.relative[:, branch] -= np.log1p(gain)  # the fleet's model has the same error
    causes = shared_by(learn_fault_models(rows, feed=0))
    if K == 2:
        assert causes == pytest.approx({(2,): 0.5, (3,): 0.5}, abs=0.01)
    else:
        assert causes.get((K + branch,), 0.0) > 0.99


def test_unexplained_vehicle_gets_wider_uncertainty_and_others_do_not() -> None:
    K = 2
    rows = rows_of(random_faults(15, vehicles=6, branches=K), seed=15)
    by = np.zeros((6, 5 * K))
    by[2, 0], by[2, 1], by[2, 2] = 0.2, -0.3, 0.15  # three ratios that agree with no two gains ...
    by[2, 5], by[2, 6], by[2, 7] = 0.1, 0.2, -0.4
    read = rows.covariance.copy()
    read[2, [3, 4, 8, 9], [3, 4, 8, 9]] = 1e-6  # ... while readings say that all sensors are right
    rows = replace(rows, covariance=read)
    plain, odd = (explain(each, model_of_equals(K), feed=0) for each in (rows, moved(rows, by)))
    wide = [np.sqrt((draws.fits.root[2, : draws.fits.number[2]] ** 2).max()) for draws in (plain, odd)]
    assert wide[1] > 3.0 * wide[0]
    for j in (0, 1, 3, 4, 5):
        n = plain.fits.number[j]
        np.testing.assert_array_equal(odd.fits.theta[j, :n], plain.fits.theta[j, :n])


def test_learning_works_with_one_vehicle_and_with_an_unused_branch() -> None:
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


def test_learning_finds_intercept_errors_larger_than_stated() -> None:
    K = 2
    rows = rows_of(random_faults(4, vehicles=30, branches=K), seed=4, errors=Errors(intercept=0.004))
    stated = rows.covariance.copy()
    at = RowPlaces(K).intercepts
    stated[:, at, at] -= np.diag([0.004**2 - 0.001**2] * K)
    wide, plain = (learned(each).spread for each in (replace(rows, covariance=stated), rows))
    variance = 0.001**2 * wide.dispersion + np.diag(wide.covariance)[at]
    np.testing.assert_allclose(variance, 0.004**2, rtol=0.5)
    assert (wide.dispersion > 2.0 * plain.dispersion).all()


def test_loads_that_differ_between_vehicles_are_learnt_as_spread_not_as_a_shared_offset() -> None:
    K, load = 2, np.random.default_rng(15).normal(0.0075, 0.0025, 30).clip(0.0)
    errors = Errors(intercept=0.0003, junction=0.0001)  # as on recorded trips
    model = learned(rows_of(random_faults(15, vehicles=30, branches=K), seed=15, errors=errors, load=load))
    carried = [model.spread.covariance[row, 4 * K - 1] for row in (3 * K - 1, 4 * K - 1)]
    np.testing.assert_allclose(np.sqrt(carried), load.std(), rtol=0.3)
    assert not model.spread.shared.any()


def test_learning_works_without_any_known_slope() -> None:
    """As with drives of a minute; this was once an internal error."""
    rows = rows_of(random_faults(1, vehicles=12, branches=2), seed=1)
    covariance = rows.covariance.copy()
    for row in np.arange(10)[RowPlaces(2).slopes]:
        covariance[:, row], covariance[:, :, row] = 0.0, 0.0
        covariance[:, row, row] = UNKNOWN_VARIANCE
    assert np.isfinite(learned(replace(rows, covariance=covariance)).log_evidence)
