"""Classify vehicles: is the vehicle itself faulty, and is any of its sensors? Section III-B of [1]_.

Two rules use the features, equations (5) and (6) of [1]_: a threshold, and decision trees that learn from an artificial
fleet. The truth about a real fleet is not known, so the artificial fleet imitates it: it has the real fleet's reference
as ideal currents, the sparsity and magnitudes that are expected, the simulation error of the models on held-out data,
and the error that the mean of as many vehicles has when the fleet is not symmetric.

.. [1] "Measurement Correction for Electric Vehicles Based on Compressed Sensing".
"""

from dataclasses import dataclass

import numpy as np
from sklearn.tree import DecisionTreeClassifier

from calibrator.artificial.random_fleet import FaultSettings, Purpose, random_stream
from calibrator.drive import Array, Mask
from calibrator.faults import Faults, slopes_and_intercepts

__all__ = [
    "TRAINING_VEHICLES", "Classification", "classify_by_expected_trees", "classify_by_threshold", "classify_by_trees",
    "classify_by_truth", "decision_criterion", "expected_features",
]  # fmt: skip

TRAINING_VEHICLES = 3000
"""Size of the artificial fleet that the trees learn from, section V-B. [1]"""

THRESHOLD_SHARE = 1.0 / 3.0
"""Threshold delta_h over the standard deviation of the criterion across the fleet, section V-B. [1]"""
TREE_DEPTH = 6
"""Largest depth of a tree, against overfitting, section V-B. [1]"""
RECALL_WEIGHT = 5.0
"""Weight of a missed fault against a false alarm. The paper judges by f2, which is largest if a vehicle counts as
faulty above a probability of f2 / (1 + 2^2), that is at odds of 1:5 for the paper's f2 of 0.84. [1]"""


@dataclass(frozen=True, kw_only=True)
class Classification:
    """Classes of N vehicles.

    Attributes
    ----------
    hardware, sensor : ndarray of bool of shape (N,)
        Whether the vehicle itself, and whether any of its sensors, is taken as faulty.
    """

    hardware: Mask
    sensor: Mask


def decision_criterion(features: Array) -> Array:
    """Compute eta of equation (7) of the paper: the estimated mean square of what hardware faults add to the currents.

    Parameters
    ----------
    features : ndarray of shape (N, K + 1)
        Equations (5) and (6) of the paper, ``features`` of :class:`~calibrator.published.evidence.FleetEvidence`.
        [A^2]

    Returns
    -------
    ndarray of shape (N,)
        Criterion. [A^2]
    """
    K = features.shape[1] - 1
    return np.asarray(features[:, :K].sum(axis=1) - features[:, K] / K)


def classify_by_threshold(features: Array) -> Classification:
    """Classify vehicles by a threshold on the criterion, equations (7) and (27) of the paper.

    The paper gives no threshold for sensor faults, so every vehicle is taken to have some: their sizes are then
    estimated for all vehicles, and come out nearly zero for healthy sensors.

    Parameters
    ----------
    features : ndarray of shape (N, K + 1)
        Features of the whole fleet, equations (5) and (6) of the paper. [A^2]

    Returns
    -------
    Classification
        Hardware faults where the criterion is above a third of its standard deviation.
    """
    eta = decision_criterion(features)
    return Classification(hardware=eta > THRESHOLD_SHARE * eta.std(ddof=1), sensor=np.ones(len(eta), bool))


def classify_by_truth(faults: Faults) -> Classification:
    """Classify vehicles perfectly, by their true faults."""
    return Classification(hardware=faults.has_hardware_fault, sensor=faults.has_sensor_fault)


def classify_by_trees(learnt: Array, truth: Faults, features: Array) -> Classification:
    """Classify vehicles by two decision trees, for hardware faults and for sensor faults.

    Parameters
    ----------
    learnt : ndarray of shape (N', K + 1)
        Features, equations (5) and (6) of the paper, of an artificial fleet made like the fleet to be classified.
        [A^2]
    truth : Faults
        Faults of the N' vehicles of the artificial fleet.
    features : ndarray of shape (N, K + 1)
        Features of the fleet to be classified. [A^2]
    """

    def found(faulty: Mask) -> Mask:
        weight = {False: 1.0, True: RECALL_WEIGHT}
        tree = DecisionTreeClassifier(max_depth=TREE_DEPTH, criterion="entropy", class_weight=weight, random_state=0)
        return np.asarray(tree.fit(learnt, faulty).predict(features), bool)

    return Classification(hardware=found(truth.has_hardware_fault), sensor=found(truth.has_sensor_fault))


def expected_features(faults: Faults, i_s: Array, simulation_error_a: Array, *, reference_vehicles: int) -> Array:
    """Compute the features of vehicles with given faults from the moments of the ideal currents.

    Features are those of equations (5) and (6) of the paper.

    Parameters
    ----------
    faults : Faults
        Faults of N vehicles.
    i_s : ndarray of shape (T, K)
        Ideal currents on the unity drive. [A]
    simulation_error_a : ndarray of shape (K,)
        Standard deviation of the simulation error. [A]
    reference_vehicles : int
        Each group of so many consecutive vehicles has its mean as reference, equation (3) of the paper.

    Returns
    -------
    ndarray of shape (N, K + 1)
        Features. [A^2]
    """
    a, b = slopes_and_intercepts(faults)
    mean, moment = np.mean(i_s, axis=0), i_s.T @ i_s / len(i_s)
    constant = b.sum(axis=1)
    junction = np.einsum("nk,kl,nl->n", a, moment, a) + 2.0 * constant * (a @ mean) + constant**2
    slope, intercept = (values - _mean_of_groups(values, reference_vehicles) for values in (a, b))
    deviation = slope**2 * np.diag(moment) + 2.0 * slope * intercept * mean + intercept**2 + simulation_error_a**2
    return np.column_stack([deviation, junction])


def _mean_of_groups(values: Array, size: int) -> Array:
    """Replace each row by the mean of its group of ``size`` consecutive rows; left-over rows join the last group."""
    group = np.minimum(np.arange(len(values)) // size, max(len(values) // size - 1, 0))
    return np.stack([values[group == number].mean(axis=0) for number in range(group[-1] + 1)])[group]


def classify_by_expected_trees(
    features: Array,
    reference: Array,
    simulation_error_a: Array,
    *,
    full_scale_a: float,
    expected: FaultSettings,
    reference_vehicles: int,
) -> Classification:
    """Classify a real fleet by decision trees that learn from an artificial fleet with the expected faults.

    Parameters
    ----------
    features : ndarray of shape (N, K + 1)
        Features of the real fleet, equations (5) and (6) of the paper. [A^2]
    reference : ndarray of shape (T, K)
        Fleet reference. [A]
    simulation_error_a : ndarray of shape (K,)
        Standard deviation of the simulation error. [A]
    full_scale_a : float
        Full scale of the junction. [A]
    expected : FaultSettings
        How the faults of the artificial fleet are drawn.
    reference_vehicles : int
        Number of vehicles whose mean is the reference.
    """
    i_s, rng = reference - reference.mean(axis=1, keepdims=True), random_stream(Purpose.TRAINING_FAULTS, 0)
    K = reference.shape[1]
    faults = expected.draw(rng, vehicles=TRAINING_VEHICLES, branches=K, full_scale_a=full_scale_a)
    learnt = expected_features(faults, i_s, simulation_error_a, reference_vehicles=reference_vehicles)
    return classify_by_trees(learnt, faults, features)
