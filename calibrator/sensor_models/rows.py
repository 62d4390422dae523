"""What one vehicle says of the excess of each of its sensors: 2K numbers that are 0 for linear sensors.

    fleet rows     i_m,k  =  a f_k(u) + b + e_k h_k             f_k: what identical vehicles draw at these inputs
    junction rows  i_m,r  =  sum_l g_l i_m,l + c - g_k e_k h_k  r: the largest branch, g_r = -1

The junction rows are exact, but for two branches they are one and the same: they tell that a sensor is not linear. The
fleet rows tell which. An excess of branch k moves its own fleet row and, as far as the columns are alike, all junction
rows; by how much is the design. Everything is in units of the family's usual excess.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calibrator.drive import Array, Mask
from calibrator.sensor_models.families import Family
from calibrator.sensor_models.instruments import InstrumentedFit, Instruments
from calibrator.sensor_models.summary import SensorSummary

__all__ = ["ExcessRows", "excess_rows"]

UNKNOWN_VARIANCE = 1e4
"""Of a row that says nothing: a hundred times the usual excess. [1]"""
LEAST_EFFECT = 0.005
"""Least share of a branch's usual current that an excess of usual size must move it by, for a row to count. [1]"""
MOST_LIKENESS = 1.5
"""An excess of another branch that moves a junction row more than this makes it a row about that branch. [1]"""
FLEET_FREEDOM = 4.0
"""Weight of the fleet's usual misfit against that of one vehicle, in instruments."""
LEAST_SD = 0.005
"""Least deviation of a row: resolution of the signals and of their interpolation. [1]"""


@dataclass(frozen=True, kw_only=True)
class ExcessRows:
    """Rows of one vehicle for one family, fleet rows first.

    Attributes
    ----------
    values : ndarray of shape (2K,)
        Excesses over the family's size. [1]
    covariance : ndarray of shape (2K, 2K)
        Of their sampling errors. [1]
    design : ndarray of shape (2K, K)
        What an excess of usual size of each branch adds to each row. [1]
    reference : ndarray of shape (K,)
        Of the linear parts, see :meth:`Family.linear_reference`.
    """

    values: Array
    covariance: Array
    design: Array
    reference: Array

    @property
    def known(self) -> Mask:
        """Which rows say something, shape (2K,)."""
        return np.diag(self.covariance) < UNKNOWN_VARIANCE / 2.0


def excess_rows(vehicles: Sequence[SensorSummary], read_out: Array, family: Family) -> list[ExcessRows]:
    """Rows of every vehicle of a fleet for one family.

    Parameters
    ----------
    vehicles : sequence of SensorSummary
        One per vehicle.
    read_out : ndarray of shape (M + 1, K)
        Of the fleet model. [A]
    family : Family
        The family, one of the summaries'.

    Returns
    -------
    list of ExcessRows
        In the order of the vehicles.
    """
    usual_a = np.median([_rms_a(vehicle) for vehicle in vehicles], axis=0)
    raw = [_of_vehicle(vehicle, read_out, family, usual_a) for vehicle in vehicles]
    power = np.stack([np.diag(one.misfit) for one in raw])
    known = np.stack([one.known for one in raw])
    usual_power = np.array([np.median(power[told, row]) if told.any() else 0.0 for row, told in enumerate(known.T)])
    usual_correlation = np.mean([_correlation(one.misfit) for one in raw], axis=0)
    return [one.rows(usual_power, usual_correlation) for one in raw]


@dataclass(frozen=True, kw_only=True)
class _Raw:
    """Rows of one vehicle before its misfit is seen beside the fleet's."""

    values: Array
    sampling: Array
    """Covariance by the spread between blocks. (2K, 2K)"""
    misfit: Array
    """Mean products of what the instruments show of the residuals, per degree of freedom. (2K, 2K)"""
    lever: Array
    """Mean products of the levers. (2K, 2K)"""
    freedom: float
    known: Mask
    design: Array
    reference: Array

    def rows(self, usual_power: Array, usual_correlation: Array) -> ExcessRows:
        """Rows, the misfit drawn towards the fleet's usual one: few instruments tell little of it."""
        weight = self.freedom / (self.freedom + FLEET_FREEDOM)
        sd = np.sqrt(weight * np.diag(self.misfit) + (1.0 - weight) * usual_power)
        correlation = weight * _correlation(self.misfit) + (1.0 - weight) * usual_correlation
        np.fill_diagonal(correlation, 1.0)
        covariance = self.sampling + np.outer(sd, sd) * correlation * self.lever
        covariance += np.diag(np.where(self.known, LEAST_SD**2, UNKNOWN_VARIANCE))
        return ExcessRows(values=self.values, covariance=covariance, design=self.design, reference=self.reference)


