"""Least squares for B, C, D, initial state and offset of a state-space model whose poles are known.

In real modal form each real pole is one state and each complex pair is a complex state xi with xi(t+1) = lambda xi(t)
+ beta u(t), kept as (Re xi, Im xi). So all the model can show is linear in few signals, the features

    inputs filtered by each mode,  powers of each pole,  the inputs,  1

and every least-squares problem needs only their second moments, which are formed once.
"""

from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

from calibrator.drive import Array, Complex, Mask
from calibrator.identification.state_space import StateSpaceModel, snr_from_power

__all__ = ["Modes", "fit_read_out", "stable_modes"]

LARGEST_POLE = 0.9999
"""Radius of the slowest pole allowed: 1000 s at 10 Hz, longer than drives tell apart from an offset. [1]"""
ROUNDS = 2
"""Times that C, D and the offset follow B, D, x0 and the offset; the error no longer changes after. [1]"""


@dataclass(frozen=True, kw_only=True)
class Modes:
    """Stable modes of a system.

    Attributes
    ----------
    poles : ndarray of complex, shape (m,)
        Real poles, and of each complex pair the one with positive imaginary part.
    A : ndarray of shape (n, n)
        Real modal form: one row per real pole, two per pair.
    C : ndarray of shape (K, n)
        Currents that belong to each state.
    """

    poles: Complex
    A: Array
    C: Array


def stable_modes(A: Array, C: Array) -> Modes:
    """Take a system apart into modes; unstable poles are reflected at the unit circle.

    Parameters
    ----------
    A, C : ndarray of shapes (n, n), (K, n)
        System.

    Returns
    -------
    Modes
        All poles at a radius of at most :data:`LARGEST_POLE`.
    """
    poles, vectors = np.linalg.eig(A)
    keep = poles.imag >= 0.0
    poles, vectors = poles[keep].astype(np.complex128), vectors[:, keep]
    radius = np.abs(poles)
    poles = np.where(radius > 1.0, poles / np.maximum(radius, 1.0) ** 2, poles)
    poles = poles * np.minimum(1.0, LARGEST_POLE / np.maximum(np.abs(poles), LARGEST_POLE))
    read_out = C @ vectors
    columns: list[Array] = []
    blocks: list[Array] = []
    for pole, c in zip(poles, read_out.T, strict=True):
        if pole.imag == 0.0:
            blocks.append(np.array([[pole.real]]))
            columns.append(c.real)
        else:
            blocks.append(np.array([[pole.real, -pole.imag], [pole.imag, pole.real]]))
            columns += [2.0 * c.real, -2.0 * c.imag]
    return Modes(poles=poles, A=_block_diagonal(blocks), C=np.array(columns).reshape(-1, len(C)).T)


def fit_read_out(modes: Modes, u: Array, y: Array, mask: Mask, *, ridge: float) -> StateSpaceModel:
    """Fit B, C, D, x0 and offset so that the simulation is nearest to the data.

    Parameters
    ----------
    modes : Modes
        Poles, and a first C.
    u, y : ndarray of shapes (T, M), (T, K)
        Standardised inputs and currents.
    mask : ndarray of bool of shape (T,)
        Samples of y to fit.
    ridge : float
        Relative ridge of the normal equations. [1]

    Returns
    -------
    StateSpaceModel
        For standardised data.
    """
    M = u.shape[1]
    features = _features(modes.poles, u)[mask]
    G = features.T @ features / mask.sum()
    H = features.T @ y[mask] / mask.sum()
    state_maps = _state_maps(modes.poles, M)
    C, n = modes.C, len(modes.A)
    direct = np.eye(len(G))[:, -(M + 1) :]
    x_map = np.zeros((len(G), n))
    for _ in range(ROUNDS if n else 0):
        weights = _fit_inputs(G, H, np.einsum("pnq,kn->kpq", state_maps, C), direct, ridge)
        x_map = np.einsum("pnq,q->pn", state_maps, weights)
        C = _solve(*_normal(G, H, np.hstack([x_map, direct])), ridge)[:n].T
    read = np.hstack([x_map, direct])
    coefficients = _solve(*_normal(G, H, read), ridge)
    residual = read @ coefficients
    error = np.mean(y[mask] ** 2, axis=0) - 2.0 * np.sum(H * residual, axis=0)
    error = np.maximum(error + np.einsum("pk,pq,qk->k", residual, G, residual), 0.0)
    B, x0 = _inputs_of(weights, n, M) if n else (np.zeros((0, M)), np.zeros(0))
    return StateSpaceModel(
        A=modes.A,
        B=B,
        C=coefficients[:n].T,
        D=coefficients[n:-1].T,
        x0=x0,
        offset_a=coefficients[-1],
        snr_db=snr_from_power(y[mask].var(axis=0), error),
    )


