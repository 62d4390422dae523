"""Does a vehicle have hardware faults, and its sensors faults? Section III-B of [1]_.

Two rules on the features (5) and (6): a threshold, and decision trees that learned from an artificial fleet.

.. [1] "Measurement Correction for Electric Vehicles Based on Compressed Sensing".
"""

from dataclasses import dataclass

import numpy as np
from sklearn.tree import DecisionTreeClassifier

from calibrator.drive import Array, Mask
from calibrator.faults import Faults

__all__ = ["Classification", "FaultTrees", "classify_by_threshold", "classify_by_truth", "decision_criterion"]

THRESHOLD_SHARE = 1.0 / 3.0
"""delta_h in standard deviations of the criterion across the fleet, section V-B. [1]"""
TREE_DEPTH = 6
"""Against overfitting, section V-B. [1]"""
RECALL_WEIGHT = 5.0
"""Weight of a missed fault against a false alarm. The paper judges by f2; that is largest if a vehicle counts as faulty
above a probability of f2 / (1 + 2^2), at odds of 1:5 for the paper's f2 of 0.84. [1]"""


@dataclass(frozen=True, kw_only=True)
class Classification:
    """What N vehicles are held to have.

    Attributes
    ----------
    hardware, sensor : ndarray of bool of shape (N,)
        Whether the vehicle itself, and any of its sensors, is faulty.
    """

    hardware: Mask
    sensor: Mask

    @property
    def case(self) -> Array:
        """The paper's cases 1 (no fault), 2 (hardware), 3 (sensors), 4 (both), shape (N,)."""
        return 1.0 + self.hardware + 2.0 * self.sensor


def decision_criterion(features: Array) -> Array:
    """Evaluate eta of (7): estimated mean square of what hardware faults add to the currents.

    Parameters
    ----------
    features : ndarray of shape (N, K + 1)
        From :class:`~calibrator.published.evidence.FleetEvidence`. [A^2]

    Returns
    -------
    ndarray of shape (N,)
        Criterion. [A^2]
    """
    K = features.shape[1] - 1
    return np.asarray(features[:, :K].sum(axis=1) - features[:, K] / K)


def classify_by_threshold(features: Array, in_reference: Mask | None = None) -> Classification:
    """Simple thresholding classifier, (7) with delta_h of (27).

    The paper gives no threshold for sensor faults, so all sensors are held to be faulty: then every vehicle is
    regressed, which finds the faults of healthy sensors to be nearly zero.

    Parameters
    ----------
    features : ndarray of shape (N, K + 1)
        Of the whole fleet. [A^2]
    in_reference : ndarray of bool of shape (N,), optional
        Vehicles whose spread sets the threshold; all by default.

    Returns
    -------
    Classification
        Hardware faults where the criterion is above a third of its standard deviation.
    """
    eta = decision_criterion(features)
    learnt = eta if in_reference is None else eta[in_reference]
    threshold = THRESHOLD_SHARE * learnt.std(ddof=1) if len(learnt) > 1 else 0.0
    return Classification(hardware=eta > threshold, sensor=np.ones(len(eta), bool))


def classify_by_truth(faults: Faults) -> Classification:
    """Perfect classifier: the truth."""
    return Classification(hardware=faults.has_hardware_fault, sensor=faults.has_sensor_fault)


class FaultTrees:
    """Decision trees for hardware faults and for sensor faults.

    Parameters
    ----------
    features : ndarray of shape (N, K + 1)
        Of an artificial fleet made like the fleet to be classified. [A^2]
    faults : Faults
        The truth about it.
    """

    def __init__(self, features: Array, faults: Faults) -> None:
        self._hardware = _fit_tree(features, faults.has_hardware_fault)
        self._sensor = _fit_tree(features, faults.has_sensor_fault)

    def classify(self, features: Array) -> Classification:
        """Classify vehicles by features of shape (N, K + 1). [A^2]"""
        return Classification(
            hardware=np.asarray(self._hardware.predict(features), bool),
            sensor=np.asarray(self._sensor.predict(features), bool),
        )


def _fit_tree(features: Array, faulty: Mask) -> DecisionTreeClassifier:
    weight = {False: 1.0, True: RECALL_WEIGHT}
    tree = DecisionTreeClassifier(max_depth=TREE_DEPTH, criterion="entropy", class_weight=weight, random_state=0)
    return tree.fit(features, faulty)
