"""State-space model (2) of [1]_ of one vehicle's currents, and its identification from one drive.

    x(t+1) = A x(t) + B u(t)
    y(t)   = C x(t) + D u(t) + offset

Symbols: u inputs (T samples, M inputs), y currents (K branches, positive into the junction), x state (order n). The
identification is PO-MOESP [2]_ on second moments:

1. Inputs and currents are standardised; samples outside the mask take no part.
2. The Gram matrix of lagged data (future inputs; past inputs and currents; future currents) is factored by Cholesky,
   which gives the same triangle as a QR of the data. The block of future currents on the past has the extended
   observability matrix as its column space: A by shift invariance, C as its first rows.
3. A is split into its modes, and unstable poles are reflected into the unit circle.
4. B, D, the initial state and the offset follow by least squares, then C, D and the offset again, both from one set of
   second moments of the inputs filtered by each mode. This minimises the simulation error (output error), so noise
   on the currents leaves no bias in the gain.

.. [1] "Measurement Correction for Electric Vehicles Based on Compressed Sensing".
.. [2] M. Verhaegen, "Identification of the deterministic part of MIMO state space models given in innovations form
   from input-output data", Automatica 30 (1994) 61-74.
"""

from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cdf2rdf
from scipy.signal import lfilter

from calibrator.drive import Array, Complex, Mask
from calibrator.errors import DriveError

__all__ = [
    "StateSpaceModel",
    "bridged",
    "choose_order",
    "identify",
    "pooled_poles",
    "simulation_snr_db",
    "snr_from_power",
]

ORDERS = (0, 1, 2, 3, 4, 6, 8)
"""Orders to choose from: a power train as seen at 10 Hz has few modes. [1]"""
BLOCK_ROWS = 10
"""Past and future samples that the subspace step sees: more than the largest order needs. [1]"""
RIDGE = 1e-12
"""Added to standardised second moments: above rounding, far below any signal. [1]"""
RIDGES = (RIDGE, 1e-11, 1e-10, 1e-9)
"""Tried one after the other where rounding is larger (inputs that hardly move): still far below any signal. [1]"""
ROWS_PER_COLUMN = 2
"""Least ratio of rows to columns of lagged data for the moments to mean anything. [1]"""
TRAIN_SHARE = 0.8
"""Share of the samples that orders are fitted on; they are compared on the rest. [1]"""
ORDER_TOLERANCE_DB = 0.2
"""An order is large enough if its simulation error is this close to the best. [dB]"""
LARGEST_POLE = 0.9999
"""Radius of the slowest pole allowed: 1000 s at 10 Hz, longer than drives can distinguish from an offset. [1]"""
ROUNDS = 2
"""Times that C, D and the offset follow B, D, x0 and the offset; the error no longer changes after. [1]"""
WORST_EIGENVECTORS = 1e8
"""Condition number of the eigenvectors of A from which on modes are not separated any more: 8 digits remain. [1]"""


@dataclass(frozen=True, kw_only=True)
class StateSpaceModel:
    """State-space model with constant offset.

    Attributes
    ----------
    A, B, C, D : ndarray of shapes (n, n), (n, M), (K, n), (K, M)
        System matrices; inputs in their own units, currents in A.
    x0 : ndarray of shape (n,)
        State at the first sample of the drive that the model was identified from.
    offset_a : ndarray of shape (K,)
        Constant part of the currents. [A]
    snr_db : ndarray of shape (K,)
        Simulation signal-to-noise ratio on that drive, see :func:`simulation_snr_db`. [dB]
    """

    A: Array
    B: Array
    C: Array
    D: Array
    x0: Array
    offset_a: Array
    snr_db: Array

    @property
    def order(self) -> int:
        """Number of states n."""
        return len(self.A)

    def steady_state(self, u: Array) -> Array:
        """State of shape (n,) that a constant input u of shape (M,) leads to."""
        return np.asarray(np.linalg.solve(np.eye(self.order) - self.A, self.B @ u))

    def simulate(self, inputs: Array, *, initial_state: Array | None = None) -> Array:
        """Currents for given inputs, (2) in [1]_.

        Parameters
        ----------
        inputs : ndarray of shape (T, M)
            Inputs in the units of the identification.
        initial_state : ndarray of shape (n,) or None
            State at the first sample; None: the steady state of the first input.

        Returns
        -------
        ndarray of shape (T, K)
            Simulated currents, positive into the junction. [A]

        Raises
        ------
        DriveError
            If the inputs are of another number, or not finite.
        """
        if inputs.ndim != 2 or inputs.shape[1] != self.D.shape[1]:
            raise DriveError(f"the model has {self.D.shape[1]} inputs, the drive to simulate has shape {inputs.shape}")
        bad = ~np.isfinite(inputs).all(axis=1)
        if bad.any():
            raise DriveError(
                f"inputs to simulate: {bad.sum()} of {len(inputs)} samples are not finite, the first is sample "
                f"{bad.argmax()}; bridge or cut them"
            )
        if not len(inputs):
            return np.empty((0, len(self.C)))
        x0 = self.steady_state(inputs[0]) if initial_state is None else initial_state
        x = np.vstack([x0, inputs[:-1] @ self.B.T])
        poles, vectors = np.linalg.eig(self.A)
        if self.order and np.linalg.cond(vectors) <= WORST_EIGENVECTORS:
            modes = x @ np.linalg.inv(vectors).T
            modes = np.stack([lfilter([1.0], [1.0, -pole], modes[:, k]) for k, pole in enumerate(poles)], axis=1)
            x = (modes @ vectors.T).real
        else:
            for t in range(1, len(x)):
                x[t] += self.A @ x[t - 1]
        return np.asarray(x @ self.C.T + inputs @ self.D.T + self.offset_a)


