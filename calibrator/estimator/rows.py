"""Evidence rows of a fleet: Gaussian, and linear in the fault parameters; (M9) to (M11) of docs/method.md.

With lambda_k = log(1 + d_k), eta = log(1 + d_h) and omega_k = o_k / (1 + d_k), equations (11), (13) and (15) of [1]_
and the junction law sum_k (i_m,k - o_k) / (1 + d_k) = l (l: load that no branch measures) become

    relative rows                                             constant rows, in fractions of full scale
    log a_k                  = lambda_k + eta + m_k           b_k / (1 + d_k)   = o_h,k + omega_k + n_k
    log(-g_k), k > 1         = lambda_1 - lambda_k + q_k      c / (1 + d_1)     = sum_k omega_k + l
    log of a bench reading   = lambda_k                       offset reading_k / (1 + d_k) = omega_k

a, b are slopes and intercepts over the fleet model; g, c those of the first measured current over the others. m, n, q
are what a vehicle and its drives differ from the fleet without any fault: the model spread. An unknown row has the
value 0 and a variance of :data:`UNKNOWN_VARIANCE`.

b and c are where lines meet zero. If a ratio is wrong, its line pivots about the mean of its data, which is known far
better, and b or c follows: (M10). The covariance holds this to first order, the residuals of an explanation (M11)
exactly: :func:`calibrator.estimator.explanations.row_residuals`.

:class:`RowPlaces` and :class:`ParameterPlaces` name the rows and the parameters in the order in which arrays hold them.

.. [1] "Measurement Correction for Electric Vehicles Based on Compressed Sensing".
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import isfinite
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from calibrator.drive import Array, Mask
from calibrator.errors import FleetError
from calibrator.estimator.fleet_model import FleetModel, regress_on_fleet
from calibrator.estimator.moments import FleetMoments, junction_law, products
from calibrator.faults import Index

__all__ = [
    "UNKNOWN_VARIANCE",
    "EvidenceRows",
    "ParameterPlaces",
    "RowPlaces",
    "VehicleEvidence",
    "collect_rows",
    "evidence_names",
    "parameter_places",
    "reported_evidence",
    "row_design",
    "row_places",
]

UNKNOWN_VARIANCE = 100.0
"""Of an unknown row: ten times full scale, or a factor of 20 000. [1]"""
LEAST_GAIN = 0.3
"""Slopes and gain ratios below are no sensor's, but those of a branch that hardly moved. [1]"""
FEWEST_BLOCKS = 4
"""Of a vehicle; from fewer no variance can be estimated."""
FLEET_BLOCKS = 20.0
"""Weight of the fleet's usual correlation of rows against that of one vehicle, in blocks."""
LEAST_SD = np.array([5e-5, 1e-5])
"""Least deviation of relative and constant rows: resolution of the signals and of their interpolation. [1]"""


class RowPlaces(NamedTuple):
    """Where an array of 5K rows holds each kind of row, for K branches.

    Attributes
    ----------
    slopes : slice
        K, log a. [1]
    ratios : slice
        K - 1, log(-g) of every branch but the first. [1]
    gain_reads : slice
        K, bench readings of log(1 + d). [1]
    intercepts : slice
        K, b, in fractions of full scale.
    junction : int
        c, in fractions of full scale.
    offset_reads : slice
        K, readings of the offsets, in fractions of full scale.
    relative, constant : slice
        The 3K - 1 rows of the first three kinds, and the 2K + 1 of the others.
    """

    slopes: slice
    ratios: slice
    gain_reads: slice
    intercepts: slice
    junction: int
    offset_reads: slice
    relative: slice
    constant: slice

    def slope(self, branch: int) -> int:
        """Row of the slope of a branch, counted from 0."""
        return int(self.slopes.start) + branch

    def ratio(self, branch: int) -> int:
        """Row of the gain ratio of a branch, counted from 0; the first branch has none."""
        return int(self.ratios.start) + branch - 1

    def intercept(self, branch: int) -> int:
        """Row of the intercept of a branch, counted from 0."""
        return int(self.intercepts.start) + branch

    @property
    def measured(self) -> NDArray[np.int64]:
        """Places of the 3K rows that drives show; the others are readings."""
        return np.asarray(np.r_[self.slopes, self.ratios, self.intercepts, self.junction])


