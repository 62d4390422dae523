"""The published method on a real fleet: models -> unity drive -> fleet mean -> faults -> parameter files.

Parameters that leave a larger Kirchhoff sum than no correction at all are written down, but marked not to be applied,
and the verdict is 'cannot tell': whatever they are, they do not explain this vehicle's sensors.
"""

from collections.abc import Sequence

import numpy as np

from calibrator.drive import Array
from calibrator.errors import FleetError
from calibrator.estimator.fleet_identification import VehicleModel, read_vehicle_model
from calibrator.estimator.settings import CalibrationSettings, FleetOutcome, require_learning
from calibrator.files.parameter_files import RunIdentity, by_branch, current_moments, junction_residual
from calibrator.fleet_truth import faults_of
from calibrator.published.calibration import ExpectedFaults, calibrate_published
from calibrator.published.recovery import Recovery
from calibrator.sources.fleet_source import Equipment, FleetSource
from calibrator.sources.vehicles import read_vehicles
from calibrator.terminal.progress import progress_bar
from calibrator.terminal.text import few
from ecu_node.parameters import BranchParameters, HardwareFault, VehicleParameters, Verdict

__all__ = ["calibrate_fleet_published", "few_vehicles_notice"]

MISFIT = 5.0
"""Simulation error over the fleet's median from which on a model is not one of the fleet. [1]"""
SLOPE_SPREAD = 0.093
"""Standard deviation of the vehicles' slopes where one of five sensor and hardware drifts is not zero, with 5 to 25 %
(S = 80, the default). [1]"""
LEAST_VEHICLES = 20
"""Below, the mean of the fleet is off by more than 2 %, nearly half of the smallest of these faults."""


def calibrate_fleet_published(
    fleet: FleetSource, equipment: Equipment, identity: RunIdentity, settings: CalibrationSettings, *, workers: int
) -> FleetOutcome:
    """Calibrate a fleet as published.

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
        If too few vehicles can be used.
    """
    vehicles, left_out = read_vehicles(
        read_vehicle_model, fleet, equipment, identity.database, workers=workers, limit_s=settings.time_limit_s
    )
    vehicles = _without_misfits(vehicles, settings.hold_out, equipment, left_out)
    learning = require_learning([vehicle.vehicle for vehicle in vehicles], settings, left_out)
    unity = _unity_vehicle([v for v, used in zip(vehicles, learning, strict=True) if used], settings.unity)
    with progress_bar("estimate the faults", None):
        recovery = _recover(vehicles, unity, equipment, identity, settings)
    left_out |= {vehicles[j].vehicle: reason for j, reason in recovery.failed.items()}
    parameters = [
        _parameters(
            vehicle,
            recovery,
            position=j,
            branches=equipment.branches,
            identity=identity,
            fleet_size=len(vehicles),
        )
        for j, vehicle in enumerate(vehicles)
        if j not in recovery.failed
    ]
    snr = np.nanmedian([vehicle.snr_db for vehicle in vehicles], axis=0)
    period_s = identity.database.layout.period_s
    return FleetOutcome(
        parameters=parameters,
        left_out=left_out,
        notices=() if settings.symmetric else few_vehicles_notice(sum(learning)),
        details={
            "unity_vehicle": unity.vehicle,
            "unity_duration_s": period_s * (len(unity.held_out_inputs) - unity.lead_in),
            "simulation_snr_db": by_branch(equipment.branches, snr),
        },
    )


def few_vehicles_notice(learning: int) -> tuple[str, ...]:
    """Say so if the mean of the fleet (3) is of so few vehicles that it is hardly a reference.

    Parameters
    ----------
    learning : int
        Vehicles whose mean it is.

    Returns
    -------
    tuple of str
        At most one notice.
    """
    if learning >= LEAST_VEHICLES:
        return ()
    return (
        f"{learning} vehicles are few for the published method, which takes the mean of the fleet for the truth: with "
        f"faults of 5 to 25 % in one of five parameters it is off by about {SLOPE_SPREAD / learning**0.5:.0%}; give it "
        f"{LEAST_VEHICLES} or more, or leave --method out",
    )


