"""Dust and the like on a ball's rim: nothing of it goes on beside the ball, and a fit without it takes most of it for a shift.

What is left of it shows in one place and not in the opposite one. The most likely speck of each ball is tested by its likelihood ratio, all
that was fitted being fitted anew with it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np

from rsa_vision.detect.balls.fits import mirrored
from rsa_vision.detect.balls.random_effects import Common, Solution
from rsa_vision.detect.film.noise import NoiseModel
from rsa_vision.detect.film.whitening import whiten, whiten_rows
from rsa_vision.detect.neighbours.pulls import Pulls, no_pulls
from rsa_vision.types import Float

_SPREADS_PX: Final = (1.0, 1.6)  # of dust as scanners draw it; half as much and twice as much are found as well
_REACH: Final = 4.0  # such spreads
_BEYOND_PX: Final = 1.0  # the rim
_SURE: Final = 4.5  # standard deviations that none of a film's places reaches by chance
_SHARE: Final = 0.5  # of the significance there is before anything else is fitted anew
_LEAST: Final = 1 / 3  # of a speck, that the fit does not take for something else: with less nothing is known of it
_HEIGHT: Final = (0.03, 0.5)  # of the ball's depth, half of a speck's: models of balls are no truer, and specks no higher than balls
_LEAST_BALLS: Final = 8  # that tell something of noise
_NOTHING: Final = 1e-30


@dataclass(frozen=True, slots=True, eq=False)
class Specks:
    """Those on some balls, at most one on each.

    Attributes
    ----------
    pulls : Pulls
    energy, kept : ndarray of shape (n,)
        Variance that specks have at the places of a ball, in units of that by noise as stated which has not been through the fit, and the
        part of it that fits leave, where it was calculated; else NaN.
    """

    pulls: Pulls
    energy: Float
    kept: Float


def how_rough(specks: list[Specks]) -> float:
    """Return the variance that specks have by noise under balls, in units of that by noise as stated; 1 where few balls tell."""
    energy, kept = (np.concatenate(of) for of in zip(*((s.energy, s.kept) for s in specks), strict=True))
    return float(np.median(energy) / np.nanmedian(kept)) if len(energy) >= _LEAST_BALLS else 1.0


def find_specks(solution: Solution, rim_px: Float, depth: Float, excess: Float, side: int, common: Common) -> Specks:
    """Look for one speck on each ball.

    Parameters
    ----------
    solution : Solution
        Of windows of ``side`` pixels.
    rim_px : ndarray of shape (n,)
        Where the images of the balls end.
    depth : ndarray of shape (n,)
    excess : ndarray of shape (n,)
        Variance around the balls, in units of the noise.
    side : int
    common : Common

    Returns
    -------
    Specks
    """
    (count, pixels), noise = solution.residual.shape, common.noise
    out = Specks(no_pulls(solution), np.zeros(count), np.full(count, np.nan))
    root, seen = np.sqrt(solution.weight), solution.weight > 0
    rows, cols = np.mgrid[0:side, 0:side].reshape(2, -1)
    opposite = mirrored(solution.local_px, side)
    near = np.hypot(cols - solution.local_px[:, :1], rows - solution.local_px[:, 1:]) < (rim_px + _BEYOND_PX)[:, None]
    near &= seen & np.take_along_axis(seen, opposite, 1)
    area = np.maximum(near.sum(axis=1), 1)
    left = whiten_rows(whiten_rows(solution.residual * root, side, noise), side, noise) * root
    by_noise = np.maximum(excess, common.rough)
    best = _SURE * np.sqrt(by_noise)
    for spread_px in _SPREADS_PX:
        told, alone = _at_every_place(left, side, spread_px), _energy(spread_px, noise) * solution.weight
        odd = told - np.take_along_axis(told, opposite, 1)
        square = np.divide(odd**2, 2 * alone, out=np.zeros_like(odd), where=near)
        out.energy[:] += square.sum(axis=1) / (len(_SPREADS_PX) * area)
        likely = near & (np.abs(odd) > _SHARE * best[:, None] * np.sqrt(2 * alone))
        for i in np.flatnonzero(likely.any(axis=1)):
            place = np.flatnonzero(near[i])
            across = opposite[i, place]
            images = _at_every_place(whiten_rows(solution.white[i], side, noise) * root[i], side, spread_px)
            taken = images[:, place] - images[:, across]
            fitted = solution.inverse[i] @ taken
            apart = np.square([cols[place] - cols[across], rows[place] - rows[across]]).sum(axis=0)
            both = 2 * np.sqrt(alone[i, place] * alone[i, across]) * np.exp(-apart / (4 * spread_px**2))
            both = alone[i, place] + alone[i, across] - both
            own = np.maximum(both - (taken * fitted).sum(axis=0), _NOTHING)
            out.kept[i] = np.mean(own / (2 * alone[i, place]))
            height = odd[i, place] / own
            of_ball = np.abs(height / depth[i])
            possible = (own > _LEAST * both) & (of_ball > _HEIGHT[0]) & (of_ball < _HEIGHT[1])
            score = np.where(possible, np.abs(height) * np.sqrt(own), 0.0)
            k = int(score.argmax())
            if score[k] < best[i]:
                continue
            best[i] = score[k]
            spots = np.zeros((1, pixels))
            spots[0, place[k]], spots[0, across[k]] = 1.0, -1.0
            both_specks = _at_every_place(spots, side, spread_px)[0]
            out.pulls.put(int(i), solution, both_specks, fitted[:, k], float(height[k]), float(by_noise[i] / own[k]))
    return out


def _at_every_place(images: Float, side: int, spread_px: float) -> Float:
    """Return the products of images (n, pixels) with a speck at every place."""
    stack = np.ascontiguousarray(images.reshape(-1, side, side).transpose(1, 2, 0))
    profile = _profile(spread_px)
    out = cv2.sepFilter2D(stack, cv2.CV_64F, profile, profile, borderType=cv2.BORDER_CONSTANT)
    return np.asarray(out.reshape(side, side, -1).transpose(2, 0, 1).reshape(images.shape))


def _profile(spread_px: float) -> Float:
    at = np.arange(-np.ceil(_REACH * spread_px), np.ceil(_REACH * spread_px) + 1)
    return np.asarray(np.exp(-0.5 * (at / spread_px) ** 2))


def _energy(spread_px: float, noise: NoiseModel) -> float:
    """Squared significance of a speck of height one where noise has variance one."""
    profile = np.pad(_profile(spread_px), len(noise.correlation))
    return float(np.square(whiten(np.outer(profile, profile), noise)).sum())
