"""Fleets some of whose sensors are not linear: drawn, and calibrated as the product does.

Each vehicle drives a part of the recorded trips with faults of its own, at temperatures of its own.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from calibrator.artificial.ground_truth import GroundTruth
from calibrator.artificial.random_fleet import draw_faults
from calibrator.calibration_settings import CalibrationSettings
from calibrator.drive import Array, Mask
from calibrator.drives.align import Samples
from calibrator.drives.delays import BranchDelays
from calibrator.experiments.joined_trial import joined_trips
from calibrator.experiments.recorded_fleet import RecordedFleet
from calibrator.experiments.recorded_trial import NOISE
from calibrator.faults import Faults, measured_currents, true_currents
from calibrator.files.parameter_files import RunIdentity
from calibrator.options import Method
from calibrator.posterior.fleet import learn_fleet
from calibrator.random_streams import Purpose, random_stream
from calibrator.sensor_models.families import GainBySign, SensorModel, TemperatureDrift
from calibrator.sensor_models.fleet import SensorFindings, findings_of, summaries_about_zeros
from calibrator.summaries.summariser import summarise
from calibrator.summaries.vehicle_summary import VehicleSummary
from calibrator.summaries.zero_current import ZeroCurrent
from calibrator.terminal.progress import progress_bar, shown
from ecu_node.database import VehicleDatabase
from ecu_node.parameters import VehicleParameters

__all__ = ["DrivenTrip", "SensorCase", "SensorFleet", "calibrate_sensors", "draw_sensors"]

START_C, RISE_C = (-5.0, 25.0), (20.0, 40.0)
"""A junction box has the temperature of the day at the start, and warms up by this. [degC], [K]"""
WARM_UP_S = 500.0


@dataclass(frozen=True, kw_only=True)
class SensorCase:
    """How a fleet is drawn.

    Attributes
    ----------
    vehicles, branches : int
        N and K.
    share : float
        Of the vehicles, that have one sensor that is not linear; half of these are of either family. [1]
    difference : tuple of float
        Range of the difference between the gains by sign. [1]
    drift_per_k : tuple of float
        Range of the drift with temperature. [1/K]
    largest_drift : float
        Of these sensors, the mean of both gains or at 25 degC. [1]
    sparsity : float
        Of the other faults. [%]
    magnitude : tuple of float
        Of the same: drifts [1], offsets in fractions of full scale.
    duration_s : float
        Driving of each vehicle, and of its unseen drive. [s]
    """

    vehicles: int = 200
    branches: int = 2
    share: float = 0.3
    difference: tuple[float, float] = (0.05, 0.2)
    drift_per_k: tuple[float, float] = (0.002, 0.006)
    largest_drift: float = 0.05
    sparsity: float = 80.0
    magnitude: tuple[float, float] = (0.02, 0.1)
    duration_s: float = 1500.0


@dataclass(frozen=True, kw_only=True)
class DrivenTrip:
    """One drive of one vehicle.

    Attributes
    ----------
    ideal : GroundTruth
        Inputs and ideal currents.
    true_a, measured_a : ndarray of shape (T, K)
        True currents, and measured ones without noise. [A]
    temperature_c : ndarray of shape (T,)
        As its signal says it, in whole degrees. [degC]
    """

    ideal: GroundTruth
    true_a: Array
    measured_a: Array
    temperature_c: Array


@dataclass(frozen=True, kw_only=True)
class SensorFleet:
    """A fleet that was drawn.

    Attributes
    ----------
    recorded : RecordedFleet
        Whose trips it drives.
    branches : tuple of str
        Names of the K branches.
    put : mapping of int to (int, SensorModel)
        Branch and model of the sensors that are not linear, by vehicle.
    faults : Faults
        Of the other sensors, and the offsets of all.
    learnt, unseen : sequence of N trips
        To calibrate from, and to judge on.
    seed : int
        Of the noise.
    """

    recorded: RecordedFleet
    branches: tuple[str, ...]
    put: Mapping[int, tuple[int, SensorModel]]
    faults: Faults
    learnt: Sequence[DrivenTrip]
    unseen: Sequence[DrivenTrip]
    seed: int

    @property
    def names(self) -> list[str]:
        """Names of the vehicles."""
        return [f"V{j:04d}" for j in range(len(self.learnt))]


def draw_sensors(recorded: RecordedFleet, case: SensorCase, seed: int) -> SensorFleet:
    """Draw a fleet.

    Parameters
    ----------
    recorded : RecordedFleet
        The trips.
    case : SensorCase
        What is put on top of them.
    seed : int
        Of this fleet.

    Returns
    -------
    SensorFleet
        The fleet.
    """
    rng = random_stream(Purpose.FAULTS, seed)
    faults = draw_faults(
        rng,
        vehicles=case.vehicles,
        branches=case.branches,
        sparsity=case.sparsity,
        magnitude=case.magnitude,
        full_scale_a=recorded.full_scale_a,
    )
    bent = rng.permutation(case.vehicles)[: round(case.share * case.vehicles)].tolist()
    put = {j: (int(rng.integers(case.branches)), _sensor(rng, case, by_sign=n % 2 == 0)) for n, j in enumerate(bent)}
    trips = recorded.with_branches(case.branches)

    def driven(purpose: Purpose) -> list[DrivenTrip]:
        ideal = joined_trips(trips, purpose, seed, vehicles=case.vehicles, duration_s=case.duration_s)
        return [_drive(rng, trip, faults.take(j), put.get(j)) for j, trip in enumerate(ideal)]

    return SensorFleet(
        recorded=recorded,
        branches=tuple(trips[0].currents_a),
        put=put,
        faults=faults,
        learnt=driven(Purpose.CALIBRATION_TRIP),
        unseen=driven(Purpose.UNSEEN_TRIP),
        seed=seed,
    )


def _sensor(rng: np.random.Generator, case: SensorCase, *, by_sign: bool) -> SensorModel:
    sign = rng.choice([-1.0, 1.0])
    drift = float(rng.uniform(-1.0, 1.0) * case.largest_drift)
    if by_sign:
        half = 0.5 * float(sign * rng.uniform(*case.difference))
        return GainBySign(drift_positive=drift + half, drift_negative=drift - half)
    return TemperatureDrift(drift=drift, drift_per_k=float(sign * rng.uniform(*case.drift_per_k)), reference_c=25.0)


def _drive(
    rng: np.random.Generator, trip: GroundTruth, faults: Faults, put: tuple[int, SensorModel] | None
) -> DrivenTrip:
    temperature_c = rng.uniform(*START_C) + rng.uniform(*RISE_C) * (1.0 - np.exp(-trip.time_s / WARM_UP_S))
    i = true_currents(trip.matrix_a(), faults)
    i_m = measured_currents(i, faults)
    if put is not None:
        k, sensor = put
        i_m[:, k] = sensor.measured(i[:, k], temperature_c) + faults.offset_a[k]
    return DrivenTrip(ideal=trip, true_a=i, measured_a=i_m, temperature_c=np.rint(temperature_c))


def calibrate_sensors(
    fleet: SensorFleet, database: VehicleDatabase
) -> tuple[dict[str, VehicleParameters], SensorFindings]:
    """Calibrate a fleet with the search for sensors that are not linear.

    Parameters
    ----------
    fleet : SensorFleet
        The fleet.
    database : VehicleDatabase
        DBC and layout of the parameter files.

    Returns
    -------
    parameters : dict of str to VehicleParameters
        By vehicle.
    findings : SensorFindings
        Of the search.
    """
    count = len(fleet.learnt)
    samples = [_samples(fleet, j) for j in shown(range(count), "take samples", count, "vehicles")]
    drives = shown(zip(fleet.names, samples, strict=True), "summarise drives", count, "vehicles")
    vehicles = [_summary(fleet, name, drive) for name, drive in drives]
    kept: list[SensorFindings] = []

    def find(vehicles: Sequence[VehicleSummary], zero_a: Array, learning: Mask, trusted: Mask) -> SensorFindings:
        names = _fleet_inputs(fleet) + (() if database.layout.temperature is None else (database.layout.temperature,))
        found = {
            vehicle.vehicle: summaries_about_zeros(
                [drive.with_inputs(names)],
                zero_a[j],
                period_s=fleet.recorded.period_s,
                temperature=database.layout.temperature,
            )
            for j, (vehicle, drive) in enumerate(zip(vehicles, samples, strict=True))
        }
        kept.append(findings_of(vehicles, found, learning=learning, trusted=trusted))
        return kept[-1]

    with progress_bar("calibrate", None):
        learnt = learn_fleet(
            vehicles,
            CalibrationSettings(sensor_models=True),
            {},
            branches=fleet.branches,
            identity=RunIdentity(database=database, method=Method.POSTERIOR, fleet="drawn", created=""),
            fleet_size=len(vehicles),
            find_models=find,
        )
        parameters = learnt.task.calibrate(vehicles).parameters
    return {each.vehicle: each for each in parameters}, kept[-1]


def _fleet_inputs(fleet: SensorFleet) -> tuple[str, ...]:
    layout = fleet.recorded.database.layout
    names = layout.fleet_inputs or layout.model_inputs
    return tuple(name for name in names if name in fleet.recorded.inputs(fleet.learnt[0].ideal))


def _samples(fleet: SensorFleet, j: int) -> Samples:
    trip, recorded = fleet.learnt[j], fleet.recorded
    inputs = {**recorded.inputs(trip.ideal), str(recorded.database.layout.temperature): trip.temperature_c}
    noise = random_stream(Purpose.FRAMES, fleet.seed, j).standard_normal(trip.measured_a.shape)
    return Samples(
        branch_names=fleet.branches,
        input_names=tuple(inputs),
        time_s=trip.ideal.time_s,
        currents_a=trip.measured_a + NOISE * recorded.full_scale_a * noise,
        inputs=np.column_stack(list(inputs.values())),
        valid=np.ones(len(trip.ideal), bool),
        masked={},
    )


def _summary(fleet: SensorFleet, name: str, drive: Samples) -> VehicleSummary:
    K = len(fleet.branches)
    unknown = np.full(K, np.nan)
    return VehicleSummary(
        vehicle=name,
        drives=(name,),
        summary=summarise([drive.with_inputs(_fleet_inputs(fleet))], period_s=fleet.recorded.period_s),
        delays=BranchDelays(branches=fleet.branches, delay_s=np.zeros(K), sd_s=np.zeros(K), known=np.ones(K, np.bool_)),
        zero_current=ZeroCurrent(offset_a=unknown, sd_a=unknown),
        recorded=frozenset(drive.input_names),
    )
