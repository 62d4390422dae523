"""The evidence rows of one vehicle, as they are told: values in the units of its sensors, with what explains them."""

from collections.abc import Sequence
from dataclasses import dataclass

__all__ = ["VehicleEvidence", "evidence_names"]


@dataclass(frozen=True, kw_only=True)
class VehicleEvidence:
    """Evidence of one vehicle.

    Attributes
    ----------
    value, sd, explained : list of 5K float or None
        What was found, its standard deviation, and what the estimate explains of it; None for both of the first two
        where a row says nothing. In the order of :func:`evidence_names`, ratios [1] before constants [A].
    """

    value: list[float | None]
    sd: list[float | None]
    explained: list[float]


def evidence_names(branches: Sequence[str]) -> list[str]:
    """Names of the 5K rows.

    Parameters
    ----------
    branches : sequence of str
        The K branches, the most moving first: the junction law is written for it.

    Returns
    -------
    list of str
        3K - 1 ratios [1], then 2K + 1 constants [A].
    """
    first = branches[0]
    return [
        *(f"slope {name}" for name in branches),
        *(f"gain ratio {first} / {name}" for name in branches[1:]),
        *(f"gain read {name}" for name in branches),
        *(f"intercept {name}" for name in branches),
        "junction constant",
        *(f"offset read {name}" for name in branches),
    ]
