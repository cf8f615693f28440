"""What may pass for a tee, and what may not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from rsa_vision.detect import detect_markers
from rsa_vision.detect.balls.decide import faint_beside
from rsa_vision.detect.balls.find import fit_at
from rsa_vision.detect.film.noise import NoiseModel, estimate_noise
from rsa_vision.detect.film.whitening import Filter
from rsa_vision.detect.models.needles import NeedleFit, NeedleShape
from rsa_vision.detect.models.profiles import Optics
from rsa_vision.detect.needles import shared, tees
from rsa_vision.detect.needles.arms import perhaps_arms
from rsa_vision.detect.needles.ends import arms_go_on
from rsa_vision.detect.needles.noise_along import noise_under_needles
from rsa_vision.detect.needles.optics import GUESS
from rsa_vision.detect.needles.tees import find_tees, first_tees, is_tee, optics_of_tees
from rsa_vision.detect.search.candidates import find_candidates
from rsa_vision.types import Float

from .films import film_of_balls, stored
from .test_covered import CELLS, SIDE, SIGMA_PX, check, exposed, light_past_tees, tips_of

_TEE = NeedleFit(
    np.zeros(2), np.array([0.0, np.pi / 2, -np.pi / 2]), NeedleShape(2.0, 16.0), np.full(3, -900.0), -900.0, 4e4, np.eye(2) * 1e-4, 190,
    1.0, 1.0, 0.98, 1.0, 0.0, 80.0, True,
)  # fmt: skip


def test_arms_of_a_few_pixels_are_no_tee() -> None:
    assert is_tee(_TEE)
    assert not is_tee(replace(_TEE, n_core=10))  # within a ball three short arms explain all of their ten pixels
    assert not is_tee(replace(_TEE, shape=NeedleShape(1.6, 5.2)))


def test_what_faint_junctions_seed_has_to_be_a_set() -> None:
    alike = [replace(_TEE, angles=_TEE.angles + 0.02 * k, shape=NeedleShape(2.0 + 0.05 * k, 16.0)) for k in range(6)]
    assert tees._is_a_set(alike)
    assert not tees._is_a_set(alike[:4])
    assert not tees._is_a_set([replace(t, angles=t.angles + 0.5 * k) for k, t in enumerate(alike)])
    assert not tees._is_a_set([replace(t, shape=NeedleShape(0.6 * 1.5**k, 16.0)) for k, t in enumerate(alike)])  # as trabeculae are


@pytest.mark.parametrize(("reach", "on"), [(17.0, False), (60.0, True)])
def test_arms_that_go_on_beyond_their_ends_are_wires(reach: float, on: bool) -> None:
    rows, cols = np.mgrid[0:121, 0:121] - 60.0
    bars = ((np.abs(cols) < 2) & (np.abs(rows) < reach) & (rows > -2)) | ((np.abs(rows) < 2) & (np.abs(cols) < reach))
    film = np.rint(40000 - 20000 * gaussian_filter(bars.astype(float), SIGMA_PX)).astype(np.uint16)
    angles, shape = np.array([-np.pi / 2, 0.0, np.pi]), NeedleShape(2.0, 17.0)
    fit = replace(_TEE, position_px=np.array([60.0, 60.0]), angles=angles, shape=shape)
    assert arms_go_on(film, fit, Optics(SIGMA_PX, 0.5), None) == on
    film[:, np.abs(cols[0]) > 17] = 40000
    assert not arms_go_on(film, fit, Optics(SIGMA_PX, 0.5), None)  # one arm may point at something by chance


def test_balls_are_not_faint_beside_thin_needles() -> None:
    """Their depth is what full opacity would come to; five crossings of wires hid all 49 balls of a film."""
    film = stored(film_of_balls((400, 400), np.array([[100.0, 100.0], [300.0, 100.0], [200.0, 300.0]]), np.full(3, 4.0), noise_sd=300.0))
    noise = estimate_noise(film, 16)
    balls = fit_at(film, np.array([[100.0, 100.0]]), np.array([4.0]), Optics(1.0, 0.5), noise)
    thin = replace(_TEE, depth=-3e5, height=1.5e4)
    assert not faint_beside(balls, [thin] * 5, 1.0, noise).any()
    assert faint_beside(balls, [replace(thin, height=3e5)] * 5, 1.0, noise).all()


def test_nothing_left_of_what_looked_like_tees_is_no_error(monkeypatch: pytest.MonkeyPatch) -> None:
    film = np.full((300, 300), 1000, np.uint16)
    model = replace(_TEE, position_px=np.array([150.0, 150.0]), depth=-90.0, background=1e3)
    monkeypatch.setattr(tees, "_models", lambda *_: ([model], []))
    monkeypatch.setattr(tees, "_like", lambda *_: [])
    optics = Optics(1.0, 0.5)
    assert find_tees(film, np.zeros((1, 5)), np.zeros((0, 6)), optics, estimate_noise(film, 16)) == ([], [], optics)


@pytest.mark.parametrize("count", [1, 9])
def test_tees_that_point_anywhere_are_tees(count: int) -> None:
    for seed in range(2):
        rng = np.random.default_rng(100 * count + seed)
        tips = rng.permutation(tips_of(rng))[:count]
        film = exposed(light_past_tees(tips, np.ones(count), turned=rng.uniform(0, 2 * np.pi, count)), rng)
        check(detect_markers(film, bits=16).images, tips, list(range(count)))


def test_twins_that_come_together_are_one() -> None:
    faint, near, other = (
        replace(_TEE, position_px=np.array([by, 0.0]), depth=of) for by, of in ((0.0, -400.0), (0.5, -600.0), (2.0, -500.0))
    )
    assert [t.depth for t in tees._one_each([faint, near, other])] == [near.depth, other.depth]


@pytest.mark.parametrize("seed", range(2))
def test_blur_comes_from_clean_tees_where_crossing_arms_look_stronger(seed: int) -> None:
    rng = np.random.default_rng(seed)
    clean, crossed = np.split(tips_of(rng), [4])
    beside = crossed + np.array([17.0, -20.0]) * rng.choice([-1, 1], (len(crossed), 1))
    tips = np.concatenate([clean, crossed, beside])
    film = exposed(light_past_tees(tips, np.ones(len(tips))), rng)
    noise = estimate_noise(film, 16)
    junctions = find_candidates(film, noise).junctions
    gap = np.hypot(*(junctions[:, None, :2] - tips).transpose(2, 0, 1)).min(axis=1)
    junctions[gap > 6.0, 4] *= 100.0
    assert np.count_nonzero(gap > 6.0) > 6
    optics, evidence = optics_of_tees(film, first_tees(film, junctions, noise), noise)
    assert evidence > 100
    assert 0.8 < optics.sigma_px / np.hypot(SIGMA_PX, np.sqrt(1 / 12)) < 1.25


@pytest.mark.parametrize("seed", range(2))
def test_arms_of_a_large_tee_that_look_like_a_turned_one_do_not_hide_it(seed: int) -> None:
    """The widest ring of junctions is half as long as its arms: another junction lies on its bar, and half of the tees became pins."""
    rng = np.random.default_rng(seed)
    tips = tips_of(rng)[:4]
    check(detect_markers(exposed(light_past_tees(tips, np.ones(4), pitch_mm=0.055), rng), bits=16).images, tips, list(range(4)))


@pytest.mark.parametrize("seed", range(2))
def test_noise_under_tees_that_no_tile_of_the_film_tells(seed: int) -> None:
    """One over the exposure, as of light through a film: twenty times the variance under tees."""
    rng = np.random.default_rng(seed)
    tips = tips_of(rng)
    seen = 0.3 + 0.7 * gaussian_filter(light_past_tees(tips, np.ones(len(tips))), SIGMA_PX)
    counts = rng.poisson(seen * 120.0) / 120.0
    film = np.clip(np.rint(10000 / counts), 0, 65535).astype(np.uint16)
    noise = estimate_noise(film, 16)
    junctions = find_candidates(film, noise).junctions
    told = noise_under_needles(film, first_tees(film, junctions[junctions[:, 4] < 0], noise), GUESS, noise)
    top = told.level[-1]
    expected = (noise.variance_at(noise.level[-1:]) * (top / noise.level[-1]) ** 3)[0]
    print(f"variance at {top:.0f} over the expected: {told.variance[-1] / expected:.2f}")
    assert top > 2 * noise.level[-1]
    assert 0.5 < told.variance[-1] / expected < 2.0
    found = detect_markers(film, bits=16)
    assert not found.dark_markers
    check(found.images, tips, list(range(len(tips))))


@pytest.mark.parametrize(("sigma_px", "seed"), [(1.0, 8), (1.3, 5), (1.3, 9)])
def test_bright_tees_in_transmitted_light(sigma_px: float, seed: int) -> None:
    """A curve so bent that steps of the common fit went astray, all tees with them, or one that was thin and `unlike` then."""
    rng = np.random.default_rng(seed)
    tips = tips_of(rng)
    exposure = 0.8 * (1 - 0.9 * (1 - gaussian_filter(light_past_tees(tips, np.ones(len(tips))), sigma_px)))
    light = 10 ** -(3.0 / (1 + (0.7 / exposure) ** 2.2))
    film = 65535 * (light + np.ptp(light) / 20 * rng.standard_normal(light.shape) + 0.1)
    found = detect_markers(np.clip(np.rint(film), 0, 65535).astype(np.uint16), bits=16).images
    check(found, tips, list(range(len(tips))))
    assert (found.flags == 0).all()


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_one_in_film_that_is_saturated_around_it_leaves_the_others_their_errors() -> None:
    rng = np.random.default_rng(3)
    tips = tips_of(rng)
    lit, half = np.ones((SIDE, SIDE)), SIDE // CELLS // 2
    col, row = tips[5].astype(int)
    lit[row - half : row + half, col - half : col + half] = 3.0  # of this tee only the cores of the arms are below the end of the values
    film = exposed(light_past_tees(tips, np.ones(len(tips))), rng)
    found = detect_markers(np.minimum(film * lit, 65535).astype(np.uint16), bits=16).images
    apart = found.position_px - tips[:, None]
    nearest = np.hypot(*apart.transpose(2, 0, 1)).argmin(axis=1)
    assert (np.hypot(*apart[np.arange(len(tips)), nearest].T) < 0.2).all()
    error = apart[np.arange(len(tips)), nearest]
    assert (np.einsum("ni,nij,nj->n", error, np.linalg.inv(found.covariance_px2[nearest]), error) < 13.8).all()


@pytest.mark.parametrize("gain", [3.0, 4.0])
def test_saturated_all_over_but_for_the_cores_of_the_arms(gain: float) -> None:
    """Windows of a few pixels are left."""
    rng = np.random.default_rng(0)
    tips = tips_of(rng)
    film = exposed(light_past_tees(tips, np.ones(len(tips))), rng) * gain
    found = detect_markers(np.minimum(film, 65535).astype(np.uint16), bits=16).images
    apart = found.position_px - tips[:, None]
    gap = np.hypot(*apart.transpose(2, 0, 1))
    for i in np.flatnonzero(found.flags == 0):
        error = apart[gap[:, i].argmin(), i]
        assert error @ np.linalg.solve(found.covariance_px2[i], error) < 13.8


@pytest.mark.parametrize("seed", range(2))
def test_on_shaded_film_that_is_linear_in_exposure(seed: int) -> None:
    """Arms take away more where there is more light: as if all of an arm were as deep, tips were 0.09 px off at a fifth of that stated."""
    rng = np.random.default_rng(seed)
    tips = tips_of(rng)
    shade = 1 + 0.4 * np.sin(np.arange(SIDE) / 25.0)
    found = detect_markers(exposed(light_past_tees(tips, np.ones(len(tips))) * shade, rng), bits=16).images
    nearest = np.hypot(*(found.position_px - tips[:, None]).transpose(2, 0, 1)).argmin(axis=1)
    error = found.position_px[nearest] - tips
    z2 = np.einsum("ni,nij,nj->n", error, np.linalg.inv(found.covariance_px2[nearest]), error)
    print(f"RMS {np.sqrt((error**2).mean()):.3f} px, error / sd {np.sqrt(z2.mean() / 2):.2f}")
    assert np.sqrt((error**2).mean()) < 0.04
    assert z2.mean() / 2 < 1.5**2


def test_what_bone_does_slowly_is_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    quietest, measured = shared.quietest, {}
    films = [_tees_on_bone(np.random.default_rng(seed)) for seed in range(2)]
    for name, choose in (("fine", quietest), ("all", lambda film, windows, systems, noise: Filter(noise))):
        monkeypatch.setattr(shared, "quietest", choose)
        error, covariance = (np.concatenate(parts) for parts in zip(*(_missed(*film) for film in films), strict=True))
        ratio = np.sqrt(np.einsum("ni,nij,nj->n", error, np.linalg.inv(covariance), error).mean() / 2)
        measured[name] = (error**2).mean(), np.median(np.trace(covariance, axis1=1, axis2=2)), ratio
        print(f"{name}: RMS {np.sqrt(measured[name][0]):.4f} px, error / sd {ratio:.2f}")
    assert measured["fine"][0] < measured["all"][0]
    assert measured["fine"][1] < 0.7 * measured["all"][1]
    assert 0.8 < measured["fine"][2] < 1.2


def _tees_on_bone(rng: np.random.Generator) -> tuple[NDArray[np.uint16], Float]:
    """Return a film of waves as long as the arms of tees and longer, and the tips on it."""
    tips = tips_of(rng)
    waves = [gaussian_filter(rng.standard_normal((SIDE, SIDE)), px) for px in (75, 20)]
    bone = np.exp(0.22 * waves[0] / waves[0].std() + 0.07 * waves[1] / waves[1].std())
    light = gaussian_filter(light_past_tees(tips, np.ones(len(tips)), 0.0625) * bone, SIGMA_PX)
    return np.clip(25000 * light * (1 + 0.03 * rng.standard_normal(light.shape)), 0, 65535).astype(np.uint16), tips


def _missed(film: NDArray[np.uint16], tips: Float) -> tuple[Float, Float]:
    """Return the errors of tips and their covariances."""
    found = detect_markers(film, bits=16).images
    nearest = np.hypot(*(found.position_px - tips[:, None]).transpose(2, 0, 1)).argmin(axis=1)
    return found.position_px[nearest] - tips, found.covariance_px2[nearest]


def _found(seed: int) -> tuple[NDArray[np.uint16], Float, list[NeedleFit], Optics, NoiseModel]:
    """Return a film, where the tips of its tees are, and what is found."""
    rng = np.random.default_rng(seed)
    tips = tips_of(rng)
    film = exposed(light_past_tees(tips, np.ones(len(tips))), rng)
    noise = estimate_noise(film, 16)
    candidates = find_candidates(film, noise)
    found, _, optics = find_tees(film, candidates.junctions, candidates.strokes, Optics(SIGMA_PX, 0.8), noise)
    return film, tips, found, optics, noise


def test_what_is_blotted_out_beside_tees_does_not_tell_what_bone_does_to_them() -> None:
    """What lies over tees is blotted out of the film while those under it are fitted: all of a film had no covariance."""
    film, tips, found, optics, noise = _found(8)
    bare = film.astype(np.float64)
    for col, row in np.rint(tips[::3] + np.array([SIDE / (2 * CELLS), 0])).astype(int):
        bare[row - 8 : row + 9, col - 8 : col + 9] = np.nan
    fitted, _ = shared.fit_shared(bare, found, optics, noise, parallel=True)
    assert len(fitted) == len(tips)
    assert np.isfinite([f.covariance_px2 for f in fitted]).all()


def test_needles_that_are_fitted_together_stay_in_their_order() -> None:
    """Sets whose arms cross are fitted in one go, wherever in the list they are."""
    film, _, found, optics, noise = _found(3)
    beside = min(found[1:], key=lambda t: float(np.hypot(*(t.position_px - found[0].position_px))))
    between = [t for t in found if t is not found[0] and t is not beside]
    longer = [replace(t, shape=replace(t.shape, length_px=1.6 * t.shape.length_px)) for t in (found[0], *between[:3], beside)]
    fitted, _ = shared.fit_shared(film, longer, optics, noise, parallel=True)
    gap = np.hypot(*np.transpose([a.position_px - b.position_px for a, b in zip(fitted, longer, strict=True)]))
    assert gap.max() < 2.0


@pytest.mark.parametrize(("cnr", "pitch_mm"), [(200.0, 0.058), (50.0, 0.058), (50.0, 0.1)])
def test_tees_alone_in_little_noise(cnr: float, pitch_mm: float) -> None:
    """What surrounds them passed for tees of the other polarity, one for two where blur was guessed, misfits of balls for noise."""
    z2 = []
    for seed in range(2):
        rng = np.random.default_rng(seed)
        tips = tips_of(rng)
        light = gaussian_filter(light_past_tees(tips, np.ones(len(tips)), pitch_mm=pitch_mm), 1.2)
        noise_sd = 40000 * (1 - light.min()) / cnr
        film = stored(40000 * light + noise_sd * rng.standard_normal(light.shape))
        found = detect_markers(film, bits=16)
        assert found.dark_markers
        check(found.images, tips, [])
        noise = found.noise.variance_at(np.array([40000.0, 40000 * light.min()])) / noise_sd**2
        assert noise.max() < 1.5
        nearest = np.hypot(*(found.images.position_px - tips[:, None]).transpose(2, 0, 1)).argmin(axis=1)
        error = found.images.position_px[nearest] - tips
        z2.append(np.einsum("ni,nij,nj->n", error, np.linalg.inv(found.images.covariance_px2[nearest]), error))
    ratio = np.sqrt(np.mean(z2) / 2)
    print(f"CNR {cnr}, pitch {pitch_mm}: error / sd {ratio:.2f}, largest {np.sqrt(np.max(z2)):.1f}")
    assert 0.7 < ratio < (1.3 if cnr < 100 else 2.0)  # of so little noise samples of a ninth of a pixel are more


def film_with_shafts(rng: np.random.Generator, deep: float, thick: float, edge_px: float) -> tuple[NDArray[np.uint16], Float]:
    """Tees over four shafts of bone on a logarithmic film, brighter than around: the film and the tips.

    ``deep``: what tees absorb; ``thick``: absorption of the shafts, whose edges are so wide.
    """
    tips = tips_of(rng)
    clear = light_past_tees(tips, np.full(len(tips), deep))
    cols, shafts = np.arange(SIDE), np.zeros(SIDE)
    for middle in (np.arange(CELLS) + 0.5) * SIDE / CELLS:
        left, half = middle + rng.uniform(-20, 20), rng.uniform(25, 45)
        shafts += 1 / (1 + np.exp(-(cols - left + half) / edge_px)) - 1 / (1 + np.exp(-(cols - left - half) / edge_px))
    light = 0.9 * np.exp(-thick * shafts) * gaussian_filter(clear, SIGMA_PX)
    return np.rint(30000 - 9000 * np.log(np.maximum(rng.poisson(8000 * light), 1) / 8000)).astype(np.uint16), tips


@pytest.mark.parametrize(("deep", "thick", "edge_px", "lost"), [(0.5, 2.5, 8.0, 0), (0.3, 1.0, 4.0, 2)])
def test_tees_over_bones_are_no_pins(deep: float, thick: float, edge_px: float, lost: int) -> None:
    """Slopes hid what a window looks like: of 32 tees 26 and 20 were lost, and arms of most of these were pins without a flag."""
    missing = 0
    for seed in (0, 5):
        film, tips = film_with_shafts(np.random.default_rng(seed), deep, thick, edge_px)
        found = detect_markers(film, bits=16).images
        assert not ((found.shape != "tee") & (found.flags == 0)).any()
        found = found.rows(found.shape == "tee")
        error = found.position_px - tips[np.hypot(*(found.position_px[:, None] - tips).transpose(2, 0, 1)).argmin(axis=1)]
        z2 = np.einsum("ni,ni->n", error, np.linalg.solve(found.covariance_px2, error[:, :, None])[:, :, 0])
        print(f"{len(found)} of {len(tips)}, {np.count_nonzero(found.flags)} flagged, largest {np.sqrt(z2.max()):.1f} sd")
        missing += len(tips) - len(found)
        assert z2.max() < 20.0
    assert missing <= lost


def test_what_lies_between_bright_arms_is_no_dark_tee() -> None:
    film, _ = film_with_shafts(np.random.default_rng(0), 0.5, 1.0, 6.0)
    noise = estimate_noise(film, 16)
    found = find_candidates(film, noise).junctions
    bright = found[found[:, 4] < 0]
    assert first_tees(film, bright, noise)
    turned = bright * [1, 1, 1, 1, -1]  # as if the search had answered to something dark there
    assert not first_tees(film, turned, noise)


def test_pins_at_whose_tips_three_arms_meet_say_so() -> None:
    pin = replace(_TEE, angles=np.array([np.pi / 2]), depths=np.full(1, -900.0), position_px=np.array([50.0, 50.0]))
    meeting = np.array([[52.0, 49.0, 0.1, 9.0, 4.0]])  # stem to the right, so that an arm points up
    assert perhaps_arms([pin], meeting).tolist() == [True]
    assert perhaps_arms([pin], meeting + np.array([30.0, 0, 0, 0, 0])).tolist() == [False]
    assert perhaps_arms([replace(pin, angles=np.array([np.pi / 4]))], meeting).tolist() == [False]
    assert perhaps_arms([pin], np.zeros((0, 5))).tolist() == [False]


def test_pins_that_begin_at_one_place_may_be_arms_of_a_tee() -> None:
    pin = replace(_TEE, angles=np.array([np.pi / 2]), depths=np.full(1, -900.0), position_px=np.array([50.0, 50.0]))
    width = 2 * pin.shape.half_width_px
    other, third = (replace(pin, angles=np.zeros(1), position_px=np.array([50.0 + by * width, 50.0])) for by in (0.9, 3.0))
    assert perhaps_arms([pin, other, third], np.zeros((0, 5))).tolist() == [True, True, False]


@pytest.mark.parametrize(
    ("gap", "turn", "told"), [(0.4, 0.0, True), (0.4, 0.15, True), (0.4, 0.5, False), (0.8, 0.0, False), (-0.4, 0.0, False)]
)
def test_pins_that_face_each_other_across_a_gap_may_be_arms_of_a_tee(gap: float, turn: float, told: bool) -> None:
    pin = replace(_TEE, angles=np.zeros(1), depths=np.full(1, -900.0), position_px=np.array([50.0, 50.0]))
    across = np.array([-gap * pin.shape.length_px, 0.0])  # of the other tip, which lies before this one's
    other = replace(pin, angles=np.array([np.pi + turn]), position_px=pin.position_px + across)
    assert perhaps_arms([pin, other], np.zeros((0, 5))).tolist() == [told, told]
