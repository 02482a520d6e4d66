"""Copies of one photograph: of another size, mirrored, or with other bytes or a shift."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeAlias

import cv2
import numpy as np

from vehanchor.errors import ImageError
from vehanchor.imagery.raster import Window
from vehanchor.imagery.tiles import read_preview
from vehanchor_flight.photograph import Photograph
from vehanchor_flight.record import Failure

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from vehanchor.imagery.raster import Raster
    from vehanchor_flight.record import Results

    Point: TypeAlias = NDArray[np.float64]
    """Point or step x, y ``[2]`` in pixels."""

_REDUCED_SIDE_PX = 32  # Side of the copy by which two sizes of a photograph are recognised.
_MIN_READ_PX = 512  # The longer side is read with at least this many pixels.
# Mean difference of two copies, in grey levels, is at most this: our choice. JPEG and resampling
# cause about 1.
_MAX_COPY_DIFFERENCE = 3.0
# A mirrored copy is recognised in pictures that differ from their own mirror image by this much, in
# grey levels: our choice, four times the limit above. Water and fields have less.
_MIN_ASYMMETRY = 12.0
_ASPECT_TOLERANCE = 0.01  # Relative difference between the aspect ratios of two copies.
# The cars of two copies have the same pattern, up to this share of their lengths: our choice.
_MAX_SHIFT = 0.1
# Mean difference between the log lengths of the cars of two copies: our choice. Different cars of
# one length and one place in the picture are rarer.
_MAX_LOG_LENGTH = 0.01


def reduced_picture(raster: Raster) -> NDArray[np.uint8]:
    """Reduce an image to ``[32, 32]`` grey levels."""
    side_px = max(raster.width_px, raster.height_px)
    factor = max(1, side_px // _MIN_READ_PX)
    whole = Window(
        0,
        0,
        width_px=max(1, raster.width_px // factor),
        height_px=max(1, raster.height_px // factor),
    )
    preview = read_preview(raster, whole, factor)
    grey = cv2.cvtColor(preview, cv2.COLOR_RGB2GRAY)
    size = (_REDUCED_SIDE_PX, _REDUCED_SIDE_PX)
    reduced = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
    return np.asarray(reduced, np.uint8)


def without_copies(results: Results) -> list[Photograph | Failure]:
    """Keep the largest of several sizes of a photograph, and the first of it and its mirror images.

    The others become failures.
    """
    remaining = list(results)
    originals: list[Photograph] = []
    for index, photograph in _widest_first(results):
        reason = _copied_from(photograph, originals)
        if reason:
            error = ImageError(f"it is a {reason}, which counts once")
            remaining[index] = Failure(photograph.name, error)
        else:
            originals.append(photograph)
    return remaining


def _copied_from(photograph: Photograph, originals: list[Photograph]) -> str:
    """Describe of which photograph this one is a copy; empty if of none."""
    for original in originals:
        if _is_smaller_copy(photograph, original):
            return f"smaller copy of {original.name!r}"
        if _is_mirrored_copy(photograph, original):
            return f"mirrored copy of {original.name!r}"
    return ""


def _widest_first(results: Results) -> list[tuple[int, Photograph]]:
    """List the photographs with their indices; those of equal width keep their order."""
    photographs = []
    for index, result in enumerate(results):
        if isinstance(result, Photograph):
            photographs.append((index, result))

    def width_px(indexed: tuple[int, Photograph]) -> int:
        _, photograph = indexed
        return photograph.view.image.width_px

    # A reversed sort keeps the order of equals, too.
    return sorted(photographs, key=width_px, reverse=True)


def _is_smaller_copy(small: Photograph, large: Photograph) -> bool:
    """Check whether two photographs of different size show the same."""
    if small.view.image.width_px == large.view.image.width_px:
        return False
    return _look_the_same(small, large)


def _is_mirrored_copy(photograph: Photograph, original: Photograph) -> bool:
    """Check whether a photograph is the mirror image of another one, of any size, turned or not."""
    if photograph.reduced is None or original.reduced is None:
        return False
    mirror_images: list[NDArray[np.uint8]] = []
    aspect = _aspect(photograph)
    if _is_one(aspect / _aspect(original)):
        upside_down = np.flip(original.reduced, axis=0)
        left_to_right = np.flip(original.reduced, axis=1)
        mirror_images += [upside_down, left_to_right]
    if _is_one(aspect * _aspect(original)):
        # The mirrors along both diagonals swap width and height.
        along_diagonal = original.reduced.T
        mirror_images += [along_diagonal, np.flip(along_diagonal)]
    for mirrored in mirror_images:
        is_asymmetric = _difference(mirrored, original.reduced) >= _MIN_ASYMMETRY
        if is_asymmetric and _difference(photograph.reduced, mirrored) <= _MAX_COPY_DIFFERENCE:
            return True
    return False


def _look_the_same(first: Photograph, second: Photograph) -> bool:
    """Check whether two photographs have one shape, and the same reduced picture."""
    if not _have_one_shape(first, second):
        return False
    return _difference(first.reduced, second.reduced) <= _MAX_COPY_DIFFERENCE


def _have_one_shape(first: Photograph, second: Photograph) -> bool:
    """Check whether two photographs have reduced pictures and the same aspect ratio."""
    if first.reduced is None or second.reduced is None:
        return False
    return _is_one(_aspect(first) / _aspect(second))


def _aspect(photograph: Photograph) -> float:
    """Compute the width of a photograph over its height."""
    image = photograph.view.image
    return image.width_px / image.height_px


def _is_one(aspect: float) -> bool:
    """Test whether a quotient of two aspect ratios is one, within the tolerance."""
    return abs(aspect - 1) <= _ASPECT_TOLERANCE


def _difference(first: NDArray[np.uint8] | None, second: NDArray[np.uint8] | None) -> float:
    """Compute the mean difference of two reduced pictures, in grey levels."""
    assert first is not None
    assert second is not None
    return float(np.abs(first.astype(float) - second).mean())


def shift_of_copy(first: Photograph, second: Photograph) -> Point | None:
    """Find how far the cars of a picture are moved in another one of the same cars.

    Pictures without features cannot be matched. Copies of them, and frames of a hovering film, are
    recognised by their pixels, or by their cars: the same lengths at the same places, up to a
    common shift. A single car has no such pattern, and must be at one place.

    Args:
        first: one photograph.
        second: another one.

    Returns:
        ``[2]`` x, y in pixels from the first to the second; None if they are not the same.
    """
    first_image = first.view.image
    second_image = second.view.image
    if first_image.image_id and first_image.image_id == second_image.image_id:
        return np.zeros(2)
    if first_image.width_px != second_image.width_px or not _look_the_same(first, second):
        return None
    boxes = first.view.detections.boxes
    others = second.view.detections.boxes
    if len(boxes) != len(others) or not len(boxes):
        return None
    shift: Point = np.zeros(2)
    if len(boxes) > 1:
        centre = boxes[:, :2].mean(axis=0)
        other_centre = others[:, :2].mean(axis=0)
        shift = np.asarray(other_centre - centre)
    moved = boxes[:, :2] + shift
    steps = moved[:, None] - others[None, :, :2]
    distances = np.hypot(steps[..., 0], steps[..., 1])
    nearest = distances.argmin(axis=1)
    is_near = distances.min(axis=1) <= _MAX_SHIFT * boxes[:, 2]
    ratios = boxes[:, 2] / others[nearest, 2]
    log_ratios = np.abs(np.log(ratios))
    if is_near.all() and log_ratios.mean() <= _MAX_LOG_LENGTH:
        return shift
    return None
