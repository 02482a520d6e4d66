"""Copies of a photograph in other sizes, as viewers and exports leave them beside it: each photograph counts once."""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np

from vehanchor.errors import ImageError
from vehanchor.imagery.raster import Window
from vehanchor.imagery.tiles import read_preview
from vehanchor_flight.photograph import Photograph
from vehanchor_flight.record import Failure

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from vehanchor.imagery.raster import Raster

_SIDE_PX = 32
_READ_PX = 512  # long side that is read, at least
_MOST_DIFFERENT = 3.0  # grey levels on average, a choice: JPEG and resampling change about 1
_SAME_SHAPE = 0.01  # relative


def reduced_picture(raster: Raster) -> NDArray[np.uint8]:
    """Reduce an image to ``[32, 32]`` grey levels."""
    factor = max(1, max(raster.width_px, raster.height_px) // _READ_PX)
    whole = Window(0, 0, max(1, raster.width_px // factor), max(1, raster.height_px // factor))
    grey = cv2.cvtColor(read_preview(raster, whole, factor), cv2.COLOR_RGB2GRAY)
    return np.asarray(cv2.resize(grey, (_SIDE_PX, _SIDE_PX), interpolation=cv2.INTER_AREA), np.uint8)


def without_copies(found: Sequence[Photograph | Failure]) -> list[Photograph | Failure]:
    """Keep the largest of several sizes of a photograph; the others become failures that name it."""
    kept = list(found)
    photographs = [(place, each) for place, each in enumerate(found) if isinstance(each, Photograph)]
    largest: list[Photograph] = []
    for place, each in sorted(photographs, key=lambda one: -one[1].view.image.width_px):
        original = next((other for other in largest if _is_copy(each, other)), None)
        if original is None:
            largest.append(each)
        else:
            error = ImageError(f"it is a smaller copy of {original.name!r}, which counts once")
            kept[place] = Failure(each.name, error)
    return kept


def _is_copy(small: Photograph, large: Photograph) -> bool:
    one, other = small.view.image, large.view.image
    shape = one.width_px * other.height_px / (one.height_px * other.width_px)
    if one.width_px == other.width_px or abs(shape - 1) > _SAME_SHAPE or small.reduced is None or large.reduced is None:
        return False
    return float(np.abs(small.reduced.astype(float) - large.reduced).mean()) <= _MOST_DIFFERENT