class ParameterPlaces(NamedTuple):
    """Where an array of 3K + 1 parameters holds each kind, for K branches, in the symbols above.

    Attributes
    ----------
    eta : int
        Hardware gain. [1]
    gains : slice
        lambda of K sensors. [1]
    hardware_offsets : slice
        o_h of all branches but the last, which is minus their sum, in fractions of full scale.
    offsets : slice
        omega of K sensors, in fractions of full scale.
    load : int
        l, in fractions of full scale.
    """

    eta: int
    gains: slice
    hardware_offsets: slice
    offsets: slice
    load: int

    def offset(self, branch: int) -> int:
        """Place of omega of the sensor of a branch, counted from 0."""
        return int(self.offsets.start) + branch


def row_places(branches: int) -> RowPlaces:
    """Where the rows of so many branches are."""
    K = branches
    return RowPlaces(
        slopes=slice(0, K),
        ratios=slice(K, 2 * K - 1),
        gain_reads=slice(2 * K - 1, 3 * K - 1),
        intercepts=slice(3 * K - 1, 4 * K - 1),
        junction=4 * K - 1,
        offset_reads=slice(4 * K, 5 * K),
        relative=slice(0, 3 * K - 1),
        constant=slice(3 * K - 1, 5 * K),
    )


def parameter_places(branches: int) -> ParameterPlaces:
    """Where the parameters of so many branches are."""
    K = branches
    return ParameterPlaces(
        eta=0, gains=slice(1, K + 1), hardware_offsets=slice(K + 1, 2 * K), offsets=slice(2 * K, 3 * K), load=3 * K
    )


@dataclass(frozen=True, kw_only=True)
class EvidenceRows:
    """Evidence of N vehicles with K branches.

    Attributes
    ----------
    relative : ndarray of shape (N, 3K - 1)
        log a (K), log(-g) (K - 1), bench readings of log(1 + d) (K). [1]
    constant : ndarray of shape (N, 2K + 1)
        b (K), c (1), readings of the offsets (K), in fractions of full scale. [1]
    covariance : ndarray of shape (N, 5K, 5K)
        Of the sampling error of both, relative rows first; of the constant rows as seen in true currents, that is
        divided by 1 + d. [1]
    means : ndarray of shape (N, 2, K)
        Means of the fleet model's and of the measured currents, in fractions of full scale, about which the lines of
        the constants pivot; zero where constants do not depend on the ratios. [1]
    """

    relative: Array
    constant: Array
    covariance: Array
    means: Array

    def __post_init__(self) -> None:
        N, K = len(self.relative), self.branches
        shapes = [values.shape for values in vars(self).values()]
        if shapes != [(N, 3 * K - 1), (N, 2 * K + 1), (N, 5 * K, 5 * K), (N, 2, K)]:
            raise FleetError(
                f"evidence of shapes {', '.join(map(str, shapes))}; expected relative rows of shape (N, 3K - 1), "
                f"constant rows (N, 2K + 1), covariance (N, 5K, 5K) and means (N, 2, K)"
            )
        if not all(np.isfinite(values).all() for values in vars(self).values()):
            raise FleetError("evidence is not finite; leave out the vehicles that have none")

    def __len__(self) -> int:
        return len(self.relative)

    @property
    def branches(self) -> int:
        """Number of branches K."""
        return int(self.relative.shape[1] + 1) // 3

    @property
    def places(self) -> RowPlaces:
        """Where :attr:`values`, :attr:`known` and the covariance hold each kind of row."""
        return row_places(self.branches)

    @property
    def values(self) -> Array:
        """All rows, relative ones first, shape (N, 5K)."""
        return np.concatenate([self.relative, self.constant], axis=1)

    @property
    def known(self) -> Mask:
        """Which rows say something, shape (N, 5K)."""
        return np.asarray(np.diagonal(self.covariance, axis1=1, axis2=2) < UNKNOWN_VARIANCE / 2.0)

    def shown(self, row: int) -> tuple[Array, Array]:
        """Values of a row in the vehicles that show it, and their standard deviations."""
        known = self.known[:, row]
        return self.values[known, row], np.sqrt(self.covariance[known, row, row])

    def take(self, index: Index) -> "EvidenceRows":
        """Return the evidence of some of the vehicles."""
        return EvidenceRows(**{name: values[index] for name, values in vars(self).items()})

    def intercept_covariance(self) -> Array:
        """Covariance of b + a mean(f), which does not depend on errors of the slopes a, shape (N, K, K)."""
        b = self.places.intercepts
        return _shifted(self.covariance, -_pivot(self.means, self.relative), first=b.start)[:, b, b]

    def dispersed(self, dispersion: Array | float) -> tuple[Array, Array]:
        """Covariance if that of the intercepts at their means is larger.

        Parameters
        ----------
        dispersion : ndarray of shape (K,), or float
            Factor on the variance of the intercepts, at least 1. [1]

        Returns
        -------
        whole : ndarray of shape (N, 5K, 5K)
            Of all rows.
        added : ndarray of shape (N, K, K)
            What of it is added to the intercepts, independent of everything else.
        """
        b = self.places.intercepts
        more = np.sqrt(np.broadcast_to(np.asarray(dispersion) - 1.0, self.branches))
        added = self.intercept_covariance() * np.outer(more, more)
        whole = self.covariance.copy()
        whole[:, b, b] += added
        return whole, added

    def with_load_spread(self, sd: float) -> "EvidenceRows":
        """Return the evidence if loads that no branch measures differ by a standard deviation, over full scale [1]."""
        covariance, junction = self.covariance.copy(), self.places.junction
        covariance[:, junction, junction] += sd**2
        return replace(self, covariance=covariance)


