"""The published method on the simulations of a real fleet, where nobody knows the truth.

The trees of section III-B of [1]_ need an artificial fleet to learn from. It is made on the fleet's own reference, with
the sparsity and magnitudes that the user expects, with the simulation error that the fleet's models show on held-out
data, and with the error that the mean of as many vehicles has when the fleet is not symmetric.

.. [1] "Measurement Correction for Electric Vehicles Based on Compressed Sensing".
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calibrator.artificial.random_fleet import draw_faults
from calibrator.drive import Array, Mask
from calibrator.faults import Faults, slopes_and_intercepts
from calibrator.options import Classifier
from calibrator.published.classify import Classification, FaultTrees, classify_by_threshold, classify_by_truth
from calibrator.published.evidence import FleetEvidence, collect_evidence, fleet_mean
from calibrator.published.recovery import Recovery, recover_fleet
from calibrator.random_streams import Purpose, random_stream

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
    symmetric : bool
        Whether the mean of the fleet is the ideal vehicle (22).
    seed : int
        Seed of the training fleet.
    """

    sparsity: float
    magnitude: tuple[float, float]
    symmetric: bool
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
        classification = classify_by_threshold(evidence.features, in_reference)
    else:
        classification = _classify_by_tree(
            evidence,
            reference,
            simulation_error_a,
            full_scale_a=full_scale_a,
            expected=expected,
            reference_vehicles=int(in_reference.sum()),
        )
    return recover_fleet(evidence, classification, full_scale_a=full_scale_a)


def expected_features(
    faults: Faults, i_s: Array, simulation_error_a: Array, *, reference_vehicles: int | None
) -> Array:
    """Features (5) and (6) that vehicles with given faults have, from the moments of the ideal currents.

    Parameters
    ----------
    faults : Faults
        Of N vehicles.
    i_s : ndarray of shape (T, K)
        Ideal currents on the unity drive. [A]
    simulation_error_a : ndarray of shape (K,)
        Standard deviation of the simulation error. [A]
    reference_vehicles : int or None
        So many vehicles in a row share their mean as their reference (3); None: the reference is the ideal current.

    Returns
    -------
    ndarray of shape (N, K + 1)
        Features. [A^2]
    """
    a, b = slopes_and_intercepts(faults)
    mean, moment = np.mean(i_s, axis=0), i_s.T @ i_s / len(i_s)
    constant = b.sum(axis=1)
    junction = np.einsum("nk,kl,nl->n", a, moment, a) + 2.0 * constant * (a @ mean) + constant**2
    if reference_vehicles is None:
        slope, intercept = a - 1.0, b
    else:
        slope, intercept = a - _mean_of_groups(a, reference_vehicles), b - _mean_of_groups(b, reference_vehicles)
    deviation = slope**2 * np.diag(moment) + 2.0 * slope * intercept * mean + intercept**2 + simulation_error_a**2
    return np.column_stack([deviation, junction])


def _mean_of_groups(values: Array, size: int) -> Array:
    """Mean over each group of rows in a row, repeated for its rows; what is left over belongs to the last group."""
    group = np.minimum(np.arange(len(values)) // size, max(len(values) // size - 1, 0))
    return np.stack([values[group == number].mean(axis=0) for number in range(group[-1] + 1)])[group]


def _classify_by_tree(
    evidence: FleetEvidence,
    reference: Array,
    simulation_error_a: Array,
    *,
    full_scale_a: float,
    expected: ExpectedFaults,
    reference_vehicles: int,
) -> Classification:
    i_s = reference - reference.mean(axis=1, keepdims=True)
    faults = draw_faults(
        random_stream(Purpose.TRAINING_FAULTS, expected.seed),
        vehicles=TRAINING_VEHICLES,
        branches=evidence.branches,
        sparsity=expected.sparsity,
        magnitude=expected.magnitude,
        full_scale_a=full_scale_a,
        balanced=True,
    )
    features = expected_features(
        faults, i_s, simulation_error_a, reference_vehicles=None if expected.symmetric else reference_vehicles
    )
    return FaultTrees(features, faults).classify(evidence.features)
