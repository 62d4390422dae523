"""Find inputs that are computed from a current sensor of the junction, such as its current times a voltage.

A fleet model that is driven by such an input follows this sensor, and its faults are then given to other branches. Such
an input carries the noise of the sensor, which no input of its own can know. With D the distance of a value from the
mean of its two neighbours, u the input, i_k the currents with white noise of variance s_k^2, and r the residual of the
junction law, which is noise alone,

    E[Du Dr] = 0  for an input of its own,      E[Du Dr] = 3/2 v s_k^2  for u = v i_k.

Values of the input are paired with the latest value of the current before it, or one that was some samples earlier or
later. Of a drive those stretches count in which the current changes least: there sensors that filter, that are late or
have another gain disagree least with the law, and r is noise indeed. That noise is no larger where the current changes
most.
"""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from calibrator.drive import Array, Drive, good_samples
from calibrator.drives.align import at_instants
from calibrator.terminal.text import few
from ecu_node.layout import Layout
from ecu_node.summary import MAD_TO_SD, TIME_RESOLUTION_S

__all__ = ["SharedNoise", "computed_inputs", "shared_noise", "why_computed"]

MOST_FRAMES = 30_000
"""Most values of an input that are looked at: the better part of an hour at 10 Hz. [1]"""
LEAST_CHANGING = 0.05
"""Least share of an input's values that differ from the one before: noise changes all, a switched load few. [1]"""
STRETCH, FEWEST_STRETCHES = 30, 8
"""Samples of a stretch, and fewest stretches of a drive that are compared. [1]"""
QUIET = 0.25
"""Share of the stretches, those in which the current changes least, that counts. [1]"""
MUCH_MORE, SURELY = 1.5, 2.0
"""Noise does not grow with the changes of a current. Where the mean of Du Dr in the liveliest quarter of the stretches
is more than this multiple of that in the quiet one, by this number of standard deviations, r holds a current. [1]"""
SHIFTS = range(-1, 6)
"""How many samples of the current an input may be late; a value may also be sent before that of its current. [1]"""
LONGEST_PAUSE = 5.0
"""Pause in median distances after which two values are no neighbours. [1]"""
WILD = 4.0
"""Differences beyond this number of standard deviations do not count: a load that is switched on is no noise. [1]"""
OVERLAP = 3.0
"""Variance of a sum of products of second differences over that of as many independent ones, about: each shares two
samples with either neighbour. [1]"""
LEAST_CORRELATION = 0.3
"""Correlation of Du and Dr from which on an input is computed from a sensor. It is 0.71 for one of two equal sensors,
and 0.45 for one of five; of inputs that are not, 0.25 at most in some 100 artificial fleets. [1]"""
LEAST_SDS = 6.0
"""Standard deviations by which it has to differ from 0, in all drives together. [1]"""


class SharedNoise(NamedTuple):
    """Noise that an input of a drive shares with the residual of the junction law."""

    correlation: float
    sd: float
    """Correlation of Du and Dr in the stretches in which i_k changes least, and standard deviation of chance. [1]"""
    lively: float
    lively_sd: float
    """Mean product of Du and Dr in the stretches in which i_k changes most, in the same unit. [1]"""
    likeness: float
    """Correlation of Du and Di_k. [1]"""
    branch: str
    """Branch k."""


def shared_noise(drive: Drive, inputs: Iterable[str], layout: Layout) -> dict[str, SharedNoise]:
    """Compare inputs of a drive with the noise of its current sensors.

    Parameters
    ----------
    drive : Drive
        A drive.
    inputs : iterable of str
        Names of recorded inputs; those that the drive lacks, or that change too little, are not in the result.
    layout : Layout
        Its time-outs say how far apart samples of a branch may be.

    Returns
    -------
    dict of str to SharedNoise
        For each input the noise at the branch and the shift at which it is surest, and the branch that is most alike.
    """
    found: dict[str, list[SharedNoise]] = {name: [] for name in inputs if name in drive.inputs}
    for branch, time_s, current_a, residual_a in _residuals(drive, layout) if found else ():
        for name in found:
            time_u, u = good_samples(drive.inputs[name])
            changed = np.diff(u, prepend=np.inf) != 0.0  # a value that is held is no new one
            if changed.mean() < LEAST_CHANGING:
                continue
            time_u, u = time_u[changed][:MOST_FRAMES], u[changed][:MOST_FRAMES]
            for at_u, at in _pairs(time_u, time_s):
                near = (np.diff(at_u) > 0) & (np.diff(at) > 0)
                near &= np.diff(time_s[at]) < LONGEST_PAUSE * np.median(np.diff(time_s[at]))
                kept = near[1:] & near[:-1]
                if not _vanishes_with(current_a[at], u[at_u], layout.full_scale_a):
                    continue
                Du, Di, Dr = (_differences(values)[kept] for values in (u[at_u], current_a[at], residual_a[at]))
                found[name] += _compared(branch, Du, Di, Dr)
    noise = dict[str, SharedNoise]()
    for name, items in found.items():
        if items:
            most_alike = max(items, key=lambda item: abs(item.likeness)).branch
            noise[name] = max(items, key=lambda item: abs(item.correlation) / item.sd)._replace(branch=most_alike)
    return noise


