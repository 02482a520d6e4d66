"""Pixels of the file and square pixels: the one mapping between both."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

LEAST_ASPECT = 1.01
"""Ratio of a pixel's sides from which it is not square: an error of half a percent in each
direction, far below that of a scale. A choice."""

MAX_ASPECT = 10.0
"""Largest ratio of a pixel's sides that is corrected: that of degrees at a latitude of 84, where
UTM ends. A choice."""


@dataclass(frozen=True)
class PixelGrid:
    """Grid of an image's pixels in its file, and the square pixels in which it is analysed.

    A pixel of a file can be higher or wider on the ground than it is wide or high. ``Raster`` then
    shows the image in square pixels, whose side is the *shorter* side of the file's pixels: no
    detail is lost. Everything inside is in square pixels: detection, rulers, masks, pictures,
    ``gsd_m_per_px``, lengths and areas in pixels. Everything that leaves in coordinates is in
    pixels of the file: boxes, outlines, points, lines, full masks, the image's size.

    ``CoordinateFrame`` brings the caller's coordinates in; ``to_file`` brings coordinates out. Both
    grids have their origin at the upper left corner of the first pixel, and the same edges.

    Attributes:
        width_px: columns of the file, upright.
        height_px: rows of the file, upright.
        aspect: height of the file's pixel over its width, both on the ground; 1 for square pixels.
    """

    width_px: int
    height_px: int
    aspect: float = 1.0

    @property
    def is_square(self) -> bool:
        """Whether both grids are the same."""
        return self.aspect == 1.0

    @property
    def square_width_px(self) -> int:
        """Columns of the image in square pixels."""
        return round(self.width_px * max(1.0, 1 / self.aspect))

    @property
    def square_height_px(self) -> int:
        """Rows of the image in square pixels."""
        return round(self.height_px * max(1.0, self.aspect))

    @property
    def square_per_file(self) -> tuple[float, float]:
        """Square pixels per pixel of the file, across and down."""
        across = self.square_width_px / self.width_px
        down = self.square_height_px / self.height_px
        return across, down

    @property
    def stated_aspect(self) -> float | None:
        """Height of the file's pixel over its width, for records; None for square pixels."""
        if self.is_square:
            return None
        across, down = self.square_per_file
        return down / across

    def to_file(self, points: Any) -> NDArray[np.float64]:
        """Convert points ``[..., 2]`` of square pixels to pixels of the file."""
        import numpy as np  # late, because help and the server start without it

        converted: NDArray[np.float64] = np.asarray(points, np.float64) / self.square_per_file
        return converted

    def to_square(self, points: Any) -> NDArray[np.float64]:
        """Convert points ``[..., 2]`` of the file's pixels to square pixels."""
        import numpy as np  # late, because help and the server start without it

        converted: NDArray[np.float64] = np.asarray(points, np.float64) * self.square_per_file
        return converted

    def mask_to_file(self, mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Convert a mask of the whole image from square pixels to pixels of the file.

        Args:
            mask: ``[square_height_px, square_width_px]``.

        Returns:
            ``[height_px, width_px]``: the mask at the centre of each pixel.
        """
        if self.is_square:
            return mask
        import numpy as np  # late, as above

        across, down = self.square_per_file
        x = (np.arange(self.width_px) + 0.5) * across
        y = (np.arange(self.height_px) + 0.5) * down
        columns = x.astype(np.intp)
        rows = y.astype(np.intp)
        in_file: NDArray[np.bool_] = mask[rows[:, None], columns]
        return in_file


def usable_aspect(aspect: float) -> float:
    """Return a ratio of a pixel's sides; 1 if the pixel is nearly square.

    Args:
        aspect: height of a pixel over its width, above 0.
    """
    ratio = max(aspect, 1 / aspect)
    return aspect if ratio >= LEAST_ASPECT else 1.0
