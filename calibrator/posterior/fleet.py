"""The default method on a fleet: its reference from some vehicles, with which any others are calibrated.

If asked to, the drives are read a second time to find sensors that are not linear; if there are any, the reference is
learnt anew from the linear parts of all sensors.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from calibrator.calibration_settings import CalibrationSettings, require_learning
from calibrator.drive import Array, Mask
from calibrator.evidence.readings import Readings
from calibrator.evidence.vehicle_evidence import evidence_names
from calibrator.files.parameter_files import RunIdentity, by_branch
from calibrator.posterior.bench import contradicted_readings, merge_readings, trust_notices, window_notices
from calibrator.posterior.bench_table import BenchReadings
from calibrator.posterior.calibration import FleetReference, estimate_summaries, learn_reference
from calibrator.posterior.fleet_task import FleetTask
from calibrator.posterior.model_parameters import finding_notices
from calibrator.sensor_models.choice import SensorModelChoice
from calibrator.sensor_models.fleet import SensorFindings, all_linear
from calibrator.sensor_models.modelled import ModelledVehicle
from calibrator.summaries.moments import DriveSummary
from calibrator.summaries.vehicle_summary import VehicleSummary

__all__ = ["FindModels", "Learnt", "learn_fleet"]

FindModels = Callable[[Sequence[VehicleSummary], Array, Mask, Mask], SensorFindings]
"""Second pass: vehicles, offsets found with linear sensors (N, K) [A], learning and trusted ones -> findings."""


@dataclass(frozen=True, kw_only=True)
class Learnt:
    """What the first pass found.

    Attributes
    ----------
    task : FleetTask
        For the second pass.
    notices : tuple of str
        What the user should know.
    details : mapping of str to JSON values
        For the record of the run.
    """

    task: FleetTask
    notices: tuple[str, ...]
    details: Mapping[str, object]


def learn_fleet(
    vehicles: Sequence[VehicleSummary],
    settings: CalibrationSettings,
    bench: BenchReadings,
    *,
    branches: tuple[str, ...],
    identity: RunIdentity,
    fleet_size: int,
    find_models: FindModels | None = None,
) -> Learnt:
    """Learn the reference of a fleet.

    Parameters
    ----------
    vehicles : sequence of VehicleSummary
        All to learn from, all that are trusted, and all that were checked on a bench.
    settings : CalibrationSettings
        How.
    bench : mapping
        Bench readings.
    branches : tuple of str
        Names of the K branches.
    identity : RunIdentity
        Of the run.
    fleet_size : int
        Vehicles of the fleet that can be used.
    find_models : callable or None
        Second pass over the drives; None: all sensors count as linear.

    Returns
    -------
    Learnt
        With which every vehicle can be calibrated.

    Raises
    ------
    FleetError
        If too few vehicles can be learnt from.
    """
    names = [vehicle.vehicle for vehicle in vehicles]
    learning = np.array(require_learning(names, settings, {}))
    trusted = np.array([name in settings.trusted for name in names])
    layout = identity.database.layout
    learner = partial(learn_reference, full_scale_a=layout.full_scale_a, branches=branches, load=layout.unmeasured_load)
    learn = partial(_learn, learning=learning, trusted=trusted, learner=learner)
    reference, believed, readings = _with_readings(vehicles, bench, branches, learn, full_scale_a=layout.full_scale_a)
    findings = all_linear(vehicles)
    if find_models is not None:
        summaries = [vehicle.summary for vehicle in vehicles]
        linear = estimate_summaries(summaries, reference, readings=readings.told, believed=believed)
        findings = find_models(vehicles, linear.faults.offset_a, learning, believed)
    if findings.not_linear.any():
        reference, believed = learn(findings.summaries, readings.told)
    learners = [name for name, use in zip(names, learning, strict=True) if use]
    return Learnt(
        task=FleetTask(
            reference=reference,
            identity=identity,
            branches=branches,
            harm_limit=settings.harm_limit,
            bench=readings.bench,
            believed=frozenset(name for name, use in zip(names, believed, strict=True) if use),
            fleet_size=fleet_size,
            not_linear=_not_linear(names, findings),
        ),
        notices=(
            *reference.health.warnings,
            *trust_notices(learners, trusted[learning], reference.health),
            *readings.notices,
            *window_notices(vehicles, believed, branches, layout.full_scale_a),
            *finding_notices(names, findings, branches),
        ),
        details=_details(reference, branches),
    )


@dataclass(frozen=True, kw_only=True)
class _Readings:
    """Direct readings: those that are used, of which bench readings, and what is to be said."""

    told: Readings
    bench: BenchReadings
    notices: Sequence[str]


def _with_readings(
    vehicles: Sequence[VehicleSummary],
    bench: BenchReadings,
    branches: tuple[str, ...],
    learn: Callable[[Sequence[DriveSummary], Readings], tuple[FleetReference, Mask]],
    *,
    full_scale_a: float,
) -> tuple[FleetReference, Mask, _Readings]:
    """Reference of linear sensors with the readings that the drives do not contradict."""
    summaries, names = [vehicle.summary for vehicle in vehicles], [vehicle.vehicle for vehicle in vehicles]
    told, notices = merge_readings(vehicles, {}, branches)
    reference, believed = learn(summaries, told)
    if not bench:
        return reference, believed, _Readings(told=told, bench={}, notices=notices)
    named = {vehicle for vehicle, _ in bench}
    checked = np.array([name in named for name in names])
    wrong: Mapping[tuple[str, str], str] = {}
    if checked.any():
        posterior = estimate_summaries(
            [summaries[j] for j in np.flatnonzero(checked).tolist()],
            reference,
            readings=told.take(checked),
            believed=believed[checked],
        )
        wrong = contradicted_readings(
            posterior, bench, [name for name in names if name in named], branches, full_scale_a
        )
    used = {sensor: values for sensor, values in bench.items() if sensor not in wrong}
    told, notices = merge_readings(vehicles, used, branches)
    reference, believed = learn(summaries, told)
    return reference, believed, _Readings(told=told, bench=used, notices=[*notices, *wrong.values()])


def _not_linear(
    names: Sequence[str], findings: SensorFindings
) -> dict[str, tuple[Sequence[SensorModelChoice], ModelledVehicle | None]]:
    """What is known of the vehicles that have sensors that are not linear, or may have."""
    told = findings.not_linear.any(axis=1) | findings.undecided.any(axis=1)
    return {names[j]: (findings.choices[j], findings.modelled[j]) for j in np.flatnonzero(told).tolist()}


def _learn(
    summaries: Sequence[DriveSummary],
    readings: Readings,
    *,
    learning: Mask,
    trusted: Mask,
    learner: Callable[..., FleetReference],
) -> tuple[FleetReference, Mask]:
    """Reference of those that may be learnt from, and which of all vehicles are believed to be faultless."""
    learners = np.flatnonzero(learning)
    reference = learner(
        [summaries[j] for j in learners.tolist()], readings=readings.take(learning), trusted=trusted[learning]
    )
    believed = trusted.copy()
    believed[learners[list(reference.health.distrusted)]] = False
    return reference, believed


def _details(reference: FleetReference, branches: Sequence[str]) -> dict[str, object]:
    health, learnt = reference.health, reference.law.hyperparameters
    prior, spread = learnt.prior, np.sqrt(np.diag(learnt.spread.covariance))
    ordered = [branches[k] for k in reference.order]
    return {
        "reference": {
            "agreeing_share": dict(zip(branches, health.agreeing_share, strict=True)),
            "mean_distance": dict(zip(branches, health.mean_distance, strict=True)),
            "least_vehicles": health.least_vehicles,
            "unmeasured_a": health.unmeasured_a,
            "doubtful": [branches[k] for k in health.doubtful],
            "read_out": {name: reference.model.read_out[:, k].tolist() for k, name in enumerate(ordered)},
        },
        "evidence": evidence_names(ordered),
        "hyperparameters": {
            "hardware_share": prior.hardware_share,
            "drift_magnitude": [prior.relative.low, prior.relative.high],
            "offset_magnitude": [prior.constant.low, prior.constant.high],
            "model_spread": by_branch(ordered, spread[: len(branches)]),
            "log_evidence": learnt.log_evidence,
        },
    }
