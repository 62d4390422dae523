"""What is told of a vehicle's evidence: the values are those of its faults, and the estimate explains them."""

from dataclasses import replace

import numpy as np
import pytest

from calibrator.drive import Array
from calibrator.evidence.vehicle_evidence import evidence_names
from calibrator.faults import Faults
from calibrator.posterior.calibration import calibrate_posterior
from calibrator.posterior.estimate import FleetPosterior
from calibrator.posterior.told_evidence import told_evidence
from tests.calibrator.evidence.simulated_drives import Conditions, no_faults, summaries_of

FULL_SCALE_A = 400.0
VEHICLES = 24


def known_faults() -> Faults:
    """A gain fault of the first sensor, an offset of the second, and the vehicle itself, each in one vehicle."""
    fleet = no_faults(VEHICLES, 3)
    fleet.drift[0, 0] = 0.1
    fleet.offset_a[1, 1] = 12.0
    fleet.hardware_drift[2] = 0.08
    return fleet


@pytest.fixture(scope="module")
def posterior() -> FleetPosterior:
    summaries = summaries_of(known_faults(), Conditions(model_error_a=0.2, unmeasured_a=2.0), seed=3)
    return calibrate_posterior(summaries, full_scale_a=FULL_SCALE_A)


def column(posterior: FleetPosterior, name: str) -> tuple[Array, Array, Array]:
    """Value, deviation and explanation of one row, shape (N,) each."""
    ordered = [f"b{k}" for k in posterior.order]
    r = evidence_names(ordered).index(name)
    found = told_evidence(posterior, full_scale_a=FULL_SCALE_A)
    value, sd = (np.array([getattr(item, what)[r] for item in found], float) for what in ("value", "sd"))
    return value, sd, np.array([item.explained[r] for item in found])


def test_slopes_are_those_of_sensor_and_vehicle(posterior: FleetPosterior) -> None:
    value, sd, _ = column(posterior, "slope b0")
    expected = np.ones(VEHICLES)
    expected[0], expected[2] = 1.1, 1.08
    assert np.abs((value - expected) / sd).max() < 5.0
    assert sd.max() < 0.02


def test_intercepts_are_in_ampere(posterior: FleetPosterior) -> None:
    value, sd, _ = column(posterior, "intercept b1")
    others = np.delete(value, 1)
    assert value[1] - np.median(others) == pytest.approx(12.0, abs=4.0 * sd[1])
    assert np.ptp(others) < 1.0


def test_the_junction_constant_holds_offsets_and_the_load_without_a_sensor(posterior: FleetPosterior) -> None:
    value, sd, explained = column(posterior, "junction constant")
    assert value[1] == pytest.approx(14.0, abs=4.0 * sd[1] + 0.2)
    assert np.median(explained) == pytest.approx(2.0, abs=0.2)


def test_the_estimate_explains_the_evidence_within_its_deviations(posterior: FleetPosterior) -> None:
    for name in ("slope b0", "slope b2", "intercept b0", "intercept b1", "junction constant"):
        value, sd, explained = column(posterior, name)
        assert np.sqrt(np.mean(((value - explained) / sd) ** 2)) < 1.6, name


def test_what_nobody_read_says_nothing(posterior: FleetPosterior) -> None:
    value, sd, _ = column(posterior, "offset read b0")
    assert np.isnan(value).all()
    assert np.isnan(sd).all()


def test_a_posterior_without_its_rows_tells_none(posterior: FleetPosterior) -> None:
    assert told_evidence(replace(posterior, rows=None), full_scale_a=FULL_SCALE_A) == []