def collect_rows(
    fleet: FleetMoments, model: FleetModel, *, full_scale_a: float, usual_correlation: Array | None = None
) -> tuple[EvidenceRows, Array]:
    """Collect the evidence of every vehicle of a fleet.

    Parameters
    ----------
    fleet : FleetMoments
        Of N vehicles.
    model : FleetModel
        Of the same fleet.
    full_scale_a : float
        Full scale of the junction. [A]
    usual_correlation : ndarray of shape (3K, 3K), or None
        Correlation of the rows that is usual in the fleet, as an earlier call returned it; None: the mean over these
        vehicles. That of each vehicle is smoothed with it, as few blocks show little of a correlation. [1]

    Returns
    -------
    rows : EvidenceRows
        Slopes and intercepts over the fleet model, and the junction law; without bench readings.
    usual_correlation : ndarray of shape (3K, 3K)
        The one that was used.
    """
    M, K, N = fleet.inputs, fleet.branches, len(fleet)
    R = 2 * K - 1  # number of slopes and gain ratios: the first of the rows that are measured, before b and c
    fits = [*regress_on_fleet(fleet, model.read_out), junction_law(fleet)]
    influence = np.concatenate([fit.influence for fit in fits], axis=1)
    covariance = fleet.blocks.total(influence[:, :, None] * influence[:, None, :])
    for k, fit in enumerate(fits):
        part = slice(2 * k, 2 * k + fit.estimate.shape[1])
        covariance[:, part, part] += fit.prior_covariance
    # from (a_1, b_1 .. a_K, b_K, g_2 .. g_K, c) to (a, -g, b, c), the latter two over full scale
    order = np.array([*range(0, 2 * K, 2), *range(2 * K, 3 * K - 1), *range(1, 2 * K, 2), 3 * K - 1])
    unit = np.concatenate([np.ones(K), -np.ones(K - 1), np.full(K + 1, 1.0 / full_scale_a)])
    values = np.concatenate([fit.estimate for fit in fits], axis=1)[:, order] * unit
    covariance = covariance[:, order[:, None], order] * np.outer(unit, unit)
    inputs = fleet.mean[:, -1, [*range(M), -1]]
    model_a = products(np.broadcast_to(model.read_out.T, (N, K, M + 1)), inputs)
    means = np.stack([model_a, fleet.mean_a], axis=1) / full_scale_a

    # Correlations are smoothed for the constants at the means (M10): at zero they depend on how far away the means
    # are, and no average over vehicles would respect that.
    to_means = np.zeros((N, K + 1, R))
    to_means[:, range(K), range(K)] = means[:, 0]
    to_means[:, K, K:] = -means[:, 1, 1:]
    covariance = _shifted(covariance, to_means, first=R)
    blocks = fleet.blocks.count[:, None, None]
    covariance[blocks[:, 0, 0] < FEWEST_BLOCKS] = UNKNOWN_VARIANCE * np.eye(3 * K)
    sd = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    safe_sd = np.where(sd > 0.0, sd, np.inf)
    own = covariance / (safe_sd[:, :, None] * safe_sd[:, None, :])
    usual = own.mean(axis=0) if usual_correlation is None else usual_correlation
    correlation = (blocks * own + FLEET_BLOCKS * usual) / (blocks + FLEET_BLOCKS)
    correlation[:, range(3 * K), range(3 * K)] = 1.0
    covariance = correlation * sd[:, :, None] * sd[:, None, :]

    # Logarithms of the ratios, constants as seen in true currents. An unknown ratio becomes 1; its constant follows.
    ratios, constant = values[:, :R], values[:, R:]
    known = ratios > LEAST_GAIN
    safe = np.where(known, ratios, 1.0)
    constant = constant + products(to_means, ratios - safe)
    per_unit = np.concatenate([1.0 / safe, 1.0 / safe[:, :K], 1.0 / safe[:, :1]], axis=1)
    covariance = covariance * per_unit[:, :, None] * per_unit[:, None, :]
    covariance += np.diag(np.repeat(LEAST_SD, [R, K + 1]) ** 2)
    vehicle, row = np.nonzero(~known)
    covariance[vehicle, row, :], covariance[vehicle, :, row] = 0.0, 0.0
    covariance[vehicle, row, row] = UNKNOWN_VARIANCE

    unread = np.zeros((N, K))
    relative = np.concatenate([np.log(safe), unread], axis=1)
    whole = np.tile(np.diag(np.full(5 * K, UNKNOWN_VARIANCE)), (N, 1, 1))
    place = row_places(K).measured
    whole[:, place[:, None], place] = _shifted(covariance, _pivot(means, relative), first=R)
    constant = np.concatenate([constant, unread], axis=1)
    return EvidenceRows(relative=relative, constant=constant, covariance=whole, means=means), usual


