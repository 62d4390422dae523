"""Find inputs that are computed from a current sensor of the junction, such as its current times a voltage.

A fleet model with such an input repeats the sensor, so that the sensor's faults are given to other branches. It can be
recognised, as it carries the noise of the sensor, and an independent input does not. With D the distance of a value
from the mean of its two neighbours, u the input, i_k the current of branch k with white noise of variance s_k^2, and r
what the junction law, fitted to the drive, leaves of i_k,

    E[Du Dr] = 0  for an independent input,      E[Du Dr] = 3/2 v s_k^2  for u = v i_k, v a factor such as a voltage.

Each value of the slower of the two is paired with the latest of the faster before it, or one some samples earlier or
later. Those stretches of a drive count in which the current changes least: there sensors that filter, are late or have
another gain disagree least with the law. Noise is no larger where the current changes most: if the product is, r holds
a current that a branch misses, and the input counts as independent. So do inputs that change rarely, as a demand, that
are not 0 at any possible current, as a voltage, or that go with no current as a whole, as a torque.
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

SHORTEST_S, MOST_VALUES = 0.05, 12_000
"""Of an input that has more values than the second, those that are closer than the first [s] are passed over, and what
is still beyond is left out: ten minutes or more remain. [1]"""
LEAST_CHANGING = 0.05
"""Least share of an input's values that differ from the one before: noise changes all, a switched load few. [1]"""
STRETCH, FEWEST_STRETCHES = 30, 8
"""Samples of a stretch, and fewest stretches of a drive that are compared. [1]"""
QUIET = 0.25
"""Share of the stretches, those in which the current changes least, that counts. [1]"""
MUCH_MORE, SURELY = 1.25, 2.0
"""If the mean of Du Dr in the liveliest quarter of the stretches exceeds `MUCH_MORE` times that in the quiet quarter,
by `SURELY` standard deviations, r holds a current and not noise alone. [1]"""
SHIFTS = range(-1, 6)
"""By how many samples, of the input or the current, whichever comes more often, an input may be late; -1: it was sent
before its current. [1]"""
LONGEST_PAUSE = 5.0
"""Pause in median distances after which two values are no neighbours. [1]"""
WILD = 4.0
"""Differences beyond this number of standard deviations do not count: a load that is switched on is no noise. [1]"""
OVERLAP = 3.0
"""By about this factor the variance of a sum of products of second differences is larger than if they were independent:
neighbours share two samples. [1]"""
LEAST_CORRELATION = 0.3
"""Mean over the drives of the correlation of Du and Dr, from which on an input is computed from a sensor: of one of n
equal sensors it is the root of 1/n. An exact power has 0.25 beside a sensor that shows means of a second (tests).
[1]"""
LEAST_LIKENESS = 0.95
"""Mean over the drives of the correlation of the input itself with the current that it is most like, from which on it
may be computed from it: a torque goes with it at one speed only, a power at any voltage that a battery has. [1]"""
LEAST_SDS = 6.0
"""Standard deviations by which it has to differ from 0, in all drives together. [1]"""


class SharedNoise(NamedTuple):
    """Noise that an input of a drive shares with what the junction law leaves.

    Attributes
    ----------
    correlation, sd : float
        Correlation of Du and Dr where the current changes least, and its standard deviation. [1]
    lively, lively_sd : float
        Mean product of Du and Dr where the current changes most, over the same two root mean squares as the
        correlation, and its standard deviation. [1]
    likeness : float
        Magnitude of the correlation of the input with the current of the branch. [1]
    branch : str
        Branch whose current is most like the input; other numbers may be of another one, at which the noise is surest.
    """

    correlation: float
    sd: float
    lively: float
    lively_sd: float
    likeness: float
    branch: str


def shared_noise(drive: Drive, inputs: Iterable[str], layout: Layout) -> dict[str, SharedNoise]:
    """Compare inputs of a drive with the noise of its current sensors.

    Parameters
    ----------
    drive : Drive
        A drive.
    inputs : iterable of str
        Names of recorded inputs. Not in the result are those that the drive lacks, that change too rarely, that are not
        0 at a current within full scale, or that have too few samples.
    layout : Layout
        Time-outs of the branches, and full scale.

    Returns
    -------
    dict of str to SharedNoise
        For each input the noise at the branch and the shift at which it is surest, and the branch that is most alike.
    """
    found: dict[str, list[SharedNoise]] = {name: [] for name in inputs if name in drive.inputs}
    values = {name: _fresh(*good_samples(drive.inputs[name])) for name in found}
    for branch, time_s, current_a, residual_a in _residuals(drive, layout) if found else ():
        for name, (time_u, u) in values.items():
            for at_u, at in _pairs(time_u, time_s):
                near = (np.diff(at_u) > 0) & (np.diff(at) > 0)
                near &= np.diff(time_s[at]) < LONGEST_PAUSE * np.median(np.diff(time_s[at]))
                kept = near[1:] & near[:-1]
                if likeness := _likeness(current_a[at], u[at_u], layout.full_scale_a):
                    Du, Di, Dr = (_differences(x)[kept] for x in (u[at_u], current_a[at], residual_a[at]))
                    found[name] += _compared(branch, likeness, Du, Di, Dr)
    noise = dict[str, SharedNoise]()
    for name, items in found.items():
        if items:
            alike = max(items, key=lambda item: item.likeness)
            surest = max(items, key=lambda item: abs(item.correlation) / item.sd)
            noise[name] = surest._replace(likeness=alike.likeness, branch=alike.branch)
    return noise


