"""All that it takes to calibrate the vehicles of a fleet: its reference, learned once, and what the user knows.

Only the project's own errors about data leave a vehicle out with advice. Any other exception is a fault of the program:
its vehicle is left out by name, and the others go on.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import compress
from typing import cast

import numpy as np

from calibrator.drives.delays import BranchDelays
from calibrator.errors import internal_error
from calibrator.estimator.fleet_estimate import (
    CONFIDENT,
    SUSPECTED,
    FleetEstimate,
    FleetReference,
    estimate_vehicles,
    learn_fleet,
)
from calibrator.estimator.readings import CONTRADICTION, BenchTable, Readings, merge_readings, trust_notices
from calibrator.estimator.rows import VehicleEvidence
from calibrator.estimator.settings import CalibrationSettings, require_learning
from calibrator.estimator.vehicle_report import deciding_evidence, faults_of, impossible
from calibrator.files.parameter_files import RunIdentity, by_branch, junction_residual
from calibrator.summaries.vehicle_summary import VehicleSummary
from ecu_node.errors import UserError
from ecu_node.parameters import BranchParameters, Explanation, HardwareFault, HeldBack, VehicleParameters, Verdict

__all__ = ["Calibrated", "FleetTask", "learn_task", "parameters_of"]

MOST_REPORTED, LEAST_REPORTED = 3, 0.02
"""Explanations that are reported, and the least probability of one after the first. [1]"""
LEAST_PROBABILITY = 1e-4
"""Of the explanations near a bench reading: below, the drives contradict it. [1]"""


@dataclass(kw_only=True)
class Calibrated:
    """What has been found of some vehicles so far, by name; what has moved by vehicle and branch."""

    parameters: dict[str, VehicleParameters] = field(default_factory=dict)
    left_out: dict[str, str] = field(default_factory=dict)
    evidence: dict[str, VehicleEvidence] = field(default_factory=dict)
    moved: dict[tuple[str, str], str] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class FleetTask:
    """All that it takes to calibrate vehicles of a fleet whose reference is known; goes to other processes.

    Attributes
    ----------
    reference : FleetReference
        Of the fleet; its branches are those of the vehicles.
    identity : RunIdentity
        For the parameter files.
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
    harm_limit: float
    bench: BenchTable
    believed: frozenset[str]
    fleet_size: int

    @property
    def branches(self) -> tuple[str, ...]:
        """Names of the K branches."""
        return self.reference.branches

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
            with np.errstate(all="ignore"):  # numbers that are not finite are refused where they come out
                estimate = self.estimate(vehicles)
            for j, vehicle in enumerate(vehicles):
                if why := impossible(estimate, j, self.branches):
                    found.left_out[vehicle.vehicle] = why
                else:
                    found.parameters[vehicle.vehicle] = parameters_of(
                        vehicle,
                        estimate,
                        j,
                        identity=self.identity,
                        branches=self.branches,
                        expected_a=self.reference.expected_a,
                        fleet_size=self.fleet_size,
                    )
                    found.evidence[vehicle.vehicle] = estimate.evidence[j]
        except Exception as error:  # noqa: BLE001 (a fault of the program is reported with its vehicle)
            if len(vehicles) > 1:
                for vehicle in vehicles:
                    self.calibrate([vehicle], found)
                return
            advice = f"its evidence cannot be used: {error}; look at its recordings"
            found.left_out[vehicles[0].vehicle] = advice if isinstance(error, UserError) else internal_error(error)


def parameters_of(
    vehicle: VehicleSummary,
    estimate: FleetEstimate,
    j: int,
    *,
    identity: RunIdentity,
    branches: Sequence[str],
    expected_a: float,
    fleet_size: int,
    decisive: str | None = None,
) -> VehicleParameters:
    """Write down what was found for vehicle j of an estimate.

    Parameters
    ----------
    vehicle, estimate, j : VehicleSummary, FleetEstimate, int
        The vehicle, and which of the estimate it is.
    identity : RunIdentity
        Of the run.
    branches : sequence of str
        Names of the K branches.
    expected_a : float
        Mean junction sum that right sensors show. [A]
    fleet_size : int
        Vehicles that can be used.
    decisive : str or None
        What would decide; None: found from the explanations.

    Returns
    -------
    VehicleParameters
        Content of its parameter file.
    """
    corrected = estimate.corrected[j]
    reported: list[Explanation] = []
    deciding = decisive or ""
    if (
        estimate.verdicts[j] == "cannot tell"
        or not estimate.confidence[j] >= CONFIDENT
        or (estimate.held_back[j] != "").any()
    ):
        first, *others = estimate.explanations[j][:MOST_REPORTED]
        reported = [first, *(each for each in others if each.probability >= LEAST_REPORTED)]
        layout = identity.database.layout
        if decisive is None:
            deciding, rival = deciding_evidence(
                estimate, j, branches, full_scale_a=layout.full_scale_a, layout=layout.path.name
            )
            reported += [rival] if rival is not None and rival not in reported else []
    hardware = _probability(estimate.hardware_probability[j])
    return VehicleParameters(
        vehicle=vehicle.vehicle,
        layout=identity.layout,
        dbc=identity.dbc,
        verdict=cast("Verdict", estimate.verdicts[j]),
        confidence=_probability(estimate.confidence[j]),
        branches={name: _branch(vehicle.delays, estimate, (j, k), name) for k, name in enumerate(branches)},
        hardware_fault=HardwareFault(
            suspected=hardware is not None and hardware > SUSPECTED,
            drift=float(estimate.hardware_drift[j]),
            offset_a=by_branch(branches, estimate.hardware_offset_a[j]),
            probability=hardware,
        ),
        explanations=reported,
        deciding_evidence=deciding,
        findings=list(estimate.findings[j]),
        junction_residual=junction_residual(
            vehicle.summary.moments[:, vehicle.summary.inputs :, vehicle.summary.inputs :],
            gain=np.where(corrected, 1.0 + estimate.drift[j], 1.0)[None],
            offset_a=np.where(corrected, estimate.offset_a[j], 0.0),
            expected_a=expected_a,
        ),
        provenance=identity.provenance(
            fleet_size=fleet_size, drives=vehicle.drives, duration_s=vehicle.summary.duration_s
        ),
    )


