"""Independent streams of chance from one seed, by what they are for.

numpy pads seeds with zeros, so [7], [7, 0] and [7, 0, 0] give the same numbers. Here purpose and count stand in front,
so that no two purposes ever share a stream.
"""

from enum import IntEnum

import numpy as np

__all__ = ["Purpose", "random_stream"]


class Purpose(IntEnum):
    """What chance is for."""

    FAULTS = 1
    CALIBRATION_TRIP = 2
    UNSEEN_TRIP = 3
    FRAMES = 4
    SIMULATION_ERROR = 5
    TRAINING_FAULTS = 6
    TRAINING_ERROR = 7
    COMMON_DRIVE = 8
    ATTACK = 9
    START_OF_RUN = 10


def random_stream(purpose: Purpose, *numbers: int) -> np.random.Generator:
    """Return the generator of one purpose.

    Parameters
    ----------
    purpose : Purpose
        What it is for.
    *numbers : int
        Seed, and what tells the streams of one purpose apart, such as the number of the vehicle; not negative.

    Returns
    -------
    numpy.random.Generator
        The same for the same arguments, independent of all others.
    """
    return np.random.default_rng([int(purpose), len(numbers), *numbers])
