import numpy as np

from calibrator.faults import Faults, measured_currents, slopes_and_intercepts, true_currents

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


def test_kinds_of_faults_are_told_apart() -> None:
    assert FAULTS.has_hardware_fault.tolist() == [True, False]
    assert FAULTS.has_sensor_fault.tolist() == [True, False]
    assert len(FAULTS) == 2
