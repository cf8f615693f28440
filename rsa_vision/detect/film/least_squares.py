"""Small linear algebra of all fits: quadratic surfaces, and normal equations whose columns are scaled to one."""

from __future__ import annotations

import numpy as np
from scipy.linalg.lapack import dgesv

from rsa_vision.types import Float

RIDGE = 1e-10  # relative


def polynomial(axis_scale: float, dx: Float, dy: Float) -> Float:
    """Return the six monomials of a quadratic surface on a new last axis, scaled to about one at the rim of the window."""
    u, v = dx / axis_scale, dy / axis_scale
    return np.moveaxis(np.array([np.ones_like(u), u, v, u * u, u * v, v * v]), 0, -1)  # each in one piece in memory


def invert(normal: Float) -> Float:
    """Return the inverses of normal matrices (n, p, p); what they do not determine has a variance that is large, not infinite."""
    scale = np.sqrt(np.maximum(np.einsum("nkk->nk", normal), 1e-30))
    both = scale[:, :, None] * scale[:, None, :]
    return np.asarray(np.linalg.inv(normal / both + RIDGE * np.eye(normal.shape[1])) / both)


def chi2(of: Float, covariance: Float) -> Float:
    """Return the squares (n,) of vectors (n, p) in units of their covariances (n, p, p)."""
    return np.asarray(np.einsum("ni,ni->n", of, np.linalg.solve(covariance, of[:, :, None])[:, :, 0]))


def columns(blocks: list[Float]) -> Float:
    """Put blocks of rows of shape (k, n) beside each other as the columns of a design matrix (n, p), each in one piece in memory."""
    return np.concatenate(blocks).T


def weighted_least_squares(jac: Float, weight: Float, target: Float, damping: float = 1e-9) -> Float:
    """Return one damped Gauss-Newton step: the weighted least-squares solution with columns scaled to one.

    Parameters
    ----------
    jac : ndarray of shape (n, p)
    weight, target : ndarray of shape (n,)
    damping : float
        Relative to the scaled diagonal; keeps what the pixels do not determine where it is.

    Returns
    -------
    ndarray of shape (p,)
    """
    root = np.sqrt(weight)
    weighted = jac * root[:, None]
    return damped_solution(weighted.T @ weighted, weighted.T @ (root * target), damping)


def damped_solution(normal: Float, right: Float, damping: float) -> Float:
    """Solve normal equations whose columns are scaled to one, ``damping`` added to the scaled diagonal."""
    scale = np.sqrt(np.maximum(normal.diagonal(), 1e-30))
    scaled = normal / (scale[:, None] * scale)
    scaled.ravel()[:: len(scale) + 1] += damping
    *_, solution, fails = dgesv(scaled, right / scale)  # numpy's own does the same in twice the time
    if fails:
        raise np.linalg.LinAlgError("singular normal equations")
    return np.asarray(solution / scale)
