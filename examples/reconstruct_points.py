"""Reconstruct markers from image points that were measured elsewhere, one stage at a time.

    python examples/reconstruct_points.py [POINTS.csv [CAGE]]

The default is points_1A.csv beside this file: points of a synthetic film with cage 1A.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from rsa_vision import load_cage
from rsa_vision.points import read_points
from rsa_vision.settings import Limits
from rsa_vision.xray import check_controls, reconstruct

SYNTHETIC = Path(__file__).with_name("points_1A.csv")


def main(points_file: str | Path = SYNTHETIC, cage_name: str = "1A") -> None:
    """Print foci, the check by control points, and markers with their uncertainty."""
    cage = load_cage(cage_name)
    for (subject, exam), points in read_points(Path(points_file), cage).items():
        result = reconstruct(points, cage, Limits())
        print(f"{subject} {exam}")
        for focus in result.foci:
            x, y, z = focus.position_mm
            fit = f"fiducial marks {focus.fiducial_rmse_um:.1f} um, lines {focus.line_rmsv_um:.0f} um"
            print(f"  focus {focus.focus}: ({x:.2f}, {y:.2f}, {z:.2f}) mm; RMS errors: {fit}")
        check = check_controls(result, cage)
        print(f"  {len(check.number)} control points as object points: RMS error {check.radial_rms_um:.1f} um")
        markers = result.markers
        deviation = np.sqrt(np.diagonal(markers.covariance_mm2, axis1=1, axis2=2))
        for name, place, sd, crossing in zip(markers.name, markers.position_mm, deviation, markers.crossing_um, strict=True):
            coordinates = "  ".join(f"{axis} {value:9.4f} +- {s:.4f}" for axis, value, s in zip("xyz", place, sd, strict=True))
            print(f"  {name}: {coordinates} mm, rays miss each other by {crossing:.1f} um")


if __name__ == "__main__":
    main(*sys.argv[1:])
