"""Put the channels of a drive on one time base.

The rule: the instants are whole multiples of the layout's period, over the span that every needed channel covers with
good samples. At each instant a channel's value is interpolated linearly between its last good sample at or before and
its next good sample at or after the instant; nothing is extrapolated. The value is valid if those two samples are not
farther apart than the channel's limit (time-out of a branch, ``max_age_s`` of an input), or if one lies at the instant
itself. An instant is valid if all its values are, and if every derived input has a finite value there. Instants that
are not valid stay in place with NaN in all columns.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from calibrator.compiled import compiled
from calibrator.drive import Array, Channel, Drive, Mask, Samples, good_samples
from calibrator.errors import DriveError
from ecu_node.formulas import FUNCTIONS, formula_value, parse_formula
from ecu_node.layout import Layout
from ecu_node.summary import INSTANT_SLACK, TIME_RESOLUTION_S

__all__ = [
    "align",
    "align_channels",
    "at_instants",
    "at_pace",
    "choose_inputs",
    "evaluate_formula",
    "step_seen",
]

MAX_SAMPLES = 20_000_000
"""Most samples of a drive, which is 23 days at 0.1 s; a longer drive has a wrong time. [1]"""

SLOWER = 1.5
"""If even the fastest branch's frames are this many periods or more apart, the period becomes their distance. [1]"""
LEVELS, FEW_LEVELS, LOOKED_AT = 10, 4, 2000
"""In :func:`step_seen`: fewest different values whose least distance is taken for the step; fewest if all are whole
steps apart, as a heater may only be on or off; about how many samples are looked at. [1]"""
_STALE, _NOT_GOOD = "stale", "not good"


def at_pace(layout: Layout, drives: Sequence[Drive]) -> Layout:
    """Return the layout, with the frame distance of the fastest branch as period if far longer, see :data:`SLOWER`."""
    channels = [channel for drive in drives for channel in drive.branches.values() if channel.good.sum() > 1]
    fastest_s = min((float(np.median(np.diff(each.time_s[each.good]))) for each in channels), default=0.0)
    if fastest_s < SLOWER * layout.period_s:
        return layout
    return msgspec.structs.replace(layout, period_s=round(fastest_s, 3))


