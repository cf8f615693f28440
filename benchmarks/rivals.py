"""Detectors that others use, each told what ours is not: the marks' radius and whether they are dark.

Every function takes a film (uint8 or uint16), the radius in pixels and the polarity and returns positions (col, row), shape (n, 2).
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]
Rival = Callable[[NDArray[Any], float, bool], Float]


def eight_bit(film: NDArray[Any]) -> NDArray[np.uint8]:
    """Stretch the range of a film to 8 bits."""
    low, high, *_ = cv2.minMaxLoc(film)
    return np.asarray(cv2.convertScaleAbs(film, alpha=255 / max(high - low, 1), beta=-low * 255 / max(high - low, 1)), np.uint8)


def simple_blob(film: NDArray[Any], radius_px: float, brighter: bool) -> Float:
    """cv2.SimpleBlobDetector.

    Film smoothed by a third of the radius, stretched to 8 bits, thresholds 50 to 205 by 5, area 0.3 to 3 times the disc's, circularity
    above 0.6, inertia above 0.3, convexity above 0.7.
    """
    image = eight_bit(cv2.GaussianBlur(film, (0, 0), max(0.7, radius_px / 3)))
    p = cv2.SimpleBlobDetector_Params()
    p.filterByColor, p.blobColor = True, 255 if brighter else 0
    p.filterByArea, p.minArea, p.maxArea = True, 0.3 * np.pi * radius_px**2, 3 * np.pi * (radius_px + 1) ** 2
    p.filterByCircularity, p.minCircularity = True, 0.6
    p.filterByInertia, p.minInertiaRatio = True, 0.3
    p.filterByConvexity, p.minConvexity = True, 0.7
    p.minThreshold, p.maxThreshold, p.thresholdStep, p.minRepeatability, p.minDistBetweenBlobs = 50, 205, 5, 3, 2 * radius_px
    return np.array([k.pt for k in cv2.SimpleBlobDetector_create(p).detect(image)]).reshape(-1, 2)


def blob_log(film: NDArray[Any], radius_px: float, brighter: bool) -> Float:
    """skimage.feature.blob_log: four scales from 0.7 to 1.2 times radius / sqrt(2), threshold 0.4 of the strongest; whole pixels."""
    from skimage.feature import blob_log as log  # optional packages of the benchmark alone

    image = film.astype(np.float32) / np.iinfo(film.dtype).max
    best = radius_px / np.sqrt(2)
    image = image if brighter else 1 - image
    blobs = log(image, 0.7 * best, 1.2 * best, num_sigma=4, threshold=None, threshold_rel=0.4, exclude_border=False)
    return np.asarray(blobs[:, 1::-1], float).reshape(-1, 2)


def trackpy(film: NDArray[Any], radius_px: float, brighter: bool) -> Float:
    """trackpy.locate: diameter the next odd number above 2 r + 3, at least 0.3 of the mass of the 20th heaviest (the film has more)."""
    from trackpy import locate

    diameter = int(2 * np.ceil(radius_px + 1) + 1)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = locate(film, diameter, invert=not brighter, noise_size=1, separation=1.5 * diameter, characterize=True, engine="python")
    mass = np.sort(found["mass"].to_numpy())[::-1]
    heavy = found[found["mass"] > 0.3 * mass[min(20, len(mass) - 1)]] if len(mass) else found
    return heavy[["x", "y"]].to_numpy(dtype=float).reshape(-1, 2)


def enclosing_circle(film: NDArray[Any], radius_px: float, brighter: bool) -> Float:
    """Marker trackers' chain: Gaussian background (4 r) off, 8 bit, median 3, threshold halfway to the marks, minEnclosingCircle."""
    image = film.astype(np.float32)
    high = (image - cv2.GaussianBlur(image, (0, 0), 4 * radius_px)) * (1 if brighter else -1)
    top = float(cv2.medianBlur(high, 5).max())
    image8 = cv2.medianBlur(np.clip(high / top * 255, 0, 255).astype(np.uint8), 3)
    contours, _ = cv2.findContours((image8 > 127).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    circles = [cv2.minEnclosingCircle(c) for c in contours]
    return np.array([c for c, r in circles if 0.5 * radius_px < r < 2 * radius_px + 1]).reshape(-1, 2)


RIVALS: dict[str, Rival] = {
    "SimpleBlobDetector": simple_blob,
    "blob_log": blob_log,
    "trackpy": trackpy,
    "enclosing circle": enclosing_circle,
}
