"""Base class of the analyses: a record, its evidence and its image."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from vehanchor.errors import InvalidParameterError, MissingExtraError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from vehanchor.imagery.metadata.georeference import Ground
    from vehanchor.imagery.sources.opening import ImageSource
    from vehanchor.options import Reading
    from vehanchor.pictures.placement import Cut


class Analysis:
    """Analysis that can be drawn over its image; the image is read again.

    Attributes:
        image: source to read the image from again; None for a stream.
        reading: options of reading; None for the defaults.
        ground: position of the image on the ground; None without a georeference.
    """

    image: ImageSource | None
    reading: Reading | None
    ground: Ground | None

    def overlay(self, image: ImageSource | None = None) -> NDArray[np.uint8]:
        """Draw the result and a scale bar over the image; a measurement shows its part of the image with a margin.

        Args:
            image: source to read the image from; None for the first source, unless it is a stream.

        Returns:
            ``[h, w, 3]`` RGB, as written by ``--overlay``.

        Raises:
            InvalidParameterError: the source cannot be read twice, and no image is given.
            ImageError: the image can no longer be read.
        """
        from vehanchor.imagery.sources.opening import open_raster
        from vehanchor.options import Reading
        from vehanchor.pictures.scale import read_reduced

        source = self.image if image is None else image
        if source is None:
            raise InvalidParameterError("the analysis does not have its image: give it, as overlay(image)")
        reading = self.reading or Reading()
        with open_raster(source, bands=reading.bands, limits=reading.limits, bgr=reading.bgr) as raster:
            cut = self._cut()
            return self._draw(read_reduced(raster, cut and cut.part), cut)

    def _cut(self) -> Cut | None:
        """Choose the part of the image to draw; None for all of it."""
        return None

    def _draw(self, image: NDArray[np.uint8], cut: Cut | None) -> NDArray[np.uint8]:
        """Draw the result over ``[h, w, 3]`` RGB: the image, the part of ``cut``, or a reduced copy of either."""
        raise NotImplementedError

    def _repr_png_(self) -> bytes | None:
        """Draw the overlay for notebooks; None if the image cannot be read again."""
        if self.image is None:
            return None
        import cv2

        _, encoded = cv2.imencode(".png", np.ascontiguousarray(self.overlay()[:, :, ::-1]))
        return encoded.tobytes()


def import_supervision() -> Any:
    """Import supervision.

    Raises:
        MissingExtraError: supervision or one of its dependencies is not installed.
    """
    try:
        import supervision
    except ImportError as error:
        raise MissingExtraError(f"to_supervision needs supervision ({error}): pip install supervision") from None
    return supervision
