"""The published method [1]_ on a real fleet: models -> unity drive -> fleet mean -> faults -> parameter files.

The model of a vehicle is identified on the first 80 % of the valid samples of each drive. The last 20 % show how well
it simulates, and may serve as the unity drive.

Parameters that leave a larger Kirchhoff sum than no correction at all are written down, but marked not to be applied,
and the verdict is 'cannot tell': whatever they are, they do not explain this vehicle's sensors.

.. [1] "Measurement Correction for Electric Vehicles Based on Compressed Sensing".
"""

from collections.abc import Sequence
from itertools import compress

import numpy as np

from calibrator.artificial.random_fleet import FaultSettings
from calibrator.drive import Array, DriveFile, Equipment, FleetSource
from calibrator.drives.align import align
from calibrator.estimator.results import Calibrated, encode_chunk
from calibrator.estimator.settings import RunIdentity, require_learning
from calibrator.estimator.vehicle_parameters import by_branch, current_moments, junction_residual
from calibrator.processes.run_many import Workers
from calibrator.published.classify import classify_by_expected_trees
from calibrator.published.recovery import Recovery, recover_fleet
from calibrator.published.state_space import VehicleModel, evidence_of_models, identify_vehicle
from calibrator.sources.fleet_source import load_drive, probe_equipment, read_vehicles
from calibrator.terminal.progress import progress_bar
from ecu_node.database import VehicleDatabase
from ecu_node.parameters import BranchParameters, HardwareFault, VehicleParameters, Verdict

__all__ = ["calibrate_fleet_published", "read_vehicle_model"]

EXPECTED = FaultSettings(sparsity=80.0, magnitude=(0.05, 0.25), balanced=True)
"""Faults of the artificial fleet that the trees learn from: one of five parameters is not zero, as in the paper."""
MISFIT = 5.0
"""Vehicles whose simulation error is more than this multiple of the fleet's median are left out. [1]"""
SLOPE_SPREAD = 0.093
"""Standard deviation of the vehicles' slopes where one of five sensor and hardware drifts is not zero, with 5 to 25 %
(S = 80, the default). [1]"""
LEAST_VEHICLES = 20
"""Fewest vehicles without a notice: of fewer the mean is off by more than 2 %, nearly half of the smallest fault."""


def read_vehicle_model(entries: Sequence[DriveFile], equipment: Equipment, database: VehicleDatabase) -> VehicleModel:
    """Read the drives of one vehicle, and identify its model from them."""
    read = (load_drive(entry, database) for entry in entries)
    drives = [align(drive, database.layout, equipment.branches, inputs=equipment.inputs) for drive in read]
    names = tuple(entry.name for entry in entries)
    return identify_vehicle(drives, period_s=database.layout.period_s, vehicle=entries[0].vehicle, names=names)


