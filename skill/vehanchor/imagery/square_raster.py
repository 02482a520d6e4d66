"""Raster of square pixels, over a raster whose pixels are higher or wider on the ground."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from vehanchor.errors import ImageTooLargeError
from vehanchor.imagery.limits import check_windowed_size
from vehanchor.imagery.raster import Raster, RasterNote, Window
from vehanchor.options.pixel_grid import PixelGrid

if TYPE_CHECKING:
    from collections.abc import Callable
    from typing import TypeAlias

    from numpy.typing import NDArray

    from vehanchor.imagery.raster import RgbImage, StoredPixels
    from vehanchor.options import ImageLimits

    ReadWindow: TypeAlias = Callable[[Window], RgbImage | None]

# Weights of two neighbouring pixels are whole shares of it, so that sums stay exact.
_WEIGHT_UNIT = 256


def in_square_pixels(raster: Raster, limits: ImageLimits) -> Raster:
    """Bring a raster to square pixels; return it unchanged if they are square or unknown.

    Args:
        raster: the image, with ``pixel_aspect``.
        limits: limits on the size of an image that is read by windows.

    Raises:
        ImageTooLargeError: the image would have too many square pixels.
    """
    grid = PixelGrid(raster.width_px, raster.height_px, raster.pixel_aspect)
    if grid.is_square:
        return raster
    try:
        check_windowed_size(
            "image in square pixels",
            grid.square_width_px,
            height_px=grid.square_height_px,
            limits=limits,
        )
    except ImageTooLargeError:
        raster.close()
        raise
    return SquareRaster(raster, grid)


class SquareRaster(Raster):
    """Image in square pixels, whose side is the shorter side of the file's pixels.

    One affine map of the whole image gives each square pixel its place in the file, whatever the
    window: windows fit together, and each is read from the file's windows.

    Args:
        raster: the image in the file's pixels; closed with this one.
        grid: its pixels.
    """

    def __init__(self, raster: Raster, grid: PixelGrid) -> None:
        super().__init__(
            raster.source,
            grid.square_width_px,
            grid.square_height_px,
            georeference_gsd_m_per_px=_finer_side(raster),
            notes=(*raster.warnings, _note(grid)),
        )
        self._raster = raster
        self._grid = grid
        self.camera = raster.camera
        self.ground = raster.ground
        self.in_memory = raster.in_memory
        self.encoded = raster.encoded

    @property
    def grid(self) -> PixelGrid:
        """Pixels of the file and square pixels."""
        return self._grid

    @property
    def in_file(self) -> Raster:
        """The image in the file's pixels."""
        return self._raster

    def read(self, window: Window | None = None) -> RgbImage:
        """Read a window of square pixels; see ``Raster.read``."""
        window = self._checked(window)
        size_px = (self._raster.width_px, self._raster.height_px)
        pixels = self._resampled(window, size_px, self._raster.read)
        assert pixels is not None
        return pixels

    def read_overview(self, window: Window, factor: int) -> RgbImage | None:
        """Read a window of the reduced image from the file's overviews; None if it has none."""

        def read(file_window: Window) -> RgbImage | None:
            return self._raster.read_overview(file_window, factor)

        # A reduced image has the same grids, each with pixels ``factor`` times as large.
        size_px = (self._raster.width_px // factor, self._raster.height_px // factor)
        return self._resampled(window, size_px, read)

    def close(self) -> None:
        """Release the file."""
        self._raster.close()

    def _read_stored(self, window: Window) -> StoredPixels:
        """Refuse: ``read`` takes the file's pixels from the other raster."""
        raise NotImplementedError

    def _resampled(
        self, window: Window, size_px: tuple[int, int], read: ReadWindow
    ) -> RgbImage | None:
        """Read a window of square pixels by linear interpolation between pixels of the file.

        Args:
            window: in square pixels of the image, or of the reduced image.
            size_px: columns and rows of the file's image, or of its reduced image.
            read: reads a window of it.
        """
        width_px, height_px = size_px
        across, down = self._grid.square_per_file
        columns = _Samples.of(window.x_px, window.width_px, per_file=across, side_px=width_px)
        rows = _Samples.of(window.y_px, window.height_px, per_file=down, side_px=height_px)
        file_window = Window(
            columns.first,
            rows.first,
            width_px=columns.count,
            height_px=rows.count,
        )
        pixels = read(file_window)
        if pixels is None:
            return None
        in_rows = rows.interpolated(pixels, axis=0)
        return columns.interpolated(in_rows, axis=1)


class _Samples:
    """Places of a window's square pixels along one side of the file.

    Attributes:
        first: first pixel of the file that is needed.
        count: number of pixels of the file that are needed.
    """

    def __init__(
        self, lower: NDArray[np.intp], upper: NDArray[np.intp], shares: NDArray[np.uint16]
    ) -> None:
        self.first = int(lower[0])
        self.count = int(upper[-1]) - self.first + 1
        self._lower = lower - self.first
        self._upper = upper - self.first
        self._shares = shares

    @classmethod
    def of(cls, start: int, length: int, *, per_file: float, side_px: int) -> _Samples:
        """Place square pixels between the centres of the file's pixels.

        Args:
            start: first square pixel.
            length: number of square pixels.
            per_file: square pixels per pixel of the file.
            side_px: pixels of the file along this side.
        """
        # Centres lie half a pixel from the edges, which both grids share. Beyond the last centres,
        # the pixel at the border counts alone.
        centres = (np.arange(start, start + length) + 0.5) / per_file - 0.5
        places = np.clip(centres, 0, side_px - 1)
        lower = np.floor(places).astype(np.intp)
        shares = np.rint((places - lower) * _WEIGHT_UNIT).astype(np.uint16)
        # A pixel that alone counts needs no neighbour, which the border may lack.
        upper = lower + (shares > 0)
        return cls(lower, upper, shares)

    def interpolated(self, pixels: RgbImage, *, axis: int) -> RgbImage:
        """Interpolate pixels ``[h, w, 3]`` along rows (0) or columns (1)."""
        if not self._shares.any() and len(self._lower) == self.count:
            return pixels
        shape = [1, 1, 1]
        shape[axis] = len(self._shares)
        shares = self._shares.reshape(shape)
        # At most 255 * 256: the sums fit 16 bits.
        lower = pixels.take(self._lower, axis=axis) * (_WEIGHT_UNIT - shares)
        upper = pixels.take(self._upper, axis=axis) * shares
        half = np.uint16(_WEIGHT_UNIT // 2)
        mixed: RgbImage = ((lower + upper + half) // _WEIGHT_UNIT).astype(np.uint8)
        return mixed


def _finer_side(raster: Raster) -> float | None:
    """Compute the shorter side of a pixel from the root of its area, metres; None if unknown."""
    gsd = raster.georeference_gsd_m_per_px
    if gsd is None:
        return None
    aspect = raster.pixel_aspect
    longer_over_shorter = max(aspect, 1 / aspect)
    return gsd / float(np.sqrt(longer_over_shorter))


def _note(grid: PixelGrid) -> RasterNote:
    """Tell that the file's pixels are not square, and which pixels the numbers are in."""
    direction = "high as wide"
    ratio = grid.aspect
    if ratio < 1:
        direction = "wide as high"
        ratio = 1 / ratio
    message = (
        f"A pixel of the file is {ratio:.4g} times as {direction} on the ground. The image was "
        f"analysed in square pixels, {grid.square_width_px} x {grid.square_height_px}, with the "
        "shorter side: the scale, and lengths and areas in pixels, are in these. Coordinates are "
        "in pixels of the file."
    )
    return RasterNote("pixels_not_square", message)
