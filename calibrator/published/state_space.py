"""State-space model (2) of [1]_ of one vehicle's currents, and its identification from one drive.

    x(t+1) = A x(t) + B u(t)
    y(t)   = C x(t) + D u(t) + offset

Symbols: u inputs (T samples, M inputs), y currents (K branches, positive into the junction), x state (order n). Poles
are found by PO-MOESP [2]_ on second moments of lagged, standardised data, and unstable ones are reflected into the unit
circle. B, D, the initial state and the offset follow by least squares, then C, D and the offset again: this minimises
the simulation error (output error), so noise on the currents leaves no bias in the gain.

.. [1] "Measurement Correction for Electric Vehicles Based on Compressed Sensing".
.. [2] M. Verhaegen, "Identification of the deterministic part of MIMO state space models given in innovations form
   from input-output data", Automatica 30 (1994) 61-74.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import compress
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.signal import lfilter

from calibrator.drive import Array, Complex, Mask, Samples
from calibrator.errors import DriveError
from calibrator.published.evidence import FleetEvidence, collect_evidence, fleet_mean
from calibrator.terminal.text import counted

__all__ = [
    "StateSpaceModel", "VehicleModel", "bridged", "choose_order", "evidence_of_models", "identify_model",
    "identify_vehicle", "pooled_poles", "simulation_snr_db", "snr_from_power", "solve_scaled",
]  # fmt: skip

TRAIN_SHARE = 0.8
"""Share of each drive that a model is identified on, section IV-C of [1]_. [1]"""
LEAD_IN_S = 60.0
"""Length of the inputs before the held-out part, during which the states of the models settle. [s]"""
LEAST_DURATION_S = 60.0
"""Least valid data that a vehicle needs: it has a few changes of speed and load by then. [s]"""
QUIET = 0.03
"""Ratio of standard deviation to mean below which an input counts as constant, like constant power at a voltage that
varies. [1]"""
GAP_S = 60.0
"""Invalid time put between two drives of a vehicle, so that no state carries over. [s]"""
ORDERS = (0, 1, 2, 3, 4, 6, 8)
"""Orders to choose from: a power train as seen at 10 Hz has few modes. [1]"""
BLOCK_ROWS = 10
"""Number of past and of future samples that the subspace step uses: more than the largest order needs. [1]"""
CHUNK_ROWS = 4096
"""Rows of lagged data that are in memory at a time."""
RIDGE = 1e-12
"""Added to the diagonal of standardised second moments: above rounding errors, far below any signal. [1]"""
ROWS_PER_COLUMN = 2
"""Least ratio of rows to columns of lagged data for the moments to mean anything. [1]"""
FITTED_SHARE = 0.8
"""Share of the samples that orders are fitted on; they are compared on the rest. [1]"""
ORDER_TOLERANCE_DB = 0.2
"""An order is large enough if its simulation error is this close to the best. [dB]"""
LARGEST_POLE = 0.9999
"""Radius of the slowest pole allowed: 1000 s at 10 Hz, longer than drives can distinguish from an offset. [1]"""
ROUNDS = 2
"""Rounds that fit first B, D, x0 and the offset, then C, D and the offset; further rounds change no error. [1]"""


@dataclass(frozen=True, kw_only=True)
class StateSpaceModel:
    """State-space model with constant offset.

    Attributes
    ----------
    A, B, C, D : ndarray of shapes (n, n), (n, M), (K, n), (K, M)
        System matrices; inputs in their own units, currents in A. A has n independent eigenvectors.
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

    def simulate(self, inputs: Array, *, initial_state: Array | None = None) -> Array:
        """Simulate the currents for given inputs, equation (2) of the paper.

        Parameters
        ----------
        inputs : ndarray of shape (T, M)
            Finite inputs in the units of the identification.
        initial_state : ndarray of shape (n,) or None
            State at the first sample; None: the steady state of the first input.

        Returns
        -------
        ndarray of shape (T, K)
            Simulated currents, positive into the junction. [A]
        """
        steady = np.linalg.solve(np.eye(len(self.A)) - self.A, self.B @ inputs[0])
        driven = np.vstack([steady if initial_state is None else initial_state, inputs[:-1] @ self.B.T])
        poles, vectors = np.linalg.eig(self.A)
        modes = driven @ np.linalg.inv(vectors).T
        for k, pole in enumerate(poles):
            modes[:, k] = lfilter([1.0], [1.0, -pole], modes[:, k])
        return np.asarray((modes @ vectors.T).real @ self.C.T + inputs @ self.D.T + self.offset_a)


