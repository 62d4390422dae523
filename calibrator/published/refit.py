"""Least squares for the faults that basis pursuit found to be nonzero: takes out the shrinkage of the l1 norm.

Unknowns as in :mod:`calibrator.published.basis_pursuit`: x = (d_h, o_h,1 .. o_h,K-1, D_m, o_m), offsets in fractions
of full scale. The model is (15) of [1]_.

.. [1] "Measurement Correction for Electric Vehicles Based on Compressed Sensing".
"""

import numpy as np

from calibrator.drive import Array, Mask

__all__ = ["refit_support", "support_of"]

SMALLEST_PARAMETER = 0.02
"""Below this a parameter is taken as zero: what the norm leaves of the noise is smaller, known faults larger. [1]"""
STEPS = 8
"""Gauss-Newton steps; the model is bilinear and the start close, so 4 already reach rounding. [1]"""


def support_of(x: Array) -> Mask:
    """Parameters of shape (3K,) that are not zero: at most the 2K largest, as there are 2K equations."""
    equations = 2 * len(x) // 3
    order = np.argsort(-np.abs(x), kind="stable")
    support = np.zeros(len(x), bool)
    support[order[:equations]] = True
    return support & (np.abs(x) > SMALLEST_PARAMETER)


def refit_support(x: Array, slopes: Array, intercepts: Array, deviations: Array) -> Array:
    """Fit the nonzero parameters of one vehicle to its slopes and intercepts by Gauss-Newton.

    Parameters
    ----------
    x : ndarray of shape (3K,)
        Start; its support stays.
    slopes, intercepts : ndarray of shape (K,)
        a [1], and b in fractions of full scale [1].
    deviations : ndarray of shape (2K,)
        Standard deviations of slopes and intercepts, positive. [1]

    Returns
    -------
    ndarray of shape (3K,)
        Refitted parameters; the start with its small entries set to zero if the refit leaves the model's range.
    """
    support = support_of(x)
    start = np.where(support, x, 0.0)
    target = np.concatenate([slopes, intercepts])
    fitted = start.copy()
    for _ in range(STEPS):
        value, jacobian = _model(fitted)
        weighted = jacobian[:, support] / deviations[:, None]
        fitted[support] += np.linalg.lstsq(weighted, (target - value) / deviations, rcond=None)[0]
        if not np.isfinite(fitted).all() or np.abs(fitted).max() > 1.0:
            return start
    return fitted


def _model(x: Array) -> tuple[Array, Array]:
    """Slopes and intercepts (2K,) of (15), and their derivatives (2K, 3K)."""
    K = len(x) // 3
    scale, drift, offset = 1.0 + x[0], 1.0 + x[K : 2 * K], x[2 * K :]
    hardware = np.append(x[1:K], -x[1:K].sum())
    k = np.arange(K)
    J = np.zeros((2 * K, 3 * K))
    J[k, 0] = drift
    J[k, K + k] = scale
    J[K + k[:-1], 1 + k[:-1]] = drift[:-1]
    J[2 * K - 1, 1:K] = -drift[-1]
    J[K + k, K + k] = hardware
    J[K + k, 2 * K + k] = 1.0
    return np.concatenate([drift * scale, drift * hardware + offset]), J
