"""Lengths of rays inside balls, ellipsoids and pointed pins: closed forms.

Vectors have their three components on the *first* axis and broadcast over the rest; lengths are mm; directions need not have unit length.
"""

from __future__ import annotations

import numpy as np

from rsa_vision.types import Bool, Float

TINY = 1e-30  # a line along a cylinder: its two crossings of the mantle go to infinity, without a division by zero


def chord_ball(origin: Float, direction: Float, centre: Float, radius: float) -> Float:
    """Return the length of lines inside a ball.

    Parameters
    ----------
    origin, direction : ndarray of shape (3, ...)
        A point on each line, and its direction.
    centre : ndarray of shape (3,)
    radius : float

    Returns
    -------
    ndarray of shape (...)
        0 where the line misses the ball.
    """
    ox, oy, oz = (origin[i] - centre[i] for i in range(3))
    dx, dy, dz = direction
    cx, cy, cz = oy * dz - oz * dy, oz * dx - ox * dz, ox * dy - oy * dx  # the cross product keeps small distances exact
    distance2 = (cx * cx + cy * cy + cz * cz) / (dx * dx + dy * dy + dz * dz)
    return np.asarray(2 * np.sqrt(np.maximum(radius * radius - distance2, 0.0)))


def chord_ellipsoid(origin: Float, direction: Float, centre: Float, unit_from_lab: Float) -> tuple[Float, Float]:
    """Return the length of lines inside an ellipsoid, and how deep they run in it.

    Parameters
    ----------
    origin, direction : ndarray of shape (3, ...)
    centre : ndarray of shape (3,)
    unit_from_lab : ndarray of shape (3, 3)
        Turns the ellipsoid about its centre into the unit ball.

    Returns
    -------
    chord : ndarray of shape (...)
        mm.
    depth : ndarray of shape (...)
        1 through the centre, 0 at the rim and outside.
    """
    offset = np.tensordot(unit_from_lab, origin - centre.reshape((3,) + (1,) * (origin.ndim - 1)), 1)
    along = np.tensordot(unit_from_lab, direction, 1)
    half = 0.5 * chord_ball(offset, along, np.zeros(3), 1.0)
    scale = np.sqrt((direction * direction).sum(0) / (along * along).sum(0))
    return 2 * half * scale, half * half


def chord_pin(origin: Float, direction: Float, tip: Float, axis: Float, length: float, radius: float, taper: float | None = None) -> Float:
    """Return the length of lines inside a pointed pin.

    The pin is a cone from its tip over ``taper``, then a cylinder, and ends flat at ``length``.

    Parameters
    ----------
    origin, direction : ndarray of shape (3, ...)
    tip, axis : ndarray of shape (3,)
        The tip, and the unit vector from it to the thick end.
    length, radius : float
        Of the whole pin, and at its thick end.
    taper : float, optional
        Length of the conical part; default: the whole pin. 0 makes a cylinder.

    Returns
    -------
    ndarray of shape (...)
        0 where the line misses the pin.
    """
    taper = length if taper is None else taper
    ox, oy, oz = (origin[i] - tip[i] for i in range(3))
    dx, dy, dz = direction
    norm2 = dx * dx + dy * dy + dz * dz
    along = (ox * dx + oy * dy + oz * dz) / norm2
    ox, oy, oz = ox - along * dx, oy - along * dy, oz - along * dz  # start at the point nearest to the tip: no cancellation in the quadrics
    o_axis, d_axis = ox * axis[0] + oy * axis[1] + oz * axis[2], dx * axis[0] + dy * axis[1] + dz * axis[2]
    o_norm2 = ox * ox + oy * oy + oz * oz

    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        ends = (-o_axis / d_axis, (length - o_axis) / d_axis)
    low, high = np.minimum(*ends), np.maximum(*ends)
    parallel = d_axis == 0.0
    low = np.where(parallel, np.where((o_axis >= 0) & (o_axis <= length), -np.inf, np.inf), low)
    high = np.where(parallel, np.inf, high)

    if taper < length:  # |x|^2 - (x.a)^2 <= radius^2
        across2 = np.maximum(norm2 - d_axis**2, TINY)
        low, high = _clip(low, high, across2, -o_axis * d_axis, o_norm2 - o_axis**2 - radius**2, d_axis)
    if taper > 0.0:  # |x|^2 - (1 + k^2) (x.a)^2 <= 0, the nappe that the slab leaves
        widen = 1.0 + (radius / taper) ** 2
        low, high = _clip(low, high, norm2 - widen * d_axis**2, -widen * o_axis * d_axis, o_norm2 - widen * o_axis**2, d_axis)
    with np.errstate(invalid="ignore"):
        return np.asarray(np.sqrt(norm2) * np.where(high > low, high - low, 0.0))


def _clip(low: Float, high: Float, a: Float, b: Float, c: Float, forward: Float) -> tuple[Float, Float]:
    """Return the part of ``low..high`` where a t^2 + 2 b t + c <= 0, on the nappe in front of the tip where there are two."""
    disc = b * b - a * c
    root = np.sqrt(np.maximum(disc, 0.0))
    q = -(b + np.copysign(root, b))
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        t1, t2 = q / a, np.where(q == 0.0, 0.0, c / q)
    first, last = np.fmin(t1, t2), np.fmax(t1, t2)
    miss: Bool = (a > 0) & (disc <= 0)
    # a < 0 (steeper than the cone): inside before the first and after the last root; only one of the two is in front of the tip
    start = np.where(a > 0, first, np.where(forward > 0, last, -np.inf))
    stop = np.where(a > 0, last, np.where(forward > 0, np.inf, first))
    return np.maximum(low, np.where(miss, np.inf, start)), np.minimum(high, np.where(miss, -np.inf, stop))
