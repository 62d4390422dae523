"""Summarise the drives of one vehicle: delays between branches, zero-current windows and second moments."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from calibrator.drive import Array, Channel, Drive, Equipment, Mask, Samples, good_values
from calibrator.drives.align import align, at_pace, step_seen
from calibrator.drives.delays import BranchDelays, estimate_delays, without_delays
from calibrator.errors import DriveError
from calibrator.summaries.filter_bank import FilterBank
from calibrator.summaries.moments import DriveSummary, add_up
from calibrator.summaries.summariser import summarise_samples
from calibrator.terminal.text import counted
from ecu_node.database import VehicleDatabase
from ecu_node.layout import Contactor, Layout
from ecu_node.summary import FEWEST_ZERO_SAMPLES, ZERO_PIECE_S, ZERO_RESOLUTION_A, ZERO_SETTLING_S

__all__ = [
    "COARSEST_PERIOD_S",
    "VehicleSummary",
    "ZeroCurrent",
    "added_summaries",
    "aligned_drives",
    "most_moving_first",
    "require_possible",
    "summarise_drives",
    "too_short",
    "too_slow",
    "weighted_mean",
    "with_noise_of_steps",
    "zero_current_offsets",
]

LEAST_DURATION_S = 120.0
"""A vehicle with less valid data is left out: fewer than four blocks do not show the uncertainty. [s]"""
COARSEST_PERIOD_S = 5.0
"""Longest time between samples of a fleet; a longer one leaves too few samples in a block of 30 s. [s]"""

QUIETEST, NOISY_STEPS = 0.25, 2.0
"""A current has noise if this quantile of its third differences exceeds so many steps; with noise of less than half a
step it does not, and a sensor may then show 0 throughout. [1]"""
MOST_OVER_FULL_SCALE = 10.0
"""Largest magnitude of a measured current that is believed, in multiples of full scale. [1]"""


@dataclass(frozen=True, kw_only=True)
class ZeroCurrent:
    """Offsets that the sensors of K branches showed in zero-current windows; NaN for a branch without a window.

    Attributes
    ----------
    offset_a, sd_a : ndarray of shape (K,)
        Mean of the medians of the windows, and its standard deviation. [A]
    """

    offset_a: Array
    sd_a: Array


@dataclass(frozen=True, kw_only=True)
class VehicleSummary:
    """All that the estimator knows of the drives of one vehicle.

    Attributes
    ----------
    vehicle : str
        Name of the vehicle.
    drives : tuple of str
        Names of the drives used.
    summary : DriveSummary
        Moments of all these drives, made after the delays were taken out.
    delays : BranchDelays
        Delays between the branches; the reference is the branch whose current varies most.
    zero_current : ZeroCurrent
        Offsets that the sensors showed while the contactors were open.
    """

    vehicle: str
    drives: tuple[str, ...]
    summary: DriveSummary
    delays: BranchDelays
    zero_current: ZeroCurrent


def added_summaries(parts: Sequence[VehicleSummary]) -> VehicleSummary:
    """Add up one or more summaries of one vehicle.

    The delays are those of the summary that knows most of them; of several, of the most precise one. They are not
    averaged, as each summary's drives were aligned with its own delays. Offsets in zero-current windows are averaged
    by precision.
    """
    offset_a, sd_a = weighted_mean(*((part.zero_current.offset_a, part.zero_current.sd_a) for part in parts))
    delays = [part.delays for part in parts]
    return VehicleSummary(
        vehicle=parts[0].vehicle,
        drives=tuple(name for part in parts for name in part.drives),
        summary=add_up([part.summary for part in parts]),
        delays=max(delays, key=lambda part: (int(part.known.sum()), -float(part.sd_s[part.known].sum()))),
        zero_current=ZeroCurrent(offset_a=offset_a, sd_a=sd_a),
    )


def summarise_drives(
    drives: Sequence[Drive],
    equipment: Equipment,
    database: VehicleDatabase,
    *,
    bank: FilterBank | None = None,
    known_s: float = 0.0,
) -> VehicleSummary:
    """Summarise the drives of one vehicle.

    Parameters
    ----------
    drives : sequence of Drive
        Drives of one vehicle.
    equipment : Equipment
        Branches and model inputs of the fleet.
    database : VehicleDatabase
        DBC and layout.
    bank : FilterBank or None
        Filters of the fleet model's inputs; None: the plain inputs.
    known_s : float
        Usable data that the vehicle has besides these drives; it counts towards the least duration. [s]

    Returns
    -------
    VehicleSummary
        Summary of these drives.

    Raises
    ------
    DriveError
        If there is too little valid data (the message says how much), the samples are too far apart, a branch is
        missing, or a current or input has impossible values.
    """
    delays, samples = aligned_drives(drives, equipment, database, known_s=known_s)
    name, temperatures_c = database.layout.temperature, None
    if name is not None:
        temperatures_c = [
            _temperature_c(drive.inputs.get(name), part) for drive, part in zip(drives, samples, strict=True)
        ]
    summary = summarise_samples(samples, period_s=database.layout.period_s, bank=bank, temperatures_c=temperatures_c)
    return VehicleSummary(
        vehicle=drives[0].vehicle,
        drives=tuple(drive.name for drive in drives),
        summary=with_noise_of_steps(summary, drives, equipment.branches, database),
        delays=delays,
        zero_current=zero_current_offsets(drives, equipment.branches, database),
    )


def aligned_drives(
    drives: Sequence[Drive], equipment: Equipment, database: VehicleDatabase, *, known_s: float = 0.0
) -> tuple[BranchDelays, list[Samples]]:
    """Return the delays of a vehicle's branches, and its drives without them, aligned to the period of the layout.

    Arguments and errors are those of :func:`summarise_drives`.
    """
    layout = database.layout
    for drive in drives:
        require_possible(drive, layout)
    if problem := too_slow(at_pace(layout, drives).period_s):
        raise DriveError(problem)
    delays = estimate_delays(drives, most_moving_first(drives, equipment.branches))
    samples = [
        align(without_delays(drive, delays.by_branch()), layout, equipment.branches, inputs=equipment.fleet_inputs)
        for drive in drives
    ]
    if problem := too_short(known_s + layout.period_s * sum(int(part.valid.sum()) for part in samples), len(drives)):
        raise DriveError(problem)
    return delays, samples


def with_noise_of_steps(
    summary: DriveSummary, drives: Sequence[Drive], branches: Sequence[str], database: VehicleDatabase
) -> DriveSummary:
    """Return the summary with each current's noise variance at least that of rounding: q^2 / 12 for steps of q.

    Differences between samples do not show the noise of rounding while the current changes by less than a step.
    """
    step_a = np.array(
        [max(step_seen(drive.branches[name], database.current_step_a(name)) for drive in drives) for name in branches]
    )
    return replace(summary, noise_a2=np.maximum(summary.noise_a2, step_a**2 / 12.0))


def too_slow(period_s: float) -> str:
    """Say why samples `period_s` apart cannot be used in a fleet; return an empty text if they can."""
    if period_s <= COARSEST_PERIOD_S:
        return ""
    alone = "a vehicle by itself is calibrated at any distance, with --trusted"
    return f"its rows are {period_s:g} s apart, and those of a fleet may be {COARSEST_PERIOD_S:g} s at most; {alone}"


def too_short(duration_s: float, drives: int) -> str:
    """Say why usable data of this duration is too little; return an empty text if it is enough."""
    if duration_s >= LEAST_DURATION_S:
        return ""
    found = f"{duration_s:.1f} s of usable data in {counted(drives, 'drive')}"
    return f"{found}; at least {LEAST_DURATION_S:.0f} s are needed"


def _temperature_c(channel: Channel | None, samples: Samples) -> Array:
    """Interpolate the temperature at the samples [degC], NaN if not recorded; it is slow, so gaps do no harm."""
    if channel is None or not channel.good.any():
        return np.full(len(samples.time_s), np.nan)
    return np.interp(samples.time_s, channel.time_s[channel.good], channel.value[channel.good])


def require_possible(drive: Drive, layout: Layout) -> None:
    """Raise DriveError if a current is far beyond the full scale of the junction, or an input is not finite."""
    for name, channel in drive.branches.items():
        largest = float(np.abs(channel.value[channel.good]).max(initial=0.0))
        if not largest <= MOST_OVER_FULL_SCALE * layout.full_scale_a:
            raise DriveError(
                f"drive {drive.name}: branch {name} shows {largest:.3g} A, full scale of the junction being "
                f"{layout.full_scale_a:g} A; check its signal in the DBC, or full_scale_a in {layout.path.name}"
            )
    for name, channel in drive.inputs.items():
        if not np.isfinite(channel.value[channel.good]).all():
            raise DriveError(f"drive {drive.name}: input {name} has values that are no numbers; import it again")


def most_moving_first(drives: Sequence[Drive], branches: Sequence[str]) -> tuple[str, ...]:
    """Return the branches by falling variance; drives that lack a branch are skipped here and refused later."""

    def variance_a2(name: str) -> float:
        channels = [drive.branches[name] for drive in drives if name in drive.branches]
        values: list[Array] = [channel.value[channel.good] for channel in channels]
        return float(np.var(np.concatenate(values))) if sum(map(len, values)) else 0.0

    return tuple(sorted(branches, key=variance_a2, reverse=True))


# ---- zero-current windows


def zero_current_offsets(drives: Sequence[Drive], branches: Sequence[str], database: VehicleDatabase) -> ZeroCurrent:
    """Read the offsets of the sensors in all zero-current windows of a vehicle's drives.

    Parameters
    ----------
    drives : sequence of Drive
        Drives of one vehicle.
    branches : sequence of str
        Names of the K branches.
    database : VehicleDatabase
        Its layout names the input that shows whether the contactors are open; without it there are no windows.

    Returns
    -------
    ZeroCurrent
        Offsets of the branches. Their standard deviations include how far an offset wanders: the scatter of the medians
        of pieces of the windows, over the root of the number of windows, as pieces of one window wander together.
        Nothing is read where a current is 0 throughout and has noise elsewhere: a control unit wrote that, no sensor.
    """
    offset, sd = np.full(len(branches), np.nan), np.full(len(branches), np.nan)
    for k, name in enumerate(branches):
        windows = [window for drive in drives for window in _shown(drive, name, database.layout)]
        if sum(len(current.value) for current in windows) >= FEWEST_ZERO_SAMPLES:
            medians = [np.median(current.value) for current in windows]
            pieces = np.concatenate([_medians_of_pieces(current) for current in windows])
            noise = np.concatenate([current.value - middle for current, middle in zip(windows, medians, strict=True)])
            if not (np.any(medians) or noise.any()) and _is_noisy(drives, name, database):
                continue
            white = np.sqrt(np.pi / 2.0) * noise.std() / np.sqrt(len(noise))
            wander = pieces.std(ddof=1) / np.sqrt(len(windows)) if len(pieces) > 1 else 0.0
            step_a = database.current_step_a(name) / np.sqrt(12.0)
            offset[k], sd[k] = np.mean(medians), np.sqrt(ZERO_RESOLUTION_A**2 + step_a**2 + max(white, wander) ** 2)
    return ZeroCurrent(offset_a=offset, sd_a=sd)


def _is_noisy(drives: Sequence[Drive], branch: str, database: VehicleDatabase) -> bool:
    """Check whether a current that flows has noise beyond its step, by the smaller ones of its third differences."""
    channels = [drive.branches[branch] for drive in drives if branch in drive.branches]
    step_a = max(step_seen(channel, database.current_step_a(branch)) for channel in channels)
    value = good_values(drives, branch)
    third_a = np.abs(np.diff(value[value != 0.0], 3))
    return bool(len(third_a) and np.quantile(third_a, QUIETEST) > NOISY_STEPS * step_a)


def _medians_of_pieces(current: Channel) -> Array:
    number = ((current.time_s - current.time_s[0]) / ZERO_PIECE_S).astype(np.int64)
    return np.array([np.median(current.value[number == piece]) for piece in np.unique(number)])


def _shown(drive: Drive, branch: str, layout: Layout) -> Iterator[Channel]:
    """Yield a branch's good samples well inside each zero-current window of a drive.

    A gap in the contactor state ends a window.
    """
    if layout.contactor is None:
        return
    state, current = drive.inputs.get(layout.contactor.input), drive.branches.get(branch)
    if state is None or current is None:
        return
    number = np.cumsum(np.diff(state.time_s, prepend=state.time_s[:1]) > layout.max_age_s)
    number = np.where(_is_open(state, layout.contactor), 2 * number + 1, 0)
    edges = np.append(np.flatnonzero(np.diff(number, prepend=0)), len(number))
    for start, stop in pairwise(edges.tolist()):
        first, last = state.time_s[start] + ZERO_SETTLING_S, state.time_s[stop - 1] - ZERO_SETTLING_S
        inside = (current.time_s >= first) & (current.time_s <= last) & current.good
        if number[start] and inside.any():
            yield Channel(time_s=current.time_s[inside], value=current.value[inside], good=current.good[inside])


def _is_open(state: Channel, contactor: Contactor) -> Mask:
    is_open = np.isclose(state.value[:, None], np.array(contactor.open)[None, :], rtol=1e-9, atol=1e-9).any(axis=1)
    return np.asarray(state.good & is_open)


def weighted_mean(*readings: tuple[Array, Array]) -> tuple[Array, Array]:
    """Return the precision-weighted mean of readings (value, sd) and the sd of this mean; NaN where none is finite."""
    told = [np.isfinite(value) & np.isfinite(sd) for value, sd in readings]
    precision = [np.where(there, 1.0 / np.square(sd), 0.0) for there, (_, sd) in zip(told, readings, strict=True)]
    total = np.sum(precision, axis=0)
    parts = zip(told, precision, readings, strict=True)
    moment = np.sum([np.where(there, weight * value, 0.0) for there, weight, (value, _) in parts], axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(total > 0.0, moment / total, np.nan), np.where(total > 0.0, 1.0 / np.sqrt(total), np.nan)
