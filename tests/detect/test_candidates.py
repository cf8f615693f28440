"""Where marks may be: structure raises what counts as significant where it is, up to the film's margins."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from rsa_vision.detect.film.noise import estimate_noise
from rsa_vision.detect.search.candidates import STRENGTH, find_candidates

from .films import stored


@pytest.mark.parametrize("width", [1264, 1280])
def test_texture_at_the_margin_is_no_crowd_of_marks(width: int) -> None:
    """Blocks of 256 pixels tell it at the coarsest scale: the last one is not whole."""
    rng = np.random.default_rng(0)
    texture = gaussian_filter(rng.normal(size=(512, width)), 7.0)
    film = stored(30000 + 60 * rng.standard_normal(texture.shape) + texture / texture.std() * np.where(np.arange(width) >= 1024, 1500, 20))
    found = find_candidates(film, estimate_noise(film, 16))
    coarse = found.position_px[(np.abs(found.strength) > STRENGTH) & (found.radius_px > 11)]
    assert np.count_nonzero(coarse[:, 0] > 1060) < 5
