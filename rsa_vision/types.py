"""The data that flows through rsa_vision, one frozen type for every arrow: film -> marker images -> named points -> rays -> 3-D markers.

Tables are structures of arrays; row ``i`` of every array belongs together. Pixel coordinates are ``(col, row)`` with (0, 0) at the centre
of the first stored pixel; laboratory coordinates are mm in the cage's frame. Covariances belong to the coordinates beside them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]
Int = NDArray[np.int64]
Bool = NDArray[np.bool_]
Str = NDArray[np.str_]


class Table:
    """Row operations shared by the structures of arrays."""

    def __len__(self) -> int:
        first: NDArray[Any] = getattr(self, fields(self)[0].name)  # type: ignore[arg-type]  # every subclass is a dataclass
        return len(first)

    def rows(self, index: NDArray[Any]) -> Self:
        """Return a new table with the rows that ``index`` (a boolean mask or integers) selects."""
        columns = {f.name: getattr(self, f.name)[index] for f in fields(self)}  # type: ignore[arg-type]  # as above
        return type(self)(**columns)


@dataclass(frozen=True, slots=True, eq=False)
class Film:
    """One radiograph as stored (no viewer rotation, no window), larger values brighter as the file declares.

    Attributes
    ----------
    values : ndarray of shape (rows, cols)
        uint8 or uint16; photometric inversion (MONOCHROME1, MINISWHITE) undone.
    bits : int
        Significant bits, 8 to 16; full scale is ``2**bits - 1``.
    pitch_mm : tuple of two floats, or None
        (row pitch, column pitch) at the detector, or None where the file does not say.
    pitch_source : str
        Where the pitch comes from, for messages and ``run.json``.
    meta : mapping
        What the file says of itself (patient, time, view), by lower-case names; may be empty.
    """

    path: Path
    values: NDArray[np.uint8] | NDArray[np.uint16]
    bits: int
    pitch_mm: tuple[float, float] | None
    pitch_source: str
    meta: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, eq=False)
class MarkerImages(Table):
    """Marker images found on one film.

    Attributes
    ----------
    position_px : ndarray of shape (n, 2)
        (col, row): centre of a ball, tip of a pin, point where the three tips of a tee meet.
    covariance_px2 : ndarray of shape (n, 2, 2)
        Covariance of (col, row).
    shape : ndarray of str, shape (n,)
        ``ball``, ``pin`` or ``tee``.
    radius_px : ndarray of shape (n,)
        Radius of a ball, half the width of the pins at their thick end.
    angle_deg : ndarray of shape (n,)
        Pin: direction from the tip to the thick end. Tee: direction of the stem (the arm without an opposite). Counter-clockwise from +col
        as displayed (row down): ``atan2(-drow, dcol)``. NaN for balls.
    contrast : ndarray of shape (n,)
        Fitted amplitude, as a part of the film's full scale, positive for either polarity: the depth of the image without blur at full
        opacity. Of marks that are small against the blur less is seen, and it may exceed 1.
    background : ndarray of shape (n,)
        What the film would be there without the mark, as a part of its full scale; NaN where not known.
    snr : ndarray of shape (n,)
        Contrast over the noise of one pixel.
    flags : ndarray of int, shape (n,)
        As :class:`rsa_vision.flags.MarkerFlag`.
    """

    position_px: Float
    covariance_px2: Float
    shape: Str
    radius_px: Float
    angle_deg: Float
    contrast: Float
    background: Float
    snr: Float
    flags: Int

    @classmethod
    def empty(cls) -> MarkerImages:
        """Return a table without rows."""
        none = np.zeros(0)
        return cls(np.zeros((0, 2)), np.zeros((0, 2, 2)), np.zeros(0, "U4"), none, none, none, none, none, np.zeros(0, np.int64))


@dataclass(frozen=True, slots=True, eq=False)
class ImagePoints(Table):
    """Named image points of one examination, all foci and films together (the left half of ``images.csv``).

    Attributes
    ----------
    focus : ndarray of int, shape (n,)
        Focus number; 0 where unassigned on a shared film.
    role : ndarray of str, shape (n,)
        ``fiducial``, ``control``, ``object`` or ``unassigned``.
    number : ndarray of str, shape (n,)
        Cage number, or ``segment/marker``; object points of different foci with the same number belong together; empty where unassigned.
    shape : ndarray of str, shape (n,)
        As in :class:`MarkerImages`; empty if not known.
    position_px, covariance_px2, flags
        As in :class:`MarkerImages`; covariance NaN where the input gave none.
    film : ndarray of int, shape (n,)
        Index into the examination's list of films.
    """

    focus: Int
    role: Str
    number: Str
    shape: Str
    position_px: Float
    covariance_px2: Float
    flags: Int
    film: Int


@dataclass(frozen=True, slots=True, eq=False)
class FocusSolution:
    """One focus after steps 1 and 2 of X-RAY.

    Attributes
    ----------
    focus : int
    plane_from_film : ndarray of shape (3, 3)
        Projective transformation from (col, row, 1) to plane coordinates (u, v, 1), last element 1 (2:1).
    position_mm : ndarray of shape (3,)
        The focus in the laboratory frame.
    covariance_mm2 : ndarray of shape (3, 3)
    fiducial_rmse_um, fiducial_max_um : float
        Root mean square and maximum of the radial errors in the fiducial plane.
    line_rmsv_um, line_max_um : float
        Root mean square and maximum of the line-to-focus distances.
    n_fiducials, n_controls : int
        Marks used, after the gross-error rules.
    fiducial_birge, control_birge : float
        Factors (1 or more) by which the standard deviations of this film's images, and on top of them of the parameters of the focus, were
        multiplied because the residuals are larger than the stated covariances predict.
    image_sd_px : float
        Standard deviation of an image coordinate by the residuals, which stands in where no covariance was given; else NaN.
    parameter_covariance : ndarray of shape (11, 11)
        Joint covariance of the first eight elements of ``plane_from_film``, row by row, and of the position, by errors of the images.
    cage_effect : ndarray of shape (11, m)
        Change of these parameters for one standard deviation of each coordinate of the cage's marks, the same marks in the same columns
        for all foci; m = 0 for a cage without standard deviations. ``covariance_mm2`` holds both parts.
    image_factor : float
        By which the images of objects are less exact than stated, on top of ``fiducial_birge``, as all marks of the film and the crossings
        show together.
    """

    focus: int
    plane_from_film: Float
    position_mm: Float
    covariance_mm2: Float
    fiducial_rmse_um: float
    fiducial_max_um: float
    line_rmsv_um: float
    line_max_um: float
    n_fiducials: int
    n_controls: int
    fiducial_birge: float
    control_birge: float
    image_sd_px: float
    parameter_covariance: Float
    cage_effect: Float
    image_factor: float = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class Markers(Table):
    """Reconstructed markers of one examination (``markers.csv``).

    Attributes
    ----------
    name : ndarray of str, shape (n,)
        ``segment/marker``.
    position_mm : ndarray of shape (n, 3)
    covariance_mm2 : ndarray of shape (n, 3, 3)
    crossing_um : ndarray of shape (n,)
        Crossing line error: length of the error vector from the ray of the first to the ray of the second focus at their closest approach
        (more foci: twice the RMS distance of the rays from the point).
    crossing_sd_um : ndarray of shape (n,)
        Its standard deviation by propagation.
    parallax_um : ndarray of shape (n,)
        y component of the error vector (two foci), else NaN.
    n_views : ndarray of int, shape (n,)
    flags : ndarray of int, shape (n,)
    """

    name: Str
    position_mm: Float
    covariance_mm2: Float
    crossing_um: Float
    crossing_sd_um: Float
    parallax_um: Float
    n_views: Int
    flags: Int


@dataclass(frozen=True, slots=True, eq=False)
class Reconstruction:
    """X-RAY of one examination: all three steps.

    Attributes
    ----------
    points : ImagePoints
        The input, flags extended.
    plane_mm : ndarray of shape (n, 3)
        Every point of ``points`` in its focus's fiducial plane, laboratory frame; NaN where the focus is unknown.
    residual_um : ndarray of shape (n,)
        Fiducial: radial error. Control: line-to-focus distance. Object: distance from its ray to the reconstructed point. Else NaN.
    used : ndarray of bool, shape (n,)
        False where a gross-error rule left the point out, or nothing was computed from it.
    foci : tuple of FocusSolution
    markers : Markers
    controls : Markers
        Control points that more than one focus sees, re-computed as object points; their errors are a check (``name`` is the cage number).
    calibration_px : float
        Error of calibrated cameras that the crossings show.
    """

    points: ImagePoints
    plane_mm: Float
    residual_um: Float
    used: Bool
    foci: tuple[FocusSolution, ...]
    markers: Markers
    controls: Markers
    calibration_px: float = 0.0
