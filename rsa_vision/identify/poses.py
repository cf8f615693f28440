"""A rigid body among points: which of its markers are which points, at which pose, and how likely that is.

The likelihood of an assignment is integrated over all poses (Laplace's approximation about the best one), so that what a pose can be made
to fit by chance is counted against it, and over how far the stated errors may be too small. Mirror images are no poses.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.special import logsumexp

from rsa_vision.errors import GeometryError
from rsa_vision.geometry.rigid import LEAST_POINTS, fit_rigid
from rsa_vision.types import Bool, Float, Int, Table

TOLERANCE_MM: Final = 0.05  # sd of a coordinate beyond the stated errors: bone is alive, markers are not exactly where they were
SCALES: Final = (1.0, 2.0, 4.0)  # stated errors may be that much too small
SCALE_PRIOR: Final = (0.9, 0.09, 0.01)
GATE: Final = 4.5  # sd within which a distance, or a marker from its predicted place, may belong
GATE_SCALE: Final = 2.0  # with the errors so much larger than stated
THIN_MM: Final = 1.0  # height of a triangle that determines no pose
ROTATION_RAD: Final = 1.0  # sd to which an undetermined rotation is known
FARTHEST_MM: Final = 3.0  # a first pose from three points predicts others no worse
MOST: Final = 400  # first poses that are refined, those with the most markers first
MOST_CLIMBED: Final = 40  # of these, from which better ones are sought
CHUNK: Final = 2000

Pairs = tuple[tuple[int, int], ...]
"""Marker and point, by rising marker; every marker and every point once at most."""


@dataclass(frozen=True, slots=True, eq=False)
class Cloud(Table):
    """Points with their errors: positions of shape (n, 3), mm, and covariances of shape (n, 3, 3), mm²."""

    position_mm: Float
    covariance_mm2: Float

    @classmethod
    def exact(cls, position_mm: Float) -> Cloud:
        """Return points without errors of their own."""
        points = np.asarray(position_mm, np.float64).reshape(-1, 3)
        return cls(points, np.zeros((len(points), 3, 3)))


@dataclass(frozen=True, slots=True, eq=False)
class Placement:
    """The pose of a body by some of its markers: ``point = rotation @ marker + translation``.

    Attributes
    ----------
    rotation : ndarray of shape (3, 3)
    translation : ndarray of shape (3,)
    centre_mm : ndarray of shape (3,)
        Mean of the body's markers used, after the motion.
    covariance : ndarray of shape (6, 6)
        Of a small rotation vector about `centre_mm` (rad) and of the shift (mm).
    log_likelihood : float
        Logarithm of the density of the points, 1/mm³ each, times mm³ rad³ of pose: integrated over poses that are all equally likely.
    sigmas : ndarray of shape (k,)
        Residual of every marker in units of its sd by the stated errors and the tolerance (root of a third of the squared length).
    """

    rotation: Float
    translation: Float
    centre_mm: Float
    covariance: Float
    log_likelihood: float
    sigmas: Float

    def predict(self, marker_mm: Float) -> tuple[Float, Float]:
        """Return where markers, shape (n, 3), are at this pose, and the covariance that the pose gives them, shape (n, 3, 3)."""
        moved = marker_mm @ self.rotation.T + self.translation
        jacobian = pose_jacobian(moved - self.centre_mm)
        return moved, jacobian @ self.covariance @ jacobian.swapaxes(-1, -2)


def pose_jacobian(arm_mm: Float) -> Float:
    """Return the derivative, shape (n, 3, 6), of moved points by rotation vector and shift; `arm_mm` (n, 3) from the centre of rotation."""
    x, y, z = np.moveaxis(arm_mm, -1, 0)
    zero = np.zeros_like(x)
    turn = np.stack([np.stack([zero, z, -y], -1), np.stack([-z, zero, x], -1), np.stack([y, -x, zero], -1)], -2)
    return np.concatenate([turn, np.broadcast_to(np.eye(3), turn.shape)], axis=-1)


def place(body: Cloud, points: Cloud, pairs: Pairs) -> Placement | None:
    """Fit the pose of a body to the points of some of its markers.

    Parameters
    ----------
    body, points : Cloud
    pairs : tuple of (marker, point)
        Three or more.

    Returns
    -------
    Placement or None
        None where the markers lie in line.

    Notes
    -----
    Least squares weighted by the covariances of both sides and :data:`TOLERANCE_MM`, linearised about the unweighted solution. With
    residuals r, covariances S and derivatives J by the pose, ``log ∫ ∏ N(r; S) dθ = Σ log N(r̂; S) + 3 log 2π − ½ log |JᵀS⁻¹J|``.
    """
    mine, theirs = np.array(pairs).T
    try:
        start = fit_rigid(body.position_mm[mine], points.position_mm[theirs])
    except GeometryError:
        return None
    rotation, translation, residual = start.rotation, start.translation, start.residual_mm
    moved = points.position_mm[theirs] - residual
    centre = moved.mean(axis=0)
    jacobian = pose_jacobian(moved - centre)
    stated = points.covariance_mm2[theirs] + rotation @ body.covariance_mm2[mine] @ rotation.T
    tolerance = TOLERANCE_MM**2 * np.eye(3)
    every = np.array(SCALES)[:, None, None, None] ** 2 * stated + tolerance  # (s, k, 3, 3)
    weight = np.linalg.inv(every)
    by_pose = weight @ jacobian  # (s, k, 3, 6)
    normal = np.einsum("kia,skib->sab", jacobian, by_pose) + np.diag([ROTATION_RAD**-2] * 3 + [0.0] * 3)
    step = np.linalg.solve(normal, np.einsum("skia,ki->sa", by_pose, residual)[..., None])[..., 0]
    left = residual - np.einsum("kia,sa->ski", jacobian, step)
    squares = np.einsum("ski,skij,skj->sk", left, weight, left)
    density = -0.5 * squares - 1.5 * np.log(2 * np.pi) - 0.5 * np.linalg.slogdet(every)[1]
    log_likelihood = density.sum(axis=1) + 3 * np.log(2 * np.pi) - 0.5 * np.linalg.slogdet(normal)[1]
    total = float(logsumexp(log_likelihood, b=SCALE_PRIOR))
    best = int(np.argmax(log_likelihood + np.log(SCALE_PRIOR)))
    covariance = np.linalg.inv(normal)
    leverage = np.einsum("kia,ab,kib->k", by_pose[0], covariance[0], jacobian) / 3
    sigmas = np.sqrt(squares[0] / 3 / np.maximum(1 - leverage, 1 / len(pairs)))
    turn = rotation_by(step[best, :3])
    rotated = turn @ rotation
    shifted = turn @ (translation - centre) + centre + step[best, 3:]
    return Placement(rotated, shifted, centre + step[best, 3:], covariance[best], total, sigmas)


def candidate_poses(body: Cloud, points: Cloud, log_worth: float) -> list[tuple[Pairs, Placement]]:
    """List the assignments of a body's markers to points that a rigid motion explains, three markers or more each.

    Parameters
    ----------
    body, points : Cloud
    log_worth : float
        Gain in log likelihood, with densities in 1/mm³, for a point that need not be explained otherwise.

    Returns
    -------
    list of (pairs, Placement)
        Every assignment once: those that grow from any three markers with the right distances, the better ones on the way from these to
        the best next to them, and all next to that (one marker left out, or on a point that is near enough).
    """
    if min(len(body), len(points)) < LEAST_POINTS:
        return []
    found: dict[Pairs, Placement | None] = {}

    def value(pairs: Pairs) -> float:
        if pairs not in found:
            found[pairs] = place(body, points, pairs) if len(pairs) >= LEAST_POINTS else None
        placement = found[pairs]
        return -np.inf if placement is None else placement.log_likelihood + len(pairs) * log_worth

    starts = {_refined(body, points, pairs) for pairs in _first_assignments(body, points)}
    climbed: set[Pairs] = set()
    for start in sorted(starts, key=lambda pairs: (-value(pairs), pairs))[:MOST_CLIMBED]:
        pairs = start
        while pairs not in climbed and (placement := found[pairs]):
            climbed.add(pairs)
            pairs = max((pairs, *_neighbours(body, points, pairs, placement)), key=value)
    return [(pairs, placement) for pairs, placement in found.items() if placement]


def volume_mm3(points: Cloud) -> float:
    """Return the volume that points fill: of the ellipsoid with their second moments, no axis much shorter than the others."""
    if len(points) < LEAST_POINTS:
        return 1.0
    axes = np.linalg.eigvalsh(np.cov(points.position_mm.T))
    return float(4 / 3 * np.pi * np.prod(np.sqrt(5 * np.maximum(axes, axes.mean() / 2) + 1.0)))


def rotation_by(vector: Float) -> Float:
    """Return the matrix of a rotation vector (Rodrigues)."""
    angle = float(np.linalg.norm(vector))
    x, y, z = vector / angle if angle > 0 else vector
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    result: Float = np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k
    return result


def distances(cloud: Cloud) -> tuple[Float, Float]:
    """Return the distances between all points, shape (n, n), and their variances by the points' own errors."""
    difference = cloud.position_mm[:, None] - cloud.position_mm[None]
    length = np.linalg.norm(difference, axis=-1)
    unit = difference / np.maximum(length, 1e-9)[..., None]
    both = cloud.covariance_mm2[:, None] + cloud.covariance_mm2[None]
    return length, np.einsum("abi,abij,abj->ab", unit, both, unit)


