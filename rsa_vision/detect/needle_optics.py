"""A first estimate of blur, attenuation and film curve from the cleanest pins or tees of a film."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsa_vision.detect.crossing import chi2_of, window_of
from rsa_vision.detect.needle_images import NeedleFit
from rsa_vision.detect.needle_sets import clusters
from rsa_vision.detect.noise import NoiseModel
from rsa_vision.detect.profiles import Optics
from rsa_vision.detect.shared import fit_shared

_BENDS = (0.6, 0.85, 0.95, 0.985, 0.999)
_SAMPLE = 18  # arms that are asked
_STEPS = 4  # for a first estimate


def common_optics(film: NDArray[Any], needles: list[NeedleFit], optics: Optics, noise: NoiseModel) -> tuple[Optics, float]:
    """Estimate what the images of the cleanest needles have in common.

    Parameters
    ----------
    film : ndarray of shape (rows, cols)
    needles : list of NeedleFit
        All pins or all tees.
    optics : Optics
        Start. Only where its blur is rough is the bend of the film curve asked for, too.
    noise : NoiseModel

    Returns
    -------
    optics : Optics
    along_px : float
        How far the tips may lie elsewhere along their needles, by other bends of the curve that explain the film nearly as well: their
        root mean square distance, weighted by likelihood.
    """
    alone = [c[0] for c in clusters(needles) if len(c) == 1] or needles
    sample = sorted(alone, key=lambda f: f.misfit)
    sample = sample[: _SAMPLE // len(sample[0].angles)]
    if not optics.rough:
        return fit_shared(film, sample, optics, noise, parallel=False, steps=_STEPS)[1], 0.0
    places = np.array([f.position_px for f in sample])
    windows = [window_of(film, [f], optics, noise, None) for f in sample]
    ways = np.array([[np.cos(f.angles[0]), -np.sin(f.angles[0])] for f in sample])
    found, left, along = [], [], []
    for bend in (0.0, *_BENDS):
        fits, by = fit_shared(film, sample, replace(optics, bend=bend), noise, parallel=False, steps=_STEPS)
        of = [int(np.hypot(*(places - f.position_px).T).argmin()) for f in fits]
        found.append(by)
        left.append(sum(chi2_of(windows[k], f, by, noise) for k, f in zip(of, fits, strict=True)))
        along.append(np.mean([(f.position_px - places[k]) @ ways[k] for k, f in zip(of, fits, strict=True)]))
    best = int(np.argmin(left))
    weight = np.exp(-0.5 * (np.array(left) - left[best]) / float(noise.correlation.sum()))
    return found[best], float(np.sqrt(np.average((np.array(along) - along[best]) ** 2, weights=weight)))
