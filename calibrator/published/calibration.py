"""The published method on the simulations of a real fleet, where nobody knows the truth.

The trees of section III-B of [1]_ need an artificial fleet to learn from. It is made on the fleet's own reference, with
the sparsity and magnitudes that the user expects, and with the simulation error that the fleet's models show on
held-out data.

.. [1] "Measurement Correction for Electric Vehicles Based on Compressed Sensing".
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calibrator.drive import Array, Mask
from calibrator.faults import Faults, slopes_and_intercepts
from calibrator.options import Classifier
from calibrator.published.classify import Classification, FaultTrees, classify_by_threshold, classify_by_truth
from calibrator.published.evidence import FleetEvidence, collect_evidence, fleet_mean
from calibrator.published.recovery import Recovery, recover_fleet
from calibrator.random_fleet import draw_faults

__all__ = ["ExpectedFaults", "calibrate_published", "expected_features"]

TRAINING_VEHICLES = 3000
"""Size of the artificial fleet that the trees learn from, section V-B of [1]_."""


@dataclass(frozen=True, kw_only=True)
class ExpectedFaults:
    """What the user expects the fleet's faults to be like; the trees are trained on it.

    Attributes
    ----------
    sparsity : float
        Sparsity level S. [%]
    magnitude : tuple of float
        Range of drifts [1] and of offsets in fractions of full scale.
    seed : int
        Seed of the training fleet.
    """

    sparsity: float
    magnitude: tuple[float, float]
    seed: int


def calibrate_published(
    simulated: Sequence[Array],
    *,
    junction_a2: Array,
    in_reference: Mask,
    simulation_error_a: Array,
    full_scale_a: float,
    classifier: Classifier,
    expected: ExpectedFaults,
    truth: Faults | None,
) -> Recovery:
    """Estimate the faults of a fleet with the paper's method.

    Parameters
    ----------
    simulated : sequence of N ndarrays of shape (T, K)
        Currents of every vehicle on the unity drive (2). [A]
    junction_a2 : ndarray of shape (N,)
        Mean square of each vehicle's measured junction sum (6). [A^2]
    in_reference : ndarray of bool of shape (N,)
        Vehicles whose mean is the fleet reference (3).
    simulation_error_a : ndarray of shape (K,)
        Standard deviation of the simulation error of each branch. [A]
    full_scale_a : float
        Full scale of the junction. [A]
    classifier : Classifier
        How hardware faults are told.
    expected : ExpectedFaults
        For the tree.
    truth : Faults or None
        Of the same vehicles, for the perfect classifier.

    Returns
    -------
    Recovery
        Faults of every vehicle, in the order given.
    """
    reference = fleet_mean(currents for currents, used in zip(simulated, in_reference, strict=True) if used)
    evidence = collect_evidence(simulated, reference, junction_a2)
    if classifier is Classifier.PERFECT:
        assert truth is not None
        classification = classify_by_truth(truth)
    elif classifier is Classifier.THRESHOLD:
        classification = classify_by_threshold(evidence.features)
    else:
        classification = _classify_by_tree(evidence, reference, simulation_error_a, full_scale_a, expected)
    return recover_fleet(evidence, classification, full_scale_a=full_scale_a)


def expected_features(faults: Faults, i_s: Array, simulation_error_a: Array) -> Array:
    """Features (5) and (6) that vehicles with given faults have, from the moments of the ideal currents.

    Parameters
    ----------
    faults : Faults
        Of N vehicles.
    i_s : ndarray of shape (T, K)
        Ideal currents on the unity drive. [A]
    simulation_error_a : ndarray of shape (K,)
        Standard deviation of the simulation error. [A]

    Returns
    -------
    ndarray of shape (N, K + 1)
        Features. [A^2]
    """
    a, b = slopes_and_intercepts(faults)
    mean, moment = np.mean(i_s, axis=0), i_s.T @ i_s / len(i_s)
    deviation = (a - 1.0) ** 2 * np.diag(moment) + 2.0 * (a - 1.0) * b * mean + b**2 + simulation_error_a**2
    constant = b.sum(axis=1)
    junction = np.einsum("nk,kl,nl->n", a, moment, a) + 2.0 * constant * (a @ mean) + constant**2
    return np.column_stack([deviation, junction])


def _classify_by_tree(
    evidence: FleetEvidence, reference: Array, simulation_error_a: Array, full_scale_a: float, expected: ExpectedFaults
) -> Classification:
    i_s = reference - reference.mean(axis=1, keepdims=True)
    faults = draw_faults(
        np.random.default_rng(expected.seed),
        vehicles=TRAINING_VEHICLES,
        branches=evidence.branches,
        sparsity=expected.sparsity,
        magnitude=expected.magnitude,
        full_scale_a=full_scale_a,
        balanced=True,
    )
    trees = FaultTrees(expected_features(faults, i_s, simulation_error_a), faults)
    return trees.classify(evidence.features)
