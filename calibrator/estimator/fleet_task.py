"""All that it takes to calibrate the vehicles of a fleet: its reference, learned once, and what the user knows.

Only the project's own errors about data leave a vehicle out with advice. Any other exception is a fault of the program:
its vehicle is left out by name, and the others go on.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from calibrator.estimator.fleet_estimate import FleetEstimate, FleetReference, estimate_vehicles, learn_fleet
from calibrator.estimator.readings import BenchTable, contradicted_readings, merge_readings, trust_notices
from calibrator.estimator.results import internal_error
from calibrator.estimator.settings import CalibrationSettings, require_learning
from calibrator.estimator.vehicle_evidence import VehicleEvidence
from calibrator.estimator.vehicle_report import impossible, vehicle_parameters
from calibrator.files.parameter_files import RunIdentity
from calibrator.summaries.vehicle_summary import VehicleSummary
from ecu_node.errors import UserError
from ecu_node.parameters import VehicleParameters

__all__ = ["Calibrated", "FleetTask", "learn_task"]


@dataclass(kw_only=True)
class Calibrated:
    """What has been found of some vehicles so far, by name."""

    parameters: list[VehicleParameters] = field(default_factory=list)
    left_out: dict[str, str] = field(default_factory=dict)
    evidence: dict[str, VehicleEvidence] = field(default_factory=dict)
    moved: dict[tuple[str, str], str] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class FleetTask:
    """All that it takes to calibrate vehicles of a fleet whose reference is known; goes to other processes.

    Attributes
    ----------
    reference : FleetReference
        Of the fleet.
    identity : RunIdentity
        For the parameter files.
    branches : tuple of str
        Names of the K branches.
    harm_limit : float
        Largest probability of harm with which a branch is corrected. [1]
    bench : mapping
        Bench readings that are used.
    believed : frozenset of str
        Trusted vehicles that do not contradict it.
    fleet_size : int
        Vehicles of the fleet that can be used.
    """

    reference: FleetReference
    identity: RunIdentity
    branches: tuple[str, ...]
    harm_limit: float
    bench: BenchTable
    believed: frozenset[str]
    fleet_size: int

    def estimate(self, vehicles: Sequence[VehicleSummary]) -> FleetEstimate:
        """Estimate some vehicles, at least one; what comes out does not depend on which others are among them."""
        layout = self.identity.database.layout
        return estimate_vehicles(
            [vehicle.summary for vehicle in vehicles],
            self.reference,
            readings=merge_readings(vehicles, self.bench, self.branches)[0],
            trusted=np.array([vehicle.vehicle in self.believed for vehicle in vehicles]),
            harm_limit=self.harm_limit,
            limits=(layout.limits.drift, layout.offset_limit_a),
        )

    def calibrate(self, vehicles: Sequence[VehicleSummary], found: Calibrated) -> None:
        """Estimate some vehicles and add their parameters, or why they have none, to what has been found.

        If they cannot be estimated together, each is by itself: one bad vehicle never stops the others.
        """
        if not vehicles:
            return
        try:
            made = self._calibrated(vehicles)
        except Exception as error:  # noqa: BLE001 (a fault of the program is reported with its vehicle)
            if len(vehicles) == 1:
                advice = f"its evidence cannot be used: {error}; look at its recordings"
                own = isinstance(error, UserError)
                found.left_out[vehicles[0].vehicle] = advice if own else internal_error(error)
                return
            for vehicle in vehicles:
                self.calibrate([vehicle], found)
        else:
            found.parameters += made.parameters
            found.left_out |= made.left_out
            found.evidence |= made.evidence

    def _calibrated(self, vehicles: Sequence[VehicleSummary]) -> Calibrated:
        found = Calibrated()
        with np.errstate(all="ignore"):  # numbers that are not finite are refused where they come out
            estimate = self.estimate(vehicles)
        for j, vehicle in enumerate(vehicles):
            if why := impossible(estimate, j, self.branches):
                found.left_out[vehicle.vehicle] = why
                continue
            parameters = vehicle_parameters(
                vehicle,
                estimate,
                j,
                branches=self.branches,
                identity=self.identity,
                fleet_size=self.fleet_size,
                expected_a=self.reference.expected_a,
            )
            found.parameters.append(parameters)
            if estimate.evidence:
                found.evidence[vehicle.vehicle] = estimate.evidence[j]
        return found


def learn_task(
    vehicles: Sequence[VehicleSummary],
    settings: CalibrationSettings,
    bench: BenchTable,
    *,
    branches: tuple[str, ...],
    identity: RunIdentity,
    fleet_size: int,
) -> tuple[FleetTask, list[str]]:
    """Learn the reference of a fleet.

    Parameters
    ----------
    vehicles : sequence of VehicleSummary
        All to learn from, all that are trusted, and all that were checked on a bench.
    settings : CalibrationSettings
        How.
    bench : mapping
        Bench readings; those that the drives contradict are not used.
    branches : tuple of str
        Names of the K branches.
    identity : RunIdentity
        Of the run.
    fleet_size : int
        Vehicles of the fleet that can be used.

    Returns
    -------
    task : FleetTask
        With which every vehicle can be calibrated.
    notices : list of str
        What the user should know.

    Raises
    ------
    FleetError
        If too few vehicles can be learnt from.
    """
    names, layout = [vehicle.vehicle for vehicle in vehicles], identity.database.layout
    learning = np.array(require_learning(names, settings, {}))
    trusted = np.array([name in settings.trusted for name in names])
    learners = [name for name, use in zip(names, learning, strict=True) if use]

    def learn(used: BenchTable) -> tuple[FleetTask, list[str]]:
        readings, notices = merge_readings(vehicles, used, branches)
        reference = learn_fleet(
            [vehicle.summary for vehicle, use in zip(vehicles, learning, strict=True) if use],
            full_scale_a=layout.full_scale_a,
            branches=branches,
            readings=readings.take(learning),
            trusted=trusted[learning],
            load=layout.unmeasured_load,
            expected_faults=settings.expected_faults,
        )
        task = FleetTask(
            reference=reference,
            identity=identity,
            branches=branches,
            harm_limit=settings.harm_limit,
            bench=used,
            believed=settings.trusted - {learners[j] for j in reference.distrusted},
            fleet_size=fleet_size,
        )
        return task, notices

    task, notices = learn({})
    if bench:
        wrong = _contradicted(task, vehicles, bench)
        task, notices = learn({sensor: values for sensor, values in bench.items() if sensor not in wrong})
        notices += wrong.values()
    return task, [
        *task.reference.notices,
        *trust_notices(
            [vehicle for vehicle, use in zip(vehicles, learning, strict=True) if use],
            trusted[learning],
            branches,
            untrusted=task.reference.distrusted,
            differing=task.reference.differing,
            full_scale_a=layout.full_scale_a,
        ),
        *notices,
    ]


def _contradicted(
    task: FleetTask, vehicles: Sequence[VehicleSummary], bench: BenchTable
) -> Mapping[tuple[str, str], str]:
    """Bench readings that the drives contradict, by vehicle and branch, and what to say of them."""
    named = {vehicle for vehicle, _ in bench}
    checked = [vehicle for vehicle in vehicles if vehicle.vehicle in named]
    if not checked:
        return {}
    found, branches = task.estimate(checked), task.branches
    certain = np.isfinite(found.confidence)  # where the reference is in doubt, drives contradict nothing
    most = max(len(each) for each in found.explanations)
    weight = np.zeros((len(checked), most))
    values = np.zeros((2, len(checked), most, len(branches)))
    for j, explanations in enumerate(found.explanations):
        for s, each in enumerate(explanations):
            weight[j, s] = each.probability
            values[:, j, s] = [[part.get(name, 0.0) for name in branches] for part in (each.drift, each.offset_a)]
    wrong = contradicted_readings(
        bench,
        [vehicle.vehicle for vehicle in checked],
        branches,
        weight=weight,
        drift=values[0],
        drift_sd=np.repeat(found.drift_sd[:, None], most, axis=1),
        offset_a=values[1],
        offset_sd_a=np.repeat(found.offset_sd_a[:, None], most, axis=1),
    )
    sure = {vehicle.vehicle for vehicle, is_certain in zip(checked, certain, strict=True) if is_certain}
    return {sensor: text for sensor, text in wrong.items() if sensor[0] in sure}