def _compatible(body: Cloud, points: Cloud) -> Bool:
    """Tell which pairs of markers may be which pairs of points, shape (n, n, m, m): their distances agree."""
    (mine, mine_var), (theirs, theirs_var) = distances(body), distances(points)
    variance = GATE_SCALE**2 * (mine_var[:, :, None, None] + theirs_var) + 2 * TOLERANCE_MM**2
    close: Bool = np.abs(mine[:, :, None, None] - theirs) < GATE * np.sqrt(variance)
    m = np.arange(len(points))
    close[:, :, m, m] = False
    return close


def _first_assignments(body: Cloud, points: Cloud) -> list[Pairs]:
    """Return what may belong together at the poses of all triples with the right distances, the largest first."""
    close = _compatible(body, points)
    sets: set[Pairs] = set()
    for marks, hits in _chunks(_triples(body, close)):
        sets.update(_grown(body, points, marks, hits))
    return sorted(sets, key=lambda pairs: (-len(pairs), pairs))[:MOST]


def _triples(body: Cloud, close: Bool) -> Iterator[tuple[tuple[int, int, int], Int]]:
    n = len(body)
    place_of = body.position_mm
    for i in range(n):
        for j in range(i + 1, n):
            first, second = np.nonzero(close[i, j])
            if not len(first):
                continue
            for k in range(j + 1, n):
                side = place_of[j] - place_of[i]
                longest = max(np.linalg.norm(side), np.linalg.norm(place_of[k] - place_of[i]), np.linalg.norm(place_of[k] - place_of[j]))
                if np.linalg.norm(np.cross(side, place_of[k] - place_of[i])) < THIN_MM * longest:
                    continue
                row, third = np.nonzero(close[i, k][first] & close[j, k][second])
                if len(row):
                    yield (i, j, k), np.stack([first[row], second[row], third], axis=1)


