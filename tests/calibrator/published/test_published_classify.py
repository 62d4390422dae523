import numpy as np
import pytest

from calibrator.faults import Faults
from calibrator.published.classify import (
    FaultTrees,
    classify_by_threshold,
    decision_criterion,
)


def faults_of(hardware: list[float], drift: list[float]) -> Faults:
    n = len(hardware)
    return Faults(
        hardware_drift=np.array(hardware),
        hardware_offset_a=np.zeros((n, 2)),
        drift=np.column_stack([drift, np.zeros(n)]),
        offset_a=np.zeros((n, 2)),
    )


def test_criterion_is_the_squared_distance_of_the_projections() -> None:
    """(7) equals (8) and (9): project the measured current on the plane of zero sum."""
    rng = np.random.default_rng(0)
    i_s = rng.normal(size=(500, 3))
    i_s -= i_s.mean(axis=1, keepdims=True)
    i_m = 1.1 * i_s + rng.normal(size=(500, 3)) + 0.5
    features = np.append(np.mean((i_m - i_s) ** 2, axis=0), np.mean(i_m.sum(axis=1) ** 2))
    projected = i_m - i_m.mean(axis=1, keepdims=True)
    expected = np.mean(np.sum((projected - i_s) ** 2, axis=1))
    assert decision_criterion(features[None])[0] == pytest.approx(expected)


def test_threshold_is_a_third_of_the_fleets_spread() -> None:
    eta = np.array([0.0, 1.0, 2.0, 9.0])
    found = classify_by_threshold(np.column_stack([eta, np.zeros(4), np.zeros(4)]))
    threshold = eta.std(ddof=1) / 3.0
    np.testing.assert_array_equal(found.hardware, eta > threshold)
    assert found.sensor.all()


def test_trees_learn_what_separates_the_classes() -> None:
    rng = np.random.default_rng(2)
    hardware, sensor = rng.random(2000) < 0.5, rng.random(2000) < 0.5
    truth = faults_of((0.1 * hardware).tolist(), (0.2 * sensor).tolist())
    features = np.column_stack([10.0 * hardware, 10.0 * hardware + 5.0 * sensor, 5.0 * sensor]) + rng.random((2000, 3))
    trees = FaultTrees(features[:1000], truth.take(slice(0, 1000)))
    found = trees.classify(features[1000:])
    np.testing.assert_array_equal(found.hardware, hardware[1000:])
    np.testing.assert_array_equal(found.sensor, sensor[1000:])
