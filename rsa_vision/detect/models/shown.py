"""What marks show at pixels, as functions: how fits are told of the marks beside the one that they are about."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np

from rsa_vision.detect.film.patches import Patches
from rsa_vision.types import Bool, Float

Images = Callable[[Float, Float], Float]
"""Images of some marks at pixels (cols, rows), in film values over the background."""

Beside = Callable[[int, Float, Float], tuple[Float, Bool]]
"""Images of all marks but one ball at pixels (cols, rows) around it, in film values, and the pixels where they are not to be trusted."""


def nothing(cols: Float, _: Float) -> Float:
    """Images of no marks."""
    return np.zeros(cols.shape)


def for_all(images: Images) -> Beside:
    """Return images that are the same for all balls, and to be trusted everywhere."""
    return lambda _, cols, rows: (images(cols, rows), np.zeros(cols.shape, bool))


def beside_each(patches: Patches, balls: Iterable[int], beside: Beside) -> tuple[Float, Bool]:
    """Return the same for a window of each of some balls, which ``beside`` calls by these numbers; both of shape (n, s, s)."""
    images, doubtful = zip(*(beside(int(ball), *patches.places(k)) for k, ball in enumerate(balls)), strict=True)
    return np.stack(images), np.stack(doubtful)
