"""Channels of a drive on one time base.

The rule. The instants are whole multiples of the layout's period, over the span that every needed channel covers with
good samples. At each instant a channel's value is interpolated linearly between its last good sample at or before and
its next good sample at or after the instant; nothing is extrapolated. The value is valid if those two samples lie not
farther apart than the channel's limit (time-out of a branch, ``max_age_s`` of an input), or if one lies at the instant
itself. An instant is valid if all its values are, and if every derived input has a finite value there. Instants that
are not valid stay in place with NaN in all columns.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibrator.drive import Array, Channel, Drive, Mask
from calibrator.errors import DriveError
from calibrator.files.formulas import evaluate_formula, formula_names, parse_formula
from ecu_node.layout import Layout

__all__ = ["Samples", "align", "align_channels", "at_instants", "base_inputs", "choose_inputs"]

TIME_RESOLUTION_S = 1e-3
"""Logs round time stamps up to this; samples exactly one limit apart must pass. [s]"""
MAX_SAMPLES = 20_000_000
"""23 days at 0.1 s; a drive that claims more has a wrong time."""

_STALE, _NOT_GOOD = "stale", "not good"
_UNDEFINED, _UNCOVERED = "undefined", "uncovered"


@dataclass(frozen=True, kw_only=True)
class Samples:
    """Aligned samples of one drive.

    Attributes
    ----------
    branch_names, input_names : tuple of str
        Names of the K branches and M inputs, derived ones included.
    time_s : ndarray of shape (T,)
        Instants since the start of the drive, equally spaced. [s]
    currents_a : ndarray of shape (T, K)
        Measured branch currents, positive into the junction; NaN where not valid. [A]
    inputs : ndarray of shape (T, M)
        Inputs in the unit of the DBC; NaN where not valid.
    valid : ndarray of bool, shape (T,)
        Whether the instant may be used.
    masked : mapping of str to int
        How many instants are not valid for which reason; an instant may have several. ``stale``: frames too far apart.
        ``not good``: frames there, but labelled as not good. ``undefined``: a derived input has no finite value.
        ``uncovered``: instants of the drive outside the span that all channels cover; these are not among the T.
    """

    branch_names: tuple[str, ...]
    input_names: tuple[str, ...]
    time_s: Array
    currents_a: Array
    inputs: Array
    valid: Mask
    masked: Mapping[str, int]

    def with_inputs(self, names: Sequence[str]) -> "Samples":
        """Return the same samples with those of the inputs that are among some names, in their order."""
        kept = [self.input_names.index(name) for name in names if name in self.input_names]
        chosen = tuple(self.input_names[i] for i in kept)
        return replace(self, input_names=chosen, inputs=np.ascontiguousarray(self.inputs[:, kept]))


def choose_inputs(
    layout: Layout, available: Collection[str], *, names: Sequence[str] | None = None
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Split inputs of the layout into those that a fleet has and those that no drive of it has.

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
        Those whose recorded inputs are all available, and the others.
    """
    wanted = layout.model_inputs if names is None else names
    kept = tuple(name for name in wanted if base_inputs(layout, [name]) <= set(available))
    return kept, tuple(name for name in wanted if name not in kept)


def base_inputs(layout: Layout, names: Collection[str]) -> set[str]:
    """Recorded inputs that inputs and derived inputs of these names are made of."""
    found = set(names)
    for item in reversed(layout.derived):
        if item.name in found:
            found.remove(item.name)
            found.update(formula_names(parse_formula(item.formula)))
    return found


