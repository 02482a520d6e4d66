"""Pillow's images as arrays, without importing Pillow: who has such an image has it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Protocol, TypeGuard, cast

import numpy as np

from vehanchor.errors import ImageDecodeError, ImageTooLargeError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from vehanchor.options import ImageLimits

__all__ = ["PillowImage", "is_pillow", "pillow_pixels"]

_AS_THEY_ARE = ("L", "RGB", "RGBA", "I;16", "I;16B", "F")


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
        ImageTooLargeError: it declares more pixels than the limits allow.
        ImageDecodeError: it is truncated or damaged.
    """
    from PIL import ImageOps

    width, height = image.size
    if width * height > limits.max_pixels:
        raise ImageTooLargeError(
            f"the Pillow image has {width} x {height} px, the limit is {limits.max_pixels} pixels "
            "(--max-megapixels, ImageLimits.max_pixels)"
        )
    try:
        upright: Any = ImageOps.exif_transpose(cast("Any", image))
        if upright.mode not in _AS_THEY_ARE:
            upright = upright.convert("RGB")
        return np.asarray(upright)
    except (OSError, ValueError, SyntaxError) as error:
        raise ImageDecodeError(f"the Pillow image cannot be decoded: {error}") from error
