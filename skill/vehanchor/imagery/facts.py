"""Facts of an image: size, scale in its georeference, metadata and checksum."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from vehanchor.imagery.identity import image_id
from vehanchor.options.pixel_grid import PixelGrid

if TYPE_CHECKING:
    from vehanchor.imagery.metadata.camera import CameraMetadata
    from vehanchor.imagery.raster import Raster, RasterNote, Window


class ImageFacts(NamedTuple):
    """Facts of an image, usable after it is closed.

    Attributes:
        width_px: columns, in square pixels.
        height_px: rows, in square pixels.
        georeference_gsd_m_per_px: GSD by the file's georeference; None without one.
        notices: warnings from reading the image.
        camera: the camera's metadata; None without any.
        image_id: checksum of the image; empty if unknown.
        file_grid: pixels of the file; None if they are square.
        density_aspect: height of a pixel over its width by the density in the header, a hint.
        part: the part that is a photograph, in square pixels; None if the image is one as it is.
    """

    width_px: int
    height_px: int
    georeference_gsd_m_per_px: float | None = None
    notices: tuple[RasterNote, ...] = ()
    camera: CameraMetadata | None = None
    image_id: str = ""
    file_grid: PixelGrid | None = None
    density_aspect: float = 1.0
    part: Window | None = None

    @property
    def photograph_size_px(self) -> tuple[int, int]:
        """Columns and rows of the photograph, in square pixels."""
        if self.part is None:
            return self.width_px, self.height_px
        return self.part.width_px, self.part.height_px

    @property
    def grid(self) -> PixelGrid:
        """Pixels of the file and square pixels."""
        return self.file_grid or PixelGrid(self.width_px, self.height_px)


def image_facts(raster: Raster) -> ImageFacts:
    """Collect the facts of an open image."""
    file_grid = None if raster.grid.is_square else raster.grid
    return ImageFacts(
        raster.width_px,
        raster.height_px,
        georeference_gsd_m_per_px=raster.georeference_gsd_m_per_px,
        notices=raster.warnings,
        camera=raster.camera,
        image_id=image_id(raster),
        file_grid=file_grid,
        density_aspect=raster.density_aspect,
    )
