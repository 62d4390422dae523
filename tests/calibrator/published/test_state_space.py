"""State-space models and their identification: known systems are found through noise, bad drives are refused."""

import numpy as np
import pytest
from scipy.signal import lfilter

from calibrator.drive import Array
from calibrator.errors import DriveError
from calibrator.published.state_space import StateSpaceModel, choose_order, identify_model, simulation_snr_db

SAMPLES, INPUTS, BRANCHES = 12_000, 5, 4
TRAIN = 9_600
A_OF_KIND = {
    "real poles": np.array([[0.5, 0.2], [0.0, 0.9]]),
    "complex pair": np.array([[0.8, -0.3], [0.3, 0.8]]),
    "static": np.zeros((0, 0)),
}


def model_with(A: Array, inputs: int = INPUTS, seed: int = 0) -> StateSpaceModel:
    rng = np.random.default_rng(seed)
    n = len(A)
    return StateSpaceModel(
        A=A,
        B=0.3 * rng.normal(size=(n, inputs)),
        C=rng.normal(size=(BRANCHES, n)),
        D=rng.normal(size=(BRANCHES, inputs)),
        x0=rng.normal(size=n),
        offset_a=np.array([5.0, -3.0, 0.0, 1.0]),
        snr_db=np.full(BRANCHES, np.inf),
    )


def true_system(order: int, seed: int) -> StateSpaceModel:
    """Oscillating modes of 0.5 to 5 s at 10 Hz with random couplings."""
    rng = np.random.default_rng(seed)
    A = np.zeros((order, order))
    for k in range(0, order, 2):
        radius, angle = rng.uniform(0.8, 0.98), rng.uniform(0.05, 0.6)
        cos, sin = radius * np.cos(angle), radius * np.sin(angle)
        A[k : k + 2, k : k + 2] = [[cos, -sin], [sin, cos]]
    return model_with(A, seed=seed)


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


@pytest.mark.parametrize("kind", A_OF_KIND)
def test_simulation_follows_the_state_equations_and_starts_in_steady_state_by_default(kind: str) -> None:
    model, expected = model_with(A_OF_KIND[kind], 2), []
    inputs, x = np.random.default_rng(1).normal(size=(50, 2)), model.x0
    for u in inputs:
        expected.append(model.C @ x + model.D @ u + model.offset_a)
        x = model.A @ x + model.B @ u
    np.testing.assert_allclose(model.simulate(inputs, initial_state=model.x0), expected, atol=1e-10)
    still = model.simulate(np.tile([1.0, -2.0], (40, 1)))
    np.testing.assert_allclose(still, still[:1].repeat(40, axis=0), atol=1e-10)


@pytest.mark.parametrize("order", [4, 6])
def test_known_system_is_found_through_noise(order: int) -> None:
    for snr_db, least_db, slope in ((20.0, 40.0, 0.006), (40.0, 60.0, 0.0006)):
        inputs, clean, noisy = recording(order, snr_db, 0)
        model = identify_model(inputs[:TRAIN], noisy[:TRAIN], order=order)
        simulated = model.simulate(inputs, initial_state=model.x0)[TRAIN:]
        centred = clean[TRAIN:] - clean[TRAIN:].mean(axis=0)
        slopes = np.sum(centred * simulated, axis=0) / np.sum(centred**2, axis=0)
        assert simulation_snr_db(clean[TRAIN:], simulated).min() > least_db
        assert np.abs(slopes - 1.0).max() < slope


def test_chosen_order_is_that_of_the_system_and_snr_that_of_the_simulation() -> None:
    inputs, _, noisy = recording(6, 30, 2)
    assert choose_order(inputs, noisy) == 6
    model = identify_model(inputs, noisy, order=6)
    simulated = model.simulate(inputs, initial_state=model.x0)
    np.testing.assert_allclose(model.snr_db, simulation_snr_db(noisy, simulated), atol=1e-3)


def test_identification_works_with_degenerate_inputs_and_a_zero_current() -> None:
    inputs, _, noisy = recording(4, 30, 7)
    blip = np.zeros(SAMPLES)
    blip[0] = 1.0  # as an air conditioning that was being switched off
    inputs = np.column_stack([inputs, inputs[:, 0], np.full(SAMPLES, 12.0), np.zeros(SAMPLES), blip])
    model = identify_model(inputs, np.column_stack([noisy, np.zeros(SAMPLES)]), order=4)
    simulated = model.simulate(inputs, initial_state=model.x0)
    assert simulation_snr_db(noisy, simulated[:, :BRANCHES]).min() > 29.0
    np.testing.assert_allclose(simulated[:, BRANCHES], 0.0, atol=1e-6)
    assert np.isnan(model.snr_db[BRANCHES])


def test_samples_outside_the_mask_are_not_used() -> None:
    inputs, clean, noisy = recording(4, 30, 8)
    valid = (np.arange(SAMPLES) + 100) % 1000 >= 7
    spoilt_inputs, spoilt = np.where(valid[:, None], inputs, np.nan), np.where(valid[:, None], noisy, np.nan)
    model = identify_model(spoilt_inputs, spoilt, order=4, valid=valid)
    assert simulation_snr_db(clean, model.simulate(inputs, initial_state=model.x0)).min() > 40.0


@pytest.mark.parametrize("growth", [1.004, 1.0])
def test_models_identified_from_growing_currents_and_from_pure_noise_are_stable(growth: float) -> None:
    inputs, noise = smooth_inputs(9, 2000), np.random.default_rng(10).normal(size=(2000, 2))
    currents = noise if growth == 1.0 else growth ** np.arange(2000.0)[:, None] * [1.0, -1.0] + inputs[:, :2]
    for order in (1, 2, 4, 8):
        model = identify_model(inputs, currents, order=order)
        assert np.abs(np.linalg.eigvals(model.A)).max() < 1.0
        assert np.isfinite(model.simulate(inputs)).all()


def test_drives_with_too_few_valid_samples_in_a_row_are_refused() -> None:
    inputs, _, noisy = recording(4, 20, 0)
    with pytest.raises(DriveError, match=r"only 11 stretches of 20 valid samples in a row, at least 360 are needed"):
        identify_model(inputs[:30], noisy[:30], order=4)
    with pytest.raises(DriveError, match=r"only 0 stretches of 20 valid samples"):
        identify_model(inputs, noisy, order=4, valid=np.arange(SAMPLES) % 10 != 0)
