"""The default method on a real fleet: drives -> summaries -> evidence -> posterior -> parameter files.

If asked to, the drives are read a second time to find sensors that are not linear; if there are any, the posterior is
computed anew from the linear parts of all sensors.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import cast

import numpy as np

from calibrator.calibration_settings import CalibrationSettings, FleetOutcome, require_learning
from calibrator.drive import Mask
from calibrator.drives.fleet_source import Equipment, FleetSource
from calibrator.errors import FleetError
from calibrator.evidence.readings import Readings
from calibrator.evidence.vehicle_summary import VehicleSummary, read_vehicle_summary
from calibrator.parameter_files import RunIdentity, by_branch, junction_rms_a
from calibrator.posterior.advice import advise
from calibrator.posterior.bench import (
    believed,
    contradicted_readings,
    merge_readings,
    read_bench,
    trust_notices,
    trusted_of,
    window_notices,
)
from calibrator.posterior.bench_table import BenchReadings
from calibrator.posterior.calibration import calibrate_posterior
from calibrator.posterior.estimate import FleetPosterior
from calibrator.posterior.explain import explanations
from calibrator.posterior.second_pass import finding_notices, tell_sensors, without_sensor_models
from calibrator.posterior.verdict import Deployment, decide
from calibrator.sensor_models.fleet import SensorFindings, all_linear, find_sensor_models
from calibrator.vehicles import read_vehicles
from ecu_node.parameters import (
    BranchParameters,
    Explanation,
    HardwareFault,
    HeldBack,
    JunctionResidual,
    VehicleParameters,
)

__all__ = ["calibrate_fleet_posterior"]

UNTOLD = 0.05
"""Probability of other explanations up to which they are not told. [1]"""
MOST_TOLD, LEAST_TOLD = 3, 0.02
"""Explanations that are told, and the least probability of one after the first. [1]"""


def calibrate_fleet_posterior(
    fleet: FleetSource, equipment: Equipment, identity: RunIdentity, settings: CalibrationSettings, *, workers: int
) -> FleetOutcome:
    """Calibrate a fleet by the sparse posterior.

    Parameters
    ----------
    fleet, equipment : FleetSource, Equipment
        The fleet, its branches and inputs.
    identity : RunIdentity
        For the parameter files.
    settings : CalibrationSettings
        How.
    workers : int
        Number of processes.

    Returns
    -------
    FleetOutcome
        Parameters of every vehicle that could be used.

    Raises
    ------
    FleetError
        If too few vehicles can be used, or a trusted one is not there.
    """
    full_scale_a = identity.database.layout.full_scale_a
    bench = read_bench(settings, fleet, equipment.branches, full_scale_a=full_scale_a)
    limit_s = settings.time_limit_s
    vehicles, left_out = read_vehicles(
        read_vehicle_summary, fleet, equipment, identity.database, workers=workers, limit_s=limit_s
    )
    names = [vehicle.vehicle for vehicle in vehicles]
    learning = require_learning(names, settings, left_out)
    trusted = trusted_of(names, settings.trusted, fleet)
    estimate = partial(
        calibrate_posterior,
        full_scale_a=full_scale_a,
        branches=equipment.branches,
        trusted=trusted,
        learning=np.array(learning),
        load=identity.database.layout.unmeasured_load,
    )
    posterior, readings, doubts = _first_pass(estimate, vehicles, bench, equipment.branches, full_scale_a)
    findings = all_linear(vehicles)
    if settings.sensor_models:
        findings = find_sensor_models(
            vehicles,
            posterior.faults.offset_a,
            fleet,
            equipment,
            identity.database,
            learning=np.array(learning),
            trusted=believed(trusted, posterior.health),
            workers=workers,
            limit_s=limit_s,
        )
    if findings.not_linear.any():
        posterior = estimate(findings.summaries, readings=readings)
    health = posterior.health
    assert health is not None
    decision = decide(posterior, identity.database.layout, harm_limit=settings.harm_limit, doubtful=health.doubtful)
    left_out |= _impossible(vehicles, posterior, equipment.branches)
    parameters = _parameter_files(vehicles, posterior, decision, findings, equipment=equipment, identity=identity)
    if not parameters:
        raise FleetError(f"{fleet.path}: no vehicle can be calibrated; the first: {next(iter(left_out.values()))}")
    return FleetOutcome(
        parameters=parameters,
        left_out=left_out,
        notices=(
            *health.warnings,
            *trust_notices(names, trusted, health),
            *doubts,
            *window_notices(vehicles, believed(trusted, health), equipment.branches, full_scale_a),
            *finding_notices(names, findings, equipment.branches),
        ),
        details=_details(posterior, equipment.branches),
    )


def _first_pass(
    estimate: Callable[..., FleetPosterior],
    vehicles: Sequence[VehicleSummary],
    bench: BenchReadings,
    branches: Sequence[str],
    full_scale_a: float,
) -> tuple[FleetPosterior, Readings, list[str]]:
    """Posterior of sensors that are taken for linear, the readings that were used, and what is to be said of them."""
    summaries = [vehicle.summary for vehicle in vehicles]
    readings, notices = merge_readings(vehicles, {}, branches)
    posterior = estimate(summaries, readings=readings)
    if bench:
        names = [vehicle.vehicle for vehicle in vehicles]
        wrong = contradicted_readings(posterior, bench, names, branches, full_scale_a)
        used = {sensor: values for sensor, values in bench.items() if sensor not in wrong}
        readings, notices = merge_readings(vehicles, used, branches)
        notices += wrong.values()
        posterior = estimate(summaries, readings=readings)
    return posterior, readings, notices


def _parameter_files(
    vehicles: Sequence[VehicleSummary],
    posterior: FleetPosterior,
    decision: Deployment,
    findings: SensorFindings,
    *,
    equipment: Equipment,
    identity: RunIdentity,
) -> list[VehicleParameters]:
    """One per vehicle whose currents a sensor can show."""
    deployment, possible = without_sensor_models(decision, findings), _possible(posterior)
    return [
        tell_sensors(
            _parameters(vehicle, posterior, deployment, position=j, branches=equipment.branches, identity=identity),
            findings.choices[j],
        )
        for j, vehicle in enumerate(vehicles)
        if possible[j].all()
    ]


def _possible(posterior: FleetPosterior) -> Mask:
    """Branches whose drift a sensor can have, shape (N, K)."""
    return np.asarray(np.abs(posterior.faults.drift) < 1.0)


def _impossible(
    vehicles: Sequence[VehicleSummary], posterior: FleetPosterior, branches: Sequence[str]
) -> dict[str, str]:
    """Why vehicles whose currents no sensor can show have no parameters."""
    possible = _possible(posterior)
    return {
        vehicle.vehicle: (
            f"its {branches[int(np.argmin(possible[j]))]} current does not follow its inputs as in the rest of the "
            f"fleet: parked, stuck, or another kind of vehicle? record a drive in which it is used"
        )
        for j, vehicle in enumerate(vehicles)
        if not possible[j].all()
    }


def _parameters(
    vehicle: VehicleSummary,
    posterior: FleetPosterior,
    deployment: Deployment,
    *,
    position: int,
    branches: Sequence[str],
    identity: RunIdentity,
) -> VehicleParameters:
    """Write down what was found for one vehicle."""
    j = position
    faults, corrected, zeros = posterior.faults.take(j), deployment.corrected[j], np.zeros(len(branches))
    moments = (vehicle.summary.mean_a, vehicle.summary.mean_product_a2)
    deployed = {"drift": np.where(corrected, faults.drift, 0.0), "offset_a": np.where(corrected, faults.offset_a, 0.0)}
    open_question = deployment.verdicts[j] == "cannot tell" or posterior.confidence[j] < 1.0 - UNTOLD
    told: list[Explanation] = []
    decisive = ""
    if open_question or (deployment.held_back[j] != "").any():
        told, decisive = _explanations(posterior, deployment, j, branches, identity)
    return VehicleParameters(
        vehicle=vehicle.vehicle,
        layout=identity.layout,
        dbc=identity.dbc,
        verdict=deployment.verdicts[j],
        confidence=None if posterior.health and posterior.health.doubtful else _share(posterior.confidence[j]),
        branches={name: _branch(vehicle, posterior, deployment, (j, k), name=name) for k, name in enumerate(branches)},
        hardware_fault=HardwareFault(
            suspected=bool(deployment.hardware[j]),
            drift=float(faults.hardware_drift),
            offset_a=by_branch(branches, faults.hardware_offset_a),
            probability=_share(posterior.hardware_fault[j]),
        ),
        explanations=told,
        deciding_evidence=decisive,
        junction_residual=JunctionResidual(
            measured_a=junction_rms_a(*moments, drift=zeros, offset_a=zeros),
            corrected_a=junction_rms_a(*moments, **deployed),
        ),
        provenance=identity.provenance(
            fleet_size=len(posterior), drives=vehicle.drives, duration_s=vehicle.summary.duration_s
        ),
    )


def _branch(
    vehicle: VehicleSummary, posterior: FleetPosterior, deployment: Deployment, place: tuple[int, int], *, name: str
) -> BranchParameters:
    k = vehicle.delays.branches.index(name)
    known = bool(vehicle.delays.known[k])
    in_doubt = posterior.health is not None and place[1] in posterior.health.doubtful
    return BranchParameters(
        drift=float(posterior.faults.drift[place]),
        offset_a=float(posterior.faults.offset_a[place]),
        drift_sd=float(posterior.drift_sd[place]),
        offset_sd_a=float(posterior.offset_sd_a[place]),
        apply=bool(deployment.corrected[place]),
        held_back=cast("HeldBack", str(deployment.held_back[place])) if deployment.held_back[place] else None,
        delay_s=float(vehicle.delays.delay_s[k]) if known else None,
        delay_sd_s=float(vehicle.delays.sd_s[k]) if known else None,
        fault_probability=None if in_doubt else _share(posterior.sensor_fault[place]),
        harm_probability=None if in_doubt else _share(posterior.harm[place]),
        identifiable=bool(posterior.identifiable[place]),
    )


def _explanations(
    posterior: FleetPosterior, deployment: Deployment, j: int, branches: Sequence[str], identity: RunIdentity
) -> tuple[list[Explanation], str]:
    """The competing explanations of one vehicle, and what would decide between them."""
    layout = identity.database.layout
    names = [branches[k] for k in posterior.order]
    found = explanations(posterior.states, j)
    told = [
        Explanation(
            probability=_share(each.probability),
            drift={name: float(d) for name, d in zip(names, each.drift, strict=True) if d},
            offset_a={name: float(o * layout.full_scale_a) for name, o in zip(names, each.offset, strict=True) if o},
            hardware_drift=each.hardware_drift,
            hardware_offset_a={
                name: float(o * layout.full_scale_a) for name, o in zip(names, each.hardware_offset, strict=True) if o
            },
        )
        for n, each in enumerate(found[:MOST_TOLD])
        if not n or each.probability >= LEAST_TOLD
    ]
    return told, advise(posterior, deployment, j, found, branches=branches, layout=layout)


def _details(posterior: FleetPosterior, branches: Sequence[str]) -> dict[str, object]:
    health, learnt = posterior.health, posterior.hyperparameters
    assert health is not None
    prior, spread = learnt.prior, np.sqrt(np.diag(learnt.spread.covariance))
    ordered = [branches[k] for k in posterior.order]
    return {
        "reference": {
            "agreeing_share": dict(zip(branches, health.agreeing_share, strict=True)),
            "mean_distance": dict(zip(branches, health.mean_distance, strict=True)),
            "least_vehicles": health.least_vehicles,
            "unmeasured_a": health.unmeasured_a,
            "doubtful": [branches[k] for k in health.doubtful],
        },
        "hyperparameters": {
            "hardware_share": prior.hardware_share,
            "drift_magnitude": [prior.relative.low, prior.relative.high],
            "offset_magnitude": [prior.constant.low, prior.constant.high],
            "model_spread": by_branch(ordered, spread[: len(branches)]),
            "log_evidence": learnt.log_evidence,
        },
    }


def _share(value: float) -> float:
    """A probability, free of rounding beyond its range."""
    return float(np.clip(value, 0.0, 1.0))