def align(drive: Drive, layout: Layout, branches: Sequence[str], *, inputs: Sequence[str] | None = None) -> Samples:
    """Put a drive on one time base; the rule stands at the top of this module.

    Parameters
    ----------
    drive : Drive
        The drive.
    layout : Layout
        Says period, limits and formulas.
    branches : sequence of str
        Names of the K branches wanted.
    inputs : sequence of str, optional
        Names of the M inputs and derived inputs wanted; the layout's model inputs by default.

    Returns
    -------
    Samples
        Aligned samples.

    Raises
    ------
    DriveError
        If a channel is missing, has no good sample, or the channels have no instant in common.
    """
    names = tuple(layout.model_inputs if inputs is None else inputs)
    recorded = sorted(base_inputs(layout, names))
    _require(drive, branches, recorded)
    limits = {branch.name: branch.timeout_s for branch in layout.branch if branch.name in branches}
    limits |= dict.fromkeys(recorded, layout.max_age_s)
    channels = {name: drive.branches[name] for name in branches} | {name: drive.inputs[name] for name in recorded}
    time_s, values, reasons = align_channels(
        channels, limits, period_s=layout.period_s, where=f"vehicle {drive.vehicle}, drive {drive.name}"
    )
    for item in layout.derived:
        if base_inputs(layout, [item.name]) <= values.keys():
            values[item.name] = evaluate_formula(parse_formula(item.formula), _inputs_only(values, branches))
    matrix = np.column_stack([np.zeros((len(time_s), 0)), *(values[name] for name in names)])
    reasons[_UNDEFINED] = ~np.all(np.isfinite(matrix), axis=1) & ~(reasons[_STALE] | reasons[_NOT_GOOD])
    valid = ~np.any(list(reasons.values()), axis=0)
    currents_a = np.column_stack([values[name] for name in branches])
    masked = {reason: int(mask.sum()) for reason, mask in reasons.items()}
    return Samples(
        branch_names=tuple(branches),
        input_names=names,
        time_s=time_s,
        currents_a=np.where(valid[:, None], currents_a, np.nan),
        inputs=np.where(valid[:, None], matrix, np.nan),
        valid=valid,
        masked=masked | {_UNCOVERED: max(int(drive.duration_s / layout.period_s) + 1 - len(time_s), 0)},
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
        Longest distance of neighbouring good samples, per channel. [s]
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
        Where any channel is ``stale``, and where any is ``not good``.

    Raises
    ------
    DriveError
        If a channel has no good sample, or the channels have no instant in common.
    """
    good = {name: _good_part(channel) for name, channel in channels.items()}
    empty = [name for name, channel in good.items() if not channel.time_s.size]
    if empty:
        raise DriveError(f"{where}: no good sample of {', '.join(empty)}; leave the drive out or repair the channel")
    time_s = _time_base(good, period_s, where)
    values: dict[str, Array] = {}
    reasons = {_STALE: np.zeros(len(time_s), np.bool_), _NOT_GOOD: np.zeros(len(time_s), np.bool_)}
    for name, channel in good.items():
        values[name], far = _interpolated(channel, time_s, limits_s[name])
        spoilt = far & _has_bad_between(channels[name], channel, time_s)
        reasons[_NOT_GOOD] |= spoilt
        reasons[_STALE] |= far & ~spoilt
    return time_s, values, reasons


def at_instants(channel: Channel, time_s: Array, limit_s: float) -> tuple[Array, Mask]:
    """Interpolate a channel, and say where it can be.

    Parameters
    ----------
    channel : Channel
        With at least one good sample.
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
    good = _good_part(channel)
    value, far = _interpolated(good, time_s, limit_s)
    return value, ~far & (time_s >= good.time_s[0]) & (time_s <= good.time_s[-1])


def _require(drive: Drive, branches: Sequence[str], inputs: Sequence[str]) -> None:
    missing = [name for name in branches if name not in drive.branches]
    missing += [name for name in inputs if name not in drive.inputs]
    if missing:
        raise DriveError(
            f"vehicle {drive.vehicle}, drive {drive.name}: no {', '.join(missing)}; it has "
            f"{', '.join([*drive.branches, *drive.inputs])}; choose branches and inputs that all drives have"
        )


def _inputs_only(values: Mapping[str, Array], branches: Sequence[str]) -> dict[str, Array]:
    return {name: value for name, value in values.items() if name not in branches}


def _good_part(channel: Channel) -> Channel:
    """Good samples only; of several at one instant the last."""
    time_s, value = channel.time_s[channel.good], channel.value[channel.good]
    last = np.append(np.diff(time_s) > 0.0, [True])[: len(time_s)]
    return Channel(time_s=time_s[last], value=value[last], good=np.ones(int(last.sum()), np.bool_))


def _time_base(channels: Mapping[str, Channel], period_s: float, where: str) -> Array:
    start = max(float(channel.time_s[0]) for channel in channels.values())
    stop = min(float(channel.time_s[-1]) for channel in channels.values())
    slack = TIME_RESOLUTION_S * period_s
    first, last = int(np.ceil((start - slack) / period_s)), int(np.floor((stop + slack) / period_s))
    if last < first:
        raise DriveError(
            f"{where}: its channels have no instant in common (the last starts at {start:.1f} s, the first ends at "
            f"{stop:.1f} s); record all of them over the same time"
        )
    if last - first >= MAX_SAMPLES:
        raise DriveError(f"{where}: {stop - start:.0f} s long; the time stamps are wrong, or cut it into drives")
    return np.arange(first, last + 1) * period_s


def _interpolated(channel: Channel, time_s: Array, limit_s: float) -> tuple[Array, Mask]:
    """Values at the instants, and where the neighbours are too far apart."""
    before, after = _neighbours(channel.time_s, time_s)
    gap_s = channel.time_s[after] - channel.time_s[before]
    share = np.divide(time_s - channel.time_s[before], gap_s, out=np.zeros(len(time_s)), where=gap_s > 0.0)
    share = np.clip(share, 0.0, 1.0)
    value = (1.0 - share) * channel.value[before] + share * channel.value[after]
    return value, gap_s > limit_s + TIME_RESOLUTION_S


def _neighbours(known_s: Array, time_s: Array) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Index of the last sample at or before and of the next at or after each instant; one and the same if at it."""
    after = np.minimum(np.searchsorted(known_s, time_s, side="left"), len(known_s) - 1)
    before = np.where(known_s[after] > time_s, np.maximum(after - 1, 0), after)
    return before, after


def _has_bad_between(channel: Channel, good: Channel, time_s: Array) -> Mask:
    """Whether samples that are not good lie between the good neighbours of each instant."""
    bad_s = channel.time_s[~channel.good]
    before, after = _neighbours(good.time_s, time_s)
    return np.asarray(np.searchsorted(bad_s, good.time_s[before]) < np.searchsorted(bad_s, good.time_s[after], "right"))
