"""The filter bank that is chosen for known vehicles follows them, and finds a pole that they share."""

import numpy as np
import pytest

from calibrator.drives.align import Samples
from calibrator.estimator.fleet_identification import choose_filter_bank
from calibrator.published.state_space import StateSpaceModel, simulation_snr_db
from tests.calibrator.estimator.dynamic_vehicles import PERIOD_S, bank_model, drive_inputs, recorded

LEAD_IN = 600
GAINS = np.random.default_rng(0).normal(size=(4, 3))


def pool(models: list[StateSpaceModel], *, samples: int = 6000, snr_db: float = 30.0) -> list[list[Samples]]:
    return [[recorded(j, snr_db=snr_db, samples=samples, model=model).samples] for j, model in enumerate(models)]


def lagging_vehicle(*poles: float) -> StateSpaceModel:
    """A vehicle with one pole, or static."""
    n = len(poles)
    return StateSpaceModel(
        A=np.diag(poles),
        B=np.array([[1.0, -0.5, 0.3]])[:n] * (1.0 - np.array(poles))[:, None],
        C=GAINS[:, :n],
        D=np.zeros((4, 3)) if n else GAINS,
        x0=np.zeros(n),
        offset_a=np.ones(4),
        snr_db=np.zeros(4),
    )


@pytest.mark.parametrize(
    ("snr_db", "median_db", "worst_db", "slope"), [(20.0, 40.0, 38.0, 3e-3), (40.0, 54.0, 45.0, 5e-4)]
)
def test_vehicles_whose_poles_differ_are_followed_by_the_bank_of_others(
    snr_db: float, median_db: float, worst_db: float, slope: float
) -> None:
    bank = choose_filter_bank([[recorded(j, snr_db=snr_db).samples] for j in range(100, 106)], period_s=PERIOD_S)
    vehicles = [recorded(j, snr_db=snr_db) for j in range(10)]
    unity, slopes, errors_db = drive_inputs(999), [], []
    for vehicle in vehicles:
        models = (vehicle.model, bank_model(bank, vehicle.samples))
        true, simulated = (model.simulate(unity)[LEAD_IN:] for model in models)
        centred = true - true.mean(axis=0)
        slopes.append(np.sum(centred * simulated, axis=0) / np.sum(centred**2, axis=0))
        errors_db.append(float(simulation_snr_db(true, simulated).min()))
    assert np.percentile(np.abs(np.concatenate(slopes) - 1.0), 95) < slope
    assert np.median(errors_db) > median_db
    assert min(errors_db) > worst_db


def test_one_common_pole_is_found_through_the_noise_and_beside_an_input_that_stands_still() -> None:
    vehicles = pool([lagging_vehicle(0.95)] * 3, snr_db=20.0)
    bank = choose_filter_bank(vehicles, period_s=PERIOD_S)
    ((pole, imag),) = bank.poles
    assert pole == pytest.approx(0.95, abs=0.002)
    assert imag == 0.0
    assert choose_filter_bank(vehicles, period_s=PERIOD_S) == bank
    for (drive,) in vehicles:
        drive.inputs[:, 2] = 5.0
    assert choose_filter_bank(vehicles, period_s=PERIOD_S).poles != ()
