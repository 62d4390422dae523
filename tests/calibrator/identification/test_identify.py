import dataclasses

import numpy as np
import pytest
from scipy.signal import lfilter

from calibrator.drive import Array
from calibrator.errors import DriveError
from calibrator.identification.identify import (
    choose_order,
    identify,
    observability,
    standardised_moments,
    subspace_modes,
)
from calibrator.identification.state_space import StateSpaceModel, simulation_snr_db

SAMPLES, INPUTS, BRANCHES = 12_000, 5, 4
TRAIN = 9_600


def true_system(order: int, seed: int) -> StateSpaceModel:
    """Oscillating modes of 0.5 to 5 s at 10 Hz with random couplings."""
    rng = np.random.default_rng(seed)
    A = np.zeros((order, order))
    for k in range(0, order, 2):
        radius, angle = rng.uniform(0.8, 0.98), rng.uniform(0.05, 0.6)
        cos, sin = radius * np.cos(angle), radius * np.sin(angle)
        A[k : k + 2, k : k + 2] = [[cos, -sin], [sin, cos]]
    return StateSpaceModel(
        A=A,
        B=0.3 * rng.normal(size=(order, INPUTS)),
        C=rng.normal(size=(BRANCHES, order)),
        D=rng.normal(size=(BRANCHES, INPUTS)),
        x0=rng.normal(size=order),
        offset_a=np.array([5.0, -3.0, 0.0, 1.0]),
        snr_db=np.full(BRANCHES, np.inf),
    )


def smooth_inputs(seed: int, samples: int = SAMPLES) -> Array:
    noise = np.random.default_rng(seed).normal(size=(samples, INPUTS))
    return np.asarray(3.0 * lfilter([0.1], [1.0, -0.9], noise, axis=0) + 2.0)


def recording(order: int, snr_db: float, seed: int) -> tuple[Array, Array, Array]:
    """Inputs, noise-free currents, and currents with white noise."""
    truth = true_system(order, seed)
    inputs = smooth_inputs(seed + 100)
    clean = truth.simulate(inputs, initial_state=truth.x0)
    noise = np.random.default_rng(seed + 200).normal(size=clean.shape)
    return inputs, clean, clean + noise * clean.std(axis=0) * 10.0 ** (-snr_db / 20.0)


def slope_error(clean: Array, simulated: Array) -> Array:
    centred = clean - clean.mean(axis=0)
    return np.asarray(np.abs(np.sum(centred * simulated, axis=0) / np.sum(centred**2, axis=0) - 1.0))


@pytest.mark.parametrize("order", [4, 6])
@pytest.mark.parametrize(("snr_db", "least_db", "slope"), [(20, 40, 0.006), (30, 50, 0.002), (40, 60, 0.0006)])
def test_known_system_is_found_through_noise(order: int, snr_db: float, least_db: float, slope: float) -> None:
    for seed in range(3):
        inputs, clean, noisy = recording(order, snr_db, seed)
        model = identify(inputs[:TRAIN], noisy[:TRAIN], order=order)
        simulated = model.simulate(inputs, initial_state=model.x0)[TRAIN:]
        assert simulation_snr_db(clean[TRAIN:], simulated).min() > least_db
        assert slope_error(clean[TRAIN:], simulated).max() < slope


def test_noise_free_system_is_found_to_rounding() -> None:
    inputs, clean, _ = recording(4, 20, 0)
    model = identify(inputs, clean, order=4)
    truth = true_system(4, 0)
    np.testing.assert_allclose(model.simulate(inputs, initial_state=model.x0), clean, atol=1e-5)
    np.testing.assert_allclose(
        np.sort_complex(np.linalg.eigvals(model.A)), np.sort_complex(np.linalg.eigvals(truth.A)), atol=1e-6
    )


def test_reported_snr_is_that_of_the_simulation() -> None:
    inputs, _, noisy = recording(4, 20, 1)
    model = identify(inputs, noisy, order=4)
    simulated = model.simulate(inputs, initial_state=model.x0)
    np.testing.assert_allclose(model.snr_db, simulation_snr_db(noisy, simulated), atol=1e-3)
    np.testing.assert_allclose(model.snr_db, 20.0, atol=0.5)


@pytest.mark.parametrize("order", [4, 6])
def test_order_is_chosen_as_the_system_has_it(order: int) -> None:
    inputs, _, noisy = recording(order, 30, 2)
    assert choose_order(inputs, noisy) == order


def test_static_system_has_order_zero_and_its_gains() -> None:
    inputs = smooth_inputs(3)
    gains = np.random.default_rng(3).normal(size=(BRANCHES, INPUTS))
    clean = inputs @ gains.T + 7.0
    noisy = clean + 0.1 * np.random.default_rng(4).normal(size=clean.shape)
    model = identify(inputs, noisy)
    assert model.order == 0
    np.testing.assert_allclose(model.D, gains, atol=0.01)
    np.testing.assert_allclose(model.offset_a, 7.0, atol=0.05)


