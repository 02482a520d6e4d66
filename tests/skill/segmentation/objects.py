"""Pictures of one object, segmented by any model."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from tests.models import blank_image
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.segmentation.prompt import Prompt
from vehanchor.segmentation.segmenter import Segmentation, Segmenter
from vehanchor.segmentation.shape import mask_bounds

if TYPE_CHECKING:
    from numpy.typing import NDArray


OBJECT_RGB = (60, 130, 200)

OTHER_RGB = (200, 60, 60)


def segment(
    segmenter: Segmenter, image: NDArray[np.uint8], prompt: Prompt, **options: Any
) -> Segmentation:
    with open_raster(image) as raster:
        return segmenter.segment(raster, prompt, **options)


def full_mask(segmentation: Segmentation, image: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Place a mask in an array of the image's size."""
    window = segmentation.window
    rows = slice(window.y_px, window.y_px + window.height_px)
    columns = slice(window.x_px, window.x_px + window.width_px)
    full = np.zeros(image.shape[:2], dtype=bool)
    full[rows, columns] = segmentation.mask
    return full


def is_rectangle(mask: NDArray[np.bool_], rectangle: tuple[int, int, int, int]) -> bool:
    """Test whether a mask is a rectangle to the pixel, except for its corners.

    Interpolation between cells rounds the corners off.
    """
    x1, y1, x2, y2 = rectangle
    area = (x2 - x1) * (y2 - y1)
    return mask_bounds(mask) == rectangle and int(mask.sum()) >= 0.98 * area


def picture(width: int, height: int, rectangle: tuple[int, int, int, int]) -> NDArray[np.uint8]:
    """Paint a rectangle x1, y1, x2, y2 of the object's colour on a varied ground."""
    image = blank_image(width, height)
    image[: height // 2, :, 1] = 20
    image[:, : width // 3] = OTHER_RGB
    x1, y1, x2, y2 = rectangle
    image[y1:y2, x1:x2] = OBJECT_RGB
    return image
