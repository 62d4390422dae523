"""Task with all that is needed to calibrate vehicles of a fleet: its reference, learned once, and what the user knows.

The task is sent to other processes, which calibrate a bucket of vehicles each (:func:`calibrate_bucket`).

Only the project's own errors about data leave a vehicle out with advice. Any other exception is a fault of the program:
its vehicle is left out by name, and the others go on.
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import compress
from pathlib import Path

import numpy as np

from calibrator.drive import Mask
from calibrator.errors import DriveError, FleetError, internal_error
from calibrator.estimator.fleet_estimate import FleetEstimate, FleetReference, estimate_vehicles, learn_fleet
from calibrator.estimator.readings import (
    CONTRADICTION,
    FEWEST_TRUSTED,
    FLOWS,
    TRUSTED_DRIFT_SD,
    TRUSTED_OFFSET_SD,
    BenchTable,
    bench_readings,
    flows_in_fleet,
    merge_readings,
    window_readings,
)
from calibrator.estimator.results import PARTS, Calibrated, encode_chunk, part_file, read_part
from calibrator.estimator.settings import RunIdentity
from calibrator.estimator.vehicle_parameters import impossible, parameters_of
from calibrator.estimator.vehicle_report import explained_faults
from calibrator.summaries.record import Record, drives_digest, joined_records
from calibrator.summaries.summary_store import SummaryStore
from calibrator.summaries.vehicle_summary import VehicleSummary
from ecu_node.errors import UserError
from ecu_node.parameters import VehicleParameters, decode_parameters

__all__ = ["FleetTask", "calibrate_bucket", "learn_task"]

LEAST_PROBABILITY = 1e-4
"""Least probability of the explanations near a bench reading: below it the drives contradict the reading. [1]"""
MOVED_SD, MOVED_PROBABILITY = 4.0, 1e-3
"""Number of standard deviations up to which new faults of a sensor count as equal to the earlier ones [1]; sensors have
moved if explanations with faults equal to the earlier ones are together less probable than the second number. [1]"""
AT_ONCE = 32
"""Number of vehicles of a bucket that are estimated together: more take more memory at a time. [1]"""
NOT_THERE = "it is not in this store; its earlier parameters are in the earlier result"


@dataclass(frozen=True, kw_only=True)
class FleetTask:
    """All that is needed to calibrate vehicles of a fleet whose reference is known; it is sent to other processes.

    Attributes
    ----------
    reference : FleetReference
        Reference of the fleet; its branches are those of the vehicles.
    identity : RunIdentity
        Identity of the run, for the parameter files.
    bench : mapping of (str, str) to BenchReading
        Bench readings that are used, by vehicle and branch.
    believed : frozenset of str
        Trusted vehicles whose currents do not contradict the trust in them.
    windows : bool
        Whether zero-current windows are used; not if a current flows in those of most vehicles.
    fleet_size : int
        Number of usable vehicles in the whole fleet, not only in the sample.
    """

    reference: FleetReference
    identity: RunIdentity
    bench: BenchTable
    believed: frozenset[str]
    windows: bool
    fleet_size: int

    @property
    def branches(self) -> tuple[str, ...]:
        """Names of the K branches."""
        return self.reference.branches

    def estimate(self, vehicles: Sequence[VehicleSummary]) -> FleetEstimate:
        """Estimate some vehicles, at least one; the estimate of each does not depend on the others."""
        layout = self.identity.database.layout
        return estimate_vehicles(
            [vehicle.summary for vehicle in vehicles],
            self.reference,
            readings=merge_readings(vehicles, self.bench, self.branches, windows=self.windows)[0],
            trusted=np.array([vehicle.vehicle in self.believed for vehicle in vehicles]),
            harm_limit=self.identity.settings.harm_limit,
            limits=(layout.limits.drift, layout.offset_limit_a),
        )

    def calibrate(self, vehicles: Sequence[VehicleSummary]) -> dict[str, Calibrated | str]:
        """Return by name what was found for one or more vehicles, or why a vehicle has no parameters.

        If they cannot be estimated together, each is estimated by itself: one bad vehicle never stops the others.
        """
        try:
            with np.errstate(all="ignore"):  # results that are not finite are refused later
                estimate = self.estimate(vehicles)
            return {vehicle.vehicle: self._found(vehicle, estimate, j) for j, vehicle in enumerate(vehicles)}
        except Exception as error:  # noqa: BLE001 (a fault of the program is reported with its vehicle)
            if len(vehicles) > 1:
                return {name: found for each in vehicles for name, found in self.calibrate([each]).items()}
            advice = f"its evidence cannot be used: {error}; look at its recordings"
            return {vehicles[0].vehicle: advice if isinstance(error, UserError) else internal_error(error)}

    def choices(self, vehicle: str) -> tuple[object, ...]:
        """Return the user's choices on which the parameters of a vehicle depend, beside its drives."""
        settings = self.identity.settings
        bench = [self.bench.get((vehicle, branch)) for branch in self.branches]
        fleet = settings.harm_limit, settings.load, settings.expected_faults, sorted(settings.hold_out)
        return *fleet, vehicle in settings.trusted, bench, self.windows

    def _found(self, vehicle: VehicleSummary, estimate: FleetEstimate, j: int) -> Calibrated | str:
        if why := impossible(estimate, j, self.branches):
            return why
        parameters = parameters_of(
            vehicle,
            estimate,
            j,
            identity=self.identity,
            branches=self.branches,
            expected_a=self.reference.expected_a,
            fleet_size=self.fleet_size,
        )
        return Calibrated(parameters, estimate.evidence[j])


