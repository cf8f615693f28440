"""A first estimate of blur, attenuation and film curve from the cleanest pins or tees of a film."""

from __future__ import annotations

from typing import Any

from numpy.typing import NDArray

from rsa_vision.detect.balls.find import COARSE_MU_PX, COARSE_SIGMA_PX
from rsa_vision.detect.film.noise import NoiseModel
from rsa_vision.detect.models.needles import NeedleFit
from rsa_vision.detect.models.profiles import Optics
from rsa_vision.detect.needles.sets import clusters
from rsa_vision.detect.needles.shared import fit_shared

GUESS = Optics(COARSE_SIGMA_PX, COARSE_MU_PX)  # before needles are asked
BLURS_PX = (0.6, 0.8, 1.0, 1.25, 1.6, 2.1)  # that are tried
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
        Start.
    noise : NoiseModel

    Returns
    -------
    optics : Optics
    taper : float
        Part of their length over which they taper.
    """
    alone = [needles[c[0]] for c in clusters(needles) if len(c) == 1] or needles
    sample = sorted(alone, key=lambda f: f.misfit)
    sample = sample[: _SAMPLE // len(sample[0].angles)]
    fits, optics = fit_shared(film, sample, optics, noise, parallel=False, steps=_STEPS)
    return optics, fits[0].shape.taper
