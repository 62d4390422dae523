"""Signs and units by the junction sum, on numbers."""

from itertools import product

import numpy as np
import pytest

from calibrator.doctor.bands import Bands
from calibrator.doctor.multipliers import Known, explanations
from calibrator.drive import Array

RNG = np.random.default_rng(3)
MOTOR, HEATER = 40.0 * RNG.normal(size=400), 6.0 * RNG.normal(size=400)
TRUE = np.stack([-(MOTOR + HEATER), MOTOR, HEATER], axis=1) + 0.3 * RNG.normal(size=(400, 3))


def bands(current_a: Array) -> Bands:
    names = ("battery", "motor", "heater")[: current_a.shape[1]]
    return Bands(branches=names, current_a=current_a, block=np.arange(len(current_a)) // 40)


def known(current_a: Array, orientation: float = 0.0) -> Known:
    return Known(peak_share=np.abs(current_a).max(axis=0) / 400.0, source=0, orientation=orientation)


def test_currents_that_cancel_are_left_as_they_are() -> None:
    best, *_ = explanations(bands(TRUE), known(TRUE))
    assert best.changed == ()


@pytest.mark.parametrize(("branch", "factor"), list(product(range(3), (-1.0, 1e3, 1e-3, 1e2, -1e-3))))
def test_one_wrong_branch_is_found_with_its_multiplier(branch: int, factor: float) -> None:
    put_in = np.ones(3)
    put_in[branch] = factor
    best, *_ = explanations(bands(TRUE * put_in), known(TRUE * put_in))
    np.testing.assert_allclose(best.multipliers * put_in, 1.0)


def test_two_branches_alone_need_the_voltage_to_tell_which_sign_is_wrong() -> None:
    two = np.stack([-MOTOR, MOTOR], axis=1) + 0.3 * RNG.normal(size=(400, 2))
    wrong = two * [1.0, -1.0]
    for orientation, multipliers in ((0.9, [1.0, -1.0]), (-0.9, [-1.0, 1.0])):
        best, *_ = explanations(bands(wrong), known(wrong, orientation))
        assert best.multipliers.tolist() == multipliers


def test_a_common_factor_changes_no_sign() -> None:
    for scale in (0.1, 1.0, 2.0):
        wrong = scale * TRUE * [1.0, 1.0, -1.0]
        best, *_ = explanations(bands(wrong), known(wrong))
        assert best.multipliers.tolist() == [1.0, 1.0, -1.0]


def test_currents_of_nothing_tell_nothing() -> None:
    nothing = np.zeros((400, 3))
    best, *_ = explanations(bands(nothing), known(nothing))
    assert best.changed == ()


def test_unrelated_currents_are_left_as_they_are() -> None:
    unrelated = 30.0 * RNG.normal(size=(400, 3))
    best, *_ = explanations(bands(unrelated), known(unrelated))
    assert best.changed == ()