def _pivot(means: Array, relative: Array) -> Array:
    """Change of b and c, as seen in true currents, per error of log a and log(-g), shape (N, K + 1, 2K - 1)."""
    N, _, K = means.shape
    pivot = np.zeros((N, K + 1, 2 * K - 1))
    pivot[:, range(K), range(K)] = -means[:, 0]
    pivot[:, K, K:] = means[:, 1, 1:] * np.exp(-relative[:, 1:K])  # -g_k / (1 + d_1) = 1 / (1 + d_k), about 1 / a_k
    return pivot


def _shifted(covariance: Array, by: Array, *, first: int) -> Array:
    """Covariance if ``by`` (N, c, r) times the first r variables is added to c variables from ``first`` on."""
    turn = np.tile(np.eye(covariance.shape[-1]), (len(covariance), 1, 1))
    turn[:, first : first + by.shape[1], : by.shape[2]] += by
    return np.asarray(turn @ covariance @ np.swapaxes(turn, 1, 2))


def row_design(branches: int, feed: int) -> Array:
    """Rows over parameters, linear as they are in true currents.

    Parameters
    ----------
    branches : int
        Number of branches K.
    feed : int
        Branch that carries a load without a sensor, counted from 0.

    Returns
    -------
    ndarray of shape (5K, 3K + 1)
        Rows as :func:`row_places`, columns as :func:`parameter_places` names them. [1]
    """
    K, row, column = branches, row_places(branches), parameter_places(branches)
    design = np.zeros((5 * K, 3 * K + 1))
    design[row.slopes, column.eta] = 1.0
    design[row.slopes, column.gains] = design[row.gain_reads, column.gains] = np.eye(K)
    design[row.ratios, column.gains] = np.hstack([np.ones((K - 1, 1)), -np.eye(K - 1)])
    design[row.intercepts, column.hardware_offsets] = np.vstack([np.eye(K - 1), -np.ones((1, K - 1))])
    design[row.intercepts, column.offsets] = design[row.offset_reads, column.offsets] = np.eye(K)
    design[row.junction, column.offsets] = 1.0
    design[[row.intercept(feed), row.junction], column.load] = 1.0
    return design


