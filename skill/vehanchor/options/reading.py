"""The option group ``Reading``: reading of images."""

from __future__ import annotations

from dataclasses import field, replace
from typing import Annotated, Any, ClassVar

from pydantic import BeforeValidator, InstanceOf

from vehanchor.options.image_limits import DECODED_BYTES_PER_PIXEL, ImageLimits
from vehanchor.options.option import Flag, Limits, Option, group, set_frozen

_MEGAPIXEL = 1_000_000
_Band = Annotated[int, Limits(least=1, whole=True)]


def _words(value: Any) -> Any:
    return value.replace(",", " ").split() if isinstance(value, str) else value


@group(frozen=True)
class Reading:
    """Options of reading an image.

    Attributes:
        bands: three 1-based bands for red, green, blue; None takes the first three.
        limits: limits on the cost of an image, checked before decoding.
        bgr: arrays have the order blue, green, red, as in OpenCV.
        max_megapixels: replaces the limits of pixels and of memory for decoding; None keeps them.

    Raises:
        InvalidParameterError: a number is invalid, or the bands are not three whole numbers >= 1.
    """

    panel: ClassVar[str] = "Reading the image"

    bands: Annotated[
        tuple[_Band, _Band, _Band] | None,
        BeforeValidator(_words),
        Option("Bands for red, green and blue, from 1. Default: the first three.", metavar="R G B"),
    ] = None
    limits: Annotated[InstanceOf[ImageLimits], Option("Limits on the cost of an image.", cli=False)] = field(
        default_factory=ImageLimits
    )
    bgr: Annotated[Flag, Option("Arrays have the order blue, green, red, as in OpenCV.", cli=False)] = False
    max_megapixels: Annotated[
        Annotated[float, Limits(above=0)] | None,
        Option("Decode images of up to this many megapixels whole. Default: 100.", metavar="MP"),
    ] = None

    def __post_init__(self) -> None:
        if self.max_megapixels is not None:
            pixels = max(1, round(self.max_megapixels * _MEGAPIXEL))
            memory = max(self.limits.max_decoded_bytes, DECODED_BYTES_PER_PIXEL * pixels)
            set_frozen(self, "limits", replace(self.limits, max_pixels=pixels, max_decoded_bytes=memory))
