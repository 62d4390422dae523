"""Calibrate single junctions: read their recordings, collect what is known of them, and make a part of the result.

The estimate itself is made by :mod:`calibrator.estimator.junction`.
"""

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np
from scipy.ndimage import maximum_filter1d, minimum_filter1d

from calibrator.drive import Array, Drive, DriveFile, Equipment, FleetSource, Samples, good_samples
from calibrator.drives.align import align, at_pace
from calibrator.drives.charge import GAP_PERIODS
from calibrator.drives.delays import MAX_DELAY_S, estimate_delays, without_delays
from calibrator.errors import DriveError, FleetError
from calibrator.estimator.junction import SEEN, JunctionKnowledge, JunctionLaw, estimate_junction, named_ratios
from calibrator.estimator.readings import (
    TRUSTED_DRIFT_SD,
    TRUSTED_OFFSET_SD,
    bench_readings,
    read_bench_table,
    window_readings,
)
from calibrator.estimator.results import Calibrated, encode_chunk
from calibrator.estimator.settings import CalibrationSettings, RunIdentity
from calibrator.estimator.vehicle_parameters import impossible, parameters_of
from calibrator.estimator.vehicle_report import sensor_texts
from calibrator.processes.run_many import Workers
from calibrator.recordings.frame_arrays import CLOCK_GAP_S
from calibrator.sources.fleet_source import load_drive, probe_equipment, read_vehicles
from calibrator.summaries.moments import BLOCK_S
from calibrator.summaries.summariser import summarise_samples
from calibrator.summaries.vehicle_summary import (
    VehicleSummary,
    most_moving_first,
    require_possible,
    with_noise_of_steps,
    zero_current_offsets,
)
from calibrator.terminal.progress import shown
from calibrator.terminal.text import few_reasons
from ecu_node.database import VehicleDatabase
from ecu_node.errors import UserError
from ecu_node.layout import Layout
from ecu_node.parameters import VehicleParameters

__all__ = ["calibrate_junctions", "read_junction", "summarise_junction"]

_Made = TypeVar("_Made")

LEAST_DURATION_S, SHORTEST_BLOCK_S, BLOCKS, FEWEST_BLOCKS = 5.0, 0.5, 16, 5
"""Least valid data [s], shortest block [s], number of blocks of a short recording, and by how many the blocks must
outnumber the branches, so that uncertainties can be estimated."""
FULL_BLOCK = 10
"""Least number of samples of a block, unless the recording is short."""
MOST_MISSING = 0.05
"""Share of a recording without samples of a branch up to which its charge is integrated. [1]"""
JUMP = 0.02
"""Change of a current within its largest possible delay, over full scale, that counts as a jump. [1]"""
MOST_SHOWN = 5
"""Largest number of vehicles whose gain ratios are shown one by one."""
WORSE, WORSE_A = 1.5, 1.0
"""A correction is reported if it raises the RMS of the junction sum by more than this factor [1] and current. [A]"""
MOST_READ_HERE = 5
"""Largest number of vehicles that are read in this process: other processes would take longer to start."""


def read_junction(entries: Sequence[DriveFile], equipment: Equipment, database: VehicleDatabase) -> VehicleSummary:
    """Read the drives of one vehicle and summarise them, see :func:`summarise_junction`."""
    return summarise_junction([load_drive(entry, database) for entry in entries], equipment.branches, database)


