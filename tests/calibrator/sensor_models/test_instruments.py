"""Regression with instruments: the textbook's result, and no attenuation by noise in the regressors."""

import numpy as np
import pytest

from calibrator.drive import Array
from calibrator.sensor_models.instruments import Instruments

BLOCKS, LENGTH = 40, 250


def _columns(seed: int, noise: float) -> Array:
    """Columns u1, u2, x (noisy), y, 1 with y = 2 x - 3 + noise of its own; x = u1 + u2 beneath its noise."""
    rng = np.random.default_rng(seed)
    u = rng.normal(0.0, 1.0, (BLOCKS * LENGTH, 2))
    x = u.sum(axis=1)
    y = 2.0 * x - 3.0 + rng.normal(0.0, 0.3, len(x))
    return np.column_stack([u, x + rng.normal(0.0, noise, len(x)), y, np.ones(len(x))])


def _instruments(columns: Array) -> Instruments:
    blocks = columns.reshape(BLOCKS, LENGTH, -1)
    return Instruments.of(np.einsum("btp,btq->bpq", blocks, blocks), [0, 1, 4], constant=4)


UNIT = np.eye(5)
X = np.column_stack([UNIT[:, 4], UNIT[:, 2]])


def test_the_coefficients_are_those_of_two_stage_least_squares() -> None:
    columns = _columns(1, 0.5)
    Z, x, y = columns[:, [0, 1, 4]], columns[:, [4, 2]], columns[:, 3]
    fitted = Z @ np.linalg.lstsq(Z, x, rcond=None)[0]
    oracle = np.linalg.lstsq(fitted, y, rcond=None)[0]
    instruments = _instruments(columns)
    assert instruments.coefficients(UNIT[:, 3], X) == pytest.approx(oracle, rel=1e-9)
    assert instruments.regress(UNIT[:, 3], X).estimate == pytest.approx(oracle[-1], rel=1e-9)


def test_noise_in_a_regressor_does_not_attenuate() -> None:
    columns = _columns(2, 2.0)
    slope = float(np.polyfit(columns[:, 2], columns[:, 3], 1)[0])
    fit = _instruments(columns).regress(UNIT[:, 3], X)
    assert slope < 1.0
    assert fit.estimate == pytest.approx(2.0, abs=4.0 * float(np.sqrt(np.sum(fit.influence**2))))


def test_standard_deviations_are_honest() -> None:
    z = []
    for seed in range(200):
        fit = _instruments(_columns(100 + seed, 1.0)).regress(UNIT[:, 3], X)
        z.append((fit.estimate - 2.0) / float(np.sqrt(np.sum(fit.influence**2))))
    assert 0.85 < float(np.std(z)) < 1.2


def test_what_instruments_tell_of_a_regressor_itself_is_nothing_more() -> None:
    instruments = _instruments(_columns(3, 0.0))
    assert instruments.strength(UNIT[:, 2], X) == pytest.approx(0.0, abs=1e-6)
    assert instruments.strength(UNIT[:, 0], X) == pytest.approx(np.sqrt(0.5), rel=0.05)


def test_instruments_that_repeat_each_other_change_nothing() -> None:
    columns = _columns(4, 0.5)
    twice = np.column_stack([columns, columns[:, 0]])
    blocks = twice.reshape(BLOCKS, LENGTH, -1)
    repeated = Instruments.of(np.einsum("btp,btq->bpq", blocks, blocks), [0, 1, 4, 5], constant=4)
    unit = np.eye(6)
    x = np.column_stack([unit[:, 4], unit[:, 2]])
    once = _instruments(columns).regress(UNIT[:, 3], X)
    again = repeated.regress(unit[:, 3], x)
    assert again.estimate == pytest.approx(once.estimate, rel=1e-9)
    assert again.freedom == pytest.approx(once.freedom)
