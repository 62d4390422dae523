from itertools import product

import numpy as np
import pytest

from calibrator.drive import Array
from calibrator.drives.charge import Band, ChargeCurve, charge_curve
from calibrator.drives.delay_search import LAG_STEP_S, search_lags
from tests.calibrator.drives.delayed_drives import MadeUp, made_up_drive

BAND = Band(short_s=0.2, long_s=5.0)
BRANCHES = ("battery", "motor", "motor_rear")
MAX_DELAY_S = 0.1


def curves_of(seed: int, vehicle: MadeUp) -> tuple[ChargeCurve, ...]:
    curves = [charge_curve(made_up_drive(seed, vehicle).branches[name]) for name in BRANCHES]
    return tuple(curve for curve in curves if curve is not None)


def best_of_all_combinations(curves: tuple[ChargeCurve, ...]) -> Array:
    """Every pair of lags, each with its own least-squares gains."""
    lags_s = np.arange(-5, 6) * LAG_STEP_S
    time_s = np.arange(6.0, 94.0, 0.1)
    target = curves[0].band(time_s, BAND)[0]
    bands = [{lag: curve.band(time_s + lag, BAND)[0] for lag in lags_s} for curve in curves[1:]]

    def residual(lags: tuple[float, float]) -> float:
        x = np.column_stack([band[lag] for band, lag in zip(bands, lags, strict=True)])
        return float(np.sum((target - x @ np.linalg.lstsq(x, target)[0]) ** 2))

    return np.array(min(product(lags_s, lags_s), key=residual))


@pytest.mark.parametrize("seed", range(4))
def test_branches_that_do_much_the_same_get_the_lags_that_all_combinations_give(seed: int) -> None:
    vehicle = MadeUp(
        size_a={"motor": 50.0, "motor_rear": 80.0},
        delay_s={"battery": 0.1, "motor": 0.172, "motor_rear": 0.035},
        noise_a=0.2,
        alike=0.95,
        duration_s=100.0,
    )
    curves = curves_of(seed, vehicle)
    found = search_lags([curves], BAND, MAX_DELAY_S)
    np.testing.assert_allclose(found, best_of_all_combinations(curves), atol=LAG_STEP_S * 1.01)
    np.testing.assert_allclose(found, [0.072, -0.065], atol=1.5 * LAG_STEP_S)
