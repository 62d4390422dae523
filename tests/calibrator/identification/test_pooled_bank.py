from dataclasses import replace

import numpy as np
import pytest

from calibrator.artificial.dynamic_vehicles import INPUT_NAMES, PERIOD_S, dynamic_vehicle, recorded
from calibrator.drives.align import Samples
from calibrator.errors import DriveError
from calibrator.identification.pooled_bank import LONGEST_S, pooled_bank
from calibrator.identification.state_space import StateSpaceModel

RNG = np.random.default_rng(0)
GAINS = RNG.normal(size=(4, 3))


def pool(models: list[StateSpaceModel], *, samples: int = 6000, snr_db: float = 30.0) -> list[list[Samples]]:
    return [[recorded(j, snr_db=snr_db, samples=samples, model=model).samples] for j, model in enumerate(models)]


def static_vehicle() -> StateSpaceModel:
    return StateSpaceModel(
        A=np.zeros((0, 0)),
        B=np.zeros((0, 3)),
        C=np.zeros((4, 0)),
        D=GAINS,
        x0=np.zeros(0),
        offset_a=np.ones(4),
        snr_db=np.zeros(4),
    )


def lagging_vehicle(pole: float) -> StateSpaceModel:
    return StateSpaceModel(
        A=np.array([[pole]]),
        B=np.array([[1.0, -0.5, 0.3]]) * (1.0 - pole),
        C=GAINS[:, :1],
        D=np.zeros((4, 3)),
        x0=np.zeros(1),
        offset_a=np.ones(4),
        snr_db=np.zeros(4),
    )


def test_vehicles_without_dynamics_get_the_plain_inputs() -> None:
    bank = pooled_bank(pool([static_vehicle()] * 3), period_s=PERIOD_S)
    assert bank.poles == ()
    assert bank.input_names == INPUT_NAMES


def test_one_common_pole_is_found_through_the_noise() -> None:
    bank = pooled_bank(pool([lagging_vehicle(0.95)] * 3, snr_db=20.0), period_s=PERIOD_S)
    ((pole, imag),) = bank.poles
    assert pole == pytest.approx(0.95, abs=0.002)
    assert imag == 0.0


def test_a_resonance_that_differs_between_vehicles_is_covered_from_both_sides() -> None:
    bank = pooled_bank(pool([dynamic_vehicle(j) for j in range(4)]), period_s=PERIOD_S)
    angles = np.angle(bank.complex_poles[bank.complex_poles.imag > 0.0]) / (2.0 * np.pi * PERIOD_S)
    true = np.sqrt(1.0 - 0.35**2) * 0.5
    assert angles.min() < true < angles.max()
    assert bank.settling * PERIOD_S < 4.0 * LONGEST_S


def test_the_choice_is_the_same_every_time() -> None:
    vehicles = pool([dynamic_vehicle(j) for j in range(2)], samples=3000)
    assert pooled_bank(vehicles, period_s=PERIOD_S) == pooled_bank(vehicles, period_s=PERIOD_S)


def test_an_input_that_stands_still_in_all_vehicles_does_no_harm() -> None:
    vehicles = pool([lagging_vehicle(0.9)] * 2)
    for (drive,) in vehicles:
        drive.inputs[:, 2] = 5.0
    assert pooled_bank(vehicles, period_s=PERIOD_S).poles != ()


def test_drives_too_short_to_hold_a_block_out_are_refused() -> None:
    with pytest.raises(DriveError, match="none of 2 vehicles has three blocks of varied, valid samples"):
        pooled_bank(pool([static_vehicle()] * 2, samples=400), period_s=PERIOD_S)


def test_drives_without_a_valid_sample_are_refused() -> None:
    ((drive,),) = pool([static_vehicle()], samples=2000)
    with pytest.raises(DriveError, match="none of 1 vehicles has three blocks of varied, valid samples"):
        pooled_bank([[replace(drive, valid=np.zeros(2000, bool))]], period_s=PERIOD_S)
