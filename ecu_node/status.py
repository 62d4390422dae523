"""What the node says of itself on the bus; the numbers are those of the DBC's value tables."""

from enum import IntEnum

__all__ = ["Quality", "Reason", "State"]


class State(IntEnum):
    """What the node does with the branch currents."""

    STARTING = 0
    CORRECTING = 1
    PASSING_THROUGH = 2
    SHADOW = 3
    ASLEEP = 4


class Reason(IntEnum):
    """Why the node does not correct, or not everything."""

    NONE = 0
    NO_PARAMETERS = 1
    MALFORMED_PARAMETERS = 2
    WRONG_VEHICLE = 3
    WRONG_LAYOUT = 4
    WRONG_DBC = 5
    IMPLAUSIBLE_PARAMETERS = 6
    BRANCH_STALE = 7
    CORRECTION_WORSE = 8
    BRANCH_STUCK = 9
    INPUT_MISSING = 10
    NOT_SIGNED = 11
    NOT_VALID_NOW = 12
    REPLAYED = 13
    REVOKED = 14
    ON_TRIAL = 15


class Quality(IntEnum):
    """What stands in one corrected signal."""

    NOT_AVAILABLE = 0
    PASSED_THROUGH = 1
    CORRECTED = 2
    INVALID = 3
