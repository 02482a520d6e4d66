"""The option group ``Reading``: reading of images."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import ClassVar

from vehanchor.errors import InvalidParameterError
from vehanchor.options.image_limits import DECODED_BYTES_PER_PIXEL, ImageLimits
from vehanchor.options.option import Flag, Limits, check_fields, option, set_frozen

_MEGAPIXEL = 1_000_000
_BAND = Limits(least=1, whole=True)


@dataclass(frozen=True)
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

    bands: tuple[int, int, int] | None = field(
        default=None,
        metadata=option("Bands for red, green and blue, from 1. Default: the first three.", metavar="R G B"),
    )
    limits: ImageLimits = field(default_factory=ImageLimits)
    bgr: bool = field(
        default=False, metadata=option("Arrays have the order blue, green, red, as in OpenCV.", Flag(), cli=False)
    )
    max_megapixels: float | None = field(
        default=None,
        metadata=option(
            "Decode images of up to this many megapixels whole. Default: 100.", Limits(above=0), metavar="MP"
        ),
    )

    def __post_init__(self) -> None:
        check_fields(self)
        if self.bands is not None:
            try:
                first, second, third = self.bands
            except (TypeError, ValueError):
                raise InvalidParameterError(f"bands is {self.bands!r}: give three, from 1") from None
            set_frozen(self, "bands", tuple(_BAND.check("bands", band) for band in (first, second, third)))
        if not isinstance(self.limits, ImageLimits):
            raise InvalidParameterError(f"limits is {self.limits!r}: give vehanchor.ImageLimits(...)")
        if self.max_megapixels is not None:
            pixels = max(1, round(self.max_megapixels * _MEGAPIXEL))
            memory = max(self.limits.max_decoded_bytes, DECODED_BYTES_PER_PIXEL * pixels)
            set_frozen(self, "limits", replace(self.limits, max_pixels=pixels, max_decoded_bytes=memory))
