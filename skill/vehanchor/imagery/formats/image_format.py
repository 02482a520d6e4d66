"""Record of an image format: how its files are named, recognised, checked and decoded."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Callable

    from vehanchor.imagery.formats.ifd import ReadAt
    from vehanchor.imagery.formats.image_header import ImageHeader


class DecoderExtra(NamedTuple):
    """Extra with the decoder of a format.

    Attributes:
        name: name of the extra in ``pyproject.toml``.
        package: package that the extra installs.
        modules: modules of which one is enough, in the order in which they are tried.
    """

    name: str
    package: str
    modules: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class ImageFormat:
    """Image format that can be measured.

    Attributes:
        name: name of the format in headers, help and messages.
        suffixes: suffixes of its files in folders, the usual one first.
        recognises: tests the first 32 bytes of a file.
        read_header: reads the header of a file. A ``struct.error`` means that the file ends within
            it.
        opencv: whether OpenCV decodes it.
        has_alpha: whether a fourth band that OpenCV decodes is always alpha.
        gdal_driver: GDAL's driver if it can be read by windows, else None; without OpenCV it is
            always read so.
        extra: the extra whose decoder it needs; None if OpenCV or GDAL reads it.
    """

    name: str
    suffixes: tuple[str, ...]
    recognises: Callable[[bytes], bool]
    read_header: Callable[[ReadAt], ImageHeader]
    opencv: bool = True
    has_alpha: bool = False
    gdal_driver: str | None = None
    extra: DecoderExtra | None = None


def starts_with(*signatures: bytes) -> Callable[[bytes], bool]:
    """Make a test of a file's first bytes."""

    def recognises(start: bytes) -> bool:
        return start.startswith(signatures)

    return recognises
