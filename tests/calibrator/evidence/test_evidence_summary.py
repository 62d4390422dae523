from dataclasses import replace

import numpy as np
import pytest

from calibrator.drives.align import Samples
from calibrator.errors import DriveError
from calibrator.evidence.summary import BLOCK_S, summarise
from tests.calibrator.evidence.simulated_drives import PERIOD_S, Conditions, drive_of, no_faults, samples_of


def a_drive(seed: int, samples: int = 300, noise_a: float = 0.3) -> Samples:
    conditions = Conditions(samples=samples, noise_a=noise_a)
    return drive_of(np.random.default_rng(seed), no_faults(1, 3).take(0), conditions)


def test_moments_are_those_of_the_samples() -> None:
    drive = a_drive(1)
    summary = summarise([drive], period_s=PERIOD_S)
    columns = np.column_stack([drive.inputs, drive.currents_a, np.ones(300)])
    np.testing.assert_allclose(summary.total, columns.T @ columns)
    np.testing.assert_allclose(summary.mean_a, drive.currents_a.mean(axis=0))
    np.testing.assert_allclose(summary.mean_product_a2, drive.currents_a.T @ drive.currents_a / 300)
    assert summary.moments.shape[0] == 300 * PERIOD_S / BLOCK_S
    assert summary.duration_s == 300.0


def test_summaries_of_drives_add_up() -> None:
    first, second = a_drive(2), a_drive(3)
    both = summarise([first, second], period_s=PERIOD_S)
    alone = [summarise([drive], period_s=PERIOD_S).total for drive in (first, second)]
    np.testing.assert_allclose(both.total, sum(alone))


def test_samples_that_are_not_valid_take_no_part() -> None:
    drive = a_drive(4)
    valid, currents = drive.valid.copy(), drive.currents_a.copy()
    valid[5:20], currents[5:20] = False, np.nan
    summary = summarise([replace(drive, valid=valid, currents_a=currents)], period_s=PERIOD_S)
    np.testing.assert_allclose(summary.mean_a, drive.currents_a[valid].mean(axis=0))
    assert np.isfinite(summary.moments).all()


def test_branches_can_be_taken_in_another_order() -> None:
    drive = a_drive(5)
    order = [2, 0, 1]
    taken = summarise([drive], period_s=PERIOD_S).take_branches(order)
    direct = summarise([replace(drive, currents_a=drive.currents_a[:, order])], period_s=PERIOD_S)
    np.testing.assert_allclose(taken.moments, direct.moments)
    np.testing.assert_allclose(taken.noise_a2, direct.noise_a2)


@pytest.mark.parametrize("samples", [30, 300])
def test_white_noise_is_measured_without_bias(samples: int) -> None:
    rng = np.random.default_rng(6)
    variance = [
        summarise([samples_of(np.zeros((samples, 0)), rng.normal(0.0, 2.0, (samples, 2)))], period_s=PERIOD_S).noise_a2
        for _ in range(400)
    ]
    assert np.mean(np.concatenate(variance)) == pytest.approx(4.0, rel=0.03)


def test_slow_currents_are_not_taken_for_noise() -> None:
    t = np.arange(600.0)
    currents = np.column_stack([100.0 * np.sin(t / 30.0), np.zeros(600)])
    assert summarise([samples_of(np.zeros((600, 0)), currents)], period_s=PERIOD_S).noise_a2.max() < 1e-3


def test_a_drive_without_enough_valid_samples_is_refused() -> None:
    drive = a_drive(7, samples=60)
    with pytest.raises(DriveError, match="no 30 s of drive in which 20% of the samples are valid"):
        summarise([replace(drive, valid=np.zeros(60, bool))], period_s=PERIOD_S)