def test_scaling_and_shifting_a_current_scales_and_shifts_its_simulation() -> None:
    inputs, _, noisy = recording(4, 20, 5)
    scale, shift = np.array([1.2, -1.0, 0.8, 1000.0]), np.array([30.0, 0.0, -5.0, 1.0])
    plain = identify(inputs, noisy, order=4)
    changed = identify(inputs, scale * noisy + shift, order=4)
    expected = scale * plain.simulate(inputs) + shift
    np.testing.assert_allclose(changed.simulate(inputs), expected, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(changed.snr_db, plain.snr_db, atol=1e-6)


def test_units_of_inputs_do_not_matter() -> None:
    inputs, _, noisy = recording(4, 20, 6)
    scale = np.array([1e3, 1.0, 1e-3, 5.0, -1.0])
    plain = identify(inputs, noisy, order=4).simulate(inputs)
    scaled = identify(scale * inputs + 10.0, noisy, order=4).simulate(scale * inputs + 10.0)
    np.testing.assert_allclose(scaled, plain, rtol=1e-6, atol=1e-6)


def test_constant_and_equal_inputs_and_a_dead_current_do_no_harm() -> None:
    inputs, _, noisy = recording(4, 30, 7)
    degenerate = np.column_stack([inputs, inputs[:, 0], np.full(len(inputs), 12.0), np.zeros(len(inputs))])
    currents = np.column_stack([noisy, np.zeros(len(noisy))])
    model = identify(degenerate, currents, order=4)
    simulated = model.simulate(degenerate, initial_state=model.x0)
    assert simulation_snr_db(noisy, simulated[:, :BRANCHES]).min() > 29.0
    np.testing.assert_allclose(simulated[:, BRANCHES], 0.0, atol=1e-6)
    assert np.isnan(model.snr_db[BRANCHES])


def test_moments_that_rounding_leaves_indefinite_tell_the_same_system() -> None:
    inputs, _, noisy = recording(2, 30.0, 3)
    inputs[:, 4] = 0.0
    inputs[0, 4] = 1.0  # for a moment only, as an air conditioning that was being switched off
    moments = standardised_moments(inputs, noisy, np.ones(len(inputs), np.bool_))
    values, vectors = np.linalg.eigh(moments.gram)
    rounding = 2e-11 * moments.rows * np.outer(vectors[:, 0], vectors[:, 0])
    rounded = dataclasses.replace(moments, gram=moments.gram - rounding)
    assert values[0] < 1e-12 * moments.rows, "some of the lagged inputs never move"
    assert np.linalg.eigvalsh(rounded.gram)[0] < -1e-11 * moments.rows
    exact, found = (
        subspace_modes(observability(each, inputs=INPUTS), BRANCHES, 2).poles for each in (moments, rounded)
    )
    assert found == pytest.approx(exact, abs=1e-6)


def test_samples_outside_the_mask_are_not_looked_at() -> None:
    inputs, clean, noisy = recording(4, 30, 8)
    valid = np.ones(len(inputs), bool)
    for start in range(900, len(inputs), 1000):
        valid[start : start + 7] = False
    spoilt_inputs, spoilt = inputs.copy(), noisy.copy()
    spoilt_inputs[~valid], spoilt[~valid] = np.nan, np.nan
    model = identify(spoilt_inputs, spoilt, order=4, valid=valid)
    assert simulation_snr_db(clean, model.simulate(inputs, initial_state=model.x0)).min() > 40.0


def test_unstable_growth_gives_a_stable_model() -> None:
    inputs = smooth_inputs(9, 2000)
    growth = 1.004 ** np.arange(2000.0)
    currents = np.column_stack([growth, -growth]) + inputs[:, :2]
    for order in (1, 2, 4, 8):
        model = identify(inputs, currents, order=order)
        assert np.abs(np.linalg.eigvals(model.A)).max() < 1.0
        assert np.isfinite(model.simulate(inputs)).all()


def test_pure_noise_gives_a_stable_model() -> None:
    rng = np.random.default_rng(10)
    model = identify(rng.normal(size=(2000, 3)), rng.normal(size=(2000, 2)), order=8)
    assert np.abs(np.linalg.eigvals(model.A)).max() < 1.0


def test_three_seconds_of_data_are_refused() -> None:
    inputs, _, noisy = recording(4, 20, 0)
    with pytest.raises(DriveError, match=r"30 valid samples are too few .* at least 360 .* longer drive"):
        identify(inputs[:30], noisy[:30], order=4)


def test_a_drive_of_gaps_is_refused() -> None:
    inputs, _, noisy = recording(4, 20, 0)
    valid = np.arange(len(inputs)) % 10 != 0
    with pytest.raises(DriveError, match=r"only 0 stretches of 20 valid samples"):
        identify(inputs, noisy, order=4, valid=valid)


def test_nan_among_valid_samples_is_refused() -> None:
    inputs, _, noisy = recording(4, 20, 0)
    noisy[1234, 2] = np.nan
    with pytest.raises(DriveError, match=r"1 of 12000 valid samples are not finite, the first is sample 1234"):
        identify(inputs, noisy, order=4)


def test_shapes_that_do_not_fit_are_refused() -> None:
    inputs, _, noisy = recording(4, 20, 0)
    with pytest.raises(DriveError, match="do not belong together"):
        identify(inputs[:-1], noisy, order=4)
