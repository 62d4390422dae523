import numpy as np
import pytest

from calibrator.drive import Array
from calibrator.faults import Faults, measured_currents, true_currents
from calibrator.options import Classifier
from calibrator.published.classify import ExpectedFaults, expected_features
from calibrator.published.evidence import collect_evidence
from calibrator.published.recovery import calibrate_published
from calibrator.score import f2_score, recovered
from tests.calibrator.estimator.simulated_rows import random_faults

FULL_SCALE_A = 400.0
EXPECTED = ExpectedFaults(sparsity=80.0, magnitude=(0.05, 0.25), symmetric=True, seed=0)


def ideal_currents(samples: int = 400) -> Array:
    rng = np.random.default_rng(1)
    battery = 60.0 + np.cumsum(rng.normal(0.0, 8.0, size=samples)) % 120.0
    auxiliary = -10.0 - 5.0 * (np.arange(samples) % 100 > 50)
    return np.column_stack([battery, -battery - auxiliary, auxiliary])


def fleet(vehicles: int, *, symmetric: bool, seed: int = 2) -> Faults:
    return random_faults(seed, vehicles=vehicles, branches=3, full_scale_a=FULL_SCALE_A, symmetric=symmetric)


def measured(i_s: Array, faults: Faults, noise_a: float = 0.0) -> Array:
    rng = np.random.default_rng(3)
    clean = [measured_currents(true_currents(i_s, faults.take(j)), faults.take(j)) for j in range(len(faults))]
    return np.stack(clean) + rng.normal(0.0, noise_a, size=(len(faults), *i_s.shape))


def test_expected_features_follow_the_mean_of_a_fleet_that_is_not_symmetric() -> None:
    i_s, faults = ideal_currents(), fleet(40, symmetric=False)
    simulated = measured(i_s, faults)
    evidence = collect_evidence(simulated, simulated.mean(axis=0), np.mean(simulated.sum(axis=2) ** 2, axis=1))
    expected = expected_features(faults, i_s, np.zeros(3), reference_vehicles=40)
    np.testing.assert_allclose(evidence.features, expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(("classifier", "least"), [(Classifier.PERFECT, 0.9), (Classifier.TREE, 0.8)])
def test_symmetric_fleet_is_recovered(classifier: Classifier, least: float) -> None:
    i_s, faults = ideal_currents(), fleet(120, symmetric=True)
    simulated = measured(i_s, faults, noise_a=0.05)
    recovery = calibrate_published(
        list(simulated),
        junction_a2=np.mean(simulated.sum(axis=2) ** 2, axis=1),
        in_reference=np.ones(120, bool),
        simulation_error_a=np.full(3, 0.05),
        full_scale_a=FULL_SCALE_A,
        classifier=classifier,
        expected=EXPECTED,
        truth=faults if classifier is Classifier.PERFECT else None,
    )
    within = recovered(recovery.faults, faults, full_scale_a=FULL_SCALE_A, smallest_fault=0.05)
    assert within.mean() >= least
    assert f2_score(recovery.classification.hardware, faults.has_hardware_fault) >= least


def test_vehicle_held_out_of_the_reference_does_not_move_the_others() -> None:
    i_s, faults = ideal_currents(), fleet(40, symmetric=True)
    simulated = measured(i_s, faults)
    wild = simulated.copy()
    wild[7] *= 3.0

    def recover(currents: Array) -> Faults:
        return calibrate_published(
            list(currents),
            junction_a2=np.mean(currents.sum(axis=2) ** 2, axis=1),
            in_reference=np.arange(40) != 7,
            simulation_error_a=np.full(3, 0.1),
            full_scale_a=FULL_SCALE_A,
            classifier=Classifier.PERFECT,
            expected=EXPECTED,
            truth=faults,
        ).faults

    others = np.arange(40) != 7
    np.testing.assert_array_equal(recover(simulated).drift[others], recover(wild).drift[others])
