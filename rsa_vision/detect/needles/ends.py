"""Whether arms go on beyond their thick ends, as wires that cross or branch do."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsa_vision.detect.film.places import on_film, sample
from rsa_vision.detect.models.needles import NeedleFit
from rsa_vision.detect.models.profiles import Optics
from rsa_vision.detect.models.shown import Images

_BEYOND = 3.0  # blur widths past the end, and aside of the arm, where nothing of it is left
_ON_THE_ARM = 0.75  # of its length: as high as anywhere, and none of its end
_AS_HIGH = 0.7  # of that
_FURTHER_PX = np.arange(1.0, 5.0)


def arms_go_on(film: NDArray[Any], tee: NeedleFit, optics: Optics, others: Images | None) -> bool:
    """Say whether two arms of a tee at least are as high beyond their ends as on them: one may point at something by chance.

    Parameters
    ----------
    film : ndarray of shape (rows, cols)
    tee : NeedleFit
    optics : Optics
    others : callable, optional
        Images of neighbours, which are subtracted.

    Returns
    -------
    bool
    """
    length, aside = tee.shape.length_px, tee.shape.half_width_px + _BEYOND * optics.sigma_px + 1
    along = np.append(_ON_THE_ARM * length, length + _BEYOND * optics.sigma_px + _FURTHER_PX)
    c, s = np.cos(tee.angles)[:, None, None], -np.sin(tee.angles)[:, None, None]
    across = np.array([0.0, -aside, aside])[:, None]
    cols, rows = tee.position_px[0] + along * c - across * s, tee.position_px[1] + along * s + across * c
    values = sample(film, cols.ravel(), rows.ravel())
    if others is not None:
        values = values - others(cols.ravel(), rows.ravel())
    middle, *sides = values.reshape(cols.shape).swapaxes(0, 1)
    height = np.sign(tee.depth) * (middle - np.mean(sides, axis=0)) * on_film(film, cols[:, 0], rows[:, 0])
    return bool(((height[:, 0] > 0) & (height[:, 1:].mean(axis=1) > _AS_HIGH * height[:, 0])).sum() > 1)
