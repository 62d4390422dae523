"""Identification of a state-space model (2) of [1]_ from one drive: PO-MOESP [2]_ on second moments.

1. Inputs and currents are standardised; samples outside the mask take no part.
2. The Gram matrix of lagged data (future inputs; past inputs and currents; future currents) is factored by Cholesky,
   which gives the same triangle as a QR of the data. The block of future currents on the past has the extended
   observability matrix as its column space: A by shift invariance, C as its first rows.
3. A is taken apart into its modes, and unstable poles are reflected into the unit circle.
4. B, D, the initial state and the offset follow by least squares, then C, D and the offset again, both from one set of
   second moments of the inputs filtered by each mode. This minimises the simulation error (output error), so noise
   on the currents leaves no bias in the gain.

.. [1] "Measurement Correction for Electric Vehicles Based on Compressed Sensing".
.. [2] M. Verhaegen, "Identification of the deterministic part of MIMO state space models given in innovations form
   from input-output data", Automatica 30 (1994) 61-74.
"""

from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from calibrator.drive import Array, Mask
from calibrator.errors import DriveError
from calibrator.identification.lagged_moments import LaggedMoments, lagged_moments
from calibrator.identification.modal_fit import Modes, fit_read_out, stable_modes
from calibrator.identification.state_space import StateSpaceModel, valid_or_all

__all__ = [
    "BLOCK_ROWS",
    "ORDERS",
    "choose_order",
    "identify",
    "observability",
    "standardised_moments",
    "subspace_modes",
]

ORDERS = (0, 1, 2, 3, 4, 6, 8)
"""Orders to choose from: a power train as seen at 10 Hz has few modes. [1]"""
BLOCK_ROWS = 10
"""Past and future samples that the subspace step sees: more than the largest order needs. [1]"""
RIDGE = 1e-12
"""Added to standardised second moments: above rounding, far below any signal. [1]"""
LARGEST_RIDGE = 1e-9
"""The same where rounding is larger: still far below any signal. [1]"""
ROWS_PER_COLUMN = 2
"""Least ratio of rows to columns of lagged data for the moments to mean anything. [1]"""
TRAIN_SHARE = 0.8
"""Share of the samples that orders are fitted on; they are compared on the rest. [1]"""
ORDER_TOLERANCE_DB = 0.2
"""An order is large enough if its simulation error is this close to the best. [dB]"""


def identify(inputs: Array, currents: Array, *, order: int | None = None, valid: Mask | None = None) -> StateSpaceModel:
    """Identify a stable model of one vehicle from one drive.

    Parameters
    ----------
    inputs : ndarray of shape (T, M)
        Inputs, sampled uniformly; constant or equal inputs do no harm. Gaps are bridged linearly.
    currents : ndarray of shape (T, K)
        Measured branch currents, positive into the junction. [A]
    order : int or None
        Order n; None: chosen by :func:`choose_order`.
    valid : ndarray of bool of shape (T,) or None
        False where inputs or currents must not be used; there they may be NaN. None: all are valid.

    Returns
    -------
    StateSpaceModel
        With poles inside the unit circle, and its simulation SNR on this drive.

    Raises
    ------
    DriveError
        If the drive is too short for the order, a valid sample is not finite, or shapes do not fit.
    """
    mask = _checked(inputs, currents, valid)
    if order is None:
        order = choose_order(inputs, currents, valid=mask)
    data = _standardise(inputs, currents, mask)
    observed = _observability(data, order) if order else np.zeros((currents.shape[1], 0))
    return data.in_units(_model_from_subspace(data, observed, order))