def _chunks(triples: Iterator[tuple[tuple[int, int, int], Int]]) -> Iterator[tuple[Int, Int]]:
    marks: list[Int] = []
    hits: list[Int] = []
    count = 0
    for mark, hit in triples:
        marks.append(np.tile(mark, (len(hit), 1)))
        hits.append(hit)
        count += len(hit)
        if count > CHUNK:
            yield np.concatenate(marks), np.concatenate(hits)
            marks, hits, count = [], [], 0
    if count:
        yield np.concatenate(marks), np.concatenate(hits)


def _grown(body: Cloud, points: Cloud, marks: Int, hits: Int) -> Iterator[Pairs]:
    """Yield for each triple all markers that have a point near where its pose puts them."""
    source, target = body.position_mm[marks], points.position_mm[hits]  # (t, 3, 3)
    middle, onto = source.mean(axis=1, keepdims=True), target.mean(axis=1, keepdims=True)
    left, _, right = np.linalg.svd((target - onto).swapaxes(1, 2) @ (source - middle))
    left[:, :, 2] *= np.linalg.det(left @ right)[:, None]  # a mirror image is no motion
    rotation = left @ right
    moved = (body.position_mm[None] - middle) @ rotation.swapaxes(1, 2) + onto  # (t, n, 3)
    away = np.linalg.norm(moved[:, :, None] - points.position_mm, axis=-1)  # (t, n, m)
    variance = np.trace(points.covariance_mm2, axis1=1, axis2=2).max() + np.trace(body.covariance_mm2, axis1=1, axis2=2).max()
    sd = np.sqrt(TOLERANCE_MM**2 + GATE_SCALE**2 * variance / 3)
    height = np.maximum(np.linalg.svd(source - middle, compute_uv=False)[:, 1], THIN_MM)
    arm = np.linalg.norm(body.position_mm[None] - middle, axis=-1)
    near = away < np.minimum(GATE * sd * (1 + arm / height[:, None]), FARTHEST_MM)[..., None]
    for t in range(len(marks)):
        yield _one_to_one(away[t], near[t], dict(zip(marks[t].tolist(), hits[t].tolist(), strict=True)))


