import numpy as np
import pytest

from calibrator.drive import Array
from calibrator.faults import Faults, measured_currents
from calibrator.score import correction_error_rms, f2_score, harmed, recovered

FULL_SCALE_A = 400.0


def sensor_faults(drift: list[list[float]], offset: list[list[float]]) -> Faults:
    """Offsets in fractions of full scale."""
    d, o = np.array(drift), FULL_SCALE_A * np.array(offset)
    return Faults(hardware_drift=np.zeros(len(d)), hardware_offset_a=np.zeros_like(d), drift=d, offset_a=o)


def found(estimate: Faults, truth: Faults, tolerance: float = 0.1) -> list[bool]:
    mask = recovered(estimate, truth, full_scale_a=FULL_SCALE_A, smallest_fault=0.05, tolerance=tolerance)
    return [bool(x) for x in mask]


def test_drift_and_offset_must_both_be_close() -> None:
    truth = sensor_faults([[0.1, 0.0]] * 3, [[0.2, 0.0]] * 3)
    estimate = sensor_faults([[0.109, 0.0], [0.111, 0.0], [0.1, 0.0]], [[0.2, 0.0], [0.2, 0.0], [0.2, 0.021]])
    assert found(estimate, truth) == [True, False, False]
    assert found(estimate, truth, tolerance=0.25) == [True, True, True]


def test_a_vanishing_truth_counts_as_the_smallest_fault() -> None:
    truth = sensor_faults([[0.0, 0.0]] * 2, [[0.0, 0.0]] * 2)
    estimate = sensor_faults([[0.0049, 0.0], [0.0051, 0.0]], [[0.0, 0.0]] * 2)
    assert found(estimate, truth) == [True, False]


def test_an_estimate_that_is_not_a_number_is_not_recovered() -> None:
    truth = sensor_faults([[0.1, 0.0]], [[0.0, 0.0]])
    assert found(sensor_faults([[np.nan, 0.0]], [[0.0, 0.0]]), truth) == [False]


def test_f2_follows_its_definition() -> None:
    actual = np.array([True] * 10 + [False] * 10)
    predicted = np.array([True] * 8 + [False] * 2 + [True] * 4 + [False] * 6)
    precision, recall = 8 / 12, 8 / 10
    assert f2_score(predicted, actual) == pytest.approx(5 * precision * recall / (4 * precision + recall))


def test_f2_is_one_for_the_truth_and_zero_if_all_is_missed() -> None:
    actual = np.array([True, False])
    assert f2_score(actual, actual) == 1.0
    assert f2_score(~actual, actual) == 0.0
    assert f2_score(np.zeros(2, bool), np.zeros(2, bool)) == 1.0


def currents(samples: int = 1000) -> Array:
    battery = 30.0 * np.random.default_rng(0).normal(size=samples) + 8.0
    return np.column_stack([battery, -battery])


def test_error_from_moments_equals_the_error_of_corrected_currents() -> None:
    rng = np.random.default_rng(1)
    i = currents()
    truth = sensor_faults([[0.2, -0.1]], [[0.05, 0.1]]).take(0)
    drift, offset = 0.1 * rng.normal(size=2), 10.0 * rng.normal(size=2)
    corrected = (measured_currents(i, truth) - offset) / (1.0 + drift)
    rms = correction_error_rms(
        true_drift=truth.drift,
        true_offset_a=truth.offset_a,
        drift=drift,
        offset_a=offset,
        mean_a=i.mean(axis=0),
        mean_square_a2=np.mean(i**2, axis=0),
    )
    np.testing.assert_allclose(rms, np.sqrt(np.mean((corrected - i) ** 2, axis=0)))


def harm(estimate: Faults, truth: Faults) -> list[bool]:
    i = currents()
    mask = harmed(estimate, truth, mean_a=i.mean(axis=0), mean_square_a2=np.mean(i**2, axis=0))
    return [bool(x) for x in mask]


def test_no_correction_and_the_true_correction_harm_nobody() -> None:
    rng = np.random.default_rng(2)
    truth = sensor_faults(rng.uniform(-0.2, 0.2, (50, 2)).tolist(), rng.uniform(-0.2, 0.2, (50, 2)).tolist())
    none = sensor_faults([[0.0, 0.0]] * 50, [[0.0, 0.0]] * 50)
    assert not any(harm(none, truth))
    assert not any(harm(truth, truth))


def test_one_worse_branch_is_harm() -> None:
    truth = sensor_faults([[0.1, 0.0], [0.1, 0.0]], [[0.0, 0.0]] * 2)
    estimate = sensor_faults([[0.1, 0.001], [0.19, 0.0]], [[0.0, 0.0]] * 2)
    assert harm(estimate, truth) == [True, False]