def choose_order(inputs: Array, currents: Array, *, valid: Mask | None = None) -> int:
    """Smallest order that simulates held-out samples as well as the best.

    Models of all :data:`ORDERS` are fitted on the first 80 % and simulated on the rest. The error of an order is the
    mean over channels of its power in dB; chosen is the smallest order within 0.2 dB of the smallest error.

    Parameters
    ----------
    inputs, currents, valid
        As in :func:`identify`.

    Returns
    -------
    int
        Order n.

    Raises
    ------
    DriveError
        As :func:`identify`.
    """
    mask = _checked(inputs, currents, valid)
    stop = int(TRAIN_SHARE * len(inputs))
    rest = np.flatnonzero(mask[stop:]) + stop
    if not rest.size:
        raise DriveError(f"no valid sample in the last {len(inputs) - stop} of {len(inputs)}: cannot compare orders")
    data = _standardise(inputs[:stop], currents[:stop], mask[:stop])
    observed = _observability(data, max(ORDERS))
    bridged = _bridged(inputs, mask)
    scale = np.where(currents[mask].std(axis=0) > 0.0, currents[mask].std(axis=0), 1.0)
    errors = []
    for order in ORDERS:
        model = data.in_units(_model_from_subspace(data, observed, order))
        simulated = model.simulate(bridged, initial_state=model.x0)[rest]
        power = np.mean(((currents[rest] - simulated) / scale) ** 2, axis=0)
        errors.append(float(np.mean(10.0 * np.log10(power + RIDGE))))
    return next(n for n, error in zip(ORDERS, errors, strict=True) if error <= min(errors) + ORDER_TOLERANCE_DB)


@dataclass(frozen=True, kw_only=True)
class _Standardised:
    """Inputs (T, M) and currents (T, K) of mean 0 and deviation 1, and how to come back."""

    u: Array
    y: Array
    mask: Mask
    input_mean: Array
    input_scale: Array
    current_mean: Array
    current_scale: Array

    def in_units(self, model: StateSpaceModel) -> StateSpaceModel:
        """The same model for inputs and currents in their units."""
        D = self.current_scale[:, None] * model.D / self.input_scale
        gain = self.input_mean / self.input_scale
        # A constant shift of the inputs moves the state by the steady state that belongs to it.
        shift = model.steady_state(gain)
        C = self.current_scale[:, None] * model.C
        return StateSpaceModel(
            A=model.A,
            B=model.B / self.input_scale,
            C=C,
            D=D,
            x0=model.x0 + shift,
            offset_a=self.current_mean + self.current_scale * model.offset_a - C @ shift - D @ self.input_mean,
            snr_db=model.snr_db,
        )


def _checked(inputs: Array, currents: Array, valid: Mask | None) -> Mask:
    """Mask of the samples to use, once shapes and values are known to fit."""
    mask = valid_or_all(valid, len(inputs))
    if inputs.ndim != 2 or currents.ndim != 2 or not len(inputs) == len(currents) == len(mask):
        raise DriveError(
            f"inputs of shape {inputs.shape}, currents of shape {currents.shape} and a mask of {len(mask)} samples "
            "do not belong together: expected (T, M), (T, K) and T"
        )
    bad = mask & ~(np.isfinite(inputs).all(axis=1) & np.isfinite(currents).all(axis=1))
    if bad.any():
        raise DriveError(
            f"{bad.sum()} of {mask.sum()} valid samples are not finite, the first is sample {bad.argmax()}; "
            "mark them as not valid"
        )
    needed = ROWS_PER_COLUMN * 2 * BLOCK_ROWS * (inputs.shape[1] + currents.shape[1])
    if mask.sum() < needed:
        raise DriveError(
            f"{mask.sum()} valid samples are too few to identify {currents.shape[1]} currents from "
            f"{inputs.shape[1]} inputs; at least {needed} are needed: record a longer drive"
        )
    return mask


def _standardise(inputs: Array, currents: Array, mask: Mask) -> _Standardised:
    u_mean, u_scale = _mean_and_scale(inputs[mask])
    y_mean, y_scale = _mean_and_scale(currents[mask])
    y = np.where(mask[:, None], (currents - y_mean) / y_scale, 0.0)
    return _Standardised(
        u=(_bridged(inputs, mask) - u_mean) / u_scale,
        y=y,
        mask=mask,
        input_mean=u_mean,
        input_scale=u_scale,
        current_mean=y_mean,
        current_scale=y_scale,
    )


def _mean_and_scale(x: Array) -> tuple[Array, Array]:
    """Mean and standard deviation of each channel; the deviation of a constant channel is taken as 1."""
    mean, scale = x.mean(axis=0), x.std(axis=0)
    constant = scale <= RIDGE * np.maximum(np.abs(mean), 1.0)
    return mean, np.where(constant, 1.0, scale)


