"""Arrays from Pillow images. Pillow is imported only by callers who already have such an image."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Protocol, TypeGuard

import numpy as np

from vehanchor.errors import ImageDecodeError, OutOfMemoryError
from vehanchor.imagery.limits import check_decoding_memory, check_whole_size

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from vehanchor.options import ImageLimits

_ARRAY_MODES = {"L": 1, "RGB": 3, "RGBA": 4, "I;16": 2, "I;16B": 2, "F": 4}
"""Modes that become arrays directly, with bytes per pixel.

Whole numbers of 32 bits (``I``) become floats first, all other modes RGB or RGBA.
"""

_STORED_BYTES = {"1": 1, "L": 1, "P": 1, "I;16": 2, "I;16B": 2}
"""Bytes per pixel in Pillow's memory; 4 for all other modes."""

_TAG_ORIENTATION = 274


class PillowImage(Protocol):
    """Image of Pillow: ``PIL.Image.Image``."""

    def getexif(self) -> Any:
        """Read the EXIF data."""


def is_pillow(image: Any) -> TypeGuard[PillowImage]:
    """Test whether an object is a Pillow image, without importing Pillow."""
    return any(
        base.__module__.startswith("PIL.") and base.__name__ == "Image"
        for base in type(image).__mro__
    )


def pillow_orientation(image: Any) -> int:
    """Read the EXIF orientation of an image, 1 to 8; 1 without a valid one."""
    orientation = image.getexif().get(_TAG_ORIENTATION, 1)
    return orientation if orientation in range(1, 9) else 1


def pillow_pixels(image: Any, limits: ImageLimits) -> NDArray[Any]:
    """Decode an image and apply its EXIF orientation.

    Returns:
        ``[h, w]`` or ``[h, w, bands]``.

    Raises:
        ImageTooLargeError: the image exceeds the limits on pixels or memory.
        OutOfMemoryError: the machine has too little free memory.
        ImageDecodeError: the image is truncated or damaged.
    """
    from PIL import ImageOps

    width, height = image.size
    check_whole_size("Pillow image", width, height_px=height, limits=limits)
    colour_mode = "RGBA" if getattr(image, "has_transparency_data", False) else "RGB"
    stored_bytes = _STORED_BYTES.get(image.mode, 4)
    array_mode = "F" if image.mode == "I" else image.mode
    array_bytes = _ARRAY_MODES.get(array_mode, len(colour_mode))
    # Pillow copies its pixels in pieces and then joins them, so the array is held twice.
    decoding_bytes = width * height * (stored_bytes + 2 * array_bytes)
    size = f"{width} x {height} px ({image.mode})"
    check_decoding_memory("Pillow image", decoding_bytes, size=size, limits=limits)
    try:
        upright = image
        # exif_transpose copies the image even if there is nothing to turn.
        if pillow_orientation(image) != 1:
            upright = ImageOps.exif_transpose(image)
        if upright.mode == "I":
            # RGB would cut off all values above 255.
            upright = upright.convert("F")
        if upright.mode not in _ARRAY_MODES:
            upright = upright.convert(colour_mode)
        return np.asarray(upright)
    except MemoryError as error:
        raise OutOfMemoryError(
            f"not enough memory for the Pillow image of {width} x {height} px: try again later"
        ) from error
    except (OSError, ValueError, SyntaxError) as error:
        raise ImageDecodeError(f"the Pillow image cannot be decoded: {error}") from error