def _without_misfits(
    vehicles: Sequence[VehicleModel], hold_out: frozenset[str], equipment: Equipment, left_out: dict[str, str]
) -> list[VehicleModel]:
    """Vehicles whose models hold on their own last 20 % about as well as the fleet's do; the others are named."""
    learning = [vehicle for vehicle in vehicles if vehicle.vehicle not in hold_out]
    usual_a = _median_error_a(learning or vehicles)
    kept: list[VehicleModel] = []
    for vehicle in vehicles:
        ratio = vehicle.simulation_error_a / np.maximum(usual_a, np.finfo(float).tiny)
        if ratio.max() <= MISFIT:
            kept.append(vehicle)
        else:
            left_out[vehicle.vehicle] = (
                f"its model misses the {equipment.branches[int(ratio.argmax())]} current of its own last 20 % "
                f"{ratio.max():.0f} times as far as the fleet's models do; record a drive with more varied use"
            )
    return kept


def _median_error_a(vehicles: Sequence[VehicleModel]) -> Array:
    """Median over vehicles of each branch's simulation error on held-out data, shape (K,). [A]"""
    return np.asarray(np.median([vehicle.simulation_error_a for vehicle in vehicles], axis=0))


def _unity_vehicle(vehicles: Sequence[VehicleModel], wanted: str | None) -> VehicleModel:
    """The vehicle whose held-out inputs become the unity drive: the one asked for, or the one with the longest."""
    if wanted is None:
        return max(vehicles, key=lambda vehicle: len(vehicle.held_out_inputs) - vehicle.lead_in)
    for vehicle in vehicles:
        if vehicle.vehicle == wanted:
            return vehicle
    there = few([vehicle.vehicle for vehicle in vehicles])
    raise FleetError(f"no usable vehicle {wanted!r} to take the unity drive from; there are {there}")


def _recover(
    vehicles: Sequence[VehicleModel],
    unity: VehicleModel,
    equipment: Equipment,
    identity: RunIdentity,
    settings: CalibrationSettings,
) -> Recovery:
    """Simulate every vehicle on the unity drive (2) and estimate its faults."""
    simulated = [vehicle.model.simulate(unity.held_out_inputs)[unity.lead_in :] for vehicle in vehicles]
    names = [vehicle.vehicle for vehicle in vehicles]
    truth = None
    if settings.truth is not None:
        if tuple(settings.truth.branches) != equipment.branches:
            raise FleetError(f"the truth is of branches {settings.truth.branches}, the fleet has {equipment.branches}")
        truth = faults_of(settings.truth, names)
    in_reference = np.array([name not in settings.hold_out for name in names])
    return calibrate_published(
        simulated,
        junction_a2=np.array([float(np.sum(vehicle.moment_a2)) for vehicle in vehicles]),
        in_reference=in_reference,
        simulation_error_a=_median_error_a([v for v, used in zip(vehicles, in_reference, strict=True) if used]),
        full_scale_a=identity.database.layout.full_scale_a,
        classifier=settings.classifier,
        expected=ExpectedFaults(
            sparsity=settings.sparsity,
            magnitude=settings.magnitude,
            symmetric=settings.symmetric,
            seed=settings.seed,
        ),
        truth=truth,
    )


def _parameters(
    vehicle: VehicleModel,
    recovery: Recovery,
    *,
    position: int,
    branches: Sequence[str],
    identity: RunIdentity,
    fleet_size: int,
) -> VehicleParameters:
    """Write down what was found for one vehicle."""
    faults = recovery.faults.take(position)
    residual = junction_residual(
        current_moments(vehicle.mean_a, vehicle.moment_a2),
        gain=1.0 + faults.drift[None],
        offset_a=faults.offset_a,
        expected_a=0.0,
    )
    helps = residual.corrected_a <= residual.measured_a
    sensor = bool(recovery.classification.sensor[position])
    verdict: Verdict = "no sensor fault" if not sensor else "corrected" if helps else "cannot tell"
    return VehicleParameters(
        vehicle=vehicle.vehicle,
        layout=identity.layout,
        dbc=identity.dbc,
        verdict=verdict,
        branches={
            name: BranchParameters(drift=float(faults.drift[k]), offset_a=float(faults.offset_a[k]), apply=helps)
            for k, name in enumerate(branches)
        },
        hardware_fault=HardwareFault(
            suspected=bool(recovery.classification.hardware[position]),
            drift=float(faults.hardware_drift),
            offset_a=by_branch(branches, faults.hardware_offset_a),
        ),
        junction_residual=residual,
        provenance=identity.provenance(fleet_size=fleet_size, drives=vehicle.drives, duration_s=vehicle.duration_s),
    )
