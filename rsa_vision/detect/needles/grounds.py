"""What the film beside pins and tees does to their tips, where it goes on under them: bone that no quadratic background follows."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from rsa_vision.detect.balls.surroundings import ROUND_ABOUT, Places, around_each
from rsa_vision.detect.film.places import are_within
from rsa_vision.detect.film.whitening import Filter
from rsa_vision.detect.models.needles import NeedleFit
from rsa_vision.detect.needles.crossing import Window
from rsa_vision.detect.needles.equations import Equations
from rsa_vision.types import Float

_ENOUGH, _SPARSEST = 400, 3  # places of a film, from which only every second or third around each is looked at
_MEDIAN = float(chdtri(1.0, 0.5))  # of a square of variance one
_LEAST = 0.1  # of what noise does, of which less is none


def errors_by_ground(
    film: NDArray[Any],
    windows: Sequence[Window],
    systems: Sequence[Equations],
    by_noise: Sequence[Float],
    needles: Sequence[NeedleFit],
    through: Filter,
) -> list[Float]:
    """Return what the film at free places beside pins or tees would move their tips by, beyond what its noise does.

    An estimate is a linear function of the pixels of its window, near enough, and a background is one that it does not see. What that
    function makes of the film beside a needle, tells what it makes of the film under it.

    Parameters
    ----------
    film : ndarray of shape (rows, cols)
    windows : sequence of Window
    systems : sequence of Equations
        Of these windows, filtered.
    by_noise : sequence of ndarray of shape (2 m, 2 m)
        Covariances of the ``m`` tips of each by noise.
    needles : sequence of NeedleFit
        All of the film, in other windows as well.
    through : Filter
        Of the equations.

    Returns
    -------
    list of ndarray of shape (m, 2, 2)
        px^2, (col, row).
    """
    noise, members = through.noise, [f for e in systems for f in e.members]
    length = np.array([f.shape.length_px for f in needles])
    middle = np.array([f.position_px for f in needles]) + 0.5 * length[:, None] * np.array([f.way for f in needles])
    across = length * np.array([1.0 if len(f.angles) == 1 else 2.0 for f in needles])  # with the bar of a tee
    way = np.array([f.way for f in members])
    axes = np.stack([way, np.stack([-way[:, 1], way[:, 0]], axis=1)], axis=1)  # (members, 2, 2)
    counts = np.cumsum([0] + [len(e.members) for e in systems])
    round_about = ROUND_ABOUT[:: max(1, min(len(ROUND_ABOUT) * len(members) // _ENOUGH, _SPARSEST))]
    places, figures, variances = [], [], []
    for window, e, scatter, first in zip(windows, systems, by_noise, counts, strict=False):
        mine = slice(first, first + len(e.members))
        span, size = max(window.box), np.array(window.box[::-1])
        corner = np.rint([window.cols.min(), window.rows.min()] + span * round_about).astype(np.intp)
        centre = corner + 0.5 * size
        free = (corner >= 0).all(axis=1) & (corner + size <= film.shape[::-1]).all(axis=1)
        free &= ~are_within(centre, middle, 0.5 * (span + across))
        boxes = [film[row : row + size[1], col : col + size[0]] for col, row in corner[free]]
        values = np.array([box.ravel().take(window.place) for box in boxes], np.float64).reshape(len(boxes), len(window.place))
        # what lies over tees is blotted out while those under it are fitted; what is saturated shows no bone
        whole = ((values > noise.floor) & (values < noise.ceiling)).all(axis=1)
        centre, values = centre[free][whole], values[whole]
        level = values.mean(axis=1, keepdims=True)
        of_pixels = window.filtered(e.inverse[e.tips] @ e.own, through) * np.sqrt(e.weight)  # the filter is its own transpose
        moved = (values - level) @ of_pixels.T
        moved = np.einsum("kma,mba->kmb", moved.reshape(len(values), len(e.members), 2), axes[mine])
        own = scatter.reshape(len(e.members), 2, len(e.members), 2)[np.arange(len(e.members)), :, np.arange(len(e.members))]
        variance = np.einsum("mba,mac,mbc->mb", axes[mine], own, axes[mine])
        louder = noise.variance_at(level) / noise.variance_at(np.array(e.shown.background))
        figures.append((moved**2 / (louder[:, :, None] * variance) / _MEDIAN).reshape(-1, 2))
        cell = np.repeat((centre // span).astype(np.intp), len(e.members), axis=0)
        near = np.tile(np.arange(len(e.members)), len(values))
        places.append(Places(0, np.arange(first, counts[-1])[: len(e.members)], near, cell, np.zeros((len(near), 0))))
        variances.append(variance)
    more = around_each(figures, places, len(members), _LEAST) - 1.0
    more = np.maximum(more, 0.0)
    extra = np.einsum("mb,mba,mbc->mac", more * np.concatenate(variances), axes, axes)
    return np.split(extra, counts[1:-1])