def choose_inputs(
    layout: Layout, available: Collection[str], *, names: Sequence[str] | None = None
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Split inputs of the layout into those that a fleet has and those that it lacks.

    Parameters
    ----------
    layout : Layout
        The layout.
    available : collection of str
        Names of the recorded inputs of all drives of the fleet together.
    names : sequence of str or None
        Inputs and derived inputs wanted; None: the layout's model inputs.

    Returns
    -------
    kept, left_out : tuple of str
        Names of the wanted inputs that are available, or derived from available inputs only; and of the other wanted
        inputs.
    """
    wanted = layout.model_inputs if names is None else names
    kept = tuple(name for name in wanted if layout.base_inputs([name]) <= set(available))
    return kept, tuple(name for name in wanted if name not in kept)


_ARRAY_FUNCTIONS: Mapping[str, Callable[..., Any]] = {
    **FUNCTIONS,
    "/": np.divide,
    "**": np.power,
    "positive": lambda x: np.maximum(x, 0.0),
    "negative": lambda x: np.minimum(x, 0.0),
    "sqrt": np.sqrt,
}


def evaluate_formula(formula: str, values: Mapping[str, Array]) -> Array:
    """Return the values of a formula of the layout, shape (T,); NaN or infinite where it is not defined.

    Parameters
    ----------
    formula : str
        A formula that ``ecu_node.formulas.parse_formula`` accepts.
    values : mapping of str to ndarray of shape (T,)
        Values by name, at least for all names in the formula.
    """
    shape = np.broadcast_shapes(*(value.shape for value in values.values()))
    arrays = {name: np.asarray(value, np.float64) for name, value in values.items()}
    with np.errstate(all="ignore"):
        return np.array(
            np.broadcast_to(formula_value(parse_formula(formula), arrays, _ARRAY_FUNCTIONS), shape), np.float64
        )


def align(drive: Drive, layout: Layout, branches: Sequence[str], *, inputs: Sequence[str] | None = None) -> Samples:
    """Put a drive on one time base; the rule stands at the top of this module.

    Parameters
    ----------
    drive : Drive
        The drive.
    layout : Layout
        The layout, with period, limits and formulas.
    branches : sequence of str
        Names of the K branches wanted.
    inputs : sequence of str, optional
        Names of the M inputs and derived inputs wanted; the layout's model inputs by default.

    Returns
    -------
    Samples
        The aligned samples.

    Raises
    ------
    DriveError
        If a channel is missing or has no good sample, the channels have no instant in common, or the drive is longer
        than :data:`MAX_SAMPLES`.
    """
    names = tuple(layout.model_inputs if inputs is None else inputs)
    recorded = sorted(layout.base_inputs(names))
    missing = [name for name in branches if name not in drive.branches]
    missing += [name for name in recorded if name not in drive.inputs]
    if missing:
        raise DriveError(
            f"vehicle {drive.vehicle}, drive {drive.name}: no {', '.join(missing)}; it has "
            f"{', '.join([*drive.branches, *drive.inputs])}; choose branches and inputs that all drives have"
        )
    limits = {branch.name: branch.timeout_s for branch in layout.branch if branch.name in branches}
    limits |= dict.fromkeys(recorded, layout.max_age_s)
    channels = {name: drive.branches[name] for name in branches} | {name: drive.inputs[name] for name in recorded}
    time_s, values, reasons = align_channels(
        channels, limits, period_s=layout.period_s, where=f"vehicle {drive.vehicle}, drive {drive.name}"
    )
    recorded_inputs = {name: value for name, value in values.items() if name not in branches}
    for item in layout.derived:
        if layout.base_inputs([item.name]) <= recorded_inputs.keys():
            recorded_inputs[item.name] = evaluate_formula(item.formula, recorded_inputs)
    matrix = np.column_stack([np.zeros((len(time_s), 0)), *(recorded_inputs[name] for name in names)])
    valid = np.all(np.isfinite(matrix), axis=1) & ~(reasons[_STALE] | reasons[_NOT_GOOD])
    currents_a = np.column_stack([values[name] for name in branches])
    return Samples(
        branch_names=tuple(branches),
        input_names=names,
        time_s=time_s,
        currents_a=np.where(valid[:, None], currents_a, np.nan),
        inputs=np.where(valid[:, None], matrix, np.nan),
        valid=valid,
    )


def align_channels(
    channels: Mapping[str, Channel], limits_s: Mapping[str, float], *, period_s: float, where: str
) -> tuple[Array, dict[str, Array], dict[str, Mask]]:
    """Put channels on one time base; the rule stands at the top of this module.

    Parameters
    ----------
    channels : mapping of str to Channel
        The channels, at least one.
    limits_s : mapping of str to float
        Longest distance of neighbouring good samples to interpolate between, by channel. [s]
    period_s : float
        Distance of the instants. [s]
    where : str
        Vehicle and drive, for messages.

    Returns
    -------
    time_s : ndarray of shape (T,)
        Instants. [s]
    values : dict of str to ndarray of shape (T,)
        Interpolated values by channel.
    reasons : dict of str to ndarray of bool, shape (T,)
        Why instants are not valid: where good samples of any channel are too far apart, with bad samples between them
        (``not good``) or without (``stale``).

    Raises
    ------
    DriveError
        If a channel has no good sample, the channels have no instant in common, or more than :data:`MAX_SAMPLES`
        of them.
    """
    empty = [name for name, channel in channels.items() if not channel.good.any()]
    if empty:
        raise DriveError(f"{where}: no good sample of {', '.join(empty)}; leave the drive out or repair the channel")
    time_s = _time_base([channel.time_s[channel.good] for channel in channels.values()], period_s, where)
    values: dict[str, Array] = {}
    label = np.zeros(len(time_s), np.uint8)
    for name, channel in channels.items():
        values[name], found = _interpolated(channel, time_s, limits_s[name])
        label |= found
    return time_s, values, {_STALE: label & _FAR > 0, _NOT_GOOD: label & _SPOILT > 0}


def at_instants(channel: Channel, time_s: Array, limit_s: float) -> tuple[Array, Mask]:
    """Return the values of a channel at some instants, interpolated, and where they are valid.

    Parameters
    ----------
    channel : Channel
        A channel with at least one good sample.
    time_s : ndarray of shape (T,)
        Instants. [s]
    limit_s : float
        Longest distance of neighbouring good samples. [s]

    Returns
    -------
    value : ndarray of shape (T,)
        Interpolated values.
    known : ndarray of bool, shape (T,)
        False where the good samples beside the instant are too far apart, or are not on both sides.
    """
    value, label = _interpolated(channel, time_s, limit_s)
    good_s = channel.time_s[channel.good]
    return value, (label == 0) & (time_s >= good_s[0]) & (time_s <= good_s[-1])


def _time_base(good_s: Sequence[Array], period_s: float, where: str) -> Array:
    """Return the multiples of the period that the good samples of every channel cover, shape (T,). [s]"""
    start, stop = max(float(time_s[0]) for time_s in good_s), min(float(time_s[-1]) for time_s in good_s)
    slack = INSTANT_SLACK * period_s
    first, last = int(np.ceil((start - slack) / period_s)), int(np.floor((stop + slack) / period_s))
    if last < first:
        raise DriveError(
            f"{where}: its channels have no instant in common (the last starts at {start:.1f} s, the first ends at "
            f"{stop:.1f} s); record all of them over the same time"
        )
    if last - first >= MAX_SAMPLES:
        raise DriveError(f"{where}: {stop - start:.0f} s long; the time stamps are wrong, or cut it into drives")
    return np.arange(first, last + 1) * period_s


def _interpolated(channel: Channel, time_s: Array, limit_s: float) -> tuple[Array, NDArray[np.uint8]]:
    """Return the values at the instants, and labels: 0, or ``_FAR`` or ``_SPOILT`` as :func:`_interpolate` says."""
    value, label = np.empty(len(time_s)), np.zeros(len(time_s), np.uint8)
    known_s, known = map(np.ascontiguousarray, good_samples(channel))
    bad_s = channel.time_s[~channel.good]
    _interpolate((known_s, known), bad_s, time_s, limit_s + TIME_RESOLUTION_S, value, label)
    return value, label


_FAR, _SPOILT = 1, 2


@compiled
def _interpolate(  # noqa: PLR0917 (compiled: no keywords)
    samples: tuple[Array, Array], bad_s: Array, time_s: Array, limit_s: float, value: Array, label: NDArray[np.uint8]
) -> None:
    """Fill `value` and `label` at increasing instants from the good samples before (or at) and after (or at) each.

    Before the first and after the last sample, that sample's value is held. If the two samples are farther apart than
    the limit, the label is ``_SPOILT`` if a bad sample lies between them or at one of them, else ``_FAR``.
    """
    known_s, known = samples
    after, bad = 0, 0
    for j in range(len(time_s)):
        while after < len(known_s) and known_s[after] <= time_s[j]:
            after += 1
        first, last = max(after - 1, 0), min(after, len(known_s) - 1)
        if known_s[first] == time_s[j]:
            last = first
        gap_s = known_s[last] - known_s[first]
        share = min(max((time_s[j] - known_s[first]) / gap_s, 0.0), 1.0) if gap_s > 0.0 else 0.0
        value[j] = (1.0 - share) * known[first] + share * known[last]
        if gap_s > limit_s:
            while bad < len(bad_s) and bad_s[bad] < known_s[first]:
                bad += 1
            label[j] = _SPOILT if bad < len(bad_s) and bad_s[bad] <= known_s[last] else _FAR


def step_seen(channel: Channel, otherwise_a: float) -> float:
    """Return the step in which a current was measured, the least distance of two of its values. [A]

    Parameters
    ----------
    channel : Channel
        Samples of the current. [A]
    otherwise_a : float
        What is returned if there are too few values to show a step, such as the scale of its signal. [A]
    """
    value_a = channel.value[channel.good]
    levels_a = np.unique(np.round(value_a[:: max(len(value_a) // LOOKED_AT, 1)], 9))
    if len(levels_a) >= FEW_LEVELS:
        step_a = float(np.diff(levels_a).min())
        steps = (levels_a - levels_a[0]) / step_a
        if len(levels_a) >= LEVELS or np.allclose(steps, np.rint(steps), atol=1e-3):
            return step_a
    return otherwise_a
