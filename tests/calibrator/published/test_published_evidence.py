from typing import Any

import numpy as np
import pytest

from calibrator.drive import Array
from calibrator.faults import Faults, slopes_and_intercepts
from calibrator.published.evidence import collect_evidence
from tests.calibrator.estimator.simulated_rows import random_faults


def ideal_currents(samples: int = 600) -> Array:
    t = np.arange(float(samples))
    battery = 40.0 * np.sin(t / 20.0) + 15.0 * np.cos(t / 7.0) + 10.0
    return np.column_stack([battery, -0.7 * battery + 3.0 * np.sin(t / 50.0), -0.3 * battery - 3.0 * np.sin(t / 50.0)])


def symmetric_fleet(vehicles: int = 40) -> Faults:
    settings: dict[str, Any] = {"balanced": False, "symmetric": True}
    return random_faults(0, vehicles=vehicles, branches=3, sparsity=60.0, full_scale_a=400.0, **settings)


def simulations(i_s: Array, faults: Faults, noise_a: float) -> Array:
    a, b = slopes_and_intercepts(faults)
    clean = a[:, None, :] * i_s + b[:, None, :]
    return np.asarray(clean + noise_a * np.random.default_rng(1).normal(size=clean.shape))


def test_noise_free_slopes_and_intercepts_are_those_of_the_faults() -> None:
    i_s, faults = ideal_currents(), symmetric_fleet()
    evidence = collect_evidence(simulations(i_s, faults, 0.0), i_s, np.zeros(len(faults)))
    a, b = slopes_and_intercepts(faults)
    np.testing.assert_allclose(evidence.slopes, a, atol=1e-12)
    np.testing.assert_allclose(evidence.intercepts_a, b, atol=1e-9)


def test_variances_are_those_of_white_noise() -> None:
    i_s, faults = ideal_currents(), symmetric_fleet(400)
    evidence = collect_evidence(simulations(i_s, faults, 5.0), i_s, np.zeros(len(faults)))
    a, b = slopes_and_intercepts(faults)
    slope_score = (evidence.slopes - a) / np.sqrt(evidence.slope_variances)
    offset_score = (evidence.intercepts_a - b) / np.sqrt(evidence.intercept_variances_a2)
    assert slope_score.std() == pytest.approx(1.0, abs=0.06)
    assert offset_score.std() == pytest.approx(1.0, abs=0.06)
