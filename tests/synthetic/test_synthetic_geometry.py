"""Films rendered without noise lie where the truth says, for every pose and cage."""

from dataclasses import replace

import numpy as np
import polars as pl
import pytest

from rsa_vision.cages import load_cage
from synthetic.film import Pose, place_film
from synthetic.render import Beam, expose
from synthetic.scene import ObjectMarker, Scene
from synthetic.study import render_examination

CUT = 2e-6  # of the exposure: 5 sigma of blur are kept
CENTROID_PX = 0.002  # of a noiseless ball: sampling of the rays, and the bias of a ball's image under perspective (below 0.0005 px)


def centroid(picture, position, half):
    """Centroid of what is missing from 1 in a square about a position (col, row)."""
    col, row = np.rint(position).astype(int)
    window = 1.0 - picture[row - half : row + half + 1, col - half : col + half + 1].astype(float)
    rows, cols = np.mgrid[row - half : row + half + 1, col - half : col + half + 1]
    return np.array([(window * cols).sum(), (window * rows).sum()]) / window.sum()


def lone_balls(cage, foci_mm, z=(60, 130), seed=1):
    """Six balls whose images stay clear of each other, without the cage's marks."""
    rng = np.random.default_rng(seed)
    places = [(x, y) for x in (-25, 25) for y in (60, 100, 140)]
    heights = np.linspace(*z, 6)
    balls = [np.array([*place, height]) + rng.uniform(-3, 3, 3) for place, height in zip(places, heights, strict=True)]
    markers = tuple(ObjectMarker("P", str(i), ball, 0.8) for i, ball in enumerate(balls))
    return Scene(cage.model_copy(update={"mark": ()}), foci_mm, markers)


@pytest.mark.parametrize("focus", [1, 2])
@pytest.mark.parametrize(
    "pose",
    [
        Pose(),
        Pose(rotation_deg=30, shift_mm=(2.0, -3.0)),
        Pose(rotation_deg=-170, mirrored=True),
        Pose(rotation_deg=3, anisotropy=0.01, shear=0.02),
    ],
)
@pytest.mark.parametrize("name", ["1A", "2"])
def test_projection_is_the_centroid_of_the_ball(name, focus, pose):
    cage = load_cage(name)
    foci = {k: np.add(v, (3.0, -4.0, 5.0)) for k, v in cage.foci.items()}
    film = place_film(cage, foci, (focus,), pose=pose, pitch_mm=(0.1, 0.12), size_mm=(300, 300))
    scene = lone_balls(cage, foci)
    picture = expose(scene, film, Beam(falloff=False)).blurred
    errors = []
    for marker in scene.markers:
        position = film.project(foci[focus], marker.position_mm)
        errors.append(centroid(picture, position, 14) - position)
    assert np.abs(errors).max() < CENTROID_PX


@pytest.mark.parametrize("past_edge_px", [-6, -2, 0, 2, 6, 15, 40])
def test_shadows_are_cut_at_the_edge_of_the_film(past_edge_px):
    """A small film gets the same exposure as that part of a larger one (the width is no multiple of a tile's)."""
    cage = load_cage("2")
    foci = {k: np.array(v, float) for k, v in cage.foci.items()}
    ball = ObjectMarker("P", "1", np.array([0.0, 100.0, 50.0]), 0.8)
    scene = Scene(cage.model_copy(update={"mark": ()}), foci, (ball,))
    large = place_film(cage, foci, (1,), size_mm=(40, 40))
    position = large.project(foci[1], ball.position_mm)
    whole = expose(scene, large, Beam(falloff=False)).blurred
    cols = int(position[0]) - past_edge_px
    small = expose(scene, replace(large, shape=(large.shape[0], cols)), Beam(falloff=False)).blurred
    assert small == pytest.approx(whole[:, :cols], abs=CUT)


def test_double_peaked_spot_keeps_its_centroid_and_widens_the_image():
    cage = load_cage("1A")
    foci = {k: np.array(v, float) for k, v in cage.foci.items()}
    film = place_film(cage, foci, (1,), size_mm=(400, 300))
    scene = lone_balls(cage, foci, z=(400, 410))
    position = film.project(foci[1], scene.markers[0].position_mm)
    widths = {}
    for double in (False, True):
        picture = expose(scene, film, Beam(double_peaked=double, falloff=False)).blurred
        assert np.abs(centroid(picture, position, 25) - position).max() < CENTROID_PX
        col, row = np.rint(position).astype(int)
        profile = 1.0 - picture[row - 25 : row + 26, col - 25 : col + 26].astype(float).sum(0) / 51
        offset = np.arange(-25, 26) + col - position[0]
        widths[double] = (profile * offset**2).sum() / profile.sum()
    assert widths[True] > widths[False] + 0.5  # px^2


def test_shadow_of_a_ball_is_what_its_chords_absorb():
    cage = load_cage("2")
    foci = {k: np.array(v, float) for k, v in cage.foci.items()}
    film = place_film(cage, foci, (1,))
    radius, mu = 0.4, 3.0
    ball = ObjectMarker("P", "1", np.array([0.0, 100.0, 50.0]), 2 * radius)
    scene = Scene(cage.model_copy(update={"mark": ()}), foci, (ball,), attenuation_per_mm=mu)
    exposure = expose(scene, film, Beam(falloff=False))
    magnification = (foci[1][2] + 10) / (foci[1][2] - 50)
    rho = (np.arange(100_000) + 0.5) / 100_000 * radius  # integral of 1 - exp(-mu chord) over the disc
    absorbed = (2 * np.pi * rho * (1 - np.exp(-2 * mu * np.sqrt(radius**2 - rho**2)))).mean() * radius
    expected_px = absorbed * magnification**2 / 0.01
    assert (1 - exposure.incident.astype(float)).sum() == pytest.approx(expected_px, rel=2e-3)
    assert (1 - exposure.blurred.astype(float)).sum() == pytest.approx(expected_px, rel=2e-3)


