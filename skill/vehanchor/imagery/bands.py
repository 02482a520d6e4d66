"""Bands of an image: the choice of red, green and blue, and the supported pixel types."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, TypeAlias

import cv2
import numpy as np

from vehanchor.errors import ImageFormatError, InvalidParameterError
from vehanchor.imagery.raster import RasterNote

if TYPE_CHECKING:
    from numpy.typing import NDArray

DTYPES = (np.uint8, np.uint16, np.float32, np.float64)
"""Supported types of stored pixels."""

BandChoice: TypeAlias = tuple[int, int, int] | None
"""The caller's bands for red, green and blue, counted from 1; None lets ``choose_bands`` decide."""


def choose_bands(
    n_bands: int, choice: BandChoice
) -> tuple[tuple[int, int, int], tuple[RasterNote, ...]]:
    """Choose three of an image's bands.

    Returns:
        Bands for red, green and blue, counted from 0, and notices about the choice.

    Raises:
        InvalidParameterError: a chosen band is missing.
    """
    if choice is not None:
        if max(choice) > n_bands:
            raise InvalidParameterError(
                f"bands={choice!r} names a band above {n_bands}, the image's number of bands"
            )
        red, green, blue = choice
        return (red - 1, green - 1, blue - 1), ()
    if n_bands < 3:  # the second of two is alpha
        return (0, 0, 0), ()
    if n_bands <= 4:  # the fourth is alpha or near infrared
        return (0, 1, 2), ()
    message = (
        f"the image has {n_bands} bands; the first three are read as red, green and blue: "
        "set bands for others"
    )
    return (0, 1, 2), (RasterNote("bands_selected", message),)


def is_alpha(values: NDArray[Any]) -> bool:
    """Test whether the values of a band of unknown role are those of alpha.

    Alpha has only 0 and one other value; near infrared has many values.
    """
    if not values.any():
        return False
    levels = np.unique(values)
    levels_of_alpha = np.unique([0, levels[-1]])
    return np.array_equal(levels, levels_of_alpha)


def merge_bands(planes: list[NDArray[Any]]) -> NDArray[Any]:
    """Merge three bands ``[h, w]`` into one contiguous ``[h, w, 3]``."""
    return cv2.merge([np.ascontiguousarray(plane) for plane in planes])


def check_dtype(dtype: np.dtype[Any]) -> None:
    """Check a pixel type.

    Raises:
        ImageFormatError: the type is unsupported.
    """
    if dtype not in DTYPES:
        raise ImageFormatError(
            f"pixels of {dtype} cannot be measured; convert them to uint8, uint16 or float32"
        )


def check_finite(values: NDArray[Any]) -> None:
    """Check that all values are finite.

    Raises:
        ImageFormatError: some are NaN or infinite.
    """
    if values.dtype.kind != "f":
        return
    n_bad = values.size - int(np.count_nonzero(np.isfinite(values)))
    if n_bad:
        raise ImageFormatError(
            f"{n_bad} of {values.size} pixels are NaN or infinite; fill them before measuring"
        )
