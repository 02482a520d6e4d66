"""Header of an image file: the declarations on which limits and decoding depend."""

from __future__ import annotations

from dataclasses import dataclass

COPIES = 2
"""Copies of an image that OpenCV holds while it decodes it.

OpenCV 5 copies the decoded image before it returns it (measured).
"""


@dataclass(frozen=True)
class TiffLayout:
    """Storage layout of a TIFF.

    Attributes:
        bands: samples per pixel.
        bits: bits of each band.
        sample_format: 1 unsigned, 2 signed, 3 float.
        photometric: 0 white is zero, 1 black is zero, 2 RGB, 3 palette, 5 CMYK, 6 YCbCr, 8 Lab.
        planar: whether bands are stored one after the other.
        compression: TIFF's code, such as 1 for none and 50001 for WebP.
        tiled: whether its blocks are tiles.
        georeferenced: whether it has GeoTIFF tags.
        alpha: whether a band is declared to be alpha.
        block_px: pixels of a strip or tile, which is decoded whole.
        mask_block_px: pixels of a strip or tile of its mask; 0 without one.
        has_no_data_value: whether it states a value of pixels without data.
        other_pages: width and height of further pages, which are neither overviews nor masks.
    """

    bands: int
    bits: tuple[int, ...]
    sample_format: int
    photometric: int
    planar: bool
    georeferenced: bool
    alpha: bool
    block_px: int
    mask_block_px: int
    has_no_data_value: bool = False
    other_pages: tuple[tuple[int, int], ...] = ()
    compression: int = 1
    tiled: bool = False

    @property
    def pixel_bytes(self) -> int:
        """Bytes of a decoded pixel with all bands."""
        most_bits = max(self.bits)
        for sample_bytes in (1, 2, 4):
            if most_bits <= 8 * sample_bytes:
                return self.bands * sample_bytes
        return self.bands * 8


@dataclass(frozen=True)
class ImageHeader:
    """Header of an encoded image.

    Attributes:
        format: one of ``vehanchor.imagery.formats.header.IMAGE_FORMATS``.
        width_px: declared width as stored, before the orientation is applied.
        height_px: declared height as stored.
        orientation: EXIF orientation, 1 to 8; 1 if it is absent or invalid.
        complete: False if the file ends too early (not every format shows it).
        tiff: layout of a TIFF; None for other formats.
        decoding_bytes: memory to decode it whole: its pixels and the decoder's buffers.
        tile_px: pixels of a JPEG 2000's tile, which is decoded whole; 0 for other formats.
        structure_bytes: memory for the structures of a tile beside its pixels, and for the list of
            all tiles; 0 for other formats than JPEG 2000.
        bands: samples per pixel of a JPEG 2000; 0 for other formats.
        n_frames: pictures of an animation; 1 for other files.
        metadata: offset and length of each block of EXIF or XMP; a TIFF has them as tags.
    """

    format: str
    width_px: int
    height_px: int
    orientation: int = 1
    complete: bool = True
    tiff: TiffLayout | None = None
    decoding_bytes: int = 0
    tile_px: int = 0
    structure_bytes: int = 0
    bands: int = 0
    n_frames: int = 1
    metadata: tuple[tuple[int, int], ...] = ()