def simulation_snr_db(measured: Array, simulated: Array) -> Array:
    """Power of the measured signal about its mean over the power of the simulation error.

    Parameters
    ----------
    measured, simulated : ndarray of shape (T, K)
        Currents. [A]

    Returns
    -------
    ndarray of shape (K,)
        Signal-to-noise ratio; infinite where the simulation is exact, NaN for a constant channel. [dB]
    """
    return snr_from_power(measured.var(axis=0), np.mean((measured - simulated) ** 2, axis=0))


def snr_from_power(signal: Array, error: Array) -> Array:
    """Ratio of two powers in dB; NaN where there is no signal."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.where(signal > 0.0, 10.0 * np.log10(signal / error), np.nan))


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
    data = _Standardised.of(inputs, currents, mask)
    observed = _observability([data]) if order else np.zeros((currents.shape[1], 0))
    return data.fit(observed, order)


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
    data = _Standardised.of(inputs[:stop], currents[:stop], mask[:stop])
    observed = _observability([data])
    everything = bridged(inputs, mask)
    scale = np.where(currents[mask].std(axis=0) > 0.0, currents[mask].std(axis=0), 1.0)
    errors_db = []
    for order in ORDERS:
        model = data.fit(observed, order)
        simulated = model.simulate(everything, initial_state=model.x0)[rest]
        power = np.mean(((currents[rest] - simulated) / scale) ** 2, axis=0)
        errors_db.append(float(np.mean(10.0 * np.log10(power + RIDGE))))
    return next(n for n, error in zip(ORDERS, errors_db, strict=True) if error <= min(errors_db) + ORDER_TOLERANCE_DB)


def pooled_poles(
    drives: Iterable[tuple[Array, Array, Mask]], orders: Sequence[int] = ORDERS, *, branches: int
) -> list[Complex]:
    """Poles of one system of each order, identified from the drives of several vehicles together.

    Parameters
    ----------
    drives : iterable of (inputs, currents, valid)
        At least one, as in :func:`identify`.
    orders : sequence of int
        Orders n.
    branches : int
        Number of currents K.

    Returns
    -------
    list of ndarray of complex
        Of each order: real poles, and of each complex pair the one with positive imaginary part.

    Raises
    ------
    DriveError
        If there are too few valid samples in a row.
    """
    observed = _observability([_Standardised.of(*drive) for drive in drives])
    return [_stable_modes(observed, branches, order)[0] for order in orders]


def _checked(inputs: Array, currents: Array, valid: Mask | None) -> Mask:
    """Mask of the samples to use, once shapes and values are known to fit."""
    mask = np.ones(len(inputs), bool) if valid is None else valid
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


def bridged(inputs: Array, valid: Mask) -> Array:
    """Inputs (T, M) with linear interpolation over samples that are not valid."""
    if valid.all():
        return inputs
    time, known = np.arange(len(valid)), np.flatnonzero(valid)
    return np.column_stack([np.interp(time, known, channel[known]) for channel in inputs.T])


@dataclass(frozen=True, kw_only=True)
class _Standardised:
    """Inputs u (T, M) and currents y (T, K) of mean 0 and deviation 1, with their means and deviations."""

    u: Array
    y: Array
    mask: Mask
    input_mean: Array
    input_scale: Array
    current_mean: Array
    current_scale: Array

    @classmethod
    def of(cls, inputs: Array, currents: Array, mask: Mask) -> "_Standardised":
        """Standardise; a constant channel keeps its unit."""
        u_mean, y_mean = (x[mask].mean(axis=0) for x in (inputs, currents))
        u_scale, y_scale = (x[mask].std(axis=0) for x in (inputs, currents))
        u_scale[u_scale <= RIDGE * np.maximum(np.abs(u_mean), 1.0)] = 1.0
        y_scale[y_scale <= RIDGE * np.maximum(np.abs(y_mean), 1.0)] = 1.0
        return cls(
            u=(bridged(inputs, mask) - u_mean) / u_scale,
            y=np.where(mask[:, None], (currents - y_mean) / y_scale, 0.0),
            mask=mask,
            input_mean=u_mean,
            input_scale=u_scale,
            current_mean=y_mean,
            current_scale=y_scale,
        )

    def fit(self, observed: Array, order: int) -> StateSpaceModel:
        """Fit a model of some order, for inputs and currents in their units, to an observability matrix."""
        poles, A, C = _stable_modes(observed, self.y.shape[1], order)
        B, C, D, x0, offset, snr_db = _fit_output_error(poles, C, self)
        B, C, D = (
            B / self.input_scale,
            self.current_scale[:, None] * C,
            self.current_scale[:, None] * D / self.input_scale,
        )
        # A constant shift of the inputs moves the state by the steady state that belongs to it.
        shift = np.linalg.solve(np.eye(order) - A, B @ self.input_mean)
        offset_a = self.current_mean + self.current_scale * offset - C @ shift - D @ self.input_mean
        return StateSpaceModel(A=A, B=B, C=C, D=D, x0=x0 + shift, offset_a=offset_a, snr_db=snr_db)


def _observability(drives: Sequence[_Standardised]) -> Array:
    """Extended observability matrix of one system, PO-MOESP.

    Weighted left singular vectors of future currents on the past, shape (BLOCK_ROWS * K, BLOCK_ROWS * K): the first n
    columns are a system of order n.
    """
    s, M = BLOCK_ROWS, drives[0].u.shape[1]
    moments = [_lagged_moments(np.hstack([data.u, data.y]), 2 * s, data.mask) for data in drives]
    gram, rows = np.sum([gram for gram, _ in moments], axis=0), sum(rows for _, rows in moments)
    if rows < ROWS_PER_COLUMN * len(gram):
        raise DriveError(
            f"only {rows} stretches of {2 * s} valid samples in a row, at least {ROWS_PER_COLUMN * len(gram)} are "
            "needed: the drive is too short or has too many gaps"
        )
    index = np.arange(len(gram)).reshape(2 * s, -1)
    future_u, past, future_y = index[s:, :M].ravel(), index[:s].ravel(), index[s:, M:].ravel()
    order = np.concatenate([future_u, past, future_y])
    L = _cholesky(gram[np.ix_(order, order)] / rows)
    left, singular, _ = np.linalg.svd(L[-len(future_y) :, len(future_u) : len(future_u) + len(past)])
    return np.asarray(left[:, : len(singular)] * np.sqrt(singular))


def _cholesky(gram: Array) -> Array:
    """Lower triangle with the smallest ridge that makes the moments positive definite."""
    for ridge in RIDGES[:-1]:
        with suppress(np.linalg.LinAlgError):
            return np.linalg.cholesky(gram + ridge * np.eye(len(gram)))
    return np.linalg.cholesky(gram + RIDGES[-1] * np.eye(len(gram)))


def _lagged_moments(z: Array, lags: int, valid: Mask) -> tuple[Array, int]:
    """Centred second moments (L p, L p) of all rows (z(t), .., z(t+L-1)) that are valid, and the number of rows.

    The Gram matrix is block-Toeplitz but for the ends of the recording: block (i+1, j+1) is block (i, j) plus one outer
    product at the end minus one at the start. So L products of the data are formed instead of L^2, and a recording with
    gaps is the sum over its pieces.
    """
    p, rows = z.shape[1], 0
    gram, total = np.zeros((lags, p, lags, p)), np.zeros((lags, p))
    edges = np.flatnonzero(np.diff(np.concatenate([[False], valid, [False]])))
    for start, stop in edges.reshape(-1, 2).tolist():
        n = stop - start - lags + 1
        if n < 1:
            continue
        rows += n
        piece = z[start:stop]
        first, last = piece[: lags - 1], piece[n:]
        total += np.cumsum(np.vstack([piece[:n].sum(axis=0), last - first]), axis=0)
        for lag in range(lags):
            i = np.arange(lags - lag)
            steps = (
                last[i[:-1], :, None] * last[i[:-1] + lag, None] - first[i[:-1], :, None] * first[i[:-1] + lag, None]
            )
            blocks = np.cumsum(np.concatenate([(piece[:n].T @ piece[lag : lag + n])[None], steps]), axis=0)
            gram[i, :, i + lag] += blocks
            if lag:
                gram[i + lag, :, i] += blocks.transpose(0, 2, 1)
    mean = total.ravel() / max(rows, 1)
    return gram.reshape(lags * p, lags * p) - rows * np.outer(mean, mean), rows


def _stable_modes(observed: Array, branches: int, order: int) -> tuple[Complex, Array, Array]:
    """Modes of the system of some order in an extended observability matrix, by shift invariance.

    Returns the poles (of a pair the one with positive imaginary part), none beyond :data:`LARGEST_POLE`; A in real
    modal form, with a pole on the diagonal or [[re, im], [-im, re]] for a pair; and C.
    """
    blocks = observed[:, :order]
    A = np.linalg.lstsq(blocks[:-branches], blocks[branches:], rcond=None)[0] if order else np.zeros((0, 0))
    poles, vectors = np.linalg.eig(A)
    poles = poles / np.maximum(np.abs(poles), 1.0) ** 2  # unstable ones are reflected at the unit circle
    poles = poles * np.minimum(1.0, LARGEST_POLE / np.maximum(np.abs(poles), LARGEST_POLE))
    A, vectors = cdf2rdf(poles, vectors)
    return poles[poles.imag >= 0.0].astype(complex), A, blocks[:branches] @ vectors


def _fit_output_error(poles: Complex, C: Array, data: _Standardised) -> tuple[Array, Array, Array, Array, Array, Array]:
    """B, C, D, x0, offset and SNR of the simulation that is nearest to the data, from a first C.

    All that the model can show is linear in few signals, the features: the inputs and an impulse at the start, filtered
    by each mode; the inputs; 1. Every least-squares problem needs only their second moments.
    """
    u, y, (n, width) = data.u, data.y[data.mask], (C.shape[1], data.u.shape[1] + 1)
    driven = np.zeros((len(u), width))  # what enters the states: inputs one sample later, and x0 as an impulse
    driven[1:, :-1], driven[0, -1] = u[:-1], 1.0
    features = np.hstack([np.zeros((len(u), n * width)), u, np.ones((len(u), 1))])
    # State i is the features times state_map[:, i] times w, the rows of (B, x0) one after the other.
    state_map, row = np.zeros((features.shape[1], n, n * width)), 0
    for pole in poles:
        size = 1 if pole.imag == 0.0 else 2
        response = lfilter([1.0], [1.0, -(pole.real if size == 1 else pole)], driven, axis=0)
        place = slice(row * width, (row + size) * width)
        features[:, place] = response if size == 1 else np.hstack([response.real, response.imag])
        turns = np.array([[[1.0, 0.0], [0.0, 1.0]], [[0.0, 1.0], [-1.0, 0.0]]])[:size, :size, :size]
        mapped = np.einsum("fsr,jl->fjsrl", turns, np.eye(width))
        state_map[place, row : row + size, place] = mapped.reshape(size * width, size, size * width)
        row += size
    features = features[data.mask]
    G, H = features.T @ features / len(y), features.T @ y / len(y)
    direct = slice(n * width, None)  # features of D and the offset
    onto = _solve(G[direct, direct], G[direct])
    G_free, H_free = G - G[:, direct] @ onto, H - onto.T @ H[direct]  # D and the offset of each current projected out
    for _ in range(ROUNDS):
        regressors = np.einsum("pnq,kn->kpq", state_map, C)
        normal, right = np.zeros((n * width, n * width)), np.zeros(n * width)
        for R, h in zip(regressors, H_free.T, strict=True):
            normal += R.T @ G_free @ R
            right += R.T @ h
        w = _solve(normal, right)
        read = np.hstack([state_map @ w, np.eye(len(G))[:, direct]])
        found = _solve(read.T @ G @ read, read.T @ H)
        C = found[:n].T
    shown = read @ found
    error = np.mean(y**2, axis=0) - 2.0 * np.sum(H * shown, axis=0) + np.sum(shown * (G @ shown), axis=0)
    snr_db = snr_from_power(y.var(axis=0), np.maximum(error, 0.0))
    B_x0 = w.reshape(n, width)
    return B_x0[:, :-1], C, found[n:-1].T, B_x0[:, -1], found[-1], snr_db


def _solve(normal: Array, right: Array) -> Array:
    """Solve scaled normal equations with a relative ridge; columns that are zero get zero."""
    scale = np.sqrt(np.diag(normal))
    scale = np.where(scale > 0.0, scale, 1.0)
    solved = np.linalg.solve(normal / np.outer(scale, scale) + RIDGE * np.eye(len(scale)), (right.T / scale).T)
    return np.asarray((solved.T / scale).T)
