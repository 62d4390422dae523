import math

import numpy as np
import pytest
from cantools.database.can import Signal
from cantools.database.conversion import BaseConversion

from calibrator.recordings.signal_range import signal_range, signal_ranges
from ecu_node.database import VehicleDatabase


def signal(minimum: float | None, maximum: float | None) -> Signal:
    conversion = BaseConversion.factory(scale=0.02, offset=0, is_float=False)
    return Signal("S", 0, 16, minimum=minimum, maximum=maximum, conversion=conversion)


@pytest.mark.parametrize(
    ("minimum", "maximum", "low", "high"),
    [
        (-5.0, 7.0, -5.0, 7.0),
        (None, 7.0, -math.inf, 7.0),
        (0, 0, -math.inf, math.inf),
        (None, None, -math.inf, math.inf),
    ],
)
def test_range_is_what_the_dbc_says(minimum: float | None, maximum: float | None, low: float, high: float) -> None:
    limits = signal_range(signal(minimum, maximum))
    assert (limits.low, limits.high) == (low, high)


def test_a_negative_factor_turns_the_range_round() -> None:
    limits = signal_range(signal(-5.0, 7.0), -2.0)
    assert (limits.low, limits.high) == (-14.0, 10.0)


def test_limits_hold_with_rounding_and_nothing_beyond_does() -> None:
    value = np.array([-5.0, 7.0 + 1e-9, 7.02, -5.02, np.nan, np.inf])
    assert signal_range(signal(-5.0, 7.0)).holds(value).tolist() == [True, True, False, False, False, False]


def test_ranges_of_a_layout_are_in_its_signs(database: VehicleDatabase) -> None:
    ranges = signal_ranges(database)
    assert (ranges["motor"].low, ranges["motor"].high) == (-650.0, 650.0)
    assert (ranges["accelerator"].low, ranges["accelerator"].high) == (0.0, 100.0)