def _of_vehicle(vehicle: SensorSummary, read_out: Array, family: Family, usual_a: Array) -> _Raw:
    columns = _Columns.of(vehicle, family, usual_a)
    K = vehicle.summary.branches
    likeness = columns.likeness()
    own = np.abs(likeness).max(axis=1) <= MOST_LIKENESS
    fits = [columns.fleet_row(k, read_out[:, k]) for k in range(K)]
    fits += [columns.junction_row(k) if own[k] else None for k in range(K)]
    known = np.array([fit is not None for fit in fits])
    scale = np.concatenate([np.ones(K), -columns.gains]) * family.size
    B, Q, _ = vehicle.products.shape
    influence = np.stack([fit.influence if fit else np.zeros(B) for fit in fits]) / scale[:, None]
    misfit = np.stack([fit.misfit / np.sqrt(fit.freedom) if fit else np.zeros(Q) for fit in fits])
    lever = np.stack([fit.lever if fit else np.zeros(Q) for fit in fits]) / scale[:, None]
    total = columns.instruments.total
    return _Raw(
        values=np.array([fit.estimate if fit else 0.0 for fit in fits]) / scale,
        sampling=influence @ influence.T,
        misfit=misfit @ total @ misfit.T,
        lever=lever @ total @ lever.T,
        freedom=max((fit.freedom for fit in fits if fit), default=1.0),
        known=known,
        design=np.concatenate([np.eye(K), likeness]) * known[:, None],
        reference=columns.reference,
    )


def _correlation(covariance: Array) -> Array:
    sd = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    safe = np.where(sd > 0.0, sd, np.inf)
    return np.asarray(covariance / np.outer(safe, safe))


@dataclass(frozen=True, kw_only=True)
class _Columns:
    """The columns of one vehicle, as unit vectors among all of them."""

    instruments: Instruments
    inputs: Array
    currents: Array
    constant: Array
    extra: Array
    """(Q, K)"""
    reference: Array
    size: float
    usual_a: Array
    gains: Array
    """g_k of the junction law with linear sensors; -1 for the largest branch. (K,)"""
    largest: int

    @classmethod
    def of(cls, vehicle: SensorSummary, family: Family, usual_a: Array) -> "_Columns":
        products = vehicle.products
        M, K, Q = vehicle.summary.inputs, vehicle.summary.branches, products.shape[1]
        unit = np.eye(Q)
        among = [*range(M), M + K, *vehicle.input_columns(family)]
        instruments = Instruments.of(products, among, constant=M + K)
        total, one, places = instruments.total, M + K, vehicle.current_columns(family)
        beyond_zero = unit[:, M : M + K] - np.outer(unit[:, one], vehicle.zero_a)
        power = np.maximum(np.einsum("qk,qr,rk->k", beyond_zero, total, beyond_zero), np.finfo(float).tiny)
        usual = np.einsum("kr,rk->k", total[places], beyond_zero) / power
        reference = np.array([family.linear_reference(float(ratio)) for ratio in usual])
        largest = int(np.argmax(power))
        columns = cls(
            instruments=instruments,
            inputs=unit[:, :M],
            currents=unit[:, M : M + K],
            constant=unit[:, one],
            extra=unit[:, places] - reference * beyond_zero,
            reference=reference,
            size=family.size,
            usual_a=usual_a,
            gains=np.full(K, -1.0),
            largest=largest,
        )
        found = instruments.coefficients(columns.currents[:, largest], columns.junction_regressors())
        columns.gains[columns.others] = found[:-1]
        return columns

    @property
    def others(self) -> list[int]:
        return [k for k in range(self.currents.shape[1]) if k != self.largest]

    def junction_regressors(self) -> Array:
        return np.column_stack([self.currents[:, self.others], self.constant])

    def fleet_row(self, k: int, read_out: Array) -> InstrumentedFit | None:
        model = np.column_stack([self.inputs, self.constant]) @ read_out
        return self._row(k, self.currents[:, k], np.column_stack([model, self.constant]))

    def junction_row(self, k: int) -> InstrumentedFit | None:
        return self._row(k, self.currents[:, self.largest], self.junction_regressors())

    def _row(self, k: int, y: Array, x: Array) -> InstrumentedFit | None:
        """Regression with the column of branch k as the last regressor; None if it says nothing."""
        if not self._tells(k, x):
            return None
        return self.instruments.regress(y, np.column_stack([x, self.extra[:, k]]))

    def _tells(self, k: int, x: Array) -> bool:
        beyond = np.column_stack([x, self.currents[:, k]])
        return self.size * self.instruments.strength(self.extra[:, k], beyond) > LEAST_EFFECT * float(self.usual_a[k])

    def likeness(self) -> Array:
        """What an excess of each branch adds to each junction row, shape (K, K)."""
        K = len(self.gains)
        x = self.junction_regressors()
        likeness = np.zeros((K, K))
        for row in range(K):
            if self._tells(row, x):
                z = np.column_stack([x, self.extra[:, row]])
                for k in range(K):
                    share = float(self.instruments.coefficients(self.extra[:, k], z)[-1])
                    likeness[row, k] = self.gains[k] * share / self.gains[row]
        return likeness


def _rms_a(vehicle: SensorSummary) -> Array:
    summary = vehicle.summary
    mean_square = np.diag(summary.mean_product_a2) - 2.0 * summary.mean_a * vehicle.zero_a + vehicle.zero_a**2
    return np.asarray(np.sqrt(np.maximum(mean_square, 0.0)))
