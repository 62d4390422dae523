"""Evidence of a fleet: clusters, the fleet model, the junction law, and rows, for vehicles whose faults are known."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from calibrator.drive import Array
from calibrator.estimator import evidence
from calibrator.faults import Faults
from calibrator.summaries.moments import DriveSummary
from calibrator.summaries.summariser import summarise_samples
from tests.calibrator.estimator import simulated_drives
from tests.calibrator.estimator.simulated_rows import parameters_of, plain_residual, random_faults

K, FULL_SCALE_A = 3, 400.0
W = simulated_drives.read_out_of(K)


# Fleet model


def one_sided_faults(vehicles: int, share: float) -> Faults:
    """Sensors that read too much, all with the same sign: the mean of the fleet is far from the ideal."""
    rng = np.random.default_rng(vehicles)
    faulty = rng.random((2, vehicles, K)) < share
    size = rng.uniform(0.05, 0.25, size=(2, vehicles, K)) * faulty
    return replace(simulated_drives.no_faults(vehicles, K), drift=size[0], offset_a=FULL_SCALE_A * size[1])


def model_of(summaries: Sequence[DriveSummary]) -> Array:
    return evidence.fit_fleet_model(evidence.stack_summaries(summaries))


def test_fleet_model_is_unbiased_even_if_all_faults_have_one_sign() -> None:
    read_out = model_of(simulated_drives.summaries_of(one_sided_faults(40, 0.5)))
    assert np.max(np.abs(read_out[:-1] - W) / np.abs(W).max(axis=0)) < 0.005
    assert np.abs(read_out[-1]).max() < 0.5
    np.testing.assert_allclose(read_out.sum(axis=1), 0.0, atol=1e-9)


@pytest.mark.parametrize("varying", [0, 3])
def test_effect_of_an_input_is_learnt_where_it_varies_and_is_0_if_it_never_does(varying: int) -> None:
    """Such as the vehicle's mass: where it is constant, its variance is rounding and must not be a divisor."""
    rng, summaries, told = np.random.default_rng(8), [], np.array([0.1, -0.1, 0.0])
    for j in range(12):
        drive = simulated_drives.drive_of(rng, simulated_drives.no_faults(1, K).take(0), simulated_drives.Conditions())
        change = 50.0 * simulated_drives.coloured(rng, len(drive.inputs), 1, 0.9) * (j < varying)
        inputs = np.hstack([drive.inputs, round(rng.uniform(1500.0, 2300.0), 3) + change])
        names = (*drive.input_names, "mass")
        drive = replace(drive, input_names=names, inputs=inputs, currents_a=drive.currents_a + change * told)
        summaries.append(summarise_samples([drive], period_s=simulated_drives.PERIOD_S))
    np.testing.assert_allclose(model_of(summaries)[-2], told * bool(varying), atol=2e-4)  # [A] per kg


# Junction law


def fleet_of(*currents_a: Array) -> evidence.FleetMoments:
    """Moments of vehicles with these currents (T, K)."""
    samples = [simulated_drives.samples_of(np.zeros((len(each), 0)), each) for each in currents_a]
    return evidence.stack_summaries([summarise_samples([one], period_s=simulated_drives.PERIOD_S) for one in samples])


def law_of(*currents_a: Array) -> evidence.VehicleRegressions:
    """Junction law of vehicles with these currents (T, K)."""
    return evidence.junction_regression(fleet_of(*currents_a))


def currents_of(seed: int, size_a: tuple[float, ...], noise_a: tuple[float, ...], samples: int) -> tuple[Array, Array]:
    """Currents of consumers of these sizes, fed by the first branch, with faults; and the true (g_2 .. g_K, c)."""
    rng = np.random.default_rng(seed)
    window = np.hanning(41)
    slow = [np.convolve(rng.normal(size=samples + 40), window / np.linalg.norm(window), "valid") for _ in size_a]
    consumers = np.array(size_a) * (np.stack(slow, axis=1) + 0.5)
    i = np.column_stack([-consumers.sum(axis=1), consumers])
    d, o = (size * rng.uniform(-1.0, 1.0, size=(len(size_a) + 1,)) for size in (0.1, 5.0))
    truth = np.append(-(1.0 + d[0]) / (1.0 + d[1:]), (1.0 + d[0]) * np.sum(o / (1.0 + d)))
    return (1.0 + d) * i + o + rng.normal(size=i.shape) * np.array(noise_a), truth


def test_averaged_signal_puts_gain_ratios_in_doubt_and_gain_errors_do_not() -> None:
    measured = [currents_of(seed, (60.0, 8.0), (0.2, 0.2, 0.2), 9000)[0] for seed in range(8)]
    assert not evidence.ratios_in_doubt(fleet_of(*measured)).any()
    window = np.ones(10) / 10.0
    means = [np.column_stack([np.convolve(each[:, 0], window, "full")[: len(each)], each[:, 1:]]) for each in measured]
    assert evidence.ratios_in_doubt(fleet_of(*means)).any()


