from __future__ import annotations

import io
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.skill.imagery.files import (
    HEIGHT_PX,
    RGB,
    WIDTH_PX,
    encoded,
    geotiff,
    read_all,
)
from vehanchor.errors import (
    ImageDecodeError,
    ImageFormatError,
    ImageNotFoundError,
    InvalidParameterError,
)
from vehanchor.imagery.sources.opening import open_raster


def test_a_path_a_file_object_and_all_kinds_of_bytes_are_images(tmp_path: Path) -> None:
    data = encoded(".png")
    path = tmp_path / "städt isch.png"
    path.write_bytes(data)
    sources: list[tuple[Any, str]] = [
        (path, str(path)),
        (str(path), str(path)),
        (data, "bytes"),
        (bytearray(data), "bytes"),
        (memoryview(data), "bytes"),
        (io.BytesIO(data), "file"),
    ]
    for image, source in sources:
        with open_raster(image) as raster:
            assert raster.source == source
            assert (raster.width_px, raster.height_px) == (WIDTH_PX, HEIGHT_PX)
            assert raster.georeference_gsd_m_per_px is None
            assert raster.warnings == ()
            np.testing.assert_array_equal(raster.read(), RGB)
    with path.open("rb") as file:
        np.testing.assert_array_equal(read_all(file), RGB)


def test_a_relative_path_is_reported_as_given(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    geotiff(Path("a.tif"), RGB)
    with open_raster("a.tif") as raster:
        assert raster.source == "a.tif"
        np.testing.assert_array_equal(raster.read(), RGB)


@pytest.fixture
def bad_paths(tmp_path: Path) -> dict[str, str]:
    os.mkfifo(tmp_path / "fifo.png")
    (tmp_path / "plain").write_bytes(b"x")
    return {
        "missing": str(tmp_path / "missing.png"),
        "directory": str(tmp_path),
        "fifo": str(tmp_path / "fifo.png"),
        "device": "/dev/zero",
        "below a file": str(tmp_path / "plain" / "a.png"),
        "empty name": "",
        "nul": "a\0b.png",
        "long": "a" * 5000,
        "vsi": "/vsicurl/https://example.com/a.tif",
        "address": "https://example.com/a.tif",
    }


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("missing", "No such file"),
        ("directory", "is a folder: give an image; vehanchor.find_images"),
        ("fifo", "is a pipe"),
        ("device", "device"),
        ("below a file", "Not a directory"),
        ("empty name", "No such file"),
        ("nul", "null"),
        ("long", "too long"),
        ("vsi", "No such file"),
        ("address", r"No such file.*; download it, or pass rasterio\.open"),
    ],
)
def test_what_is_no_file_is_not_found(bad_paths: dict[str, str], name: str, message: str) -> None:
    with pytest.raises(ImageNotFoundError, match=message) as caught:
        open_raster(bad_paths[name])
    assert caught.value.code == "image_not_found"
    assert repr(bad_paths[name]) in str(caught.value)


@pytest.mark.parametrize("image", [None, 7, ["a.png"], object()])
def test_what_is_no_source_at_all_is_a_wrong_parameter(image: Any) -> None:
    with pytest.raises(InvalidParameterError, match=type(image).__name__) as caught:
        open_raster(image)
    assert caught.value.code == "invalid_parameter"


def test_a_text_file_object_is_a_wrong_parameter() -> None:
    stream: Any = io.StringIO("text")
    with pytest.raises(InvalidParameterError, match="binary mode"):
        open_raster(stream)


def test_a_failing_file_object_is_undecodable() -> None:
    class Failing(io.RawIOBase):
        def read(self, _size: int = -1) -> bytes:
            raise OSError("cable pulled")

    stream: Any = Failing()
    with pytest.raises(ImageDecodeError, match="cable pulled"):
        open_raster(stream)


def test_no_file_stays_open(tmp_path: Path) -> None:
    path = geotiff(tmp_path / "a.tif", RGB)
    (tmp_path / "bad.png").write_bytes(b"bad")
    before = len(list(Path("/proc/self/fd").iterdir()))
    for _ in range(3):
        with open_raster(path) as raster:
            raster.read()
        with pytest.raises(ImageFormatError):
            open_raster(geotiff(tmp_path / "b.tif", RGB.astype(np.int16)))
        with pytest.raises(ImageNotFoundError):
            open_raster(tmp_path)
        with pytest.raises(ImageDecodeError):
            open_raster(tmp_path / "bad.png")
    assert len(list(Path("/proc/self/fd").iterdir())) == before
