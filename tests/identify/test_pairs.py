"""Pairing object images: every wrong pair must be doubted, most right ones must not."""

from __future__ import annotations

import itertools
import os
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import poisson

from rsa_vision.geometry.rays import RayBundle
from rsa_vision.identify.alone import images_alone
from rsa_vision.identify.looks import Looks
from rsa_vision.identify.packing import pack
from rsa_vision.identify.pair_looks import log_odds_of_looks
from rsa_vision.identify.pairs import Pairing, pair_rays

EXAMINATIONS = int(os.environ.get("RSA_VISION_EXAMINATIONS", "24"))
FOCI = {1: np.array([-240.0, 100.0, 1120.0]), 2: np.array([240.0, 100.0, 1120.0]), 3: np.array([0.0, 500.0, 1050.0])}


@dataclass
class Rays:
    bundle: RayBundle
    radius_mm: np.ndarray
    contrast: np.ndarray
    marker: list[tuple[int, int]]  # (focus, marker) of every image; marker -1: false
    shared: bool

    def pair(self, *, looks: bool = True, **options: object) -> Pairing:
        return pair_rays(
            self.bundle,
            region=lambda x: (x[..., 2] > -2) & (x[..., 2] < 700),
            radius_mm=self.radius_mm if looks else None,
            contrast=self.contrast if looks else None,
            **options,  # type: ignore[arg-type]
        )

    def right(self, group: Sequence[int]) -> bool:
        names = [self.marker[self.bundle.image[row]] for row in group]
        good = all(focus == self.bundle.focus[row] for (focus, _), row in zip(names, group, strict=True))
        return good and len({marker for _, marker in names}) == 1 and names[0][1] >= 0


def rays_to(
    markers: np.ndarray,
    rng: np.random.Generator,
    *,
    foci: Sequence[int] = (1, 2),
    shared: bool = True,
    sd_mm: float = 0.003,
    hidden: int = 0,
    false: int = 0,
    radii_mm: Sequence[float] = (0.4,),
    radius_sd_mm: float = 0.005,
    extra_mm: float = 0.0,
) -> Rays:
    """Project markers to the plane z = 0 by similar triangles, with noise and false images."""
    low, high = markers.min(axis=0) - 5, markers.max(axis=0) + 5
    true_radius = rng.choice(radii_mm, len(markers))
    images = []
    for focus in foci:
        f = FOCI[focus]
        lost = set(rng.choice(len(markers), hidden, replace=False).tolist())
        some = [(m, x, true_radius[m], 0.3) for m, x in enumerate(markers) if m not in lost]
        some += [(-1, low + rng.random(3) * (high - low), rng.uniform(0.2, 0.8), rng.uniform(0.05, 0.6)) for _ in range(false)]
        for m, x, radius, contrast in some:
            grown = f[2] / (f[2] - x[2])
            at = f[:2] + (x[:2] - f[:2]) * grown + rng.normal(0, np.hypot(sd_mm, extra_mm), 2)
            images.append((focus, m, at, radius * grown + rng.normal(0, radius_sd_mm), contrast * np.exp(rng.normal(0, 0.03))))
    rows = [(i, focus) for i, image in enumerate(images) for focus in (foci if shared else [image[0]])]
    n = len(rows)
    covariance = np.zeros((n, 6, 6))
    covariance[:, 0, 0] = covariance[:, 1, 1] = sd_mm**2
    bundle = RayBundle(
        image=np.array([i for i, _ in rows]),
        focus=np.array([focus for _, focus in rows]),
        origin_mm=np.array([FOCI[focus] for _, focus in rows]),
        through_mm=np.array([[*images[i][2], 0.0] for i, _ in rows]),
        covariance_mm2=covariance,
        cage_effect_mm=np.zeros((n, 6, 0)),
    )
    return Rays(
        bundle, np.array([images[i][3] for i, _ in rows]), np.array([images[i][4] for i, _ in rows]), [im[:2] for im in images], shared
    )


def some_markers(count: int, rng: np.random.Generator) -> np.ndarray:
    return np.array([-50.0, 30.0, 30.0]) + rng.random((count, 3)) * [100.0, 140.0, 100.0]


