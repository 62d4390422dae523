r"""Exact l1 optimum of noise-free slopes and intercepts, by enumeration: an oracle for basis pursuit, and much faster.

The problem is (18) of [1]_ with epsilon = 0, in the form of its footnote 1 (o_h,K is minus the sum of the others and
not in the norm), as in :mod:`calibrator.published.basis_pursuit`; offsets are in fractions of full scale:

    min  |d_h| + sum_k<K |o_h,k| + sum_k |d_k| + sum_k |o_k|    s.t.  (1 + d_k)(1 + d_h) = a_k,
                                                                     (1 + d_k) o_h,k + o_k = b_k,  sum_k o_h,k = 0

**Where the optimum is.** All a_k are positive, so t = 1 + d_h is. With o_h,k = t h_k the constraints give
d_k = a_k / t - 1 and o_k = b_k - a_k h_k, which does not depend on t. What is left to minimise is

    f(t, h) = |t - 1| + sum_k |a_k / t - 1| + t sum_k<K |h_k| + sum_k |b_k - a_k h_k|,    h_K = - sum_k<K h_k.

1. For any t, f is convex, piecewise linear and coercive in (h_1 .. h_K-1), so it has a minimum at a vertex: K - 1
   independent ones of the equations h_k = 0 (k < K) and h_k = b_k / a_k (all k) hold. Two for one k are parallel, so
   either every h_k with k < K is 0 or b_k / a_k, or h_K = b_K / a_K, all but one of the others are, and that one is
   minus the sum of the rest. These (K + 1) 2^(K-2) vertices do not depend on t.
2. For any h, between two neighbours of the kinks {1, a_1 .. a_K} f is linear in t plus A / t, with A the sum of the a_k
   above less that of those below. If A <= 0 that is concave, and the minimum is at a kink. If A > 0 it is convex, with
   f' = s + H - A / t^2, s the sign of t - 1 and ``H = sum_k<K |h_k|``: the minimum is at sqrt(A / (s + H)), or at the
   kink beside it. Beyond the largest kink f rises, and towards t = 0 it grows without bound.

From any point, moving h to a vertex and then t to a kink or such a stationary point does not raise f; as f is coercive,
the optimum is among these pairs. The stationary points do matter: slopes (1.3, 1.3, 0.9) with H = 0.1 have one at
t = 1.243. Below 60 % of drift none exists for K = 2 and H < 0.25, and the optimum has d_h = 0 or a_k - 1.

.. [1] "Measurement Correction for Electric Vehicles Based on Compressed Sensing".
"""

from itertools import product

import numpy as np
from numpy.typing import NDArray

from calibrator.drive import Array
from calibrator.errors import FleetError

__all__ = ["l1_norm", "l1_optimum"]


def l1_optimum(slopes: Array, intercepts: Array) -> Array:
    """Find the faults of least l1 norm that explain noise-free slopes and intercepts exactly.

    Parameters
    ----------
    slopes, intercepts : ndarray of shape (N, K)
        a [1], and b in fractions of full scale [1], of N vehicles with K >= 2 branches.

    Returns
    -------
    ndarray of shape (N, 3K)
        (d_h, o_h,1 .. o_h,K-1, D_m, o_m), offsets in fractions of full scale; one of them where several have the same
        norm.

    Raises
    ------
    FleetError
        If a slope is not positive, or a value not finite.
    """
    _refuse_impossible(slopes, intercepts)
    h = _vertices(intercepts / slopes)
    t = _scales(slopes, np.abs(h[..., :-1]).sum(axis=2))
    x = _parameters(slopes[:, None, None], intercepts[:, None, None], t[..., None], h[:, :, None])
    x = x.reshape(len(slopes), -1, x.shape[-1])
    best = np.argmin(l1_norm(x), axis=1)
    return np.asarray(x[np.arange(len(x)), best])


def l1_norm(x: Array) -> Array:
    """Norm of parameters (..., 3K), which leave out o_h,K; shape (...)."""
    return np.asarray(np.abs(x).sum(axis=-1))


def _refuse_impossible(slopes: Array, intercepts: Array) -> None:
    bad = ~(np.isfinite(slopes) & np.isfinite(intercepts) & (slopes > 0.0))
    if bad.any():
        j, k = (int(i) for i in np.argwhere(bad)[0])
        raise FleetError(
            f"vehicle {j + 1}, branch {k + 1}: slope {slopes[j, k]:g}, intercept {intercepts[j, k]:g} of full scale; "
            "expected finite ones and a positive slope; leave the vehicle out"
        )


def _vertices(ratio: Array) -> Array:
    """Vertices h of shape (N, V, K) for b / a of shape (N, K)."""
    K = ratio.shape[1]
    free = ratio[:, None, :-1] * _patterns(K - 1)
    found = [np.concatenate([free, -free.sum(axis=2, keepdims=True)], axis=2)]
    for k in range(K - 1):
        others = np.delete(np.arange(K - 1), k)
        h = np.empty((len(ratio), 2 ** (K - 2), K))
        h[..., others] = ratio[:, None, others] * _patterns(K - 2)
        h[..., -1] = ratio[:, -1:]
        h[..., k] = -h[..., others].sum(axis=2) - h[..., -1]
        found.append(h)
    return np.concatenate(found, axis=1)


def _patterns(size: int) -> NDArray[np.float64]:
    return np.array(list(product((0.0, 1.0), repeat=size))).reshape(2**size, size)


def _scales(slopes: Array, hardware: Array) -> Array:
    """Kinks and stationary points t for each vertex with H of shape (N, V): shape (N, V, 2K + 2)."""
    kinks = np.sort(np.concatenate([np.ones((len(slopes), 1)), slopes], axis=1), axis=1)
    lower = np.concatenate([np.zeros((len(slopes), 1)), kinks[:, :-1]], axis=1)
    middle = (lower + kinks) / 2.0
    A = np.sum(slopes[:, None] * np.sign(slopes[:, None] - middle[:, :, None]), axis=2)[:, None]
    curb = np.sign(middle - 1.0)[:, None] + hardware[:, :, None]
    inside = (A > 0.0) & (curb > 0.0)
    stationary = np.sqrt(np.where(inside, A, 1.0) / np.where(inside, curb, 1.0))
    within = inside & (stationary > lower[:, None]) & (stationary < kinks[:, None])
    kink = np.broadcast_to(kinks[:, None], within.shape)
    return np.concatenate([kink, np.where(within, stationary, kink)], axis=2)


def _parameters(a: Array, b: Array, t: Array, h: Array) -> Array:
    """Parameters of shape (N, V, T, 3K) at scales (N, V, T, 1) and vertices (N, V, 1, K)."""
    drift = a / t - 1.0
    offset = np.broadcast_to(b - a * h, drift.shape)
    return np.concatenate([t - 1.0, t * h[..., :-1], drift, offset], axis=-1)