def test_standardised_errors_of_the_junction_law_are_standard_normal() -> None:
    currents, truths = zip(*(currents_of(seed, (80.0, 6.0), (0.5, 0.5, 0.5), 1800) for seed in range(120)), strict=True)
    fit = law_of(*currents)
    z = (fit.estimate - np.array(truths)) / fit.sd
    rms = np.sqrt(np.mean(z**2, axis=0))
    assert (np.abs(z.mean(axis=0)) < 0.35).all(), z.mean(axis=0)
    assert ((rms > 0.75) & (rms < 1.3)).all(), rms


def test_noise_on_a_small_branch_does_not_bias_its_gain_to_zero() -> None:
    """Least squares would be biased by 7 % and more."""
    currents, truths = zip(*(currents_of(seed, (80.0, 6.0), (0.5, 0.5, 2.0), 3600) for seed in range(60)), strict=True)
    ratio = law_of(*currents).estimate[:, 1] / np.array(truths)[:, 1]
    assert np.mean(ratio) == pytest.approx(1.0, abs=0.006)


# Rows


def errors_of(rows: evidence.EvidenceRows, faults: Faults) -> Array:
    """Rows less what they are without error, as seen in true currents, shape (N, 5K)."""
    offsets = {name: getattr(faults, name) / FULL_SCALE_A for name in ("hardware_offset_a", "offset_a")}
    theta = parameters_of(replace(faults, **offsets))
    vehicles = [slice(j, j + 1) for j in range(len(rows))]
    return np.concatenate([plain_residual(rows.take(one), theta[one]) for one in vehicles])


@pytest.mark.parametrize("conditions", [
    simulated_drives.Conditions(noise_a=1.0, memory=0.8),
    pytest.param(simulated_drives.Conditions(), marks=pytest.mark.long),
    pytest.param(simulated_drives.Conditions(model_error_a=1.0), marks=pytest.mark.long),
], ids=["noise with a memory", "usual conditions", "errors of the model"])  # fmt: skip
def test_errors_of_rows_are_as_stated(conditions: simulated_drives.Conditions, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(evidence, "LEAST_SD", np.array([5e-5, 1e-5]))  # these sensors are exact
    faults = random_faults(1, vehicles=150, branches=K, sparsity=70.0, full_scale_a=FULL_SCALE_A)
    fleet = evidence.stack_summaries(simulated_drives.summaries_of(faults, conditions, seed=1))
    rows, _ = evidence.collect_rows(fleet, np.vstack([W, np.zeros(K)]), full_scale_a=FULL_SCALE_A)
    measured = evidence.RowPlaces(K).measured
    L = np.linalg.cholesky(rows.covariance[:, measured][:, :, measured])
    z = np.linalg.solve(L, errors_of(rows, faults)[:, measured, None])[..., 0]
    rms = np.sqrt(np.mean(z**2, axis=0))
    assert 0.75 < np.sqrt(np.mean(z**2)) < 1.25, rms
    # The last one, the junction constant, is the sum of the intercepts but for rounding: its deviation is overstated.
    assert ((rms[:-1] > 0.35) & (rms[:-1] < 1.45)).all(), rms
    assert 0.15 < rms[-1] < 1.45, rms
    assert (np.abs(z.mean(axis=0)) < 0.45).all(), z.mean(axis=0)


def test_slope_of_a_dead_sensor_is_known_to_be_small_and_one_of_a_branch_that_hardly_moves_is_unknown() -> None:
    faults = simulated_drives.no_faults(3, K)
    faults.drift[:2, 1] = -0.8, -0.98
    summaries = list(simulated_drives.summaries_of(faults, simulated_drives.Conditions(samples=600)))
    rng = np.random.default_rng(1)
    u = 1e-4 * simulated_drives.coloured(rng, 600, 3, 0.5)
    still = simulated_drives.samples_of(u, rng.normal(0.0, 0.3, (600, K)))
    summaries[2] = summarise_samples([still], period_s=simulated_drives.PERIOD_S)
    fleet = evidence.stack_summaries(summaries)
    rows, _ = evidence.collect_rows(fleet, np.vstack([W, np.zeros(K)]), full_scale_a=FULL_SCALE_A)
    row = rows.places.slope(1)
    sd = np.sqrt(rows.covariance[:, row, row])
    assert rows.values[:2, row] == pytest.approx(np.log([0.2, 0.085]), abs=0.02)
    assert sd[0] < 0.02
    assert 0.4 < sd[1] < 0.8
    assert sd[2] > 0.3
