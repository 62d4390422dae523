"""Whether what a row of a bucket says makes sense: buckets come from disks and tools that may have spoilt them."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from calibrator.summaries.moments import DriveSummary
from calibrator.summaries.record import IMPOSSIBLE, MOST_MOMENT, MOST_VARIANCE_A2

__all__ = ["row_problem"]

NAMES = ("drives", "sources", "recorded")
PER_BRANCH = ("delay_s", "delay_sd_s", "zero_offset_a", "zero_sd_a")


def row_problem(row: Mapping[str, Any], summary: DriveSummary | None, branches: Sequence[str]) -> str:
    """Why the summary that a row holds cannot be used.

    Parameters
    ----------
    row : mapping of str to values
        Columns of a record that has no problem, but ``moments``, ``noise_a2`` and those of the fit sums.
    summary : DriveSummary or None
        Made of these two; None if they are not of a whole number of blocks.
    branches : sequence of str
        Names of the K branches.

    Returns
    -------
    str
        Why not, and what to do; empty if it can.
    """
    spoilt = _spoilt_columns(row, summary, branches)
    if spoilt:
        return (
            f"its summary is damaged: {' and '.join(spoilt)} do not fit the other columns; summarise its drives again"
        )
    assert summary is not None
    possible = _possible_moments(summary) and _possible_delays(row) and _possible_offsets(row)
    return "" if possible and 0.0 < row["duration_s"] < math.inf else IMPOSSIBLE


def _spoilt_columns(row: Mapping[str, Any], summary: DriveSummary | None, branches: Sequence[str]) -> list[str]:
    """Columns in which values are missing, or which have too few or too many."""
    spoilt = ["moments, noise_a2 and fit sums"] if summary is None else []
    spoilt += [name for name in NAMES if row[name] is None or None in row[name]]
    if not spoilt and len(row["drives"]) != len(row["sources"]):
        spoilt.append("sources")
    spoilt += [name for name in PER_BRANCH if row[name] is None or None in row[name] or len(row[name]) != len(branches)]
    spoilt += ["delay_reference"] if row["delay_reference"] not in branches else []
    return spoilt + (["duration_s"] if row["duration_s"] is None else [])


def _possible_moments(summary: DriveSummary) -> bool:
    """Every sum is finite, no sum of squares negative, every block has samples, noise is a variance of a current."""
    moments, noise = summary.moments, summary.noise_a2
    squares = np.diagonal(moments, axis1=1, axis2=2)
    fit = summary.fit
    if fit is not None and not (
        np.abs(fit.levels).max() < MOST_MOMENT
        and fit.levels[..., -1].min() >= 0.0
        and np.abs(fit.fast_a2).max() < MOST_MOMENT
        and 0.0 <= fit.spikes.min() <= fit.spikes.max() < math.inf
        and not np.isinf(fit.temperature_c).any()
    ):
        return False
    return bool(
        np.abs(moments).max() < MOST_MOMENT  # nor is not-a-number
        and squares.min() >= 0.0
        and squares[:, -1].min() > 0.0
        and noise.min() >= 0.0
        and noise.max() <= MOST_VARIANCE_A2
    )


def _possible_delays(row: Mapping[str, Any]) -> bool:
    """A delay is a number, or not known: then its deviation is infinite."""
    pairs = zip(row["delay_s"], row["delay_sd_s"], strict=True)
    return all(sd == math.inf or (0.0 <= sd < math.inf and math.isfinite(delay)) for delay, sd in pairs)


def _possible_offsets(row: Mapping[str, Any]) -> bool:
    """An offset is a number with a deviation, or there was no window: then both are not-a-number."""
    pairs = zip(row["zero_offset_a"], row["zero_sd_a"], strict=True)
    return all(
        (math.isnan(offset) and math.isnan(sd)) or (math.isfinite(offset) and 0.0 < sd < math.inf)
        for offset, sd in pairs
    )