def test_conventions_of_upright_mirrored_and_turned_films():
    cage = load_cage("1A")
    foci = {k: np.array(v, float) for k, v in cage.foci.items()}
    low, right, high = np.array([[0.0, 0, 0], [65, 0, 0], [0, 200, 0]])

    def steps(**pose):
        film = place_film(cage, foci, (1, 2), pose=Pose(**pose))
        a, b, c = (film.project(foci[1], point) for point in (low, right, high))
        return (b - a) / np.linalg.norm(b - a), (c - a) / np.linalg.norm(c - a)

    for pose, u_way, v_way in [
        ({}, (1, 0), (0, -1)),  # u to the right, v up: rows count downwards
        ({"mirrored": True}, (-1, 0), (0, -1)),
        ({"rotation_deg": 90}, (0, -1), (-1, 0)),  # counter-clockwise: what pointed right points up
    ]:
        assert np.array(steps(**pose)) == pytest.approx(np.array([u_way, v_way]), abs=1e-12)


@pytest.mark.parametrize(("name", "shared", "files"), [("1A", None, 1), ("1A", False, 2), ("1B", None, 1), ("2", None, 2)])
def test_truth_by_hand(name, shared, files):
    """Every image of the truth, found with similar triangles and the pose's matrix alone."""
    options = {"n_objects": 3, "shared": shared, "rotation_deg": 5, "shift_mm": (1, 2), "quanta": None, "fine": 1}
    shot = render_examination(name, rng=np.random.default_rng(3), **options)
    cage = load_cage(name)
    assert len(shot.films) == files
    by_number = {(m.role, str(m.number), f): np.array(m.xyz) for m in cage.mark for f in m.foci}
    by_name = {f"{m.segment}/{m.marker}": m.position_mm for m in shot.scene.markers}
    turn = np.radians(5)
    for row in shot.images.filter(pl.col("role") != "unassigned").iter_rows(named=True):
        point = by_name[row["number"]] if row["role"] == "object" else by_number[row["role"], row["number"], row["focus"]]
        fx, fy, fz = shot.scene.foci_mm[row["focus"]]
        x, y, z = point
        if name == "2" and row["focus"] == 2:
            k = (135 - fx) / (x - fx)
            u, v = fz + k * (z - fz), fy + k * (y - fy)
            fiducial = (125, fy + (125 - fx) / (x - fx) * (y - fy), fz + (125 - fx) / (x - fx) * (z - fz))
        else:
            depth = 8.0 if name == "1B" else 10.0
            k = (fz + depth) / (fz - z)
            u, v = fx + k * (x - fx), fy + k * (y - fy)
            fiducial = (fx + fz / (fz - z) * (x - fx), fy + fz / (fz - z) * (y - fy), 0)
        film = shot.planes[row["file"]]
        middle = film.origin_mm @ film.axes[:2].T
        du, dv = np.array([u, v]) - middle
        rows, cols = shot.films[row["file"]].shape
        col = (cols - 1) / 2 + 10 * (1 + np.cos(turn) * du - np.sin(turn) * dv)
        line = (rows - 1) / 2 + 10 * (2 - np.sin(turn) * du - np.cos(turn) * dv)
        assert (row["col_px"], row["row_px"]) == pytest.approx((col, line), abs=1e-9)
        assert (row["x_mm"], row["y_mm"], row["z_mm"]) == pytest.approx(fiducial, abs=1e-9)


def test_tee_and_pin_fade_out_at_their_tips():
    """Near the tip of a pin the shadow thins out with the square of the distance; it ends flat and dark."""
    cage = load_cage("1A")
    foci = {1: np.array([0.0, 100.0, 1100.0])}
    film = place_film(cage, foci, (1,))
    pin = ObjectMarker("P", "1", np.array([0.0, 100.0, 0.0]), 0.5, arms=((1.0, 0.0, 0.0),), length_mm=2.0)
    scene = Scene(cage.model_copy(update={"mark": ()}), foci, (pin,), attenuation_per_mm=0.01)  # thin: shadow ~ volume
    shadow = 1 - expose(scene, film, Beam(falloff=False), blur_mm=0.0).blurred.astype(float)
    tip = film.project(foci[1], pin.position_mm)
    row = int(np.rint(tip[1]))
    along = shadow[row - 8 : row + 9].sum(0)
    distance_mm = 0.1 * (np.arange(len(along)) - tip[0]) / (1110 / 1100)
    inside = (distance_mm > 0.3) & (distance_mm < 1.8)
    area_mm2 = np.pi * (0.25 * distance_mm[inside] / 2.0) ** 2
    assert along[inside] == pytest.approx(0.01 * area_mm2 * (1110 / 1100) / 0.1, rel=0.02)
    assert np.abs(along[(distance_mm < -0.1) | (distance_mm > 2.1)]).max() < 1e-7