def summarise_junction(drives: Sequence[Drive], branches: Sequence[str], database: VehicleDatabase) -> VehicleSummary:
    """Summarise the currents of one vehicle, in short blocks if its drives are short.

    Parameters
    ----------
    drives : sequence of Drive
        Drives of one vehicle.
    branches : sequence of str
        Names of the K branches.
    database : VehicleDatabase
        DBC and layout.

    Returns
    -------
    VehicleSummary
        Without inputs.

    Raises
    ------
    DriveError
        If a branch is missing, a value is impossible, or there is too little valid data.
    """
    layout = at_pace(database.layout, drives)
    for drive in drives:
        require_possible(drive, layout)
    delays = estimate_delays(drives, most_moving_first(drives, branches))
    samples = [align(without_delays(drive, delays.by_branch()), layout, branches, inputs=()) for drive in drives]
    samples = _without_jumps(samples, [delays.branches[k] for k in np.flatnonzero(~delays.known)], layout)
    duration_s = layout.period_s * sum(int(part.valid.sum()) for part in samples)
    if duration_s < LEAST_DURATION_S:
        raise DriveError(
            f"{duration_s:.1f} s in which all branches have usable samples; at least {LEAST_DURATION_S:g} s are "
            f"needed; rows farther apart than the timeout_s of their branch are stale"
        )
    longest_s = max(BLOCK_S, FULL_BLOCK * layout.period_s)
    block_s = max(min(longest_s, duration_s / BLOCKS), SHORTEST_BLOCK_S, layout.period_s)
    summary = summarise_samples(samples, period_s=layout.period_s, block_s=block_s)
    summary = with_noise_of_steps(summary, drives, branches, database)
    if len(summary.moments) < len(branches) + FEWEST_BLOCKS:
        raise DriveError(
            f"{duration_s:.1f} s of usable samples on a time base of {layout.period_s:g} s tell too little: at least "
            f"{(len(branches) + FEWEST_BLOCKS) * block_s:.0f} s are needed"
        )
    return VehicleSummary(
        vehicle=drives[0].vehicle,
        drives=tuple(drive.name for drive in drives),
        summary=summary,
        delays=delays,
        zero_current=zero_current_offsets(drives, branches, database),
    )


def _without_jumps(drives: Sequence[Samples], unknown: Sequence[str], layout: Layout) -> list[Samples]:
    """Leave out samples near a jump of a branch whose delay is not known: the jump would appear in the junction's sum.

    Where that would leave less than half of the samples, as on a drive that is all jumps, they stay.
    """
    kept = []
    width = 2 * round(MAX_DELAY_S / layout.period_s) + 1
    for drive in drives:
        jump = np.zeros(len(drive.valid), bool)
        for name in unknown:
            current_a = drive.currents_a[:, drive.branch_names.index(name)]
            low_a = minimum_filter1d(np.where(drive.valid, current_a, np.inf), width)
            high_a = maximum_filter1d(np.where(drive.valid, current_a, -np.inf), width)
            jump |= high_a - low_a > JUMP * layout.full_scale_a
        kept.append(replace(drive, valid=drive.valid & ~jump))
    before, after = (sum(int(drive.valid.sum()) for drive in each) for each in (drives, kept))
    return kept if 2 * after > before else list(drives)


def _same_error(parameters: VehicleParameters, known: Collection[str]) -> list[str]:
    """Return a notice if all gains deviate alike from the only known one, which may itself be wrong then; else []."""
    others = [branch for name, branch in parameters.branches.items() if name not in known]
    drifts = np.array([branch.drift for branch in others])
    sds = np.array([branch.drift_sd for branch in others], dtype=float)
    if len(known) != 1 or len(others) < 2 or not (np.abs(drifts) > SEEN * sds).all():
        return []
    if np.ptp(drifts) > SEEN * np.hypot(*np.sort(sds)[-2:]):
        return []
    (reference,), error = known, drifts.mean()
    own = 1.0 / (1.0 + error) - 1.0
    return [f"all others read {error:+z.1%} against {reference}: a gain error of its own of {own:+z.1%} looks the same"]


