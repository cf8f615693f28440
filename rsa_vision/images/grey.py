"""From decoded samples to one grey array."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsa_vision.errors import FilmError, FilmFormatError
from rsa_vision.images.header import MIN_BITS

Pixels = NDArray[np.uint8] | NDArray[np.uint16]


def to_grey(values: NDArray[Any], bits: int, path: Path, *, inverted: bool = False) -> tuple[Pixels, int]:
    """Return decoded samples as one grey array.

    Parameters
    ----------
    values : ndarray of shape (rows, cols) or (rows, cols, samples)
        Integers of 8 or 16 bits; of two or four samples the last is opacity.
    bits : int
        Significant bits as declared.
    path : Path
        For messages.
    inverted : bool
        Whether low values are bright.

    Returns
    -------
    values : ndarray of uint8 or uint16, shape (rows, cols)
    bits : int
        One less for signed samples that are never negative; negative ones are shifted so that the lowest possible value becomes 0.

    Raises
    ------
    FilmError
        Values beyond the bits.
    FilmFormatError
        Unequal colours, real transparency, other types.
    """
    if values.dtype.kind not in "ui" or values.dtype.itemsize > 2:
        raise FilmFormatError(f"{path}: values of type {values.dtype}; export it again as 16-bit (or 8-bit) unsigned integers")
    grey = _one_channel(values, path)
    if grey.dtype.kind == "i":
        grey, bits = _from_signed(grey, bits)
    full = 2**bits - 1
    if bits < grey.dtype.itemsize * 8 and int(grey.max()) > full:
        raise FilmError(f"{path}: values beyond the {bits} bits that its header tells; the file is damaged, export it again")
    kind = np.uint8 if bits <= MIN_BITS else np.uint16
    own: Any = np.ascontiguousarray(grey, dtype=kind)
    if inverted:
        own = np.subtract(kind(full), own, out=own if own.flags.writeable else None)
    return own, bits


def _one_channel(values: NDArray[Any], path: Path) -> NDArray[Any]:
    if values.ndim == 2:
        return values
    if values.ndim != 3 or not 1 <= values.shape[2] <= 4:
        raise FilmFormatError(f"{path}: an array of shape {values.shape} is no single film; export one film a file")
    *colours, last = (values[..., sample] for sample in range(values.shape[2]))
    if len(colours) in (1, 3):
        if last.min() != last.max():
            raise FilmFormatError(f"{path}: has transparent parts; export it again as grey without an alpha channel")
    else:
        colours.append(last)
    if not all(np.array_equal(colours[0], other) for other in colours[1:]):
        raise FilmFormatError(f"{path}: a colour image; export it again as grey")
    return colours[0]


def _from_signed(values: NDArray[Any], bits: int) -> tuple[NDArray[Any], int]:
    lowest = int(values.min())
    unsigned = values.astype(f"u{values.dtype.itemsize}")  # modulo 2**bits, so that adding the offset below gives the shifted value
    if lowest >= 0:
        return unsigned, max(bits - 1, MIN_BITS)
    unsigned += unsigned.dtype.type(2 ** (bits - 1))
    return unsigned, bits