def simulation_snr_db(measured: Array, simulated: Array) -> Array:
    """Return the variance of the measured currents (T, K) over the power of the simulation error, per channel. [dB]

    It is infinite where the simulation is exact, and NaN for a constant channel.
    """
    return snr_from_power(measured.var(axis=0), np.mean((measured - simulated) ** 2, axis=0))


def snr_from_power(signal: Array, error: Array) -> Array:
    """Return the ratio of signal power to error power in dB; NaN where there is no signal."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.where(signal > 0.0, 10.0 * np.log10(signal / error), np.nan))


def identify_model(
    inputs: Array, currents: Array, *, order: int | None = None, valid: Mask | None = None
) -> StateSpaceModel:
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
        Model with poles inside the unit circle, and with its simulation SNR on this drive.

    Raises
    ------
    DriveError
        If there are too few valid samples in a row.
    """
    mask = np.ones(len(inputs), bool) if valid is None else valid
    n = choose_order(inputs, currents, valid=mask) if order is None else order
    return next(_models(inputs, currents, mask, [n]))


def choose_order(inputs: Array, currents: Array, *, valid: Mask | None = None) -> int:
    """Choose the smallest order that simulates held-out samples nearly as well as the best order does.

    Models of all :data:`ORDERS` are fitted on the first 80 % of the samples and simulated on the rest. The error of an
    order is its error power in dB, averaged over the channels; the smallest order within 0.2 dB of the least error is
    returned. Arguments are as in :func:`identify_model`.
    """
    mask = np.ones(len(inputs), bool) if valid is None else valid
    stop = int(FITTED_SHARE * len(inputs))
    u, scale = bridged(inputs, mask), _standardised(currents, mask)[2]
    errors_db = []
    for model in _models(inputs[:stop], currents[:stop], mask[:stop], ORDERS):
        error = (currents - model.simulate(u, initial_state=model.x0))[stop:][mask[stop:]] / scale
        power = np.mean(error**2, axis=0)
        errors_db.append(float(np.mean(10.0 * np.log10(power + RIDGE))))
    return next(n for n, error in zip(ORDERS, errors_db, strict=True) if error <= min(errors_db) + ORDER_TOLERANCE_DB)


def pooled_poles(drives: Sequence[tuple[Array, Array, Mask]], orders: Sequence[int]) -> list[Complex]:
    """Identify the poles of one system of each order from the drives of several vehicles together.

    Parameters
    ----------
    drives : sequence of (inputs, currents, valid)
        At least one, as in :func:`identify_model`.
    orders : sequence of int
        Orders n.

    Returns
    -------
    list of ndarray of complex
        For each order the real poles, and of each complex pair the one with positive imaginary part.

    Raises
    ------
    DriveError
        If there are too few valid samples in a row.
    """
    observed = _observability([(_standardised(u, mask)[0], _standardised(y, mask)[0], mask) for u, y, mask in drives])
    found = (_stable_modes(observed, drives[0][1].shape[1], order)[0] for order in orders)
    return [poles[poles.imag >= 0.0] for poles in found]


def bridged(values: Array, valid: Mask) -> Array:
    """Return values (T, M) in which those that are not valid (T,) are linear interpolations of their neighbours."""
    time, known = np.arange(len(valid)), np.flatnonzero(valid)
    return np.column_stack([np.interp(time, known, channel[known]) for channel in values.T])


def _standardised(values: Array, mask: Mask) -> tuple[Array, Array, Array]:
    """Return values (T, M) scaled to mean 0 and standard deviation 1, gaps bridged; and means and scales, each (M,)."""
    mean, scale = values[mask].mean(axis=0), values[mask].std(axis=0)
    scale[scale <= RIDGE * np.maximum(np.abs(mean), 1.0)] = 1.0
    return (bridged(values, mask) - mean) / scale, mean, scale