def computed_inputs(drives: Sequence[Mapping[str, SharedNoise]]) -> dict[str, str]:
    """Return the inputs that are computed from a current sensor, and the branch whose current they are most like.

    Parameters
    ----------
    drives : sequence of mapping of str to SharedNoise
        What :func:`shared_noise` found in drives of different vehicles.
    """
    found = dict[str, str]()
    for name in dict.fromkeys(name for drive in drives for name in drive):
        items = [drive[name] for drive in drives if name in drive]
        shared, sd, lively, lively_sd, *_ = np.array([item[:4] for item in items]).T
        total, more = shared.sum(), lively.sum() * np.sign(shared.sum())
        is_shared = abs(total) >= max(LEAST_CORRELATION * len(items), LEAST_SDS * np.sqrt(np.square(sd).sum()))
        if is_shared and more - MUCH_MORE * abs(total) < SURELY * np.sqrt(np.square(lively_sd).sum()):
            found[name] = Counter(item.branch for item in items).most_common(1)[0][0]
    return found


def why_computed(computed: Mapping[str, str]) -> str:
    """Say why inputs are not used, from what :func:`computed_inputs` returned."""
    which = few([f"{name} (most like {branch})" for name, branch in computed.items()])
    return f"{which}, computed from current sensors, whose noise and faults are in it"


def _residuals(drive: Drive, layout: Layout) -> Iterator[tuple[str, Array, Array, Array]]:
    """Yield each branch with the instants of its samples [s], its current and the residual of the junction law. [A]

    Gains and offsets of the sensors are fitted; only instants at which all branches are known count.
    """
    channels = {name: channel for name, channel in drive.branches.items() if channel.good.sum() > STRETCH}
    for branch, channel in channels.items():
        time_s, current_a = good_samples(channel)
        others, known = np.ones((len(time_s), len(channels))), np.ones(len(time_s), np.bool_)
        for k, name in enumerate(name for name in channels if name != branch):
            others[:, k], valid = at_instants(channels[name], time_s, layout.find_branch(name).timeout_s)
            known &= valid
        time_s, current_a, others = time_s[known], current_a[known], others[known]
        if len(channels) > 1 and len(time_s) > STRETCH * FEWEST_STRETCHES:
            yield branch, time_s, current_a, current_a - others @ np.linalg.lstsq(others, current_a, rcond=None)[0]


def _pairs(time_u: Array, time_s: Array) -> Iterator[tuple[NDArray[np.intp], NDArray[np.intp]]]:
    """Yield for each of :data:`SHIFTS` places of values of the input, and of those of the current that belong to them.

    Each value of the slower one of both is paired with one of the faster one.
    """
    if min(len(time_u), len(time_s)) <= STRETCH * FEWEST_STRETCHES:
        return
    is_slow = np.median(np.diff(time_u)) >= np.median(np.diff(time_s))
    slow_s, fast_s = (time_u, time_s) if is_slow else (time_s, time_u)
    latest = np.searchsorted(fast_s, slow_s + TIME_RESOLUTION_S, side="right") - 1
    for shift in SHIFTS:
        fast = latest - shift if is_slow else latest + shift
        slow = np.flatnonzero((fast >= 0) & (fast < len(fast_s)))
        yield (slow, fast[slow]) if is_slow else (fast[slow], slow)


def _vanishes_with(current_a: Array, u: Array, full_scale_a: float) -> bool:
    """Check that the line of an input over a current is 0 at some current; that of a voltage, which sags, is not."""
    (variance, covariance), (_, _) = np.cov(current_a, u)
    return bool(abs(variance * u.mean() - covariance * current_a.mean()) <= full_scale_a * abs(covariance))


def _differences(values: Array) -> Array:
    return values[1:-1] - 0.5 * (values[:-2] + values[2:])


def _compared(branch: str, Du: Array, Di: Array, Dr: Array) -> Iterator[SharedNoise]:
    """Yield the noise that an input shares with the residual in the quiet stretches; nothing if these are too few."""
    count = len(Di) // STRETCH
    if count < FEWEST_STRETCHES:
        return
    # What i_k and the other branches both show is a current; this product has none of their noise in the mean.
    current_a2 = np.abs((Di * (Di - Dr))[: count * STRETCH].reshape(count, STRETCH).sum(axis=1))
    limits = np.quantile(current_a2, [QUIET, 1.0 - QUIET])
    quiet, lively = (np.repeat(chosen, STRETCH) for chosen in (current_a2 <= limits[0], current_a2 >= limits[1]))
    Du, Di, Dr = (values[: count * STRETCH] for values in (Du, Di, Dr))
    uu, rr = (np.square(_without_wild(values[quiet])).mean() for values in (Du, Dr))
    of_quiet, of_lively = (_without_wild(Du[chosen]) * _without_wild(Dr[chosen]) for chosen in (quiet, lively))
    if of_quiet.any() and Di.any():
        yield SharedNoise(
            correlation=float(of_quiet.mean() / np.sqrt(uu * rr)),
            sd=_sd_of_mean(of_quiet / np.sqrt(uu * rr)),
            lively=float(of_lively.mean() / np.sqrt(uu * rr)),
            lively_sd=_sd_of_mean(of_lively / np.sqrt(uu * rr)),
            likeness=float(Du @ Di / np.sqrt((Du @ Du) * (Di @ Di))),
            branch=branch,
        )


def _sd_of_mean(values: Array) -> float:
    return float(np.sqrt(OVERLAP * np.square(values).sum())) / len(values)


def _without_wild(values: Array) -> Array:
    limit = WILD * MAD_TO_SD * np.median(np.abs(values))
    return np.where(np.abs(values) <= limit, values, 0.0)
