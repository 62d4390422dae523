"""Sensors with a model: all that the decision on a correction needs of the drives.

The excess of a sensor is found first, and the rest from its linear part, whose moments depend on the excess:

    i_m - e c,    c = h - reference * (i_m - Z)

(:mod:`.families`). How sure a correction is depends on what the rest would be for another excess, so the products of
c with the other columns are kept beside the summary of the linear parts.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calibrator.drive import Array
from calibrator.sensor_models.choice import LINEAR, SensorModelChoice
from calibrator.sensor_models.families import Family
from calibrator.sensor_models.linear_part import excess_column, family_of, linear_columns, linear_summary
from calibrator.sensor_models.sections import ColumnMoments, Sections, usual_moments
from calibrator.sensor_models.summary import SensorSummary
from calibrator.summaries.moments import DriveSummary

__all__ = ["ModelledSensor", "ModelledVehicle", "UsualSections", "modelled_vehicle", "usual_sections"]

UsualSections = dict[tuple[str, int], Sections]
"""Of a fleet's usual drive, by name of the family and branch."""


@dataclass(frozen=True, kw_only=True)
class ModelledSensor:
    """One sensor that is not linear, on the drives of its vehicle.

    Attributes
    ----------
    branch : int
        Its branch, in the vehicle's own order.
    choice : SensorModelChoice
        What it is.
    zero_a : float
        Current that it was taken to show at 0 A. [A]
    own, usual : Sections
        Of the vehicle's own drives, and of the fleet's usual one.
    block_at : ndarray of shape (B,)
        Section of each block as a whole, see :attr:`Sections.at`.
    """

    branch: int
    choice: SensorModelChoice
    zero_a: float
    own: Sections
    usual: Sections
    block_at: Array

    @property
    def family(self) -> Family:
        """Family of its model."""
        return family_of(self.choice.model)

    def block_gain(self) -> Array:
        """What the linear part shows in each block over a linear sensor, shape (B,). [1]"""
        return self.family.left_in_linear_part(self.choice.excess, self.block_at)


@dataclass(frozen=True, kw_only=True)
class ModelledVehicle:
    """A vehicle with sensors that are not linear.

    Attributes
    ----------
    linear_parts : DriveSummary
        Of its drives, for the excesses that were found.
    sensors : tuple of n ModelledSensor
        Those that are not linear.
    products : ndarray of shape (B, n, M + K + 1)
        Products of the c of each with (inputs, linear parts [A], 1), summed per block.
    squares : ndarray of shape (B, n, n)
        Products of the c of each with one another.
    """

    linear_parts: DriveSummary
    sensors: tuple[ModelledSensor, ...]
    products: Array
    squares: Array

    def with_excess(self, excess: Mapping[int, float]) -> DriveSummary:
        """Summary of the linear parts if some sensors had another excess.

        Parameters
        ----------
        excess : mapping of int to float
            By branch; 0: its measured current itself. The others keep theirs.

        Returns
        -------
        DriveSummary
            With the same blocks.
        """
        rows = [self.linear_parts.inputs + sensor.branch for sensor in self.sensors]
        found = [sensor.choice.excess for sensor in self.sensors]
        change = np.array([excess.get(s.branch, e) - e for s, e in zip(self.sensors, found, strict=True)])
        moved = change[:, None] * self.products
        moments = self.linear_parts.moments.copy()
        moments[:, rows] -= moved
        moments[:, :, rows] -= np.swapaxes(moved, 1, 2)
        moments[:, np.array(rows)[:, None], rows] += np.outer(change, change) * self.squares
        return replace(self.linear_parts, moments=moments)


def usual_sections(vehicles: Sequence[SensorSummary]) -> UsualSections:
    """Sections of a fleet's usual drive, for linear parts of reference 0.

    Parameters
    ----------
    vehicles : sequence of SensorSummary
        At least one, all with the same branches and families.

    Returns
    -------
    dict of (str, int) to Sections
        By name of the family and branch.
    """
    return {
        (family.name, k): family.sections(usual_moments([_moments(each, k, family) for each in vehicles]))
        for family in vehicles[0].families
        for k in range(vehicles[0].summary.branches)
    }


def modelled_vehicle(
    vehicle: SensorSummary, choices: Sequence[SensorModelChoice], usual: UsualSections
) -> ModelledVehicle | None:
    """A vehicle with what its drives tell of its sensors that are not linear.

    Parameters
    ----------
    vehicle : SensorSummary
        Of the vehicle.
    choices : sequence of K SensorModelChoice
        For its branches.
    usual : dict of (str, int) to Sections
        Of its fleet.

    Returns
    -------
    ModelledVehicle or None
        None if all its sensors are linear.
    """
    bent = [(k, choice) for k, choice in enumerate(choices) if choice.model != LINEAR]
    if not bent:
        return None
    excess = np.column_stack([excess_column(vehicle, k, choice) for k, choice in bent])
    products = np.swapaxes(excess, 0, 1) @ vehicle.products
    return ModelledVehicle(
        linear_parts=linear_summary(vehicle, choices),
        sensors=tuple(_modelled(vehicle, k, choice, usual[choice.model, k]) for k, choice in bent),
        products=products @ linear_columns(vehicle, choices),
        squares=products @ excess,
    )


def _modelled(vehicle: SensorSummary, k: int, choice: SensorModelChoice, usual: Sections) -> ModelledSensor:
    family = family_of(choice.model)
    ratios = [_of_products(vehicle, block, k, family).ratio[0] for block in vehicle.products]
    return ModelledSensor(
        branch=k,
        choice=choice,
        zero_a=float(vehicle.zero_a[k]),
        own=family.sections(_moments(vehicle, k, family)).beside(choice.reference),
        usual=usual.beside(choice.reference),
        block_at=np.array(ratios) - choice.reference,
    )


def _moments(vehicle: SensorSummary, k: int, family: Family) -> ColumnMoments:
    return _of_products(vehicle, vehicle.products.sum(axis=0), k, family)


def _of_products(vehicle: SensorSummary, products: Array, k: int, family: Family) -> ColumnMoments:
    """Moments of a branch and its column from the summed products of some blocks, shape (Q, Q)."""
    one = vehicle.summary.inputs + vehicle.summary.branches
    current, column = vehicle.summary.inputs + k, vehicle.current_columns(family)[k]
    place, zero_a = [one, current, column], float(vehicle.zero_a[k])
    mean = products[np.ix_(place, place)] / products[one, one]
    return ColumnMoments(
        x=float(mean[0, 1]) - zero_a,
        xx=float(mean[1, 1] - 2.0 * zero_a * mean[0, 1] + zero_a**2),
        h=float(mean[0, 2]),
        hx=float(mean[1, 2] - zero_a * mean[0, 2]),
        hh=float(mean[2, 2]),
    )
