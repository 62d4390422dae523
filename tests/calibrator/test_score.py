import numpy as np
import pytest

from calibrator.drive import Array
from calibrator.faults import Faults, measured_currents, slopes_and_intercepts, true_currents
from calibrator.score import UnseenDrive, f2_score, harmed, recovered

FULL_SCALE_A = 400.0
I_A = np.column_stack([sign * (30.0 * np.random.default_rng(0).normal(size=1000) + 8.0) for sign in (1.0, -1.0)])
"""True currents, shape (T, 2). [A]"""
MEAN_A, MEAN_SQUARE_A2 = I_A.mean(axis=0), np.mean(I_A**2, axis=0)


def sensor_faults(drift: list[list[float]] | Array, offset: list[list[float]] | Array) -> Faults:
    """Make sensor faults from drifts, and from offsets in fractions of full scale."""
    d, o = np.array(drift), FULL_SCALE_A * np.array(offset)
    return Faults(hardware_drift=np.zeros(len(d)), hardware_offset_a=np.zeros_like(d), drift=d, offset_a=o)


@pytest.mark.parametrize(("true", "found", "within_10", "within_25"), [
    ((0.1, 0.2), (0.109, 0.2), True, True),
    ((0.1, 0.2), (0.111, 0.2), False, True),
    ((0.1, 0.2), (0.1, 0.221), False, True),
    ((0.0, 0.0), (0.0049, 0.0), True, True),  # a truth of zero counts as the smallest fault, 0.05
    ((0.0, 0.0), (0.0051, 0.0), False, True),
    ((0.1, 0.0), (float("nan"), 0.0), False, False),
])  # fmt: skip
def test_vehicle_is_recovered_if_drift_and_offset_are_within_the_tolerance(
    true: tuple[float, float], found: tuple[float, float], within_10: bool, within_25: bool
) -> None:
    truth, estimate = (sensor_faults([[d, 0.0]], [[o, 0.0]]) for d, o in (true, found))
    for tolerance, expected in ((0.1, within_10), (0.25, within_25)):
        mask = recovered(estimate, truth, full_scale_a=FULL_SCALE_A, smallest_fault=0.05, tolerance=tolerance)
        assert mask.tolist() == [expected]


def test_f2_score_follows_its_definition() -> None:
    actual = np.array([True] * 10 + [False] * 10)
    predicted = np.array([True] * 8 + [False] * 2 + [True] * 4 + [False] * 6)
    precision, recall = 8 / 12, 8 / 10
    assert f2_score(predicted, actual) == pytest.approx(5 * precision * recall / (4 * precision + recall))
    assert f2_score(~actual, actual) == 0.0
    assert f2_score(np.zeros(2, bool), np.zeros(2, bool)) == 1.0


def test_error_from_moments_equals_the_error_of_corrected_currents() -> None:
    truth = sensor_faults([[0.2, -0.1]], [[0.05, 0.1]])
    drift, offset_a = np.array([[0.15, -0.3]]), np.array([[2.0, 11.0]])
    i_m = measured_currents(I_A, truth.take(0))
    expected = np.sqrt(np.mean(((i_m - offset_a) / (1.0 + drift) - I_A) ** 2, axis=0))
    for unseen in (UnseenDrive.of_linear_sensors(MEAN_A, MEAN_SQUARE_A2, truth), UnseenDrive.of_samples([(I_A, i_m)])):
        np.testing.assert_allclose(unseen.rms_a(drift, offset_a)[0], expected)


def test_one_worsened_branch_counts_as_harm_and_no_or_perfect_correction_does_not() -> None:
    rng = np.random.default_rng(2)
    truth = sensor_faults(*rng.uniform(-0.2, 0.2, (2, 50, 2)))
    moments = {"mean_a": MEAN_A, "mean_square_a2": MEAN_SQUARE_A2}
    for harmless in (truth, sensor_faults(*np.zeros((2, 50, 2)))):
        assert not harmed(harmless, truth, **moments).any()
    none = np.zeros((2, 2))
    truth, estimate = (sensor_faults(drift, none) for drift in ([[0.1, 0.0]] * 2, [[0.1, 0.001], [0.19, 0]]))
    assert harmed(estimate, truth, **moments).tolist() == [True, False]


FAULTS = Faults(
    hardware_drift=np.array([0.1, 0.0]),
    hardware_offset_a=np.array([[5.0, -5.0], [0.0, 0.0]]),
    drift=np.array([[0.2, 0.0], [0.0, 0.0]]),
    offset_a=np.array([[-3.0, 0.0], [0.0, 0.0]]),
)


def test_slopes_and_intercepts_reproduce_the_measured_currents() -> None:
    i_s = np.array([[80.0, -80.0], [-20.0, 20.0], [1.0, -1.0]])
    a, b = slopes_and_intercepts(FAULTS)
    for j in range(2):
        measured = measured_currents(true_currents(i_s, FAULTS.take(j)), FAULTS.take(j))
        np.testing.assert_allclose(measured, a[j] * i_s + b[j])