@pytest.mark.parametrize("shared", [True, False])
@pytest.mark.parametrize(
    ("fixed", "named"),
    [({}, 0.99), ({"hidden": 2, "false": 5}, 0.9), ({"hidden": 2, "false": 40}, 0.1), ({"radii_mm": (0.4, 0.5), "false": 3}, 0.8)],
    ids=["clean", "some false", "mostly false", "two sizes"],
)
def test_wrong_pairs_are_doubted(shared: bool, fixed: dict, named: float, capsys: pytest.CaptureFixture[str]) -> None:
    count = {"right": 0, "right, doubted": 0, "wrong, doubted": 0, "wrong": 0, "possible": 0}
    stated = 0.0
    for seed in range(2 * EXAMINATIONS):
        rng = np.random.default_rng(seed)
        rays = rays_to(some_markers(13, rng), rng, shared=shared, **fixed)
        pairing = rays.pair()
        both = [m for m in range(13) if {(1, m), (2, m)} <= set(rays.marker)]
        count["possible"] += len(both)
        stated += float((1 - pairing.posterior[~pairing.ambiguous]).sum())
        for group, doubted in zip(pairing.groups, pairing.ambiguous, strict=True):
            right = rays.right(group)
            count["right"] += right and not doubted
            count["wrong"] += not right and not doubted
            count["right, doubted"] += right and bool(doubted)
            count["wrong, doubted"] += not right
        assert bool(pairing.reasons) == bool(pairing.ambiguous.any())
        used = rays.bundle.image[[row for group in pairing.groups for row in group]]
        assert len(set(used.tolist())) == len(used)
        np.testing.assert_array_equal(np.sort(np.concatenate([used, pairing.unmatched])), np.arange(len(rays.marker)))
    with capsys.disabled():
        print(f"\n{'shared' if shared else 'separate'} {fixed}: {count}, stated probability of wrong ones {stated:.2f}")
    assert count["right"] >= named * count["possible"]
    # with hidden and false images rays may meet by chance: as often as the stated posteriors say
    assert poisson.sf(count["wrong"] - 1, stated) > 1e-3
    assert stated < 0.001 * count["right"]
    if not fixed:
        assert count["wrong"] == 0


@pytest.mark.parametrize("count", [8, 13])
def test_marker_images_among_clutter_of_other_looks_are_decided(count: int) -> None:
    sure = 0
    for seed in range(20):
        rng = np.random.default_rng(seed)
        rays = rays_to(some_markers(count, rng), rng, sd_mm=0.01, false=15)
        pairing = rays.pair()
        sure += not pairing.reasons
        assert all(rays.right(g) or doubted for g, doubted in zip(pairing.groups, pairing.ambiguous, strict=True)), f"seed {seed}"
    assert sure >= 10


def test_hidden_markers_of_one_kind_are_not_sure_by_their_likeness_alone() -> None:
    """Every marker hidden from one focus or the other: what crosses does so by chance, however alike it looks."""
    sure = 0
    for seed in range(40):
        rng = np.random.default_rng(seed)
        markers = some_markers(24, rng)
        rays = rays_to(markers, rng, shared=False, sd_mm=0.01)
        keep = np.array([(focus == 1) == (marker % 2 == 0) for focus, marker in rays.marker])[rays.bundle.image]
        some = Rays(rays.bundle.rows(np.flatnonzero(keep)), rays.radius_mm[keep], rays.contrast[keep], rays.marker, False)
        sure += int((~some.pair().ambiguous).sum())
    assert sure == 0


def epipolar_twins(apart_mm: float, rng: np.random.Generator, **fixed: object) -> Rays:
    """Nine markers, two of which lie in one plane with both foci: their rays cross either way."""
    markers = some_markers(9, rng)
    middle = (FOCI[1] + FOCI[2]) / 2
    first = np.array([-10.0, 100.0, 50.0])
    towards = (middle - first) / np.linalg.norm(middle - first)
    markers[0], markers[1] = first, first + apart_mm * towards + [0.1 * apart_mm, 0.0, 0.0]
    return rays_to(markers, rng, shared=False, **fixed)  # type: ignore[arg-type]


def test_twins_in_one_epipolar_plane_are_told_by_size_or_doubted() -> None:
    decided = 0
    for seed in range(EXAMINATIONS):
        rng = np.random.default_rng(seed)
        rays = epipolar_twins(80.0, rng, radius_sd_mm=0.002)
        pairing = rays.pair()
        for group, doubted in zip(pairing.groups, pairing.ambiguous, strict=True):
            assert rays.right(group) or doubted
        decided += not pairing.reasons
        blind = rays.pair(looks=False)
        twins = [g for g, group in enumerate(blind.groups) if {rays.marker[rays.bundle.image[row]][1] for row in group} & {0, 1}]
        assert all(blind.ambiguous[g] or rays.right(blind.groups[g]) for g in twins)
        assert blind.reasons == ("pair-ambiguous",)
    assert decided > 0


def counts(rays: Rays, pairing: Pairing) -> np.ndarray:
    """Markers that are named without doubt: (rightly, wrongly)."""
    sure = [rays.right(group) for group, doubted in zip(pairing.groups, pairing.ambiguous, strict=True) if not doubted]
    return np.array([sum(sure), len(sure) - sum(sure)])