def learn_task(
    vehicles: Sequence[VehicleSummary],
    bench: BenchTable,
    *,
    branches: tuple[str, ...],
    identity: RunIdentity,
    fleet_size: int,
) -> tuple[FleetTask, list[str]]:
    """Learn the reference of a fleet, and make the task with which each of its vehicles is calibrated.

    Parameters
    ----------
    vehicles : sequence of VehicleSummary
        Sample of the fleet, with every trusted vehicle and every one that has a bench reading. Those held out are not
        learnt from.
    bench : mapping of (str, str) to BenchReading
        Bench readings by vehicle and branch; those that the drives contradict are not used.
    branches : tuple of str
        Names of the K branches.
    identity : RunIdentity
        Identity of the run, with the user's choices.
    fleet_size : int
        Number of vehicles of the fleet that can be used.

    Returns
    -------
    task : FleetTask
        For every vehicle of the fleet.
    notices : list of str
        What may be wrong about the fleet, its trusted vehicles and its bench readings, one line each.
    """
    layout, settings = identity.database.layout, identity.settings
    learning = np.array([vehicle.vehicle not in settings.hold_out for vehicle in vehicles])
    learners = list(compress(vehicles, learning))
    trusted = np.array([vehicle.vehicle in settings.trusted for vehicle in learners])
    windows = not flows_in_fleet(learners)

    def learn(used: BenchTable) -> tuple[FleetTask, list[str]]:
        readings, notices = merge_readings(vehicles, used, branches, windows=windows)
        reference = learn_fleet(
            [vehicle.summary for vehicle in learners],
            full_scale_a=layout.full_scale_a,
            branches=branches,
            readings=readings[:, :, learning],
            trusted=trusted,
            load=settings.load or layout.unmeasured_load,
            expected_faults=settings.expected_faults,
        )
        task = FleetTask(
            reference=reference,
            identity=identity,
            bench=used,
            believed=settings.trusted - {learners[j].vehicle for j in reference.distrusted},
            windows=windows,
            fleet_size=fleet_size,
        )
        return task, notices

    task, notices = learn({})
    if bench:
        wrong = _contradicted(task, vehicles, bench)
        task, notices = learn({sensor: values for sensor, values in bench.items() if sensor not in wrong})
        notices += wrong.values()
    if not windows:
        notices.append(
            f"most vehicles: {FLOWS}; no vehicle's zero-current windows are used; check [contactor] in the layout"
        )
    return task, [*task.reference.notices, *_distrust(learners, trusted, task.reference, windows=windows), *notices]