def _bridged(inputs: Array, mask: Mask) -> Array:
    """Inputs with linear bridges over samples that are not valid."""
    if mask.all():
        return inputs
    time, good = np.arange(len(mask)), np.flatnonzero(mask)
    return np.stack([np.interp(time, good, channel[good]) for channel in inputs.T], axis=1)


def standardised_moments(inputs: Array, currents: Array, valid: Mask) -> LaggedMoments:
    """Second moments of the lagged data of one drive, every channel of mean 0 and deviation 1.

    Parameters
    ----------
    inputs, currents, valid
        As in :func:`identify`.

    Returns
    -------
    LaggedMoments
        Of 2 * :data:`BLOCK_ROWS` lags of (inputs, currents).
    """
    return _lagged(_standardise(inputs, currents, valid))


def observability(moments: LaggedMoments, *, inputs: int) -> Array:
    """Extended observability matrix from standardised data of one system, PO-MOESP.

    Parameters
    ----------
    moments : LaggedMoments
        Of 2 * :data:`BLOCK_ROWS` lags of (inputs, currents); of several vehicles, they add up.
    inputs : int
        Number of inputs M.

    Returns
    -------
    ndarray of shape (BLOCK_ROWS * K, BLOCK_ROWS * K)
        Weighted left singular vectors of future currents on the past: the first n columns are a system of order n.

    Raises
    ------
    DriveError
        If there are too few rows of lagged data.
    """
    size, s = len(moments.gram), BLOCK_ROWS
    if moments.rows < ROWS_PER_COLUMN * size:
        raise DriveError(
            f"only {moments.rows} stretches of {2 * s} valid samples in a row, at least {ROWS_PER_COLUMN * size} are "
            "needed: the drive is too short or has too many gaps"
        )
    index = np.arange(size).reshape(2 * s, -1)
    future_u, future_y = index[s:, :inputs].ravel(), index[s:, inputs:].ravel()
    past = index[:s].ravel()
    rows = np.concatenate([future_u, past, future_y])
    gram = moments.gram[np.ix_(rows, rows)] / moments.rows
    L = _cholesky(gram)
    block = L[-len(future_y) :, len(future_u) : len(future_u) + len(past)]
    left, singular, _ = np.linalg.svd(block)
    return np.asarray(left[:, : len(singular)] * np.sqrt(singular))


def _cholesky(gram: Array) -> Array:
    """Lower triangle; where rounding leaves moments indefinite (inputs that hardly move), with a larger ridge."""
    for ridge in (RIDGE, 10.0 * RIDGE, 100.0 * RIDGE):
        with suppress(np.linalg.LinAlgError):
            return np.linalg.cholesky(gram + ridge * np.eye(len(gram)))
    return np.linalg.cholesky(gram + LARGEST_RIDGE * np.eye(len(gram)))


def subspace_modes(observed: Array, branches: int, order: int) -> Modes:
    """Stable modes of the system of some order in an extended observability matrix, by shift invariance.

    Parameters
    ----------
    observed : ndarray of shape (BLOCK_ROWS * K, at least order)
        From :func:`observability`.
    branches : int
        Number of currents K.
    order : int
        Order n.

    Returns
    -------
    Modes
        Poles inside the unit circle.
    """
    blocks = observed[:, :order]
    A = np.linalg.lstsq(blocks[:-branches], blocks[branches:], rcond=None)[0] if order else np.zeros((0, 0))
    return stable_modes(A, blocks[:branches])


def _lagged(data: _Standardised) -> LaggedMoments:
    return lagged_moments(np.hstack([data.u, data.y]), 2 * BLOCK_ROWS, data.mask)


def _observability(data: _Standardised, order: int) -> Array:
    """First columns of the extended observability matrix, (BLOCK_ROWS * K, order)."""
    return observability(_lagged(data), inputs=data.u.shape[1])[:, :order]


def _model_from_subspace(data: _Standardised, observed: Array, order: int) -> StateSpaceModel:
    """Model of standardised data for the first columns of the observability matrix."""
    return fit_read_out(subspace_modes(observed, data.y.shape[1], order), data.u, data.y, data.mask, ridge=RIDGE)