def computed_inputs(drives: Sequence[Mapping[str, SharedNoise]]) -> dict[str, str]:
    """Find the inputs that are computed from a current sensor.

    The mean correlations over the drives are large enough, and that of the noise not far larger where currents change
    most.

    Parameters
    ----------
    drives : sequence of mapping of str to SharedNoise
        What :func:`shared_noise` found in drives of different vehicles.

    Returns
    -------
    dict of str to str
        By name of the input the branch that it is most like in most drives.
    """
    found = dict[str, str]()
    for name in dict.fromkeys(name for drive in drives for name in drive):
        items = [drive[name] for drive in drives if name in drive]
        total, lively = sum(item.correlation for item in items), sum(item.lively for item in items)
        sd, lively_sd = np.sqrt(sum(i.sd**2 for i in items)), np.sqrt(sum(i.lively_sd**2 for i in items))
        likeness = sum(item.likeness for item in items) / len(items)
        is_shared = abs(total) >= max(LEAST_CORRELATION * len(items), LEAST_SDS * sd)
        grows = lively * np.sign(total) - MUCH_MORE * abs(total) >= SURELY * lively_sd
        if is_shared and not grows and likeness >= LEAST_LIKENESS:
            found[name] = Counter(item.branch for item in items).most_common(1)[0][0]
    return found


def why_computed(computed: Mapping[str, str]) -> str:
    """Say why inputs are not used, from what :func:`computed_inputs` returned."""
    which = few([f"{name} (most like {branch})" for name, branch in computed.items()])
    return f"{which}, as if computed from current sensors, with their noise and their faults"


def _fresh(time_s: Array, value: Array) -> tuple[Array, Array]:
    """Return the values that differ from the one before, none if these are rare; not too many, see MOST_VALUES."""
    changed = np.diff(value, prepend=np.inf) != 0.0
    if changed.sum() < LEAST_CHANGING * len(value):
        return time_s[:0], value[:0]
    if changed.sum() > MOST_VALUES:
        changed &= np.diff(np.floor(time_s / SHORTEST_S), prepend=-1.0) > 0.0
    return time_s[changed][:MOST_VALUES], value[changed][:MOST_VALUES]


def _residuals(drive: Drive, layout: Layout) -> Iterator[tuple[str, Array, Array, Array]]:
    """Yield each branch with the instants of its samples [s], its current and the residual of the junction law. [A]

    Gains and offsets of the sensors are fitted. Only instants at which all branches are known count, and only branches
    with more than a few good samples.
    """
    channels = {name: channel for name, channel in drive.branches.items() if channel.good.sum() > STRETCH}
    for branch, channel in channels.items():
        time_s, current_a = good_samples(channel)
        others = np.ones((len(time_s), len(channels)))  # the last column stays 1: the offset
        known = np.ones(len(time_s), np.bool_)
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
    least = STRETCH * FEWEST_STRETCHES
    if min(len(time_u), len(time_s)) <= least:
        return
    is_slow = np.median(np.diff(time_u)) >= np.median(np.diff(time_s))
    slow_s, fast_s = (time_u, time_s) if is_slow else (time_s, time_u)
    latest = np.searchsorted(fast_s, slow_s + TIME_RESOLUTION_S, side="right") - 1
    for shift in SHIFTS:
        fast = latest - shift if is_slow else latest + shift
        slow = np.flatnonzero((fast >= 0) & (fast < len(fast_s)))
        if len(slow) > least:
            yield (slow, fast[slow]) if is_slow else (fast[slow], slow)


def _likeness(current_a: Array, u: Array, full_scale_a: float) -> float:
    """Return the magnitude of the correlation of an input with a current [A]; 0 if both do not vanish together.

    The straight line of the input over the current must be 0 at a current within full scale; that of a voltage is not.
    """
    (variance, covariance), (_, square) = np.cov(current_a, u)
    away = abs(variance * u.mean() - covariance * current_a.mean())
    if covariance == 0.0 or away > full_scale_a * abs(covariance):
        return 0.0
    return float(abs(covariance) / np.sqrt(variance * square))


def _differences(values: Array) -> Array:
    return values[1:-1] - 0.5 * (values[:-2] + values[2:])


def _compared(branch: str, likeness: float, Du: Array, Di: Array, Dr: Array) -> Iterator[SharedNoise]:
    """Yield the noise that an input shares with the residual; nothing if there are too few stretches."""
    count = len(Di) // STRETCH
    if count < FEWEST_STRETCHES:
        return
    # Dr - Di is the change that the other branches show: its product with Di has no noise in its mean.
    current_a2 = np.abs((Di * (Di - Dr))[: count * STRETCH].reshape(count, STRETCH).sum(axis=1))
    limits = np.quantile(current_a2, [QUIET, 1.0 - QUIET])
    quiet, lively = (np.repeat(chosen, STRETCH) for chosen in (current_a2 <= limits[0], current_a2 >= limits[1]))
    Du, Dr = Du[: count * STRETCH], Dr[: count * STRETCH]
    uu, rr = (np.square(_without_wild(values[quiet])).mean() for values in (Du, Dr))
    of_quiet, of_lively = (_without_wild(Du[chosen]) * _without_wild(Dr[chosen]) for chosen in (quiet, lively))
    if of_quiet.any():
        yield SharedNoise(
            correlation=float(of_quiet.mean() / np.sqrt(uu * rr)),
            sd=_sd_of_mean(of_quiet / np.sqrt(uu * rr)),
            lively=float(of_lively.mean() / np.sqrt(uu * rr)),
            lively_sd=_sd_of_mean(of_lively / np.sqrt(uu * rr)),
            likeness=likeness,
            branch=branch,
        )


def _sd_of_mean(values: Array) -> float:
    return float(np.sqrt(OVERLAP * np.square(values).sum())) / len(values)


def _without_wild(values: Array) -> Array:
    limit = WILD * MAD_TO_SD * np.median(np.abs(values))
    return np.where(np.abs(values) <= limit, values, 0.0)