def _one_to_one(cost: Float, possible: Bool, fixed: dict[int, int] | None = None) -> Pairs:
    """Return the pairs that are possible, the cheapest first, every marker and point once."""
    pairs = dict(fixed or {})
    taken = set(pairs.values())
    mine, theirs = np.nonzero(possible)
    for rank in np.argsort(cost[mine, theirs], kind="stable").tolist():
        marker, point = int(mine[rank]), int(theirs[rank])
        if marker not in pairs and point not in taken:
            pairs[marker] = point
            taken.add(point)
    return tuple(sorted(pairs.items()))


def nearness(body: Cloud, points: Cloud, placement: Placement) -> Float:
    """Return how far points are from where a pose puts markers, shape (n, m), in units of their sd (errors as in :data:`GATE_SCALE`)."""
    moved, by_pose = placement.predict(body.position_mm)
    own = placement.rotation @ body.covariance_mm2 @ placement.rotation.T
    covariance = GATE_SCALE**2 * (own[:, None] + points.covariance_mm2) + by_pose[:, None] + TOLERANCE_MM**2 * np.eye(3)
    difference = points.position_mm - moved[:, None]
    squares = (difference * np.linalg.solve(covariance, difference[..., None])[..., 0]).sum(-1)
    result: Float = np.sqrt(squares)
    return result


def _refined(body: Cloud, points: Cloud, pairs: Pairs) -> Pairs:
    """Return the assignment that its own pose leads to."""
    for _ in range(5):
        if len(pairs) < LEAST_POINTS or not (placement := place(body, points, pairs)):
            return ()
        away = nearness(body, points, placement)
        if (again := _one_to_one(away, away < GATE)) == pairs:
            break
        pairs = again
    return pairs


def _neighbours(body: Cloud, points: Cloud, pairs: Pairs, placement: Placement) -> Iterator[Pairs]:
    for pair in pairs:
        yield tuple(other for other in pairs if other != pair)
    away = nearness(body, points, placement)
    for marker, point in zip(*(index.tolist() for index in np.nonzero(away < 2 * GATE)), strict=True):
        if (marker, point) not in pairs:
            kept = [(i, a) for i, a in pairs if i != marker and a != point]
            yield tuple(sorted([*kept, (marker, point)]))
            freed = dict(pairs).get(marker)
            owner = next((i for i, a in pairs if a == point), None)
            if freed is not None and owner is not None:
                yield tuple(sorted([*kept, (marker, point), (owner, freed)]))


def disjoint(groups: Sequence[Pairs]) -> list[Pairs]:
    """Return the larger parts of assignments that overlap: each less the markers and points of another."""
    parts: dict[Pairs, None] = {}
    for one in groups:
        for other in groups:
            markers, hits = {i for i, _ in other}, {a for _, a in other}
            rest = tuple(pair for pair in one if pair[0] not in markers and pair[1] not in hits)
            if LEAST_POINTS <= len(rest) < len(one):
                parts[rest] = None
    return list(parts)
