"""Decoding of whole images with OpenCV, after their headers have been checked."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from vehanchor.errors import ImageDecodeError, OutOfMemoryError
from vehanchor.imagery.formats.png import without_ancillary_chunks

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from vehanchor.imagery.formats.image_header import ImageHeader

_NO_MEMORY = -4  # cv::Error::StsNoMem


def decode(data: bytes, source: str, header: ImageHeader) -> NDArray[Any]:
    """Decode an image to ``[h, w]`` or ``[h, w, 3 or 4]`` in BGR order, in its stored depth.

    OpenCV applies the orientation tag of TIFFs even with IMREAD_UNCHANGED, but not that of other
    formats.

    Args:
        data: the encoded image.
        source: name of the image in messages.
        header: its header, which has been checked (``file_check``).

    Raises:
        ImageDecodeError: the image is truncated or damaged.
        OutOfMemoryError: the machine has too little free memory.
    """
    if header.format == "PNG":
        data = without_ancillary_chunks(data)
    try:
        pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except (cv2.error, MemoryError) as error:
        if isinstance(error, MemoryError) or error.code == _NO_MEMORY:
            raise OutOfMemoryError(
                f"not enough memory for the {header.format} of {header.width_px} x "
                f"{header.height_px} px: try again later"
            ) from error
        raise ImageDecodeError(
            f"the {header.format} ({source}) cannot be decoded: {error.err}"
        ) from error
    # Every OpenCV can return None; the type stubs of older versions omit it. The sides are sorted
    # because OpenCV turns a TIFF by its orientation tag.
    declared_sides = sorted((header.height_px, header.width_px))
    if pixels is None or sorted(pixels.shape[:2]) != declared_sides:
        message = f"the {header.format} ({source}) cannot be decoded: truncated or damaged"
        if header.format == "AVIF":
            message += (
                f", or unknown to OpenCV {cv2.__version__}: pip install -U opencv-python-headless"
            )
        raise ImageDecodeError(message)
    return pixels