def _branch(delays: BranchDelays, estimate: FleetEstimate, place: tuple[int, int], name: str) -> BranchParameters:
    k = delays.branches.index(name)
    delay_s, delay_sd_s = (float(values[k]) if delays.known[k] else None for values in (delays.delay_s, delays.sd_s))
    return BranchParameters(
        drift=float(estimate.drift[place]),
        offset_a=float(estimate.offset_a[place]),
        drift_sd=float(estimate.drift_sd[place]),
        offset_sd_a=float(estimate.offset_sd_a[place]),
        apply=bool(estimate.corrected[place]),
        held_back=cast("HeldBack | None", str(estimate.held_back[place]) or None),
        delay_s=delay_s,
        delay_sd_s=delay_sd_s,
        fault_probability=_probability(estimate.fault_probability[place]),
        harm_probability=_probability(estimate.harm_probability[place]),
        identifiable=bool(estimate.identifiable[place]),
    )


def _probability(value: float) -> float | None:
    """A probability free of rounding beyond its range; None where it is not known (NaN)."""
    return None if np.isnan(value) else float(np.clip(value, 0.0, 1.0))


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
    layout = identity.database.layout
    learning = np.array(require_learning([vehicle.vehicle for vehicle in vehicles], settings, {}))
    learners = list(compress(vehicles, learning))
    trusted = np.array([vehicle.vehicle in settings.trusted for vehicle in learners])

    def learn(used: BenchTable) -> tuple[FleetTask, list[str]]:
        readings, notices = merge_readings(vehicles, used, branches)
        reference = learn_fleet(
            [vehicle.summary for vehicle in learners],
            full_scale_a=layout.full_scale_a,
            branches=branches,
            readings=readings.take(learning),
            trusted=trusted,
            load=settings.load or layout.unmeasured_load,
            expected_faults=settings.expected_faults,
        )
        task = FleetTask(
            reference=reference,
            identity=identity,
            harm_limit=settings.harm_limit,
            bench=used,
            believed=settings.trusted - {learners[j].vehicle for j in reference.distrusted},
            fleet_size=fleet_size,
        )
        return task, notices

    task, notices = learn({})
    if bench:
        wrong = _contradicted(task, vehicles, bench)
        task, notices = learn({sensor: values for sensor, values in bench.items() if sensor not in wrong})
        notices += wrong.values()
    reference = task.reference
    distrust = trust_notices(
        learners,
        trusted,
        branches,
        untrusted=reference.distrusted,
        differing=reference.differing,
        full_scale_a=layout.full_scale_a,
    )
    return task, [*reference.notices, *distrust, *notices]


def _contradicted(task: FleetTask, vehicles: Sequence[VehicleSummary], bench: BenchTable) -> dict[tuple[str, str], str]:
    """Bench readings that the drives contradict (of another vehicle, or a slip), and what to say of them."""
    named, branches = {vehicle for vehicle, _ in bench}, task.branches
    checked = [vehicle for vehicle in vehicles if vehicle.vehicle in named]
    if not checked:
        return {}
    found, wrong = task.estimate(checked), set[tuple[str, str]]()
    value, sd = Readings.of_bench(bench, [vehicle.vehicle for vehicle in checked], branches).values
    for j, vehicle in enumerate(checked):
        faults = np.array([faults_of(each, branches) for each in found.explanations[j]])
        apart = np.abs(value[:, j] - faults) / np.hypot(sd[:, j], [found.drift_sd[j], found.offset_sd_a[j]])
        near = ~(apart > CONTRADICTION).any(axis=1)  # what was not read is not far
        probability = np.array([each.probability for each in found.explanations[j]]) @ near
        wrong |= {(vehicle.vehicle, branches[k]) for k in np.flatnonzero(probability < LEAST_PROBABILITY)}
    return {
        (vehicle, branch): f"vehicle {vehicle}: the bench reading of its {branch} sensor is not what its drives show, "
        f"and is not used; check it again, and whether it is of this vehicle"
        for vehicle, branch in bench
        if (vehicle, branch) in wrong
    }