def test_images_that_no_ball_describes_make_no_marker_doubtful() -> None:
    """Threads of screws among the markers: that they were fitted badly is told, and fewer markers are doubted for them."""
    told, untold = np.zeros(2), np.zeros(2)
    for seed in range(8):
        rng = np.random.default_rng(seed)
        rays = rays_to(some_markers(13, rng), rng, sd_mm=0.01, hidden=1, false=20)
        rays.radius_mm[:], rays.contrast[:] = (
            0.4 * np.exp(rng.normal(0, 0.2, len(rays.bundle))),
            0.3 * np.exp(rng.normal(0, 0.4, len(rays.bundle))),
        )
        false = np.array([rays.marker[image][1] < 0 for image in rays.bundle.image])
        told += counts(rays, rays.pair(quality=np.where(false, 2, 0)))
        untold += counts(rays, rays.pair())
    assert told[0] > untold[0] + 10
    assert told[1] == 0


def test_contrasts_of_several_sorts_are_no_doubt() -> None:
    """Two exposures that lap on one film: a ball's contrast is a quarter of another's in one image, in the other, or in both."""
    named = np.zeros(2)
    for seed in range(8):
        rng = np.random.default_rng(seed)
        rays = rays_to(some_markers(14, rng), rng, sd_mm=0.006, hidden=1)
        focus, marker = np.array([rays.marker[image] for image in rays.bundle.image]).T
        faint = (marker % 3 == 2) | (marker % 3 == focus - 1)
        rays.contrast[faint] /= 4
        named += counts(rays, rays.pair())
    assert named[0] >= 0.9 * 8 * 12
    assert named[1] == 0


def test_a_lone_mediocre_crossing_is_doubted() -> None:
    rng = np.random.default_rng(0)
    rays = rays_to(np.array([[0.0, 100.0, 60.0]]), rng, shared=False, sd_mm=0.1, false=4)
    pairing = rays.pair()
    assert pairing.ambiguous.all()


def test_pair_beyond_the_crossing_limit_is_none() -> None:
    rng = np.random.default_rng(1)
    rays = rays_to(some_markers(8, rng), rng, shared=False)
    moved = rays.bundle.through_mm.copy()
    row = int(np.flatnonzero(rays.bundle.focus == 2)[3])
    moved[row, 1] += 0.2
    bundle = RayBundle(
        rays.bundle.image, rays.bundle.focus, rays.bundle.origin_mm, moved, rays.bundle.covariance_mm2, rays.bundle.cage_effect_mm
    )
    pairing = pair_rays(bundle, slack_mm=0.0)
    assert len(pairing.groups) == 7
    assert rays.bundle.image[row] in pairing.unmatched
    assert (pairing.crossing_sigma < 5).all()


def test_systematic_error_is_found_and_said() -> None:
    rng = np.random.default_rng(2)
    rays = rays_to(some_markers(15, rng), rng, shared=False, extra_mm=0.05)
    pairing = rays.pair()
    assert 0.02 <= pairing.slack_mm <= 0.15
    assert sum(rays.right(g) for g in pairing.groups) >= 13
    exact = rays_to(some_markers(15, rng), rng, shared=False).pair()
    assert exact.slack_mm == 0


@pytest.mark.parametrize("shared", [True, False])
def test_three_foci(shared: bool) -> None:
    whole = 0
    for seed in range(20):
        rng = np.random.default_rng(seed)
        rays = rays_to(some_markers(10, rng), rng, foci=(1, 2, 3), shared=shared, hidden=1, false=4)
        pairing = rays.pair()
        for group, doubted in zip(pairing.groups, pairing.ambiguous, strict=True):
            assert rays.right(group) or doubted, f"seed {seed}"
            whole += len(group) == 3 and rays.right(group) and not doubted
    assert whole > 100


@pytest.mark.parametrize("count", [0, 1])
def test_nothing_to_pair(count: int) -> None:
    rng = np.random.default_rng(3)
    rays = rays_to(some_markers(3, rng), rng)
    bundle = rays.bundle.rows(np.arange(count))
    pairing = pair_rays(bundle)
    assert pairing.groups == ()
    assert len(pairing.unmatched) == count
    assert pairing.reasons == ()


