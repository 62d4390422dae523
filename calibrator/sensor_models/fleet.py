"""Second pass over a fleet's drives: which sensors are not linear, and the summaries of their linear parts.

The first pass has found delays and, with linear sensors, offsets. Both are used here: the delays are taken out before
the drives are aligned, and the offsets are what the sensors show at 0 A.

Offsets of several sensors that nearly cancel look like a hardware offset, in which all sensors show 0 at 0 A; and a
sensor that is not linear leaves a constant in the junction sum, by which linear sensors are taken for the former. So
such a vehicle is looked at with both zeros. A linear sensor is linear about any zero, one that is not only about its
own: the zeros about which the nonlinearity is plainer are the right ones.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from calibrator.drive import Array, DriveFile, Mask
from calibrator.drives.align import Samples, align
from calibrator.drives.delays import without_delays
from calibrator.processes.reading import TIME_LIMIT_S
from calibrator.sensor_models.choice import LEAST_VEHICLES, LINEAR, SensorModelChoice, choose_sensor_models
from calibrator.sensor_models.modelled import ModelledVehicle, modelled_vehicle, usual_sections
from calibrator.sensor_models.summary import SensorSummary, summarise_sensors
from calibrator.sources.fleet_source import Equipment, FleetSource, load_drive
from calibrator.sources.vehicles import read_each
from calibrator.summaries.moments import DriveSummary
from calibrator.summaries.vehicle_summary import VehicleSummary
from ecu_node.database import VehicleDatabase

__all__ = ["SensorFindings", "all_linear", "find_sensor_models", "findings_of", "summaries_about_zeros"]

Found = Mapping[str, tuple[SensorSummary, ...]]
"""What a second pass has read, by vehicle: about the offsets found before, and perhaps about 0."""

_LINEAR = SensorModelChoice(log_bayes_factor=0.0)


@dataclass(frozen=True, kw_only=True)
class SensorFindings:
    """What the second pass found of N vehicles with K branches.

    Attributes
    ----------
    choices : sequence of N sequences of K SensorModelChoice
        Linear for vehicles that could not be looked at.
    summaries : sequence of N DriveSummary
        For the linear estimator: of the linear parts where a sensor is not linear, else those of the first pass.
    modelled : sequence of N ModelledVehicle or None
        Vehicles with sensors that are not linear; None for the others.
    notices : tuple of str
        What the user should know.
    """

    choices: Sequence[Sequence[SensorModelChoice]]
    summaries: Sequence[DriveSummary]
    modelled: Sequence[ModelledVehicle | None]
    notices: tuple[str, ...] = ()

    @property
    def not_linear(self) -> Mask:
        """Which sensors are not linear, shape (N, K)."""
        return np.array([[choice.model != LINEAR for choice in row] for row in self.choices])

    @property
    def undecided(self) -> Mask:
        """Which sensors may be the one that is not linear, though others may be as well, shape (N, K)."""
        return np.array([[choice.undecided for choice in row] for row in self.choices])


def all_linear(vehicles: Sequence[VehicleSummary]) -> SensorFindings:
    """Findings without a second pass: the first pass as it is."""
    summaries = [vehicle.summary for vehicle in vehicles]
    choices = [[_LINEAR] * summary.branches for summary in summaries]
    return SensorFindings(choices=choices, summaries=summaries, modelled=[None] * len(vehicles))


def find_sensor_models(
    vehicles: Sequence[VehicleSummary],
    zero_a: Array,
    fleet: FleetSource,
    equipment: Equipment,
    database: VehicleDatabase,
    *,
    learning: Mask,
    trusted: Mask,
    workers: int,
    limit_s: float = TIME_LIMIT_S,
) -> SensorFindings:
    """Read the drives again and choose the sensor model of every branch.

    Parameters
    ----------
    vehicles : sequence of N VehicleSummary
        From the first pass.
    zero_a : ndarray of shape (N, K)
        Offsets found with linear sensors. [A]
    fleet, equipment, database : FleetSource, Equipment, VehicleDatabase
        The fleet, its branches and inputs, DBC and layout.
    learning : ndarray of bool of shape (N,)
        Vehicles from which others may learn.
    trusted : ndarray of bool of shape (N,)
        Vehicles whose sensors were found faultless on a bench, hence linear.
    workers : int
        Number of processes.
    limit_s : float
        Longest time for one vehicle. [s]

    Returns
    -------
    SensorFindings
        In the order of the vehicles. One that cannot be read again counts as linear, with a notice.
    """
    temperature, notices = _temperature(vehicles, equipment, database.layout.temperature)
    readers = {
        vehicle.vehicle: partial(
            _read_sensors, delays=vehicle.delays.by_branch(), zero_a=zero_a[j], temperature=temperature
        )
        for j, vehicle in enumerate(vehicles)
    }
    found, errors = read_each(
        readers, fleet, equipment, database, workers=workers, limit_s=limit_s, label="read drives again"
    )
    notices += [f"sensor models: {name} counts as linear: {reason}" for name, reason in errors.items()]
    findings = findings_of(vehicles, found, learning=learning, trusted=trusted)
    return replace(findings, notices=(*notices, *findings.notices))


def findings_of(vehicles: Sequence[VehicleSummary], found: Found, *, learning: Mask, trusted: Mask) -> SensorFindings:
    """Choose the sensor model of every branch from what a second pass has read.

    Parameters
    ----------
    vehicles : sequence of N VehicleSummary
        From the first pass.
    found : mapping of str to tuple of SensorSummary
        Of :func:`summaries_about_zeros`, by vehicle; those that are missing count as linear.
    learning, trusted : ndarray of bool of shape (N,)
        As for :func:`find_sensor_models`.

    Returns
    -------
    SensorFindings
        In the order of the vehicles.
    """
    names = [vehicle.vehicle for vehicle in vehicles]
    learners = [name for name, learns in zip(names, learning, strict=True) if learns and name in found]
    if len(learners) < LEAST_VEHICLES:
        return replace(all_linear(vehicles), notices=(_too_few(len(learners)),))
    chosen = _choose(found, learners)
    linear = all_linear(vehicles).choices
    choices = [
        chosen[name][1] if name in chosen and not sound else row
        for name, sound, row in zip(names, trusted, linear, strict=True)
    ]
    usual = usual_sections([found[name][0] for name in learners])
    modelled = [
        modelled_vehicle(chosen[name][0], row, usual) if name in chosen else None
        for name, row in zip(names, choices, strict=True)
    ]
    summaries = [
        vehicle.summary if it is None else it.linear_parts for vehicle, it in zip(vehicles, modelled, strict=True)
    ]
    return SensorFindings(choices=choices, summaries=summaries, modelled=modelled)


def _too_few(learners: int) -> str:
    return (
        f"sensor models: {learners} vehicles to learn from, at least {LEAST_VEHICLES} are needed; all count as linear"
    )


def _temperature(
    vehicles: Sequence[VehicleSummary], equipment: Equipment, name: str | None
) -> tuple[str | None, list[str]]:
    """Input that is the temperature, if most vehicles have it, and what to say if not."""
    if name is None:
        return None, ["sensor models: the layout names no temperature, so no drift with it is looked for"]
    if name in equipment.fleet_inputs:
        return None, [f"sensor models: {name} is a fleet input, so no drift with temperature is looked for"]
    if 2 * sum(name in vehicle.recorded for vehicle in vehicles) <= len(vehicles):
        return None, [f"sensor models: {name} was hardly recorded, so no drift with temperature is looked for"]
    return name, []


def _read_sensors(
    entries: Sequence[DriveFile],
    equipment: Equipment,
    database: VehicleDatabase,
    *,
    delays: Mapping[str, float],
    zero_a: Array,
    temperature: str | None,
) -> tuple[SensorSummary, ...]:
    """Read the drives of one vehicle and summarise them with the columns of the families."""
    layout = database.layout
    inputs = (*equipment.fleet_inputs, *([temperature] if temperature is not None else []))
    samples = [
        align(without_delays(load_drive(entry, database), delays), layout, equipment.branches, inputs=inputs)
        for entry in entries
    ]
    return summaries_about_zeros(samples, zero_a, period_s=layout.period_s, temperature=temperature)


def summaries_about_zeros(
    drives: Sequence[Samples], zero_a: Array, *, period_s: float, temperature: str | None
) -> tuple[SensorSummary, ...]:
    """Summaries of the drives of one vehicle, about each zero that its sensors may have.

    Parameters
    ----------
    drives, period_s, temperature
        As for :func:`~calibrator.sensor_models.summary.summarise_sensors`.
    zero_a : ndarray of shape (K,)
        Offsets found with linear sensors. [A]

    Returns
    -------
    tuple of SensorSummary
        About the offsets; where several sensors have one, about 0 as well.
    """
    zeros = [zero_a, np.zeros(len(zero_a))] if np.count_nonzero(zero_a) > 1 else [zero_a]
    return tuple(summarise_sensors(drives, zero_a=zero, period_s=period_s, temperature=temperature) for zero in zeros)


def _choose(found: Found, learners: Sequence[str]) -> dict[str, tuple[SensorSummary, list[SensorModelChoice]]]:
    """Choices by vehicle, with the summary they hold for.

    A vehicle that is held out, and one about another zero, is compared with the learners and does not change their
    choices.
    """
    fleet = [found[name][0] for name in learners]
    chosen = dict(zip(learners, zip(fleet, choose_sensor_models(fleet), strict=True), strict=True))
    for name in found.keys() - chosen.keys():
        chosen[name] = found[name][0], choose_sensor_models([*fleet, found[name][0]])[-1]
    several = [name for name, summaries in found.items() if len(summaries) > 1]
    others = [found[name][1] for name in several]
    for name, other, row in zip(several, others, choose_sensor_models([*fleet, *others])[len(fleet) :], strict=True):
        if _plainest(row) > _plainest(chosen[name][1]):
            chosen[name] = other, row
    return chosen


def _plainest(row: Sequence[SensorModelChoice]) -> float:
    return max(choice.log_bayes_factor for choice in row)
