"""Images of ids: each number in them is an object, and 0 is the background."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from vehanchor.errors import ImageDecodeError, ImageFormatError, ImageNotFoundError

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path
    from typing import TypeAlias

    from numpy.typing import NDArray

    from vehanchor.segmentation.shape import Mask

    NumberedMask: TypeAlias = tuple[int, int, int, Mask]
    """Number of an object, left and top of its box, and its mask in the box."""


def read_masks(path: Path) -> Iterator[NumberedMask]:
    """Read the objects of a label image of 8 or 16 bit: see ``split_instances``.

    Raises:
        ImageError: the file cannot be read, or is not a label image.
    """
    return masks_of(read_pixels(path), str(path))


def masks_of(numbers: NDArray[Any], source: str) -> Iterator[NumberedMask]:
    """Find the objects in the pixels of a label image: see ``split_instances``.

    Args:
        numbers: its pixels, as OpenCV decodes them.
        source: name of the image in messages.

    Raises:
        ImageFormatError: it has several bands, or no whole numbers.
    """
    # Grey pictures are often stored with three equal bands.
    if numbers.ndim == 3:
        first_band = numbers[..., :1]
        if (numbers[..., :3] == first_band).all():
            numbers = numbers[..., 0]
    has_one_band = numbers.ndim == 2
    has_integers = numbers.dtype in (np.uint8, np.uint16)
    if not has_one_band or not has_integers:
        raise ImageFormatError(
            f"{source}: masks must have one band of 8 or 16 bit, got {numbers.dtype} "
            f"{numbers.shape}"
        )
    return split_instances(numbers)


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
    # OpenCV raises its own error for an empty buffer.
    pixels = None
    if len(data):
        pixels = cv2.imdecode(data, flags)
    if pixels is None:
        raise ImageDecodeError(f"{path}: damaged, or not an image")
    return np.asarray(pixels)


def split_instances(ids: NDArray[np.integer[Any]]) -> Iterator[NumberedMask]:
    """Split a label image into its objects.

    Args:
        ids: ``[h, w]``, 0 for the background; numbers may have gaps.

    Yields:
        Number, left, top and mask, ``[h', w']`` bool, of each object, in the order of the numbers.
    """
    from scipy.ndimage import find_objects

    # Numbers become ranks without gaps: find_objects makes an entry for every number up to the
    # largest.
    largest = int(ids.max(initial=0))
    is_present = np.zeros(largest + 1, bool)
    is_present[ids] = True
    is_present[0] = False
    numbers = np.flatnonzero(is_present)
    rank_of_number = np.zeros(len(is_present), np.int32)
    rank_of_number[numbers] = np.arange(1, len(numbers) + 1)
    ranks = rank_of_number[ids]
    for rank, box in enumerate(find_objects(ranks), start=1):
        rows, columns = box
        number = int(numbers[rank - 1])
        mask = ranks[box] == rank
        yield number, columns.start, rows.start, mask
