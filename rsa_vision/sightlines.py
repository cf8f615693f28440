"""Rays of images that belong to nothing, from the tables of an examination alone."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rsa_vision.errors import GeometryError
from rsa_vision.geometry.homography import apply_homography, fit_homography, homography_jacobians
from rsa_vision.geometry.rays import RayBundle
from rsa_vision.readings import joined_rays
from rsa_vision.tables import Row, Rows

SHAPE = "ball"
LEAST_MARKS = 4


def free_rays(rows: Rows) -> RayBundle:
    """Return the rays of all images of balls that nothing explains.

    Parameters
    ----------
    rows : dict
        Tables of one examination.

    Returns
    -------
    RayBundle
        ``image`` is the row of the table of images. An image of a shared film that no focus claims has a ray of each focus. Without a
        fiducial plane (calibrated cameras) there are none.

    Notes
    -----
    The projective transformation of each focus is found again from the images that the tables give in the fiducial plane.
    """
    free = [
        index
        for index, row in enumerate(rows["images"])
        if row["role"] == "unassigned"
        and row["shape"] == SHAPE
        and row["sd_col_px"] is not None
        and "foreign-mark" not in (row["flags"] or "")
    ]
    parts = [_rays(focus, rows["images"], [i for i in free if rows["images"][i]["focus"] in (0, focus["focus"])]) for focus in rows["foci"]]
    return joined_rays([_no_rays(), *parts])


def _no_rays() -> RayBundle:
    none = np.zeros(0, np.int64)
    return RayBundle(none, none, np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 6, 6)), np.zeros((0, 6, 0)))


def _rays(focus: Row, images: Sequence[Row], free: Sequence[int]) -> RayBundle:
    known = [row for row in images if row["focus"] == focus["focus"] and row["role"] == "fiducial" and row["x_mm"] is not None]
    if not free or len(known) < LEAST_MARKS or focus["x_mm"] is None:
        return _no_rays()
    places = np.array([[row["x_mm"], row["y_mm"], row["z_mm"]] for row in known])
    middle = places.mean(axis=0)
    basis = np.linalg.svd(places - middle)[2][:2]
    try:
        plane_from_film = fit_homography(np.array([[row["col_px"], row["row_px"]] for row in known]), (places - middle) @ basis.T)
    except GeometryError:
        return _no_rays()
    n = len(free)
    px = np.array([[images[i]["col_px"], images[i]["row_px"]] for i in free])
    sd = np.array([[images[i]["sd_col_px"], images[i]["sd_row_px"]] for i in free])
    beside = np.array([images[i]["cov_col_row_px2"] or 0.0 for i in free])
    in_film = sd[:, :, None] ** 2 * np.eye(2) + beside[:, None, None] * np.array([[0, 1], [1, 0]])
    by_film = basis.T @ homography_jacobians(plane_from_film, px)[0]  # (n, 3, 2)
    covariance = np.zeros((n, 6, 6))
    covariance[:, :3, :3] = by_film @ in_film @ by_film.swapaxes(1, 2)
    covariance[:, 3:, 3:] = np.diag([(focus[f"sd_{axis}_mm"] or 0.0) ** 2 for axis in "xyz"])
    through = middle + apply_homography(plane_from_film, px) @ basis
    origin = np.tile([focus[f"{axis}_mm"] for axis in "xyz"], (n, 1))
    return RayBundle(np.array(free, np.int64), np.full(n, focus["focus"], np.int64), origin, through, covariance, np.zeros((n, 6, 0)))
