"""Position of an image, or of a part of it, in a picture."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

import cv2
import numpy as np

from vehanchor.imagery.raster import Window

if TYPE_CHECKING:
    from numpy.typing import NDArray

RgbImage: TypeAlias = "NDArray[np.uint8]"
"""Picture ``[h, w, 3]``, RGB."""

Colour: TypeAlias = tuple[int, int, int]
"""Red, green and blue, 0..255."""

Points: TypeAlias = "NDArray[np.float64]"
"""Places ``[n, 2]``: x and y in pixels, from the corner of the first one."""

CUT_SIDE_PX = 1000
"""Default of the longer side of a picture of a part."""

# Margin around the shown points, as a share of their larger extent.
_MARGIN_SHARE = 0.5
_MIN_MARGIN_PX = 24
MIN_PART_SIDE_PX = 512
"""A part is enlarged to at least this longer side, so that its details and labels are legible."""

# A larger picture of the same pixels shows nothing more, beyond that side.
_MAX_ENLARGEMENT = 4.0
# Longer side of a picture over the width of its lines.
_SIDE_PER_LINE = 500


class Placement(NamedTuple):
    """Position of an image, or of a part of it, in a picture.

    Attributes:
        scale: ``[2]`` pixels of the picture per image pixel, across and down.
        origin: ``[2]`` x and y of the picture's upper left corner, pixels of the image.
    """

    scale: NDArray[np.float64]
    origin: NDArray[np.float64]

    @classmethod
    def of(cls, picture: RgbImage, part: Window) -> Placement:
        """Place a part of an image in a picture that shows nothing else.

        Args:
            picture: ``[h, w, 3]`` RGB.
            part: the part, pixels of the image.
        """
        height, width = picture.shape[:2]
        scale = np.array([width / part.width_px, height / part.height_px])
        origin = np.array([part.x_px, part.y_px], dtype=np.float64)
        return cls(scale, origin)

    def to_picture(self, points: Any) -> NDArray[np.float64]:
        """Convert points, ``[..., 2]`` pixels of the image, to pixels of the picture."""
        from_origin = np.asarray(points, dtype=np.float64) - self.origin
        converted: NDArray[np.float64] = from_origin * self.scale
        return converted

    def to_opencv(self, points: Any) -> NDArray[np.int32]:
        """Convert points to whole pixels of OpenCV, whose origin is the first pixel's centre."""
        from_centre = self.to_picture(points) - 0.5
        return np.rint(from_centre).astype(np.int32)


class Cut(NamedTuple):
    """Part of an image to draw.

    Attributes:
        part: the part, pixels of the image.
        long_side_px: longer side of the picture, at most.
    """

    part: Window
    long_side_px: int

    def sized(
        self,
        image: RgbImage,
        max_enlargement: float | None = None,
        enlarging: int = cv2.INTER_NEAREST,
    ) -> RgbImage:
        """Copy the part's pixels at the size of the picture.

        Args:
            image: ``[h, w, 3]`` RGB, the pixels of the part or a reduced copy of them.
            max_enlargement: largest side of the image's pixels in the picture; None for 4, or what
                makes the picture large enough to see.
            enlarging: OpenCV's interpolation for a larger picture.

        Returns:
            ``[h', w', 3]`` RGB.
        """
        width = self.part.width_px
        height = self.part.height_px
        long_side = max(width, height)
        if max_enlargement is None:
            max_enlargement = max(_MAX_ENLARGEMENT, MIN_PART_SIDE_PX / long_side)
        factor = min(max_enlargement, self.long_side_px / long_side)
        picture_width = max(1, round(width * factor))
        picture_height = max(1, round(height * factor))
        size = (picture_width, picture_height)
        method = cv2.INTER_AREA if picture_width < image.shape[1] else enlarging
        picture = cv2.resize(image, size, interpolation=method)
        return np.array(picture, dtype=np.uint8)


def line_px(picture: RgbImage, limit_px: float = np.inf) -> int:
    """Compute the width of lines for a picture; ``limit_px`` keeps them thin on small objects."""
    long_side = max(picture.shape[:2])
    width = min(long_side / _SIDE_PER_LINE, limit_px)
    return int(np.clip(round(width), 1, 3))


def part_around(points: Points, whole: Window) -> Window:
    """Return the part of an image around points, with a margin of half of their extent.

    Args:
        points: ``[n, 2]`` pixels of the image, one at least.
        whole: all of the image.
    """
    low = points.min(0)
    high = points.max(0)
    extent = float((high - low).max())
    margin = max(_MIN_MARGIN_PX, _MARGIN_SHARE * extent)
    size = np.array([whole.width_px, whole.height_px])
    # Points may lie on the image's edge or, by rounding, beyond it: one pixel remains.
    first = np.clip(np.floor(low - margin), 0, size - 1)
    last = np.clip(np.ceil(high + margin), 1, size)
    left, top = first.astype(int).tolist()
    right, bottom = last.astype(int).tolist()
    width = max(1, right - left)
    height = max(1, bottom - top)
    return Window(left, top, width_px=width, height_px=height)