def calibrate_junctions(
    fleet: FleetSource, identity: RunIdentity, *, workers: Workers
) -> tuple[Equipment, bytes, dict[str, object], list[str]]:
    """Calibrate each vehicle by itself; with option --meter all together, as they are recordings of one car.

    Parameters
    ----------
    fleet : FleetSource
        The recordings.
    identity : RunIdentity
        Identity of the run, with the user's choices; ``trusted`` are here names of branches whose sensor is right.
    workers : Workers
        Processes or cluster that read the drives, if there are many.

    Returns
    -------
    equipment : Equipment
        The K branches of the vehicles, without inputs.
    part : bytes
        Content of a part file of the result (Parquet): parameters of every vehicle that could be used, and why the
        others could not.
    details : dict of str to JSON values
        Gain ratios and constants, for the record of the run.
    notices : list of str
        What was found for each of a few vehicles, and known values that contradict each other.

    Raises
    ------
    UserError
        If no vehicle can be used, or something is given as known of a branch or vehicle that is not there.
    """
    layout, settings = identity.database.layout, identity.settings
    equipment, vehicles, left_out, drives = _read(fleet, identity.database, settings, workers)
    branches, load = equipment.branches, settings.load or layout.unmeasured_load
    expected_a = 0.0 if load is None else load.mean_a
    read = _known_readings(vehicles, branches, settings, layout, left_out=left_out)
    charge_a = _charges(drives, settings, fleet)
    groups = [[j] for j in range(len(vehicles))] if settings.meter is None else [[*range(len(vehicles))]]
    calibrated, junctions, notices = dict[str, Calibrated](), dict[str, object](), list[str]()
    worse = dict[str, str]()
    for group in groups:
        known = JunctionKnowledge(read[..., group, :], load, charge_a, settings.meter)
        try:
            found, laws, deciding, contradictions = estimate_junction(
                [vehicles[j] for j in group], branches, known, layout=layout, harm_limit=settings.harm_limit
            )
        except FleetError as error:
            if len(groups) == 1:
                raise
            left_out[vehicles[group[0]].vehicle] = str(error)
            continue
        if contradictions:
            why = "; ".join(contradictions)
            notices.append(f"what is known contradicts itself or the recording, so nothing is corrected: {why}")
        for i, j in enumerate(group):
            name = vehicles[j].vehicle
            if why := impossible(found, i, branches):
                left_out[name] = why
                continue
            mine = parameters_of(
                vehicles[j],
                found,
                i,
                identity=identity,
                branches=branches,
                expected_a=expected_a,
                fleet_size=1,
                decisive=deciding[i],
            )
            calibrated[name] = Calibrated(mine)
            was_a, is_a = mine.junction_residual.about_expected()
            if is_a > max(WORSE * was_a, was_a + WORSE_A) and any(each.apply for each in mine.branches.values()):
                worse[name] = f"RMS {was_a:.2f} A -> {is_a:.2f} A"
            junctions[name] = {"gain_ratio": named_ratios(laws[i], branches), "constant_a": laws[i].constant_a}
            if len(vehicles) <= MOST_SHOWN:
                gains_known = [branches[k] for k in np.flatnonzero(np.isfinite(read[:, 0, 0, j]).any(axis=0))]
                texts = [*_shown_texts(mine, laws[i]), *_same_error(mine, gains_known)]
                notices += [f"{name}: {text}" for text in texts]
    if worse:
        what = "the values and signs of what was declared (--charge, --load, --trusted, --readings)"
        where = few_reasons(worse)
        notices.append(
            f"the correction makes the junction sum worse; check {what}, or for a load without a sensor{where}"
        )
    details = {"junction": junctions, "declared_load_a": expected_a}
    return equipment, encode_chunk({**left_out, **calibrated}), details, notices


def _shown_texts(parameters: VehicleParameters, law: JunctionLaw) -> list[str]:
    """Describe the sensors of a vehicle, its gain ratios and the sum of its sensors at zero current."""
    ratios = named_ratios(law, list(parameters.branches)).items()
    said = ", ".join(f"{value:.4f} +- {sd:.4f} ({pair})" for pair, (value, sd) in ratios)
    return [
        *(f"{branch}: {text}" for branch, text in sensor_texts(parameters).items()),
        f"gain ratios {said}; at zero current the sensors sum to {law.constant_a[0]:+.2f} +- "
        f"{law.constant_a[1]:.2f} A: their offsets, and loads without a sensor",
    ]


def _read(
    fleet: FleetSource, database: VehicleDatabase, settings: CalibrationSettings, workers: Workers
) -> tuple[Equipment, list[VehicleSummary], dict[str, str], list[Sequence[Drive]]]:
    """Return equipment, summaries of usable vehicles, why others are not, and each one's drives if they are few."""
    branches, limit_s = settings.branches, settings.time_limit_s
    if len(fleet.vehicles) > MOST_READ_HERE:
        equipment = probe_equipment(fleet, database, branches, limit_s=limit_s, modelled=False)
        found = read_vehicles(read_junction, fleet, equipment, database, workers=workers, limit_s=limit_s)
        return equipment, *found, []
    left_out = dict(fleet.left_out)

    def usable(make: Callable[[Any], _Made], items: Iterable[tuple[str, Any]]) -> dict[str, _Made]:
        """Apply ``make`` to the item of each vehicle; leave out those where it fails; FleetError if all do."""
        found = dict[str, _Made]()
        for vehicle, item in items:
            try:
                found[vehicle] = make(item)
            except UserError as problem:
                left_out[vehicle] = str(problem)
        if not found:
            raise FleetError(list(left_out.values())[-1])
        return found

    entries = shown(fleet.vehicles.items(), "read drives", len(fleet.vehicles), "vehicles")
    drives = usable(lambda mine: [load_drive(entry, database) for entry in mine], entries)
    first = [mine[0] for mine in drives.values()]
    equipment = probe_equipment(fleet, database, branches, limit_s=limit_s, modelled=False, drives=first)
    vehicles = usable(lambda mine: summarise_junction(mine, equipment.branches, database), drives.items())
    return equipment, list(vehicles.values()), left_out, list(drives.values())


