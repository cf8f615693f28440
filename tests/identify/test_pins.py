"""Pairing tips of pins, whose errors are long along the pin: with pins only, by crossings whose errors go with the direction."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pytest
from scipy.stats import poisson

from rsa_vision.geometry.rays import RayBundle, cross
from rsa_vision.identify.pairs import Pairing, pair_rays

STUDIES = 5 * int(os.environ.get("RSA_VISION_EXAMINATIONS", "24"))
FOCI = {1: np.array([-240.0, 100.0, 1120.0]), 2: np.array([240.0, 100.0, 1120.0])}
LENGTH_MM, HALF_WIDTH_MM, BALL_MM = 2.0, 0.25, 0.4
ALONG_MM, ACROSS_MM, BALL_SD_MM = (0.02, 0.3), (0.004, 0.02), 0.004  # of tips on films of 0.1 mm pixels, log-uniform
WIDTH_SD, CLUTTER_MM = 0.04, (0.15, 0.5)


@dataclass
class Images:
    """Images of a study: focus, marker (-1: none), shape, place, covariance, radius."""

    focus: list[int]
    marker: list[int]
    shape: list[str]
    place_mm: list[np.ndarray]
    covariance_mm2: list[np.ndarray]
    radius_mm: list[float]
    shared: bool

    @property
    def bundle(self) -> RayBundle:
        rows = [(i, f) for i, focus in enumerate(self.focus) for f in (FOCI if self.shared else [focus])]
        covariance = np.zeros((len(rows), 6, 6))
        covariance[:, :2, :2] = np.array([self.covariance_mm2[i] for i, _ in rows]).reshape(-1, 2, 2)
        through = np.array([[*self.place_mm[i], 0.0] for i, _ in rows]).reshape(-1, 3)
        image, focus = np.array(rows, int).reshape(-1, 2).T
        return RayBundle(image, focus, np.array([FOCI[f] for f in focus]).reshape(-1, 3), through, covariance, np.zeros((len(rows), 6, 0)))

    def pair(self) -> Pairing:
        bundle = self.bundle
        shape, radius = np.array(self.shape)[bundle.image], np.array(self.radius_mm)[bundle.image]
        return pair_rays(bundle, region=lambda x: (x[..., 2] > -2) & (x[..., 2] < 700), shape=shape, radius_mm=radius)

    def sure_pins(self, pairing: Pairing) -> Mapping[bool, list[float]]:
        """Return the posteriors of pins that are not doubted, by whether they are right."""
        bundle, result = self.bundle, {True: [], False: []}
        for group, posterior, doubted in zip(pairing.groups, pairing.posterior.tolist(), pairing.ambiguous, strict=True):
            first, second = bundle.image[list(group)]
            assert self.shape[first] == self.shape[second]
            if self.shape[first] == "pin" and not doubted:
                right = self.marker[first] == self.marker[second] >= 0
                right &= all(self.focus[bundle.image[ray]] == bundle.focus[ray] for ray in group)
                result[right].append(posterior)
        return result


def seen(focus: int, point_mm: np.ndarray) -> tuple[np.ndarray, float]:
    """Project to the plane z = 0 by similar triangles."""
    f = FOCI[focus]
    grown = f[2] / (f[2] - point_mm[2])
    return f[:2] + (point_mm[:2] - f[:2]) * grown, grown


def log_uniform(rng: np.random.Generator, bounds: tuple[float, float]) -> float:
    return float(np.exp(rng.uniform(*np.log(bounds))))


def study(
    rng: np.random.Generator, pins: int, *, hidden: int = 0, clutter: int = 0, balls: int = 0, shared: bool = False, bent_mm: float = 0.0
) -> Images:
    """Pins that point anywhere, some hidden from a focus, among balls and other pointed things at random on either film."""
    low, high = np.array([-50.0, 30.0, 30.0]), np.array([50.0, 170.0, 130.0])
    images = Images([], [], [], [], [], [], shared)
    tips, axes = low + rng.random((pins, 3)) * (high - low), rng.normal(size=(pins, 3))
    centres = low + rng.random((balls, 3)) * (high - low)
    for focus in FOCI:
        lost = rng.choice(pins, hidden, replace=False) if hidden else []
        things = [(k, tips[k], axes[k], HALF_WIDTH_MM) for k in range(pins) if k not in lost]
        things += [(-1, low + rng.random(3) * (high - low), rng.normal(size=3), log_uniform(rng, CLUTTER_MM)) for _ in range(clutter)]
        things += [(pins + k, centre, np.zeros(3), BALL_MM) for k, centre in enumerate(centres)]
        for marker, point, axis, half_width in things:
            place, grown = seen(focus, point)
            covariance = BALL_SD_MM**2 * np.eye(2)
            if axis.any():
                way = seen(focus, point + LENGTH_MM * axis / np.linalg.norm(axis))[0] - place
                length = float(np.linalg.norm(way))
                along = log_uniform(rng, ALONG_MM) * min(LENGTH_MM / length, 3.0)  # of pins that point at the focus little is seen
                covariance = log_uniform(rng, ACROSS_MM) ** 2 * np.eye(2) + along**2 * np.outer(way, way) / length**2
            images.focus.append(focus)
            images.marker.append(marker)
            images.shape.append("pin" if axis.any() else "ball")
            images.place_mm.append(rng.multivariate_normal(place, covariance + bent_mm**2 * np.eye(2)))
            images.covariance_mm2.append(covariance)
            images.radius_mm.append(half_width * grown * np.exp(rng.normal(0, WIDTH_SD)))
    return images


@pytest.mark.parametrize("turn_deg", [0.0, 30.0, 90.0])
def test_what_a_crossing_misses_by_is_the_error_across_the_base_not_along_it(turn_deg: float) -> None:
    """Rays of foci along x meet in a plane with x in it: n = y, and errors on film are (1 - t) of themselves at the crossing."""
    point, along, across = np.array([10.0, 100.0, 70.0]), 1.0, 0.01
    turn = np.deg2rad(turn_deg)
    way, side = np.array([np.cos(turn), np.sin(turn)]), np.array([-np.sin(turn), np.cos(turn)])
    covariance = [along**2 * np.outer(way, way) + across**2 * np.outer(side, side)] * 2
    places = [seen(focus, point)[0] for focus in FOCI]
    images = Images([1, 2], [0, 0], ["pin", "pin"], places, covariance, [1.0, 1.0], shared=False)
    bundle = images.bundle
    _, _, sigma = cross(bundle.rows(np.array([0])), bundle.rows(np.array([1])))
    assert sigma[0, 0] == pytest.approx(
        (1 - 70.0 / 1120.0) * np.sqrt(2 * ((along * np.sin(turn)) ** 2 + (across * np.cos(turn)) ** 2)), rel=1e-3
    )


def test_crossing_errors_of_pins_are_as_stated_in_every_direction() -> None:
    deviations = []
    for seed in range(300):
        images = study(np.random.default_rng(seed), 4)
        bundle = images.bundle
        _, distance, sigma = cross(bundle.rows(np.arange(4)), bundle.rows(np.arange(4, 8)))
        deviations.append(np.diagonal(distance / sigma))
    square = np.square(deviations).ravel()
    assert square.mean() == pytest.approx(1.0, abs=4 * np.sqrt(2 / len(square)))
    assert (square > 9).mean() < 0.006


@pytest.mark.parametrize("shared", [True, False])
@pytest.mark.parametrize(
    ("pins", "others", "named"),
    [
        (2, {}, 0.2),
        (4, {}, 0.85),
        (6, {}, 0.95),
        (6, {"balls": 7}, 0.95),
        (6, {"clutter": 1}, 0.7),
        (4, {"clutter": 2, "hidden": 1}, 0.0),
        (1, {"clutter": 3}, 0.0),
        (0, {"clutter": 2, "balls": 7}, 0.0),
    ],
    ids=["two", "four", "six", "six, balls", "six, one false", "four, two false, hidden", "mostly false", "all false"],
)
def test_wrong_pairs_of_pins_are_doubted(
    pins: int, others: dict[str, int], named: float, shared: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    right = wrong = possible = 0
    stated = 0.0
    for seed in range(STUDIES):
        images = study(np.random.default_rng(seed), pins, shared=shared, **others)
        sure = images.sure_pins(images.pair())
        right, wrong = right + len(sure[True]), wrong + len(sure[False])
        stated += sum(1 - posterior for some in sure.values() for posterior in some)
        possible += sum((1, k) in (both := set(zip(images.focus, images.marker, strict=True))) and (2, k) in both for k in range(pins))
    with capsys.disabled():
        where = "shared" if shared else "separate"
        print(f"\n{where} {pins} pins {others}: {right} of {possible} named, {wrong} wrong, stated probability of wrong ones {stated:.2f}")
    assert poisson.sf(wrong - 1, stated) > 1e-3
    assert stated <= 0.001 * (right + wrong)
    assert right >= named * possible
    if not others:
        assert wrong == 0


def test_a_ball_and_a_pin_of_one_place_are_no_marker() -> None:
    images = study(np.random.default_rng(0), 5, balls=6)
    at = next(k for k, name in enumerate(zip(images.focus, images.marker, strict=True)) if name == (2, 5))  # a ball
    images.shape[at] = "pin"
    pairing = images.pair()
    assert at in pairing.unmatched
    assert len(pairing.groups) == 5 + 5


def test_pins_leave_balls_as_they_are_and_balls_pins() -> None:
    """Each shape has looks, clutter and partners of its own."""
    images = study(np.random.default_rng(1), 5, balls=8, clutter=1)
    bundle, both = images.bundle, images.pair()
    shape, radius = np.array(images.shape)[bundle.image], np.array(images.radius_mm)[bundle.image]
    for one in ("ball", "pin"):
        mine = np.flatnonzero(shape == one)
        alone = pair_rays(bundle.rows(mine), region=lambda x: (x[..., 2] > -2) & (x[..., 2] < 700), radius_mm=radius[mine])
        told = {group: posterior for group, posterior in zip(both.groups, both.posterior.tolist(), strict=True) if shape[group[0]] == one}
        assert told == {tuple(mine[list(g)].tolist()): p for g, p in zip(alone.groups, alone.posterior.tolist(), strict=True)}


def test_an_error_of_the_rays_that_balls_show_is_that_of_pins() -> None:
    """Two pins cannot tell that a film was bent."""
    with_balls, alone = [], []
    for seed in range(40):
        images = study(np.random.default_rng(seed), 2, balls=12, bent_mm=0.08)
        bundle, pairing = images.bundle, images.pair()
        pins = np.array(images.shape)[bundle.image] == "pin"
        with_balls += [s for group, s in zip(pairing.groups, pairing.crossing_sigma.tolist(), strict=True) if pins[group[0]]]
        alone += pair_rays(bundle.rows(np.flatnonzero(pins))).crossing_sigma.tolist()
    assert np.sqrt(np.mean(np.square(with_balls))) == pytest.approx(1.0, abs=0.2)
    assert np.sqrt(np.mean(np.square(alone))) > 1.5


def test_widths_speak_for_pins_among_others_and_unknown_contrasts_do_not_silence_them() -> None:
    with_width = without = 0
    for seed in range(STUDIES // 2):
        images = study(np.random.default_rng(seed), 6, clutter=1)
        with_width += len(images.sure_pins(images.pair())[True])
        images.radius_mm = [np.nan] * len(images.radius_mm)
        without += len(images.sure_pins(images.pair())[True])
    assert with_width > 1.5 * without