def test_nan_rays_are_left_out() -> None:
    rng = np.random.default_rng(4)
    rays = rays_to(some_markers(6, rng), rng, shared=False)
    through = rays.bundle.through_mm.copy()
    through[0] = np.nan
    bundle = RayBundle(
        rays.bundle.image, rays.bundle.focus, rays.bundle.origin_mm, through, rays.bundle.covariance_mm2, rays.bundle.cage_effect_mm
    )
    pairing = pair_rays(bundle)
    assert 0 in pairing.unmatched
    assert len(pairing.groups) == 5


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 4), st.integers(5, 9), st.floats(-4, 8)), min_size=1, max_size=9, unique_by=lambda g: g[:2]))
def test_posteriors_are_those_of_all_assignments(edges: list[tuple[int, int, float]]) -> None:
    groups, gain = [edge[:2] for edge in edges], np.array([edge[2] for edge in edges])
    packing = pack(groups, gain)
    weights, holds, best = [], [], (0.0, frozenset())
    for size in range(len(groups) + 1):
        for some in itertools.combinations(range(len(groups)), size):
            images = [i for g in some for i in groups[g]]
            if len(set(images)) == len(images):
                weights.append(np.exp(gain[list(some)].sum()))
                holds.append([g in some for g in range(len(groups))])
                best = max(best, (float(gain[list(some)].sum()), frozenset(some)), key=lambda item: item[0])
    expected = np.array(weights) @ np.array(holds) / np.sum(weights)
    np.testing.assert_allclose(packing.posterior, expected, rtol=1e-9, atol=1e-12)
    assert gain[packing.chosen].sum() == pytest.approx(best[0], abs=1e-9)


def test_crowd_is_bounded_and_has_no_posterior() -> None:
    rng = np.random.default_rng(5)
    groups = [(a, b) for a in range(60) for b in range(60, 120)]
    packing = pack(groups, rng.normal(2, 1, len(groups)))
    assert packing.chosen.any()
    assert np.isnan(packing.posterior).all()


def test_a_marker_with_bone_before_one_image_is_paired() -> None:
    """A contrast unlike that of the other pairs is no reason to doubt a crossing that nothing else meets."""
    for seed in range(10):
        rng = np.random.default_rng(seed)
        rays = rays_to(some_markers(13, rng), rng, shared=False, sd_mm=0.006)
        rays.contrast[:2] *= 0.4  # images of markers 0 and 1 from focus 1
        pairing = rays.pair()
        assert not pairing.reasons, f"seed {seed}"
        assert all(rays.right(group) for group in pairing.groups)


def test_images_that_all_are_disturbed_teach_as_clear_ones_do() -> None:
    rng = np.random.default_rng(4)
    rays = rays_to(some_markers(10, rng), rng, hidden=1, false=6)
    zero = np.zeros(len(rays.bundle), int)
    clear, saturated = rays.pair(quality=zero), rays.pair(quality=zero + 1)
    assert saturated.groups == clear.groups
    np.testing.assert_allclose(saturated.posterior, clear.posterior)


def test_the_only_marker_of_its_size_is_no_pair_of_strangers_if_both_images_agree() -> None:
    pairs, strangers = 10, 12
    alone_of_its_kind = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        kind = np.zeros((2 * pairs, 2))
        kind[:2] = np.log(2.0)
        of_ray = np.concatenate([kind + rng.normal(0, 0.02, kind.shape), rng.normal(0.3, 0.7, (strangers, 2))])
        n = len(of_ray)
        a, b = np.append(np.arange(0, 2 * pairs, 2), n - 2), np.append(np.arange(1, 2 * pairs, 2), n - 1)
        looks = Looks(np.arange(n), of_ray, np.zeros(n, int), a, b, np.zeros(len(a)), np.zeros(len(a)), np.zeros(n))
        paired = (np.arange(n) < 2 * pairs).astype(float)
        odds = log_odds_of_looks(looks, np.append(np.ones(pairs), 1e-6), images_alone(looks, paired), images_alone(looks.sizes, paired))
        assert (odds[1:pairs] > 2).all()
        assert odds[-1] < -1
        alone_of_its_kind.append(odds[0])
    assert np.mean(alone_of_its_kind) > -2


def test_size_still_speaks_for_a_pair_whose_contrasts_do_not_agree() -> None:
    better = 0
    for seed in range(10):
        rng = np.random.default_rng(seed)
        rays = rays_to(some_markers(9, rng), rng, shared=False, sd_mm=0.05)
        odd = next(i for i, name in enumerate(rays.marker) if name == (2, 0))
        rays.contrast[odd] *= 4
        doubt = []
        for factor in (1.0, 1.4):
            rays.radius_mm[odd] *= factor
            pairing = rays.pair()
            right = [
                p for g, p in zip(pairing.groups, pairing.posterior, strict=True) if odd in rays.bundle.image[list(g)] and rays.right(g)
            ]
            doubt.append(1 - right[0] if right else 1.0)
        better += doubt[0] < 0.5 * doubt[1]
    assert better >= 9
