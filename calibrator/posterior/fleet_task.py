"""What it takes to calibrate any vehicles of a fleet whose reference is known, a few at a time."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from calibrator.evidence.vehicle_evidence import VehicleEvidence
from calibrator.files.parameter_files import RunIdentity
from calibrator.posterior.bench import merge_readings
from calibrator.posterior.bench_table import BenchReadings
from calibrator.posterior.calibration import FleetReference, estimate_summaries
from calibrator.posterior.estimate import FleetPosterior
from calibrator.posterior.model_decision import JudgedSensor, judge_sensor
from calibrator.posterior.model_parameters import tell_sensors, with_model_residual
from calibrator.posterior.second_pass import ModelJudge, with_sensor_models
from calibrator.posterior.told_evidence import told_evidence
from calibrator.posterior.vehicle_parameters import impossible_vehicles, vehicle_parameters
from calibrator.posterior.verdict import Deployment, decide
from calibrator.sensor_models.choice import SensorModelChoice
from calibrator.sensor_models.fleet import SensorFindings, all_linear
from calibrator.sensor_models.modelled import ModelledVehicle
from calibrator.summaries.moments import DriveSummary
from calibrator.summaries.vehicle_summary import VehicleSummary
from ecu_node.parameters import VehicleParameters

__all__ = ["Calibrated", "FleetTask"]

Judged = Mapping[int, JudgedSensor]
"""Sensors of a vehicle that are not linear, by branch."""


@dataclass(frozen=True, kw_only=True)
class Calibrated:
    """What was found of some vehicles.

    Attributes
    ----------
    parameters : list of VehicleParameters
        Of those that can be calibrated.
    left_out : dict of str to str
        Why the others cannot.
    evidence : dict of str to VehicleEvidence
        What the parameters were found from, by vehicle.
    """

    parameters: list[VehicleParameters]
    left_out: dict[str, str]
    evidence: dict[str, VehicleEvidence]


@dataclass(frozen=True, kw_only=True)
class FleetTask:
    """All that it takes to calibrate vehicles of a fleet whose reference is known.

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
        Trusted vehicles that do not break the junction law.
    fleet_size : int
        Vehicles of the fleet that can be used.
    not_linear : mapping of str to (sequence of SensorModelChoice, ModelledVehicle or None)
        Of the vehicles that have sensors that are not linear, or may have; None where no sensor was chosen.
    """

    reference: FleetReference
    identity: RunIdentity
    branches: tuple[str, ...]
    harm_limit: float
    bench: BenchReadings
    believed: frozenset[str]
    fleet_size: int
    not_linear: Mapping[str, tuple[Sequence[SensorModelChoice], ModelledVehicle | None]] = field(default_factory=dict)

    def calibrate(self, vehicles: Sequence[VehicleSummary]) -> Calibrated:
        """Calibrate some vehicles; what comes out does not depend on which others are among them.

        Parameters
        ----------
        vehicles : sequence of VehicleSummary
            N of them.

        Returns
        -------
        Calibrated
            Parameters of those whose currents a sensor can show.
        """
        if not vehicles:
            return Calibrated(parameters=[], left_out={}, evidence={})
        findings, posterior = self._findings(vehicles), self.estimate(vehicles)
        impossible = impossible_vehicles(posterior, self.branches)
        judged = [
            {} if j in impossible else self._judge(vehicle, findings.modelled[j], posterior, j)
            for j, vehicle in enumerate(vehicles)
        ]
        layout, health = self.identity.database.layout, self.reference.health
        decision = decide(posterior, layout, harm_limit=self.harm_limit, doubtful=health.doubtful)
        judge = ModelJudge(layout=layout, harm_limit=self.harm_limit)
        deployment = with_sensor_models(decision, posterior, findings, judged, judge)
        parameters = [
            self._written(vehicle, posterior, deployment, position=j, findings=findings, judged=judged[j])
            for j, vehicle in enumerate(vehicles)
            if j not in impossible
        ]
        evidence = told_evidence(posterior, full_scale_a=layout.full_scale_a)
        return Calibrated(
            parameters=parameters,
            left_out={vehicles[j].vehicle: why for j, why in impossible.items()},
            evidence={vehicle.vehicle: found for vehicle, found in zip(vehicles, evidence, strict=True)},
        )

    def estimate(self, vehicles: Sequence[VehicleSummary]) -> FleetPosterior:
        """Posterior of some vehicles, at least one, in their order."""
        return self._estimate(vehicles, self._findings(vehicles).summaries)

    def _estimate(self, vehicles: Sequence[VehicleSummary], summaries: Sequence[DriveSummary]) -> FleetPosterior:
        """Posterior of vehicles that have these summaries."""
        readings, _ = merge_readings(vehicles, self.bench, self.branches)
        return estimate_summaries(
            summaries,
            self.reference,
            readings=readings,
            believed=np.array([vehicle.vehicle in self.believed for vehicle in vehicles]),
        )

    def _judge(
        self, vehicle: VehicleSummary, modelled: ModelledVehicle | None, posterior: FleetPosterior, j: int
    ) -> Judged:
        """How sure corrections of a vehicle's sensors that are not linear are."""
        if modelled is None:
            return {}
        judge = partial(
            judge_sensor,
            modelled,
            estimate=lambda summaries: self._estimate([vehicle] * len(summaries), summaries),
            full_scale_a=self.identity.database.layout.full_scale_a,
        )
        drift, offset_a = posterior.faults.drift[j].tolist(), posterior.faults.offset_a[j].tolist()
        return {
            sensor.branch: judge(sensor=sensor, drift=drift[sensor.branch], offset_a=offset_a[sensor.branch])
            for sensor in modelled.sensors
        }

    def _written(
        self,
        vehicle: VehicleSummary,
        posterior: FleetPosterior,
        deployment: Deployment,
        *,
        position: int,
        findings: SensorFindings,
        judged: Judged,
    ) -> VehicleParameters:
        """Parameters of one vehicle, with its sensor models."""
        linear_parts = vehicle_parameters(
            vehicle,
            posterior,
            deployment,
            position=position,
            branches=self.branches,
            identity=self.identity,
            fleet_size=self.fleet_size,
        )
        parameters = tell_sensors(linear_parts, findings.choices[position], judged)
        modelled = findings.modelled[position]
        if modelled is None:
            return parameters
        drift = {name: branch.drift for name, branch in linear_parts.branches.items()}
        return with_model_residual(parameters, modelled, linear=drift)

    def _findings(self, vehicles: Sequence[VehicleSummary]) -> SensorFindings:
        linear = all_linear(vehicles)
        found = [self.not_linear.get(vehicle.vehicle) for vehicle in vehicles]
        modelled = [None if it is None else it[1] for it in found]
        return SensorFindings(
            choices=[row if it is None else it[0] for it, row in zip(found, linear.choices, strict=True)],
            summaries=[
                part if it is None else it.linear_parts for it, part in zip(modelled, linear.summaries, strict=True)
            ],
            modelled=modelled,
        )