def _distrust(
    vehicles: Sequence[VehicleSummary], trusted: Mask, reference: FleetReference, *, windows: bool = True
) -> list[str]:
    """Say which trusted vehicles contradict the trust in them, and whether too few are left to carry the reference."""
    notices, names = [], [vehicle.vehicle for vehicle in vehicles]
    carriers = int(np.count_nonzero(trusted)) - len(reference.distrusted)
    if trusted.any() and carriers < FEWEST_TRUSTED:
        notices.append(
            f"only {carriers} of the trusted vehicles can carry the reference, {FEWEST_TRUSTED} are needed: it is the "
            f"fleet's"
        )
    notices += [f"vehicle {names[j]} is not trusted: {why}; check it again" for j, why in reference.distrusted.items()]
    (_, offset_a), (_, sd_a) = window_readings(vehicles)
    shown = (
        windows
        & trusted[:, None]
        & (np.abs(offset_a) > CONTRADICTION * np.hypot(sd_a, TRUSTED_OFFSET_SD * reference.full_scale_a))
    )
    return notices + [
        f"trusted vehicle {names[j]}: its {reference.branches[k]} sensor showed {offset_a[j, k]:+.1f} A with open "
        f"contactors; it was taken for faultless: check it again, or do not trust it"
        for j, k in np.argwhere(shown).tolist()
    ]


def _contradicted(task: FleetTask, vehicles: Sequence[VehicleSummary], bench: BenchTable) -> dict[tuple[str, str], str]:
    """Find bench readings that the drives contradict (misread, or of another vehicle), with a notice for each."""
    named, branches = {vehicle for vehicle, _ in bench}, task.branches
    checked = [vehicle for vehicle in vehicles if vehicle.vehicle in named]
    if not checked:
        return {}
    found, wrong = task.estimate(checked), set[tuple[str, str]]()
    value, sd = bench_readings(bench, [vehicle.vehicle for vehicle in checked], branches)
    for j, vehicle in enumerate(checked):
        faults = np.array([explained_faults(each, branches) for each in found.explanations[j]])
        apart = np.abs(value[:, j] - faults) / np.hypot(sd[:, j], [found.drift_sd[j], found.offset_sd_a[j]])
        near = ~(apart > CONTRADICTION).any(axis=1)  # NaN, not read, counts as near
        probability = np.array([each.probability for each in found.explanations[j]]) @ near
        wrong |= {(vehicle.vehicle, branches[k]) for k in np.flatnonzero(probability < LEAST_PROBABILITY)}
    return {
        (vehicle, branch): f"vehicle {vehicle}: the bench reading of its {branch} sensor is not what its drives show, "
        f"and is not used; check it again, and whether it is of this vehicle"
        for vehicle, branch in bench
        if (vehicle, branch) in wrong
    }


