"""How good the corrections of a fleet with sensors that are not linear are, on drives that were not used for them."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass

import numpy as np

from calibrator.drive import Array, Mask
from calibrator.experiments.sensor_fleet import SensorFleet
from calibrator.sensor_models.choice import LINEAR
from calibrator.sensor_models.families import GainBySign, GainBySignFamily, TemperatureDrift, TemperatureFamily
from calibrator.sensor_models.fleet import SensorFindings
from calibrator.terminal.text import dumps, table
from ecu_node.database import VehicleDatabase
from ecu_node.in_force import InForce, sensor_fault
from ecu_node.parameters import VehicleParameters

__all__ = ["SensorScore", "score_sensors", "unseen_errors_a"]

FAMILY_OF: dict[type, str] = {GainBySign: GainBySignFamily.name, TemperatureDrift: TemperatureFamily.name}
EVERY = 10
"""Corrections are judged on every tenth sample: once per second. [1]"""


@dataclass(frozen=True, kw_only=True)
class SensorScore:
    """Counts of sensors of a fleet.

    Attributes
    ----------
    not_linear : int
        Sensors that are not linear.
    decided : int
        Those of them that were named, with their family.
    wrong : int
        Linear sensors that were taken for sensors that are not.
    undecided : int
        Vehicles in which it could not be told which sensor it is.
    deployed, harmed : int
        Branches that are corrected with a sensor model, and those of them that are worse on the unseen drive.
    others_deployed, others_harmed : int
        The same of branches that are corrected as linear.
    rms_measured_a, rms_corrected_a : float
        Median error of the deployed sensors on the unseen drive, as measured and as corrected; NaN if there are none.
        [A]
    """

    not_linear: int
    decided: int
    wrong: int
    undecided: int
    deployed: int
    harmed: int
    others_deployed: int
    others_harmed: int
    rms_measured_a: float
    rms_corrected_a: float

    def as_json(self) -> str:
        """The score as JSON."""
        return dumps(asdict(self))

    def as_text(self) -> str:
        """The score for people."""
        rows = [
            ("sensors that are not linear", f"{self.not_linear}"),
            ("named", f"{self.decided}"),
            ("vehicles undecided", f"{self.undecided}"),
            ("linear sensors named", f"{self.wrong}"),
            ("corrected with a model", f"{self.deployed}"),
            ("of these worse", f"{self.harmed}"),
            ("their error, measured", f"{self.rms_measured_a:.2f} A"),
            ("their error, corrected", f"{self.rms_corrected_a:.2f} A"),
            ("corrected as linear", f"{self.others_deployed}"),
            ("of these worse", f"{self.others_harmed}"),
        ]
        return table(("on unseen drives", ""), rows)


def score_sensors(
    fleet: SensorFleet,
    parameters: Mapping[str, VehicleParameters],
    findings: SensorFindings,
    database: VehicleDatabase,
) -> SensorScore:
    """Judge the parameters of a fleet.

    Parameters
    ----------
    fleet : SensorFleet
        The fleet, with its unseen drives.
    parameters : mapping of str to VehicleParameters
        By vehicle.
    findings : SensorFindings
        Of its vehicles.
    database : VehicleDatabase
        DBC and layout of the node.

    Returns
    -------
    SensorScore
        The counts.
    """
    put = {(j, k): FAMILY_OF[type(sensor)] for j, (k, sensor) in fleet.put.items()}
    found = {(j, k): c.model for j, row in enumerate(findings.choices) for k, c in enumerate(row) if c.model != LINEAR}
    applied, errors = _errors(fleet, parameters, database)
    modelled = np.array([[(j, k) in found for k in range(applied.shape[1])] for j in range(len(applied))])
    worse, bent = errors[:, :, 1] > errors[:, :, 0], applied & modelled
    medians = np.median(errors[bent], axis=0) if bent.any() else np.full(2, np.nan)
    return SensorScore(
        not_linear=len(put),
        decided=sum(found.get(place) == family for place, family in put.items()),
        wrong=len(found.keys() - put.keys()),
        undecided=int(findings.undecided.any(axis=1).sum()),
        deployed=int(bent.sum()),
        harmed=int((bent & worse).sum()),
        others_deployed=int((applied & ~modelled).sum()),
        others_harmed=int((applied & ~modelled & worse).sum()),
        rms_measured_a=float(medians[0]),
        rms_corrected_a=float(medians[1]),
    )


def _errors(
    fleet: SensorFleet, parameters: Mapping[str, VehicleParameters], database: VehicleDatabase
) -> tuple[Mask, Array]:
    """Which branches are corrected, (N, K), and errors as measured and as corrected, (N, K, 2). [A]"""
    N, K = len(fleet.learnt), len(fleet.branches)
    applied, errors = np.zeros((N, K), np.bool_), np.zeros((N, K, 2))
    for j, name in enumerate(fleet.names):
        if name in parameters:
            branches = parameters[name].branches
            applied[j] = [branches[branch].apply for branch in fleet.branches]
            errors[j] = np.column_stack(unseen_errors_a(fleet, j, parameters[name], database))
    return applied, errors


def unseen_errors_a(
    fleet: SensorFleet, j: int, parameters: VehicleParameters, database: VehicleDatabase
) -> tuple[Array, Array]:
    """Errors of one vehicle's currents on its unseen drive, as measured and as the node corrects them.

    Parameters
    ----------
    fleet : SensorFleet
        The fleet.
    j : int
        Number of the vehicle.
    parameters : VehicleParameters
        Of the vehicle.
    database : VehicleDatabase
        DBC and layout of the node.

    Returns
    -------
    measured, corrected : ndarray of shape (K,)
        Root mean square errors of the branches, noise apart. [A]
    """
    trip, in_force = fleet.unseen[j], InForce(parameters=parameters)
    true_a, measured_a, temperature_c = (
        values[::EVERY] for values in (trip.true_a, trip.measured_a, trip.temperature_c)
    )
    corrected = measured_a.copy()
    for k, name in enumerate(fleet.branches):
        fault = sensor_fault(database, in_force, name)
        if fault.applied:
            pairs = zip(measured_a[:, k].tolist(), temperature_c.tolist(), strict=True)
            found = [(i_m, fault.true_current(i_m, at_c)) for i_m, at_c in pairs]
            corrected[:, k] = [i_m if i is None else i for i_m, i in found]
    return _rms(measured_a - true_a), _rms(corrected - true_a)


def _rms(error_a: Array) -> Array:
    return np.asarray(np.sqrt(np.mean(error_a**2, axis=0)))
