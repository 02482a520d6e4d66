from __future__ import annotations

import io
import struct
from pathlib import Path

import numpy as np
import pytest

from tests.skill.imagery.files import (
    RGB,
    bigtiff_header,
    bmp_header,
    encoded,
    exif,
    jpeg_header,
    jpeg_with,
    png_header,
    read_all,
    tiff_header,
    webp_header,
)
from vehanchor.errors import (
    ImageDecodeError,
)
from vehanchor.imagery.sources.opening import open_raster


@pytest.mark.parametrize("value", [0, 9, 65535])
def test_a_meaningless_orientation_is_ignored(value: int) -> None:
    assert read_all(jpeg_with(value)).shape == RGB.shape


def test_damaged_exif_is_ignored() -> None:
    data = encoded(".jpg")
    for payload in (b"Exif\0\0", b"Exif\0\0II*\0", b"Exif\0\0" + exif(6)[:-9], b"Exif\0\0XX*\0" + b"\xff" * 20):
        segment = b"\xff\xe1" + struct.pack(">H", len(payload) + 2) + payload
        assert read_all(data[:2] + segment + data[2:]).shape == RGB.shape


@pytest.mark.parametrize("size", [(1, 1), (2048, 300), (1600, 1200)])
def test_an_end_mark_is_found_wherever_the_scan_is_cut_into_chunks(size: tuple[int, int]) -> None:
    from vehanchor.imagery.formats import header as image_header
    from vehanchor.imagery.formats import jpeg

    data = encoded(".jpg", np.random.default_rng(1).integers(0, 256, (*size, 3), dtype=np.uint8))
    for chunk_bytes in (2, 3, 64, 1000, 1 << 20)[-2 if len(data) > 100_000 else 0 :]:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(jpeg, "_CHUNK_BYTES", chunk_bytes)
            assert image_header.read_header(lambda at, n: data[at : at + n]).complete
            assert not image_header.read_header(lambda at, n: data[: len(data) - 1][at : at + n]).complete


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\0",
        b"this is text",
        b"GIF89a" + bytes(50),
        b"\xff\xd8\xff",
        b"\xff\xd8\xff\xd9",
        b"\xff\xd8\xff\xe0\xff",
        b"\x89PNG\r\n\x1a\n",
        b"\x89PNG\r\n\x1a\n" + bytes(30),
        png_header(30, 30),
        jpeg_header(30, 30),
        bmp_header(30, 30),
        webp_header(30, 30),
        tiff_header(30, 30),
        b"BM",
        b"RIFF\0\0\0\0WEBP",
        b"II*\0",
        b"II*\0\xff\xff\xff\xff",
        b"II*\0\x08\0\0\0\xff\xff",
        b"II*\0\x08\0\0\0\0\0",
        bigtiff_header(30, 30),
    ],
    ids=lambda data: repr(data[:16]),
)
def test_what_is_no_image_is_undecodable(data: bytes, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "a.png"
    path.write_bytes(data)
    for image in (path, data, io.BytesIO(data)):
        with pytest.raises(ImageDecodeError) as caught:
            open_raster(image)
        assert caught.value.code == "image_undecodable"
    assert capfd.readouterr().err == ""