def _features(poles: Complex, u: Array) -> Array:
    """Signals of shape (T, p): per mode the filtered inputs and the power of the pole (Re, Im), the inputs, 1."""
    delayed = np.vstack([np.zeros((1, u.shape[1])), u[:-1]])
    impulse = np.zeros((len(u), 1))
    impulse[0] = 1.0
    driven = np.hstack([delayed, impulse])
    parts: list[Array] = []
    for pole in poles:
        if pole.imag == 0.0:
            parts.append(lfilter([1.0], [1.0, -pole.real], driven, axis=0))
        else:
            response = lfilter([1.0], [1.0, -pole], driven, axis=0)
            parts += [response.real, response.imag]
    return np.hstack([*parts, u, np.ones((len(u), 1))])


def _state_maps(poles: Complex, M: int) -> Array:
    """Tensor (p, n, q): state i is the features times map[:, i, :] times the q entries of (B, x0) by rows."""
    n = int(sum(1 if pole.imag == 0.0 else 2 for pole in poles))
    width = M + 1
    maps = np.zeros((n * width + M + 1, n, n * width))
    j, row = np.arange(width), 0
    for pole in poles:
        real, imag = row * width + j, (row + 1) * width + j
        maps[real, row, real] = 1.0
        if pole.imag != 0.0:
            maps[imag, row, imag] = -1.0
            maps[imag, row + 1, real] = 1.0
            maps[real, row + 1, imag] = 1.0
        row += 1 if pole.imag == 0.0 else 2
    return maps


def _fit_inputs(G: Array, H: Array, regressors: Array, direct: Array, ridge: float) -> Array:
    """Entries of (B, x0) by rows, with D and offset of each channel projected out."""
    DD = direct.T @ G @ direct
    onto = direct @ _solve(DD, direct.T @ G, ridge)
    G_free = G - G @ onto
    H_free = H - onto.T @ H
    q = regressors.shape[2]
    normal, right = np.zeros((q, q)), np.zeros(q)
    for k, regressor in enumerate(regressors):
        normal += regressor.T @ G_free @ regressor
        right += regressor.T @ H_free[:, k]
    return _solve(normal, right, ridge)


def _normal(G: Array, H: Array, read: Array) -> tuple[Array, Array]:
    return read.T @ G @ read, read.T @ H


def _solve(normal: Array, right: Array, ridge: float) -> Array:
    """Solve scaled normal equations with a relative ridge; columns that are zero get zero."""
    scale = np.sqrt(np.diag(normal))
    scale = np.where(scale > 0.0, scale, 1.0)
    scaled = normal / np.outer(scale, scale) + ridge * np.eye(len(normal))
    shape = (-1,) + (1,) * (right.ndim - 1)
    return np.asarray(np.linalg.solve(scaled, right / scale.reshape(shape)) / scale.reshape(shape))


def _inputs_of(weights: Array, n: int, M: int) -> tuple[Array, Array]:
    table = weights.reshape(n, M + 1)
    return table[:, :M], table[:, M]


def _block_diagonal(blocks: list[Array]) -> Array:
    n = sum(map(len, blocks))
    A = np.zeros((n, n))
    row = 0
    for block in blocks:
        A[row : row + len(block), row : row + len(block)] = block
        row += len(block)
    return A
