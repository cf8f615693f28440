"""Whether the posterior of pairs is what it says: stated against observed, over the examinations of the point-level benchmark.

Every pair of every examination of the right cage (:mod:`identification`) is held against the truth, and counted by the posterior that was
stated for it. `stated wrong` is the sum of 1 - posterior: if posteriors are honest, about as many are wrong, give or take its root.
"""

from __future__ import annotations

import argparse
from itertools import pairwise
from pathlib import Path
from unittest.mock import patch

import numpy as np
from identification import CAGES, Examination, draw, measure

from rsa_vision import examination
from rsa_vision.geometry.rays import RayBundle
from rsa_vision.identify.pairs import Pairing, pair_rays

EDGES = (0.0, 0.6, 0.8, 0.9, 0.95, 0.98, 0.99, 0.995, 0.999, 0.9999, 1.0)
PAGE = Path(__file__).parents[1] / "docs" / "benchmarks" / "pair_calibration.md"


def shows_one_ball(exam: Examination, bundle: RayBundle, group: tuple[int, ...]) -> bool:
    """Return whether all rays of a group show the same ball."""
    starts = np.cumsum([0, *(len(film.images) for _, film in exam.films)])
    balls = set(range(len(exam.objects.xyz_mm)))
    for ray in group:
        number = int(np.searchsorted(starts, bundle.image[ray], "right")) - 1
        row, film = int(bundle.image[ray] - starts[number]), exam.films[number][1]
        balls &= {ball for ball in balls if film.shows(row, (int(bundle.focus[ray]), "object", ball))}
    return bool(balls)


def pairs_of(seed: int, name: str) -> list[tuple[float, bool]]:
    """Return posterior and truth of every pair of an examination; pairs without a posterior are left out."""
    exam = draw(seed, name)
    if exam.kind != "right":
        return []
    met: list[tuple[RayBundle, Pairing]] = []

    def recorded(bundle: RayBundle, *args: object, **options: object) -> Pairing:
        pairing = pair_rays(bundle, *args, **options)  # type: ignore[arg-type]  # passed on
        met.append((bundle, pairing))
        return pairing

    with patch.object(examination, "pair_rays", recorded):
        measure(exam)
    return [
        (float(posterior), shows_one_ball(exam, bundle, group))
        for bundle, pairing in met
        for group, posterior in zip(pairing.groups, pairing.posterior, strict=True)
        if np.isfinite(posterior)
    ]


def main() -> None:
    """Run the benchmark and write its page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--n", type=int, default=1000, help="examinations in all")
    parser.add_argument("--seed", type=int, default=0, help="of the first examination of each cage")
    args = parser.parse_args()
    found = [pair for k in range(args.n) for pair in pairs_of(args.seed + k // len(CAGES), CAGES[k % len(CAGES)])]
    posterior, right = np.array([p for p, _ in found]), np.array([r for _, r in found])
    text = ["# Posteriors of pairs", "", (__doc__ or "").strip().replace("(:mod:`identification`)", "([names](identification.md))"), ""]
    text += [f"Made by `python benchmarks/pair_calibration.py --n {args.n} --seed {args.seed}`.", ""]
    text += ["| stated posterior | pairs | stated wrong | wrong |", "|---|---|---|---|"]
    for low, high in pairwise(EDGES):
        here = (posterior >= low) & ((posterior < high) | (high == EDGES[-1]))
        text.append(f"| {low:g} to {high:g} | {here.sum()} | {(1 - posterior[here]).sum():.2f} | {(~right[here]).sum()} |")
    text.append(f"| all | {len(found)} | {(1 - posterior).sum():.2f} | {(~right).sum()} |")
    PAGE.write_text("\n".join([*text, ""]), encoding="utf-8")
    print("\n".join(text[-len(EDGES) - 2 :]))


if __name__ == "__main__":
    main()