def _known_readings(
    vehicles: Sequence[VehicleSummary],
    branches: Sequence[str],
    settings: CalibrationSettings,
    layout: Layout,
    *,
    left_out: Mapping[str, str],
) -> Array:
    """Collect what is known of sensors, see :class:`JunctionKnowledge`; FleetError if one of them is not there."""
    scale_a, names = layout.full_scale_a, [each.vehicle for each in vehicles]
    meter = [settings.meter] if settings.meter else []
    for option, given in {"--trusted": settings.trusted, "--charge": settings.charge_ah, "--meter": meter}.items():
        for name in given:
            if name not in branches:
                raise FleetError(f"{option} {name}: no such branch was recorded; there are {', '.join(branches)}")
    if meter and len(vehicles) < 2:
        raise FleetError(f"--meter {settings.meter}: one folder of recordings; give one for each of its sensors")
    problems = {**left_out, **dict.fromkeys(names, "")}
    bench = read_bench_table(settings.readings, branches, problems, trusted=(), full_scale_a=scale_a)
    right = np.full((2, 2, len(names), len(branches)), np.nan)
    for k, name in enumerate(branches):
        if name in settings.trusted:
            of = slice(None) if name == settings.meter or not meter else slice(1)  # once for each sensor
            right[0, :, of, k] = 0.0
            right[1, 0, of, k] = max(TRUSTED_DRIFT_SD, layout.find_branch(name).uncertainty)
            right[1, 1, of, k] = TRUSTED_OFFSET_SD * scale_a
    return np.stack([window_readings(vehicles), bench_readings(bench, names, branches), right])


def _charges(
    drives: Sequence[Sequence[Drive]], settings: CalibrationSettings, fleet: FleetSource
) -> dict[str, tuple[float, float, float]]:
    """Return :attr:`JunctionKnowledge.charge_a`, empty if no charge is given; FleetError if it cannot be used. [A]"""
    if not settings.charge_ah:
        return {}
    if len(drives) != 1:
        raise FleetError(
            f"--charge is of the recordings of one vehicle, and there are {len(fleet.vehicles)}; give those of one"
        )
    found, duration_s = {}, sum(drive.duration_s for drive in drives[0])
    for branch, (charge_ah, sd_ah) in settings.charge_ah.items():
        measured_as = missing_s = error_as2 = longest_s = 0.0
        for drive in drives[0]:
            time_s, value_a = good_samples(drive.branches[branch])
            if len(time_s) < 2:
                missing_s, longest_s = missing_s + drive.duration_s, np.inf
                continue
            step_s = np.diff(time_s)
            at_ends_s, is_gap = drive.duration_s - step_s.sum(), step_s > GAP_PERIODS * np.median(step_s)
            gap_s = np.append(step_s[is_gap], at_ends_s)
            measured_as += float(np.trapezoid(value_a, time_s)) * drive.duration_s / float(step_s.sum())
            missing_s += float(gap_s.sum())
            longest_s = max(longest_s, float(gap_s.max()))
            # in a gap the current may be any that it has elsewhere; gaps may all be where it is large
            beside_a = np.append(value_a[:-1][is_gap], value_a[1:][is_gap])
            unusual_a = float(beside_a.mean() - value_a.mean()) if is_gap.any() else 0.0
            error_as2 += float(np.sum(gap_s**2) * np.var(value_a) + (gap_s.sum() * unusual_a) ** 2)
        if missing_s > MOST_MISSING * duration_s or longest_s >= CLOCK_GAP_S - 0.5:
            raise FleetError(
                f"--charge {branch}: {missing_s:.0f} s of {duration_s:.0f} s have no samples of it, so its charge is "
                f"not known (at most {MOST_MISSING:.0%} may be missing, and less than {CLOCK_GAP_S:g} s at once); "
                f"leave the option out"
            )
        sd_as = float(np.sqrt((3600.0 * sd_ah) ** 2 + error_as2))
        found[branch] = measured_as / duration_s, charge_ah * 3600.0 / duration_s, sd_as / duration_s
    return found
