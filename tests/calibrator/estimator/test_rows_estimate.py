"""From evidence rows to estimates: right where they are sure, each vehicle by itself, harmless in odd worlds."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from calibrator.drive import Array, Mask
from calibrator.estimator.decision import RowsEstimate, estimate_rows
from calibrator.estimator.evidence import EvidenceRows
from calibrator.estimator.fleet_estimate import HARM_LIMIT
from calibrator.estimator.learning import learn_fault_models
from calibrator.faults import Faults
from calibrator.score import harmed, recovered
from tests.calibrator.estimator.simulated_drives import no_faults
from tests.calibrator.estimator.simulated_rows import random_faults, rows_of

VARIANCE = 0.04
"""Of the currents, in squares of full scale."""


def moments(rows: EvidenceRows) -> dict[str, Any]:
    mean, ideal = rows.means[:, 1], rows.means[0, 0]
    return {"mean": mean, "mean_square": mean**2 + VARIANCE, "usual": np.stack([ideal, ideal**2 + VARIANCE])}


def estimated(faults: Faults, *, seed: int, load: Array | float = 0.0) -> tuple[RowsEstimate, Faults]:
    """Estimate, and what of it would be deployed."""
    rows = rows_of(faults, seed=seed, load=load)
    found = estimate_rows(rows, learn_fault_models(rows, feed=0), feed=0, **moments(rows))
    deployed = found.identifiable & (found.harm_probability < HARM_LIMIT)
    none = no_faults(*faults.drift.shape)
    return found, replace(none, drift=found.drift * deployed, offset_a=found.offset_a * deployed)


def worse(deployed: Faults, faults: Faults) -> Mask:
    """Whether any branch of a vehicle is worse on another drive."""
    mean = np.full(faults.drift.shape, 0.05)
    return harmed(deployed, faults, mean_a=mean, mean_square_a2=mean**2 + VARIANCE)


@pytest.mark.parametrize("magnitude", [(0.01, 0.05), (0.3, 0.6), pytest.param((0.05, 0.25), marks=pytest.mark.long)])
@pytest.mark.parametrize("K", [2, pytest.param(3, marks=pytest.mark.long)])
def test_faults_are_recovered_and_corrected_whatever_their_size(K: int, magnitude: tuple[float, float]) -> None:
    faults = random_faults(1, vehicles=40, branches=K, magnitude=magnitude)
    found, deployed = estimated(faults, seed=1)
    estimate = replace(no_faults(40, K), drift=found.drift, offset_a=found.offset_a)
    right = recovered(estimate, faults, full_scale_a=1.0, smallest_fault=magnitude[0])
    assert right.mean() >= 0.9
    assert not worse(deployed, faults).any()
    faulty = (faults.drift != 0.0) | (faults.offset_a != 0.0)
    assert ((deployed.drift != 0.0) | (deployed.offset_a != 0.0))[faulty].mean() > 0.8
    spread = np.sqrt(np.sum(found.confidence * (1.0 - found.confidence)))
    assert abs(right.sum() - found.confidence.sum()) < 3.0 * spread + 1.0


@pytest.mark.parametrize(
    ("shared", "size", "share"),
    [
        ("offset", 0.05, 0.6),
        ("load", 0.025, 0.15),
        ("gain", 0.04, 1.0),
        pytest.param("offset", 0.0125, 1.0, marks=pytest.mark.long),
        pytest.param("load", 0.0125, 1.0, marks=pytest.mark.long),
    ],
)
def test_what_a_batch_of_sensors_or_a_load_makes_alike_makes_no_vehicle_worse(
    shared: str, size: float, share: float
) -> None:
    faults, some = random_faults(2, vehicles=24, branches=2), np.arange(24) < 24 * share
    if shared == "offset":
        faults.offset_a[some, 0] += size
    elif shared == "gain":
        faults.drift[some, 1] = (1.0 + size) * (1.0 + faults.drift[some, 1]) - 1.0
    found, deployed = estimated(faults, seed=2, load=size * some * (shared == "load"))
    assert not worse(deployed, faults).any()
    assert shared == "gain" or np.abs(found.offset_a[:, 1] - faults.offset_a[:, 1]).max() < 0.01


def test_standard_deviations_are_those_of_the_errors() -> None:
    faults = random_faults(6, vehicles=80, branches=2)
    found, _ = estimated(faults, seed=6)
    truth = np.hstack([faults.drift, faults.offset_a])
    error, sd = np.hstack([found.drift, found.offset_a]) - truth, np.hstack([found.drift_sd, found.offset_sd_a])
    sure = (found.confidence > 0.95)[:, None] & (truth != 0.0)
    within = np.abs(error[sure]) / sd[sure]
    assert 0.55 < (within < 1.0).mean() < 0.95
    assert (within > 3.5).mean() < 0.02