def calibrate_bucket(bucket: int, *, store: SummaryStore, task: FleetTask, previous: Path | None = None) -> bytes:
    """Calibrate the vehicles of a bucket; one bad vehicle never stops the others.

    Parameters
    ----------
    bucket : int
        Number of the bucket.
    store, task : SummaryStore, FleetTask
        The store, and what was learnt from it.
    previous : Path or None
        Earlier result: vehicles without new drives keep its parameters, unless the user's choices for them changed.

    Returns
    -------
    bytes
        Content of a part file of the result (Parquet): parameters, and which vehicles were left out and why.

    Raises
    ------
    UserError
        If the earlier result is not there, or it or the store cannot be read.
    """
    if previous is not None and not (previous / PARTS).is_dir():
        raise FleetError(
            f"{previous / PARTS}: no such folder here; give the whole folder that 'calibrator calibrate' wrote, at a "
            f"path by which every worker reaches it"
        )
    records, before = store.read(bucket), {} if previous is None else read_part(part_file(previous, bucket))
    digests = {name: drives_digest(items, task.choices(name)) for name, items in records.items()}
    found: dict[str, Calibrated | str] = dict.fromkeys(before.keys() - records.keys(), NOT_THERE)
    todo, moved = list[VehicleSummary](), dict[str, dict[str, str]]()
    for name, items in records.items():
        earlier = decode_parameters(before[name].text, f"earlier parameters of {name}") if name in before else None
        if earlier is not None and before[name].drives == digests[name]:
            found[name] = Calibrated(earlier)  # its evidence was found against another reference, and is not kept
            continue
        try:
            summary, moved[name] = _what_holds(items, earlier, task)
            todo.append(summary)
        except DriveError as error:
            found[name] = str(error)
        except UserError:
            raise
        except Exception as error:  # noqa: BLE001 (a fault of the program is reported with its vehicle)
            found[name] = internal_error(error)
    for first in range(0, len(todo), AT_ONCE):
        found |= task.calibrate(todo[first : first + AT_ONCE])
    return encode_chunk(
        {
            name: item if isinstance(item, str) else item._replace(drives=digests[name], moved=moved.get(name, {}))
            for name, item in found.items()
        }
    )


def _what_holds(
    records: Sequence[Record], earlier: VehicleParameters | None, task: FleetTask
) -> tuple[VehicleSummary, dict[str, str]]:
    """Return the summary of all drives of a vehicle, or of the new ones alone if they show that sensors have moved.

    Return also by branch how sensors have moved. Records are in the order in which they came. Those before the first
    one that the earlier parameters were found from are not used: they are older than a move that was found earlier.
    """
    drives = set() if earlier is None else set(earlier.provenance.drives)
    known = [place for place, record in enumerate(records) if record.drives and set(record.drives) <= drives]
    if earlier is None or not known:
        return joined_records(records), {}
    everything, new = joined_records(records[known[0] :]), records[known[-1] + 1 :]
    if any(record.found for record in new):
        with suppress(UserError):  # the new drives alone do not suffice
            recent = joined_records(new)
            if changes := _moved_sensors(earlier, task.estimate([recent]), task):
                return recent, changes
    return everything, {}


def _moved_sensors(before: VehicleParameters, now: FleetEstimate, task: FleetTask) -> dict[str, str]:
    """Say by branch how sensors have moved, if no explanation of the new drives has the earlier faults.

    ``now`` is the estimate of the vehicle from drives that came since ``before``, and from these alone.
    """
    branches, scale_a = task.branches, task.identity.database.layout.full_scale_a
    old = [before.branches[name] for name in branches]
    was = np.array([[item.drift for item in old], [item.offset_a for item in old]])
    was_sd = np.array([[item.drift_sd or 0.0 for item in old], [item.offset_sd_a or 0.0 for item in old]])
    is_now, now_sd = np.array([now.drift[0], now.offset_a[0]]), np.array([now.drift_sd[0], now.offset_sd_a[0]])
    accuracy = np.array([[TRUSTED_DRIFT_SD], [TRUSTED_OFFSET_SD * scale_a]])
    same = MOVED_SD * np.sqrt(now_sd**2 + was_sd**2 + accuracy**2)
    near = (
        each.probability
        for each in now.explanations[0]
        if (np.abs(explained_faults(each, branches) - was) <= same).all()
    )
    if sum(near) >= MOVED_PROBABILITY:
        return {}
    return {
        branches[k]: (
            f"drift {was[0, k]:+z.2%} -> {is_now[0, k]:+z.2%}, offset {was[1, k]:+.2f} A -> {is_now[1, k]:+.2f} A"
        )
        for k in np.flatnonzero((np.abs(is_now - was) > same).any(axis=0)).tolist()
    }
