"""Mask of an object with its place in the image, whoever drew it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from vehanchor.segmentation.shape import mask_bounds

if TYPE_CHECKING:
    from vehanchor.imagery.raster import Window
    from vehanchor.segmentation.prompt import Box
    from vehanchor.segmentation.shape import Mask


@dataclass(frozen=True, eq=False)
class ObjectMask:
    """Mask of an object.

    Attributes:
        mask: ``[h, w]`` bool, the pixels of ``window``; nothing outside it belongs to the object.
        window: part of the image that the mask covers.
    """

    mask: Mask
    window: Window

    @property
    def bounding_box(self) -> Box | None:
        """Smallest box around the mask, in whole pixels of the image; None for an empty mask."""
        bounds = mask_bounds(self.mask)
        if bounds is None:
            return None
        x1, y1, x2, y2 = bounds
        left = self.window.x_px
        top = self.window.y_px
        return x1 + left, y1 + top, x2 + left, y2 + top