def _models(inputs: Array, currents: Array, mask: Mask, orders: Sequence[int]) -> Iterator[StateSpaceModel]:
    """Yield a fitted model of each order."""
    (u, u_mean, u_scale), (y, y_mean, y_scale) = _standardised(inputs, mask), _standardised(currents, mask)
    observed = _observability([(u, y, mask)]) if any(orders) else np.zeros((y.shape[1], 0))
    for order in orders:
        A, B, C, D, x0, offset, snr_db = _fit_output_error(*_stable_modes(observed, y.shape[1], order), u, y, mask)
        B, C, D = B / u_scale, y_scale[:, None] * C, y_scale[:, None] * D / u_scale
        # A constant shift of the inputs moves the state by the steady state that belongs to it.
        shift = np.linalg.solve(np.eye(order) - A, B @ u_mean)
        offset_a = y_mean + y_scale * offset - C @ shift - D @ u_mean
        yield StateSpaceModel(A=A, B=B, C=C, D=D, x0=x0 + shift, offset_a=offset_a, snr_db=snr_db)


def _observability(drives: Sequence[tuple[Array, Array, Mask]]) -> Array:
    """Find the extended observability matrix (BLOCK_ROWS * K, BLOCK_ROWS * K) by PO-MOESP, from drives (u, y, valid).

    Its columns are weighted left singular vectors of the future currents regressed on the past; the first n columns
    stand for a system of order n. The Cholesky factor of the moments is the triangle of a QR of the lagged data.
    """
    s, M, channels = BLOCK_ROWS, drives[0][0].shape[1], drives[0][0].shape[1] + drives[0][1].shape[1]
    columns, count = 2 * s * channels, 0
    moments = np.zeros((columns, columns))
    for u, y, mask in drives:
        # By padding, even a drive that is too short has windows; none of them is valid.
        windows = sliding_window_view(np.pad(np.hstack([u, y]), ((0, 2 * s), (0, 0))), 2 * s, axis=0)
        whole = np.flatnonzero(sliding_window_view(np.pad(mask, (0, 2 * s)), 2 * s).all(axis=1))
        count, total = count + len(whole), np.zeros(columns)
        for chunk in np.array_split(whole, len(whole) // CHUNK_ROWS + 1):
            rows = windows[chunk].reshape(len(chunk), columns)
            moments, total = moments + rows.T @ rows, total + rows.sum(axis=0)
        moments -= np.outer(total, total) / max(len(whole), 1)
    if count < ROWS_PER_COLUMN * columns:
        raise DriveError(
            f"only {count} stretches of {2 * s} valid samples in a row, at least {ROWS_PER_COLUMN * columns} are "
            "needed: the drive is too short or has too many gaps"
        )
    index = np.arange(columns).reshape(channels, 2 * s)
    order = np.concatenate([index[:M, s:].ravel(), index[:, :s].ravel(), index[M:, s:].T.ravel()])  # future u, past, y
    moments = moments[np.ix_(order, order)] / count
    ridge = max(RIDGE, -2.0 * np.linalg.eigvalsh(moments)[0])  # more if rounding errors are larger: still inputs
    L = np.linalg.cholesky(moments + ridge * np.eye(columns))
    left, singular, _ = np.linalg.svd(L[-s * (channels - M) :, s * M : s * (M + channels)])
    return np.asarray(left * np.sqrt(singular))


def _stable_modes(observed: Array, branches: int, order: int) -> tuple[Complex, Complex]:
    """Find poles (n,) inside the unit circle and complex C (K, n), by shift invariance of the observability matrix."""
    blocks = observed[:, :order]
    A = np.linalg.lstsq(blocks[:-branches], blocks[branches:], rcond=None)[0] if order else np.zeros((0, 0))
    poles, vectors = (part.astype(complex) for part in np.linalg.eig(A))
    poles /= np.maximum(np.abs(poles), 1.0) ** 2  # unstable ones are reflected at the unit circle
    poles *= np.minimum(1.0, LARGEST_POLE / np.maximum(np.abs(poles), LARGEST_POLE))
    return poles, blocks[:branches] @ vectors


def _fit_output_error(poles: Complex, C: Complex, u: Array, y: Array, mask: Mask) -> tuple[Array, ...]:
    """Fit A, B, C, D, x0 and the offset to simulate the data best, starting from poles and C; return them and the SNR.

    The simulated currents are linear in a few signals, the features: the inputs and an impulse at the start, filtered
    by each mode; the inputs themselves; 1. Every least-squares problem needs only their second moments.
    """
    y, n, width = y[mask], len(poles), u.shape[1] + 1
    pair = np.flatnonzero(poles.imag > 0.0)  # the conjugate of each follows it
    modes = np.eye(n, dtype=complex)  # over real states: of a pair, the real and the negative imaginary part
    modes[pair + 1, pair + 1], modes[pair, pair + 1], modes[pair + 1, pair] = 1j, -1j, 1.0
    driven = np.vstack([np.eye(width)[-1], np.pad(u[:-1], ((0, 0), (0, 1)))])  # impulse for x0; inputs for later states
    filtered = [lfilter([1.0], [1.0, -pole], driven, axis=0) for pole in poles]
    states = [x.imag if pole.imag < 0.0 else x.real for pole, x in zip(poles, filtered, strict=True)]
    features = np.hstack([*states, u, np.ones((len(u), 1))])[mask]
    of_modes = block_diag(np.kron(modes, np.eye(width)), np.eye(width))
    G = of_modes.conj() @ (features.T @ features / len(y)) @ of_modes.T
    H = of_modes.conj() @ (features.T @ y / len(y))
    direct, modal = slice(n * width, None), slice(n * width)
    onto = solve_scaled(G[direct, direct], G[direct])  # features of D and the offset, projected out of the others
    G_free, H_free = (G - G[:, direct] @ onto)[modal, modal], (H - onto.conj().T @ H[direct])[modal]
    for _ in range(ROUNDS):
        read = C.repeat(width, axis=1)  # current k shows C[k, i] (B, x0)[i, j] times input j filtered by mode i
        right = np.sum(read.conj().T * H_free, axis=1, keepdims=True)
        B_x0 = solve_scaled((read.conj().T @ read) * G_free, right).reshape(n, width)
        shown = block_diag(*B_x0[:, :, None], np.eye(width))
        found = solve_scaled(shown.conj().T @ G @ shown, shown.conj().T @ H)
        C = found[:n].T
    snr_db = simulation_snr_db(y, features @ (of_modes.T @ shown @ found).real)
    A, entering = (np.linalg.solve(modes, of).real for of in (poles[:, None] * modes, B_x0))
    return A, entering[:, :-1], (C @ modes).real, found[n:-1].real.T, entering[:, -1], found[-1].real, snr_db


def solve_scaled(normal: NDArray[Any], right: NDArray[Any]) -> NDArray[Any]:
    """Solve normal equations (..., Q, Q) with right sides (..., Q, R) and a tiny ridge; columns of 0 get solution 0."""
    scale = np.sqrt(np.einsum("...ii->...i", normal).real)[..., None]
    scale = np.where(scale > 0.0, scale, 1.0)
    scaled = normal / (scale * np.swapaxes(scale, -1, -2)) + RIDGE * np.eye(normal.shape[-1])
    return np.asarray(np.linalg.solve(scaled, right / scale) / scale)


@dataclass(frozen=True, kw_only=True)
class VehicleModel:
    """One vehicle with a model of its own.

    Attributes
    ----------
    vehicle : str
        Name.
    drives : tuple of str
        Names of the drives used.
    duration_s : float
        Valid data of all drives. [s]
    model : StateSpaceModel
        Model from inputs to measured currents, equation (2) of the paper.
    snr_db : ndarray of shape (K,)
        Simulation signal-to-noise ratio on held-out data. [dB]
    simulation_error_a : ndarray of shape (K,)
        Root mean square of the simulation error on held-out data. [A]
    mean_a : ndarray of shape (K,)
        Mean measured currents on all valid samples. [A]
    moment_a2 : ndarray of shape (K, K)
        Mean of the products of measured currents on all valid samples. [A^2]
    held_out_inputs : ndarray of shape (L + T, M)
        Inputs of the last 20 % of the longest drive with a lead-in of L samples before them, gaps bridged.
    lead_in : int
        L.
    """

    vehicle: str
    drives: tuple[str, ...]
    duration_s: float
    model: StateSpaceModel
    snr_db: Array
    simulation_error_a: Array
    mean_a: Array
    moment_a2: Array
    held_out_inputs: Array
    lead_in: int


def identify_vehicle(
    drives: Sequence[Samples], *, period_s: float, vehicle: str, names: tuple[str, ...]
) -> VehicleModel:
    """Identify the model of one vehicle from its aligned drives.

    Parameters
    ----------
    drives : sequence of Samples
        Drives of one vehicle, with the same branches and inputs.
    period_s : float
        Distance of the samples. [s]
    vehicle : str
        Name of the vehicle.
    names : tuple of str
        Names of the drives.

    Returns
    -------
    VehicleModel
        Its model, learnt on the first 80 % of each drive, with its errors on the rest.

    Raises
    ------
    DriveError
        If there is too little valid data; the message says how much.
    """
    duration_s = period_s * sum(int(drive.valid.sum()) for drive in drives)
    if duration_s < LEAST_DURATION_S:
        raise DriveError(
            f"{duration_s:.1f} s of usable data in {counted(len(drives), 'drive')}; at least {LEAST_DURATION_S:.0f} s "
            f"are needed"
        )
    # The drives one after the other, each followed by a gap that is not valid.
    gap = int(GAP_S / period_s)

    def joined(parts: Iterable[Any]) -> Any:
        return np.concatenate([np.pad(part, [(0, gap), *[(0, 0)] * (part.ndim - 1)]) for part in parts])

    inputs, currents = joined(drive.inputs for drive in drives), joined(drive.currents_a for drive in drives)
    valid = joined(drive.valid for drive in drives)
    training = valid & joined(_in_training(drive.valid) for drive in drives)
    held_out, stop = valid & ~training, int(np.flatnonzero(training)[-1]) + 1
    model = _identify_excited(inputs[:stop], currents[:stop], training[:stop])
    simulated = model.simulate(bridged(inputs, valid), initial_state=model.x0)
    longest = max(drives, key=lambda drive: int(drive.valid.sum()))
    first_held_out = int(np.argmin(_in_training(longest.valid)))
    start = max(0, first_held_out - int(LEAD_IN_S / period_s))
    return VehicleModel(
        vehicle=vehicle,
        drives=names,
        duration_s=duration_s,
        model=model,
        snr_db=simulation_snr_db(currents[held_out], simulated[held_out]),
        simulation_error_a=np.sqrt(np.mean((currents - simulated)[held_out] ** 2, axis=0)),
        mean_a=np.mean(currents[valid], axis=0),
        moment_a2=currents[valid].T @ currents[valid] / valid.sum(),
        held_out_inputs=bridged(longest.inputs, longest.valid)[start:],
        lead_in=first_held_out - start,
    )


def _in_training(valid: Mask) -> Mask:
    """Mark the first 80 % of the valid samples of a drive, and the invalid ones between them."""
    return np.asarray(np.cumsum(valid) <= TRAIN_SHARE * valid.sum())


def _identify_excited(inputs: Array, currents: Array, valid: Mask) -> StateSpaceModel:
    """Identify a model from the inputs that vary; others get coefficients of 0, as their effect cannot be learnt."""
    excited = inputs[valid].std(axis=0) > QUIET * np.abs(inputs[valid].mean(axis=0))
    if not excited.any():
        raise DriveError("none of its inputs varies: was it parked? record a drive in which it is used")
    try:
        model = identify_model(inputs[:, excited], currents, valid=valid)
    except np.linalg.LinAlgError as error:
        raise DriveError(
            f"no model can be identified from its drives ({error}); record a longer, varied drive"
        ) from None
    columns = np.eye(len(excited))[excited]
    return replace(model, B=model.B @ columns, D=model.D @ columns)


def evidence_of_models(
    vehicles: Sequence[VehicleModel], in_reference: Sequence[bool]
) -> tuple[FleetEvidence, Array, VehicleModel]:
    """Simulate all vehicles on the unity drive, the longest held-out drive, and compare them with their mean.

    Parameters
    ----------
    vehicles : sequence of N VehicleModel
        Models of the vehicles, with K branches.
    in_reference : sequence of N bool
        Whether a vehicle counts in the fleet reference (the mean, equation (3) of the paper) and its held-out drive may
        be the unity drive.

    Returns
    -------
    evidence : FleetEvidence
        Evidence of all vehicles.
    reference : ndarray of shape (T, K)
        Fleet reference. [A]
    unity : VehicleModel
        The vehicle whose held-out drive is the unity drive.
    """
    unity = max(compress(vehicles, in_reference), key=lambda vehicle: len(vehicle.held_out_inputs) - vehicle.lead_in)
    simulated = [vehicle.model.simulate(unity.held_out_inputs)[unity.lead_in :] for vehicle in vehicles]
    reference = fleet_mean(compress(simulated, in_reference))
    junction_a2 = np.array([float(np.sum(vehicle.moment_a2)) for vehicle in vehicles])
    return collect_evidence(simulated, reference, junction_a2), reference, unity
