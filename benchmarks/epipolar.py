"""How far image points of two views are off the epipolar geometry that they share: errors told by nothing but the points."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

Float = NDArray[np.float64]
PARAMETERS = 7


def scatter(first: Float, second: Float, covariance_first: Float, covariance_second: Float) -> float:
    """Return the standard deviation of image points about their epipolar geometry, in units of what is stated.

    The fundamental matrix is fitted to the points themselves, to first order of their errors (Luong & Faugeras, Int. J. Computer Vision
    17, 1996). Errors along the epipolar lines do not show.

    Parameters
    ----------
    first, second : ndarray of shape (n, 2)
        The same points in two views, n > 7.
    covariance_first, covariance_second : ndarray of shape (n, 2, 2)
        Stated; identities give a standard deviation of one coordinate in pixels.

    Returns
    -------
    float
    """
    middle, size = first.mean(axis=0), float(first.std())
    one, two = ((points - middle) / size for points in (first, second))
    of_one, of_two = covariance_first / size**2, covariance_second / size**2

    def matrix(p: Float) -> Float:
        left, right = cv2.Rodrigues(p[:3])[0], cv2.Rodrigues(p[3:6])[0]
        return np.asarray(left @ np.diag([1.0, p[6], 0.0]) @ right.T)

    def residual(p: Float) -> Float:
        f = matrix(p)
        a, b = np.column_stack([one, np.ones(len(one))]), np.column_stack([two, np.ones(len(two))])
        of_a, of_b = b @ f, a @ f.T
        variance = np.einsum("ni,nij,nj->n", of_a[:, :2], of_one, of_a[:, :2]) + np.einsum("ni,nij,nj->n", of_b[:, :2], of_two, of_b[:, :2])
        return np.asarray((b * of_b).sum(axis=1) / np.sqrt(variance))

    rough, _ = cv2.findFundamentalMat(one, two, cv2.FM_8POINT)
    u, s, vt = np.linalg.svd(rough)
    u[:, 2] *= np.linalg.det(u)  # the third column belongs to a singular value of zero
    v = vt.T * [1.0, 1.0, np.linalg.det(vt)]
    start = np.concatenate([cv2.Rodrigues(u)[0].ravel(), cv2.Rodrigues(v)[0].ravel(), [s[1] / s[0]]])
    left = least_squares(residual, start, x_scale="jac").fun
    return float(np.sqrt(left @ left / (len(left) - PARAMETERS)))
