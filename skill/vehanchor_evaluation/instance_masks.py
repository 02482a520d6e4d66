"""Instance masks from label images and from COCO's polygons and run lengths."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from vehanchor.errors import ImageDecodeError, ImageNotFoundError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class InstanceMask:
    """Annotated object.

    Attributes:
        instance: its number in the image.
        category: its class, in lower case with hyphens.
        left_px: column of the mask's first pixel in the image.
        top_px: row of the mask's first pixel in the image.
        mask: ``[h, w]`` bool, cropped to the object.
    """

    instance: int
    category: str
    left_px: int
    top_px: int
    mask: NDArray[np.bool_]

    @property
    def box(self) -> tuple[float, float, float, float]:
        """Bounding box x1, y1, x2, y2 of the pixels; the image's first pixel spans 0 to 1."""
        height, width = self.mask.shape
        return self.left_px, self.top_px, self.left_px + width, self.top_px + height


@dataclass(frozen=True, eq=False)
class AnnotatedImage:
    """Image of known scale with annotated objects.

    Attributes:
        name: name of the image, unique in its data set.
        path: path of the image.
        gsd_m_per_px: its true GSD.
        read_masks: reads all its objects; raises OSError or ValueError on failure.
    """

    name: str
    path: Path
    gsd_m_per_px: float
    read_masks: Callable[[], list[InstanceMask]]


def read_pixels(path: Path, flags: int = cv2.IMREAD_UNCHANGED) -> NDArray[Any]:
    """Decode a label image exactly as stored, from any path that Python can open.

    Raises:
        ImageNotFoundError: there is no such file.
        ImageDecodeError: the file is damaged or not an image.
    """
    try:
        data = np.frombuffer(path.read_bytes(), np.uint8)
    except OSError as error:
        raise ImageNotFoundError(f"{path}: {error.strerror}") from None
    pixels = cv2.imdecode(data, flags) if len(data) else None
    if pixels is None:
        raise ImageDecodeError(f"{path}: damaged, or not an image")
    return np.asarray(pixels)


def split_instances(ids: NDArray[np.integer[Any]]) -> Iterator[tuple[int, int, int, NDArray[np.bool_]]]:
    """Split a label image into its objects.

    Args:
        ids: ``[h, w]``, 0 for the background; numbers may have gaps.

    Yields:
        Number, left, top and mask, ``[h', w']`` bool, of each object, in the order of the numbers.
    """
    from scipy.ndimage import find_objects

    present = np.zeros(int(ids.max(initial=0)) + 1, bool)
    present[ids] = True
    present[0] = False
    numbers = np.flatnonzero(present)
    ranks = np.zeros(len(present), np.int32)
    ranks[numbers] = np.arange(1, len(numbers) + 1)
    ranked = ranks[ids]
    for rank, place in enumerate(find_objects(ranked), start=1):
        yield int(numbers[rank - 1]), place[1].start, place[0].start, ranked[place] == rank


def decode_segmentation(segmentation: Any, width_px: int, height_px: int) -> tuple[int, int, NDArray[np.bool_]] | None:
    """Rasterise the ``segmentation`` of a COCO annotation.

    iSAID's tools write polygons as rings of pixel centres (``cv2.findContours``): one ring per piece of the object, no
    holes. Filling them with their outline, as here, restores the mask. ``pycocotools`` reads the same numbers as
    corners and loses half a pixel on every side.

    Args:
        segmentation: a list of rings ``[x1, y1, x2, y2, ...]``, or run lengths ``{"size": [h, w], "counts": ...}``.
        width_px: width of the image.
        height_px: height of the image.

    Returns:
        Left, top and the mask ``[h', w']`` bool; None if no pixel is inside the image.

    Raises:
        ValueError: the segmentation has neither form.
    """
    if isinstance(segmentation, dict):
        whole = _decode_run_lengths(segmentation, width_px, height_px)
        return next(((left, top, mask) for _, left, top, mask in split_instances(whole.astype(np.uint8))), None)
    rings = [np.asarray(ring, np.float64) for ring in segmentation]
    if not rings or any(
        ring.ndim != 1 or len(ring) < 2 or len(ring) % 2 or not np.isfinite(ring).all() for ring in rings
    ):
        raise ValueError("a segmentation must be a list of rings x1, y1, x2, y2, ... or run lengths")
    points = [np.rint(ring.reshape(-1, 2)).astype(np.int32) for ring in rings]
    every = np.concatenate(points)
    left, top = np.maximum(every.min(axis=0), 0)
    right, bottom = np.minimum(every.max(axis=0) + 1, (width_px, height_px))
    if right <= left or bottom <= top:
        return None
    canvas = np.zeros((bottom - top, right - left), np.uint8)
    for ring in points:  # one by one: in a single call, the overlap of two rings would become a hole
        cv2.fillPoly(canvas, [ring - np.array([left, top], np.int32)], 1)
    return (int(left), int(top), canvas > 0) if canvas.any() else None


def _decode_run_lengths(segmentation: dict[str, Any], width_px: int, height_px: int) -> NDArray[np.bool_]:
    """Decode COCO's run lengths, as numbers or text: background and object alternate, column by column."""
    counts = segmentation.get("counts")
    runs = _uncompress(counts) if isinstance(counts, str) else counts
    if segmentation.get("size") != [height_px, width_px] or not isinstance(runs, list):
        raise ValueError(f"run lengths must have counts and the image's size, [{height_px}, {width_px}]")
    lengths = np.asarray(runs, np.int64)
    if (lengths < 0).any() or lengths.sum() != width_px * height_px:
        raise ValueError(f"run lengths cover {lengths.sum()} pixels of {width_px * height_px}")
    values = np.repeat(np.arange(len(lengths)) % 2 == 1, lengths)
    return np.asarray(values.reshape(width_px, height_px).T)


def _uncompress(text: str) -> list[int]:
    """Decode COCO's compressed run lengths.

    Each character holds five bits, lowest first, and a sixth bit if more follow. From the third run on, numbers are
    differences to the run before the last.
    """
    runs: list[int] = []
    value = shift = 0
    for character in text:
        bits = ord(character) - 48
        value |= (bits & 0x1F) << shift
        shift += 5
        if not bits & 0x20:
            if bits & 0x10:
                value -= 1 << shift
            runs.append(value + (runs[-2] if len(runs) > 2 else 0))
            value = shift = 0
    return runs
