import numpy as np
import pytest

from calibrator.drive import Array
from calibrator.errors import DriveError
from calibrator.identification.state_space import StateSpaceModel, simulation_snr_db


def model_with(A: Array) -> StateSpaceModel:
    rng = np.random.default_rng(0)
    n = len(A)
    return StateSpaceModel(
        A=A,
        B=rng.normal(size=(n, 2)),
        C=rng.normal(size=(3, n)),
        D=rng.normal(size=(3, 2)),
        x0=rng.normal(size=n),
        offset_a=np.array([1.0, 2.0, 3.0]),
        snr_db=np.zeros(3),
    )


def step_by_step(model: StateSpaceModel, inputs: Array, x: Array) -> Array:
    rows = []
    for u in inputs:
        rows.append(model.C @ x + model.D @ u + model.offset_a)
        x = model.A @ x + model.B @ u
    return np.array(rows)


MODES = {
    "real poles": np.array([[0.5, 0.2], [0.0, 0.9]]),
    "complex pair": np.array([[0.8, -0.3], [0.3, 0.8]]),
    "no separate modes": np.array([[0.9, 1.0, 0.0], [0.0, 0.9, 1.0], [0.0, 0.0, 0.9]]),
    "static": np.zeros((0, 0)),
}


@pytest.mark.parametrize("name", MODES)
def test_simulation_follows_the_equations(name: str) -> None:
    model = model_with(MODES[name])
    inputs = np.random.default_rng(1).normal(size=(50, 2))
    expected = step_by_step(model, inputs, model.x0)
    np.testing.assert_allclose(model.simulate(inputs, initial_state=model.x0), expected, atol=1e-10)


def test_simulation_starts_in_steady_state() -> None:
    model = model_with(MODES["complex pair"])
    simulated = model.simulate(np.tile([1.0, -2.0], (40, 1)))
    np.testing.assert_allclose(simulated, simulated[:1].repeat(40, axis=0), atol=1e-12)


def test_no_sample_gives_no_sample() -> None:
    assert model_with(MODES["real poles"]).simulate(np.empty((0, 2))).shape == (0, 3)


def test_snr_is_infinite_for_an_exact_and_nan_for_a_constant_channel() -> None:
    measured = np.column_stack([np.arange(10.0), np.full(10, 4.0), np.arange(10.0)])
    simulated = measured + np.array([0.0, 1.0, 0.1])
    snr = simulation_snr_db(measured, simulated)
    assert np.isposinf(snr[0])
    assert np.isnan(snr[1])
    assert snr[2] == pytest.approx(10.0 * np.log10(8.25 / 0.01))


def test_wrong_number_of_inputs_is_refused() -> None:
    with pytest.raises(DriveError, match=r"has 2 inputs, the drive to simulate has shape \(5, 3\)"):
        model_with(MODES["real poles"]).simulate(np.zeros((5, 3)))


def test_inputs_that_are_not_finite_are_refused() -> None:
    inputs = np.zeros((5, 2))
    inputs[3, 1] = np.inf
    with pytest.raises(DriveError, match="1 of 5 samples are not finite, the first is sample 3"):
        model_with(MODES["real poles"]).simulate(inputs)