def calibrate_fleet_published(
    fleet: FleetSource, identity: RunIdentity, *, workers: Workers
) -> tuple[Equipment, bytes, dict[str, object], tuple[str, ...]]:
    """Calibrate a fleet by the published method.

    Parameters
    ----------
    fleet : FleetSource
        The fleet.
    identity : RunIdentity
        Identity of the run, with the user's choices.
    workers : Workers
        Processes or cluster that read the drives.

    Returns
    -------
    equipment : Equipment
        Branches and inputs of the fleet.
    part : bytes
        Content of a part file of the result (Parquet): parameters of every vehicle that could be used, and why the
        others could not.
    details : dict of str to JSON values
        Unity drive and simulation SNR, for the record of the run.
    notices : tuple of str
        A notice if the fleet is small for this method.

    Raises
    ------
    FleetError
        If too few vehicles can be used.
    """
    database, settings, limit_s = identity.database, identity.settings, identity.settings.time_limit_s
    equipment = probe_equipment(fleet, database, settings.branches, limit_s=limit_s)
    branches, layout = equipment.branches, database.layout
    vehicles, left_out = read_vehicles(read_vehicle_model, fleet, equipment, database, workers=workers, limit_s=limit_s)
    vehicles = _without_misfits(vehicles, settings.hold_out, branches, left_out)
    names = [vehicle.vehicle for vehicle in vehicles]
    require_learning(names, settings, left_out)
    learning = [name not in settings.hold_out for name in names]
    learners = list(compress(vehicles, learning))
    with progress_bar("estimate the faults", None):
        evidence, reference, unity = evidence_of_models(vehicles, learning)
        classes = classify_by_expected_trees(
            evidence.features,
            reference,
            _median_error_a(learners),
            full_scale_a=layout.full_scale_a,
            expected=EXPECTED,
            reference_vehicles=len(learners),
        )
        recovery = recover_fleet(evidence, classes, full_scale_a=layout.full_scale_a)
    left_out |= {names[j]: reason for j, reason in recovery.failed.items()}
    size = len(vehicles)
    calibrated = {
        names[j]: Calibrated(_parameters(vehicle, recovery, j, branches=branches, identity=identity, fleet_size=size))
        for j, vehicle in enumerate(vehicles)
        if j not in recovery.failed
    }
    details = {
        "unity_vehicle": unity.vehicle,
        "unity_duration_s": layout.period_s * (len(unity.held_out_inputs) - unity.lead_in),
        "simulation_snr_db": by_branch(branches, np.nanmedian([vehicle.snr_db for vehicle in vehicles], axis=0)),
    }
    notices: tuple[str, ...] = ()
    if len(learners) < LEAST_VEHICLES:
        notices = (
            f"{len(learners)} vehicles are few for the published method, which takes the mean of the fleet for the "
            f"truth: with faults of 5 to 25 % in one of five parameters it is off by about "
            f"{SLOPE_SPREAD / len(learners) ** 0.5:.0%}; give it {LEAST_VEHICLES} or more, or leave --method out",
        )
    return equipment, encode_chunk({**left_out, **calibrated}), details, notices


def _without_misfits(
    vehicles: Sequence[VehicleModel], hold_out: frozenset[str], branches: Sequence[str], left_out: dict[str, str]
) -> list[VehicleModel]:
    """Keep vehicles whose models simulate their last 20 % well; add the others to ``left_out``.

    The simulation error of each branch may be at most :data:`MISFIT` times its median over the fleet.
    """
    usual_a = _median_error_a([vehicle for vehicle in vehicles if vehicle.vehicle not in hold_out] or vehicles)
    kept: list[VehicleModel] = []
    for vehicle in vehicles:
        ratio = vehicle.simulation_error_a / np.maximum(usual_a, np.finfo(float).tiny)
        if ratio.max() <= MISFIT:
            kept.append(vehicle)
        else:
            left_out[vehicle.vehicle] = (
                f"its model misses the {branches[int(ratio.argmax())]} current of its own last 20 % {ratio.max():.0f} "
                f"times as far as the fleet's models do; record a drive with more varied use"
            )
    return kept


def _median_error_a(vehicles: Sequence[VehicleModel]) -> Array:
    """Return the median over vehicles of each branch's simulation error on held-out data, shape (K,). [A]"""
    return np.asarray(np.median([vehicle.simulation_error_a for vehicle in vehicles], axis=0))


def _parameters(
    vehicle: VehicleModel,
    recovery: Recovery,
    j: int,
    *,
    branches: Sequence[str],
    identity: RunIdentity,
    fleet_size: int,
) -> VehicleParameters:
    """Return the parameters of vehicle j: its faults, the junction sum with and without them, and the verdict."""
    faults, classes = recovery.faults.take(j), recovery.classification
    residual = junction_residual(
        current_moments(vehicle.mean_a, vehicle.moment_a2),
        gain=1.0 + faults.drift[None],
        offset_a=faults.offset_a,
        expected_a=0.0,
    )
    helps = residual.corrected_a <= residual.measured_a
    verdict: Verdict = "no sensor fault" if not classes.sensor[j] else "corrected" if helps else "cannot tell"
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
            suspected=bool(classes.hardware[j]),
            drift=float(faults.hardware_drift),
            offset_a=by_branch(branches, faults.hardware_offset_a),
        ),
        junction_residual=residual,
        provenance=identity.provenance(fleet_size=fleet_size, drives=vehicle.drives, duration_s=vehicle.duration_s),
    )
