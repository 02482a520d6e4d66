"""Pillow's images as arrays, without importing Pillow: who has such an image has it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Protocol, TypeGuard, cast

import numpy as np

from vehanchor.errors import ImageDecodeError, ImageTooLargeError, OutOfMemoryError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from vehanchor.options import ImageLimits

_AS_THEY_ARE = {"L": 1, "RGB": 3, "RGBA": 4, "I;16": 2, "I;16B": 2, "F": 4}
"""Modes that become arrays as they are, and the bytes of a pixel in these; all others are turned into RGB first."""

_HELD_BYTES = {"1": 1, "L": 1, "P": 1, "I;16": 2, "I;16B": 2}
"""Bytes of a pixel that Pillow holds; 4 in all other modes."""

_TAG_ORIENTATION = 274


class PillowImage(Protocol):
    """What is used of ``PIL.Image.Image``."""

    @property
    def mode(self) -> str:
        """The kind of its pixels."""

    @property
    def size(self) -> tuple[int, int]:
        """Width and height, pixels."""

    def getexif(self) -> Any:
        """The EXIF data."""

    def convert(self, mode: str) -> Any:
        """The image in another mode."""


def is_pillow(image: Any) -> TypeGuard[PillowImage]:
    """Whether something is an image of Pillow."""
    return any(kind.__module__.startswith("PIL.") and kind.__name__ == "Image" for kind in type(image).__mro__)


def pillow_pixels(image: PillowImage, limits: ImageLimits) -> NDArray[Any]:
    """Decode an image and turn it as its EXIF says.

    Returns:
        ``[h, w]`` or ``[h, w, bands]``.

    Raises:
        ImageTooLargeError: it declares more pixels than the limits allow, or takes more memory.
        OutOfMemoryError: there is too little memory for it now.
        ImageDecodeError: it is truncated or damaged.
    """
    from PIL import ImageOps

    width, height = image.size
    if width * height > limits.max_pixels:
        raise ImageTooLargeError(
            f"the Pillow image has {width} x {height} px, the limit is {limits.max_pixels} pixels "
            "(--max-megapixels, ImageLimits.max_pixels)"
        )
    held, shown = _HELD_BYTES.get(image.mode, 4), _AS_THEY_ARE.get(image.mode, 3)
    taken = width * height * (held + 2 * shown)  # Pillow gives its pixels away in pieces, which it then joins
    if taken > limits.max_decoded_bytes:
        raise ImageTooLargeError(
            f"decoding the Pillow image of {width} x {height} px ({image.mode}) takes {taken} bytes, the limit is "
            f"{limits.max_decoded_bytes} (ImageLimits.max_decoded_bytes); convert it to RGB, or raise the limit"
        )
    try:
        upright: Any = image
        if image.getexif().get(_TAG_ORIENTATION, 1) != 1:  # else it would be copied all the same
            upright = ImageOps.exif_transpose(cast("Any", image))
        if upright.mode not in _AS_THEY_ARE:
            upright = upright.convert("RGB")
        return np.asarray(upright)
    except MemoryError as error:
        raise OutOfMemoryError(f"no memory for the Pillow image of {width} x {height} px: try again later") from error
    except (OSError, ValueError, SyntaxError) as error:
        raise ImageDecodeError(f"the Pillow image cannot be decoded: {error}") from error