def evidence_names(branches: Sequence[str]) -> list[str]:
    """Names of the 5K rows.

    Parameters
    ----------
    branches : sequence of str
        The K branches, the most moving first: the junction law is written for it.

    Returns
    -------
    list of str
        3K - 1 ratios [1], then 2K + 1 constants [A].
    """
    first = branches[0]
    return [
        *(f"slope {name}" for name in branches),
        *(f"gain ratio {first} / {name}" for name in branches[1:]),
        *(f"gain read {name}" for name in branches),
        *(f"intercept {name}" for name in branches),
        "junction constant",
        *(f"offset read {name}" for name in branches),
    ]


@dataclass(frozen=True, kw_only=True)
class VehicleEvidence:
    """What the parameters of one vehicle were found from, in the units of its sensors.

    Attributes
    ----------
    value, sd, explained : list of 5K float or None
        What was measured, its standard deviation, and what the estimate makes of it; None for both of the first two
        where a row is unknown. ``evidence`` in the details of ``run.json`` names the rows: ratios [1], then constants
        [A].
    """

    value: list[float | None]
    sd: list[float | None]
    explained: list[float]


def reported_evidence(
    rows: EvidenceRows,
    *,
    centre: Array,
    covariance: Array,
    drift: Array,
    offset_a: Array,
    hardware_drift: Array,
    hardware_offset_a: Array,
    full_scale_a: float,
) -> list[VehicleEvidence]:
    """The evidence rows in the units of the sensors, beside what the estimates make of them, for the pages of a report.

    Parameters
    ----------
    rows : EvidenceRows
        Of N vehicles with K branches; all that follows has its order of branches.
    centre : ndarray of shape (5K,)
        What vehicles without faults show in the rows: the load without a sensor belongs to the junction constant. [1]
    covariance : ndarray of shape (N, 5K, 5K)
        Of each reading together with what faultless vehicles differ by. [1]
    drift, offset_a, hardware_offset_a : ndarray of shape (N, K)
        Estimates. [1], [A], [A]
    hardware_drift : ndarray of shape (N,)
        Estimates. [1]
    full_scale_a : float
        Full scale of the junction. [A]

    Returns
    -------
    list of VehicleEvidence
        In the order of the vehicles.
    """
    gain, first = 1.0 + drift, 1.0 + drift[:, :1]
    ratios = np.exp(rows.relative)
    seen = np.concatenate([gain, first, np.ones_like(gain)], axis=1) * full_scale_a  # constants are held over (1 + d)
    value = np.concatenate([ratios, rows.constant * full_scale_a], axis=1)
    sd = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2)) * np.concatenate([ratios, seen], axis=1)
    # a_k = (1 + d_k)(1 + d_h); -g_k = (1 + d_1) / (1 + d_k); b_k = o_k + (1 + d_k) o_h,k; c = (1 + d_1) sum o/(1 + d)
    relative = np.concatenate([gain * (1.0 + hardware_drift[:, None]), first / gain[:, 1:], gain], axis=1)
    junction = first * (offset_a / gain).sum(axis=1, keepdims=True)
    constant = np.concatenate([offset_a + gain * hardware_offset_a, junction, offset_a], axis=1)
    at = rows.places
    made = np.concatenate([relative * np.exp(centre[at.relative]), constant + seen * centre[at.constant]], axis=1)
    value[~rows.known], sd[~rows.known] = np.nan, np.nan

    def told(values: Array) -> list[list[float | None]]:
        return [[v if isfinite(v) else None for v in row] for row in values.tolist()]

    columns = zip(told(value), told(sd), made.tolist(), strict=True)
    return [VehicleEvidence(value=v, sd=s, explained=m) for v, s, m in columns]
