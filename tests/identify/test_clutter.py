"""Images of a shape of which none is paired: markers that the other film shows as something else, against clutter."""

from __future__ import annotations

import os

import numpy as np
import pytest

from rsa_vision.geometry.rays import RayBundle
from rsa_vision.identify.clutter import more_than_clutter
from rsa_vision.types import Bool, Float

STUDIES = 5 * int(os.environ.get("RSA_VISION_EXAMINATIONS", "40"))
FOCI = {1: np.array([-240.0, 100.0, 1120.0]), 2: np.array([240.0, 100.0, 1120.0])}
FALSE_ALARMS = 0.15  # of two foci, each asked for how many there are and for what they meet, each at 0.05 at the most


def rays(places: dict[int, Float], sd_mm: float) -> RayBundle:
    """Return rays through places (n, 2) in the plane z = 0 on the film of each focus."""
    focus = np.repeat(list(places), [len(at) for at in places.values()])
    through = np.column_stack([np.concatenate(list(places.values())).reshape(-1, 2), np.zeros(len(focus))])
    covariance = np.zeros((len(focus), 6, 6))
    covariance[:, [0, 1], [0, 1]] = sd_mm**2
    origin = np.array([FOCI[int(f)] for f in focus]).reshape(-1, 3)
    return RayBundle(np.arange(len(focus)), focus, origin, through, covariance, np.zeros((len(focus), 6, 0)))


def shadows(points: Float, focus: int) -> Float:
    part = points[:, 2:] / FOCI[focus][2]
    result: Float = ((points - part * FOCI[focus]) / (1 - part))[:, :2]
    return result


def told(places: dict[int, Float], pins: Bool, sd_mm: float = 0.01) -> set[int]:
    bundle = rays(places, sd_mm)
    found = more_than_clutter(bundle, pins, np.ones(len(pins), bool), lambda x: (x[..., 2] > -2) & (x[..., 2] < 700), 0.0)
    assert not (found & ~pins).any()
    return set(bundle.focus[found].tolist())


def anywhere(rng: np.random.Generator, count: int) -> Float:
    return rng.uniform((-150.0, -50.0), (150.0, 250.0), (count, 2))


@pytest.mark.parametrize("pins", [2, 5])
@pytest.mark.parametrize("clutter", [0, 8])
def test_pins_that_the_other_film_shows_as_something_else_are_told(pins: int, clutter: int) -> None:
    """As pins that point at a focus: poor balls there, whose places are a tenth of a millimetre unsure."""
    rng = np.random.default_rng([pins, clutter])
    for _ in range(STUDIES):
        markers = np.column_stack([rng.uniform((-30, 60), (30, 140), (pins, 2)), rng.uniform(80, 200, pins)])
        places = {focus: np.concatenate([shadows(markers, focus), anywhere(rng, clutter)]) for focus in FOCI}
        places = {focus: at + rng.normal(0, 0.02, at.shape) for focus, at in places.items()}
        is_pin = np.concatenate([np.ones(pins, bool), np.zeros(clutter, bool), np.zeros(pins + clutter, bool)])
        assert told(places, is_pin, 0.02) == {1}


@pytest.mark.parametrize(("pins", "found"), [(0, set()), (1, set()), (2, {1}), (6, {1})])
def test_pins_of_one_film_are_told_where_the_other_shows_none(pins: int, found: set[int]) -> None:
    rng = np.random.default_rng(pins)
    assert told({1: anywhere(rng, pins), 2: anywhere(rng, 0)}, np.ones(pins, bool)) == found


@pytest.mark.parametrize("many", [1, 3, 10, 40])
def test_clutter_as_thick_on_either_film_is_seldom_told(many: int) -> None:
    rng = np.random.default_rng(many)
    alarms = []
    for _ in range(STUDIES):
        places = {focus: anywhere(rng, many + int(rng.poisson(many))) for focus in FOCI}
        pins = np.concatenate([np.arange(len(at)) < rng.binomial(len(at), 0.5) for at in places.values()])
        alarms.append(bool(told(places, pins)))
    assert np.mean(alarms) < FALSE_ALARMS + 2 * np.sqrt(FALSE_ALARMS / STUDIES)


def test_an_image_of_a_shared_film_is_no_partner_of_its_own() -> None:
    rng = np.random.default_rng(0)
    both = anywhere(rng, 4)
    bundle = rays({1: both, 2: both}, 0.01)
    shared = RayBundle(
        np.tile(np.arange(4), 2), bundle.focus, bundle.origin_mm, bundle.through_mm, bundle.covariance_mm2, bundle.cage_effect_mm
    )
    assert not more_than_clutter(shared, np.ones(8, bool), np.ones(8, bool), None, 0.0).any()
