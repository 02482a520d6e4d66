from __future__ import annotations

import io
import os
import struct
import sys
import time
import tracemalloc
import warnings
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import rasterio
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from PIL import Image
from rasterio.errors import NotGeoreferencedWarning
from rasterio.transform import Affine

from vehanchor.errors import (
    ImageDecodeError,
    ImageError,
    ImageFormatError,
    ImageNotFoundError,
    ImageTooLargeError,
    InvalidParameterError,
    MissingExtraError,
)
from vehanchor.imagery.raster import MIN_SIDE_PX, Window, open_raster
from vehanchor.options import ImageLimits

WIDTH_PX, HEIGHT_PX = 60, 40


def smooth_rgb(width_px: int = WIDTH_PX, height_px: int = HEIGHT_PX) -> NDArray[np.uint8]:
    """A colour ramp that no flip, turn or band swap leaves as it is, gentle enough for JPEG."""
    x = np.linspace(0, 1, width_px)[np.newaxis, :]
    y = np.linspace(0, 1, height_px)[:, np.newaxis]
    bands = [40 + 180 * x + 0 * y, 200 - 150 * y + 0 * x, 60 + 60 * x * y]
    return np.rint(np.stack(bands, axis=-1)).astype(np.uint8)


RGB = smooth_rgb()
NOISE = np.random.default_rng(7).integers(0, 256, (90, 130, 3), dtype=np.uint8)


def encoded(suffix: str, rgb: NDArray[Any] = RGB, *parameters: int) -> bytes:
    done, data = cv2.imencode(suffix, rgb[..., ::-1] if rgb.ndim == 3 else rgb, parameters)
    assert done
    return data.tobytes()


def pillow(format_name: str, mode: str, rgb: NDArray[Any] = RGB, **options: Any) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(rgb).convert(mode).save(buffer, format_name, **options)
    return buffer.getvalue()


def geotiff(path: Path, bands_hwc: NDArray[Any], mask: NDArray[Any] | None = None, **profile: Any) -> Path:
    """Write [h, w, bands] as a GeoTIFF of 0.25 m/px in UTM 31N unless told otherwise."""
    height, width, count = bands_hwc.shape
    profile = {
        "crs": "EPSG:32631",
        "transform": Affine(0.25, 0, 500_000, 0, -0.25, 5_000_000),
        "driver": "GTiff",
        "dtype": bands_hwc.dtype,
        **profile,
    }
    with warnings.catch_warnings(), rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True):
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        with rasterio.open(path, "w", width=width, height=height, count=count, **profile) as dataset:
            dataset.write(np.moveaxis(bands_hwc, -1, 0))
            if mask is not None:
                dataset.write_mask(mask)
    return path


def read_all(image: Any, **options: Any) -> NDArray[np.uint8]:
    with open_raster(image, **options) as raster:
        pixels = raster.read()
        assert pixels.shape == (raster.height_px, raster.width_px, 3)
        assert pixels.dtype == np.uint8
        assert pixels.flags.c_contiguous
        return pixels


# --- Formats ---


@pytest.mark.parametrize(
    ("data", "tolerance"),
    [
        (encoded(".png"), 0),
        (encoded(".bmp"), 0),
        (encoded(".tif"), 0),
        (encoded(".webp", RGB, cv2.IMWRITE_WEBP_QUALITY, 101), 0),
        (encoded(".webp", RGB, cv2.IMWRITE_WEBP_QUALITY, 95), 12),
        (encoded(".jpg", RGB, cv2.IMWRITE_JPEG_QUALITY, 98), 6),
        (encoded(".jpg", RGB, cv2.IMWRITE_JPEG_QUALITY, 98, cv2.IMWRITE_JPEG_PROGRESSIVE, 1), 6),
        (encoded(".jpg", RGB, cv2.IMWRITE_JPEG_QUALITY, 98, cv2.IMWRITE_JPEG_RST_INTERVAL, 2), 6),
        (pillow("JPEG", "CMYK", quality=98), 8),
        (pillow("PNG", "RGBA"), 0),
        (pillow("WEBP", "RGBA", lossless=True), 0),
        (pillow("TIFF", "RGBA"), 0),
        (pillow("TIFF", "RGB", compression="tiff_lzw"), 0),
        (pillow("TIFF", "RGB", compression="jpeg", quality=98), 6),
        (pillow("TIFF", "YCbCr", compression="jpeg", quality=98), 8),
    ],
    ids=lambda value: None if isinstance(value, bytes) else str(value),
)
def test_every_format_gives_the_same_rgb(data: bytes, tolerance: int) -> None:
    difference = np.abs(read_all(data).astype(int) - RGB)
    assert difference.max() <= tolerance


@pytest.mark.parametrize("format_name", ["PNG", "BMP", "TIFF"])
@pytest.mark.parametrize("mode", ["L", "P", "1"])
def test_grey_palette_and_bilevel_become_three_bands(format_name: str, mode: str) -> None:
    data = pillow(format_name, mode)
    expected = np.asarray(Image.open(io.BytesIO(data)).convert("RGB"))
    np.testing.assert_array_equal(read_all(data), expected)


@pytest.mark.parametrize("depth", [8, 16])
def test_a_tiff_whose_white_is_zero_is_shown_as_seen_or_refused(depth: int, tmp_path: Path) -> None:
    grey = RGB[..., :1].astype(f"u{depth // 8}")
    path = geotiff(tmp_path / "grey.tif", grey, photometric="MINISWHITE", crs=None, transform=None)
    if depth == 8:
        np.testing.assert_array_equal(read_all(path)[..., 0], 255 - grey[..., 0])
    else:
        with pytest.raises(ImageFormatError, match="photometric interpretation 0"):
            open_raster(path)


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


# --- Orientation ---


def exif(orientation: int, order: str = "<") -> bytes:
    mark = b"II*\0" if order == "<" else b"MM\0*"
    return mark + struct.pack(order + "IHHHIHHI", 8, 1, 274, 3, 1, orientation, 0, 0)


def jpeg_with(orientation: int, order: str = "<") -> bytes:
    data = encoded(".jpg", RGB, cv2.IMWRITE_JPEG_QUALITY, 100)
    payload = b"Exif\0\0" + exif(orientation, order)
    comment = b"\xff\xfe\x00\x04hi"
    return data[:2] + comment + b"\xff\xe1" + struct.pack(">H", len(payload) + 2) + payload + data[2:]


def png_with(orientation: int) -> bytes:
    data = encoded(".png")
    payload = exif(orientation)
    chunk = struct.pack(">I", len(payload)) + b"eXIf" + payload + struct.pack(">I", zlib.crc32(b"eXIf" + payload))
    return data[:33] + chunk + data[33:]


def webp_with(orientation: int) -> bytes:
    return pillow("WEBP", "RGB", lossless=True, exif=b"Exif\0\0" + exif(orientation))


def tiff_with(orientation: int) -> bytes:
    return pillow("TIFF", "RGB", tiffinfo={274: orientation})


UPRIGHT: dict[int, Callable[[NDArray[Any]], NDArray[Any]]] = {
    1: lambda a: a,
    2: lambda a: a[:, ::-1],
    3: lambda a: a[::-1, ::-1],
    4: lambda a: a[::-1],
    5: lambda a: a.swapaxes(0, 1),
    6: lambda a: np.rot90(a, -1),
    7: lambda a: a.swapaxes(0, 1)[::-1, ::-1],
    8: lambda a: np.rot90(a, 1),
}


@pytest.mark.parametrize("orientation", UPRIGHT)
@pytest.mark.parametrize("make", [jpeg_with, png_with, webp_with, tiff_with])
def test_the_orientation_tag_is_honoured(make: Callable[[int], bytes], orientation: int) -> None:
    expected = UPRIGHT[orientation](RGB)
    with open_raster(make(orientation)) as raster:
        assert (raster.height_px, raster.width_px) == expected.shape[:2]
        assert np.abs(raster.read().astype(int) - expected).max() <= 4
        window = Window(3, 5, 20, 7)
        assert np.abs(raster.read(window).astype(int) - expected[5:12, 3:23]).max() <= 4


@pytest.mark.parametrize("orientation", UPRIGHT)
def test_a_tiff_read_by_windows_is_turned_like_one_decoded_whole(orientation: int) -> None:
    data = tiff_with(orientation)
    limits = ImageLimits(max_pixels=WIDTH_PX * HEIGHT_PX - 1)
    np.testing.assert_array_equal(read_all(data, limits=limits), read_all(data))


def test_opencv_and_this_code_agree_on_jpeg_orientation() -> None:
    for orientation in range(1, 9):
        data = jpeg_with(orientation, ">")
        theirs = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
        assert theirs is not None
        np.testing.assert_array_equal(read_all(data), theirs[..., ::-1])


@pytest.mark.parametrize("value", [0, 9, 65535])
def test_a_meaningless_orientation_is_ignored(value: int) -> None:
    assert read_all(jpeg_with(value)).shape == RGB.shape


def test_damaged_exif_is_ignored() -> None:
    data = encoded(".jpg")
    for payload in (b"Exif\0\0", b"Exif\0\0II*\0", b"Exif\0\0" + exif(6)[:-9], b"Exif\0\0XX*\0" + b"\xff" * 20):
        segment = b"\xff\xe1" + struct.pack(">H", len(payload) + 2) + payload
        assert read_all(data[:2] + segment + data[2:]).shape == RGB.shape


# --- Depth and bands ---


@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_sixteen_bits_are_stretched_by_percentiles_and_not_shifted(suffix: str) -> None:
    twelve_bit = RGB.astype(np.uint16) * 16 + 7
    with open_raster(encoded(suffix, twelve_bit)) as raster:
        shown = raster.read()
        assert [note.code for note in raster.warnings] == ["pixels_stretched"]
    low, high = np.percentile(twelve_bit, (2, 98), method="nearest")
    expected = np.rint(np.clip((twelve_bit - float(low)) / (float(high) - low), 0, 1) * 255)
    np.testing.assert_allclose(shown, expected, atol=1)
    np.testing.assert_array_equal(shown, read_all(twelve_bit))


def test_files_of_floats_and_sixteen_bit_alpha_are_read_in_rgb_order(tmp_path: Path) -> None:
    unit = (RGB / 255).astype(np.float32)
    plain = geotiff(tmp_path / "a.tif", unit, crs=None, transform=None, photometric="RGB")
    with without_rasterio():
        np.testing.assert_array_equal(read_all(plain), RGB)
    alpha = np.full((HEIGHT_PX, WIDTH_PX, 1), 65535)
    bgra = np.concatenate([RGB[..., ::-1].astype(np.uint16) * 257, alpha], axis=2).astype(np.uint16)
    data = cv2.imencode(".png", bgra)[1].tobytes()
    np.testing.assert_array_equal(read_all(data), read_all(RGB.astype(np.uint16) * 257))


ARRAYS: list[tuple[str, NDArray[Any], NDArray[Any]]] = [
    ("rgb", RGB, RGB),
    ("grey", RGB[..., 0], RGB[..., [0, 0, 0]]),
    ("one band", RGB[..., :1], RGB[..., [0, 0, 0]]),
    ("grey and alpha", RGB[..., :2], RGB[..., [0, 0, 0]]),
    ("four bands", np.concatenate([RGB, RGB[..., :1]], axis=2), RGB),
    ("floats of 0..1", RGB / 255, RGB),
    ("float32", (RGB / 255).astype(np.float32), RGB),
    ("a strided view", np.repeat(RGB, 2, axis=1)[:, ::2], RGB),
    ("a mirrored view", RGB[:, ::-1], RGB[:, ::-1]),
    ("BGR turned by a view", RGB[..., ::-1], RGB[..., ::-1]),
    ("all zero", np.zeros((20, 20), np.uint16), np.zeros((20, 20, 3))),
    ("a constant", np.full((20, 20), 5000, np.uint16), np.zeros((20, 20, 3))),
    ("zero floats", np.zeros((20, 20)), np.zeros((20, 20, 3))),
]


@pytest.mark.parametrize(("array", "expected"), [case[1:] for case in ARRAYS], ids=[case[0] for case in ARRAYS])
def test_arrays_are_read_and_left_as_they_are(array: NDArray[Any], expected: NDArray[Any]) -> None:
    before = array.copy()
    np.testing.assert_array_equal(read_all(array), expected)
    np.testing.assert_array_equal(array, before)
    assert array.flags.writeable


def test_an_rgb_array_is_not_copied_and_cannot_be_written_through() -> None:
    array = RGB.copy()
    with open_raster(array) as raster:
        assert raster.source == "array"
        shown = raster.read()
    assert np.shares_memory(shown, array)
    assert not shown.flags.writeable


@pytest.mark.parametrize("dtype", ["float16", ">u2", ">f4", "uint16", "float64"])
def test_depths_and_byte_orders_give_the_same_picture(dtype: str) -> None:
    array = (RGB.astype(int) * 3).astype(dtype)
    np.testing.assert_array_equal(read_all(array), read_all(array.astype(np.float64)))


def test_one_bright_pixel_does_not_turn_the_picture_black() -> None:
    array = np.zeros((30, 30), np.uint16)
    array[4, 5] = 60000
    shown = read_all(array)
    assert shown[4, 5].tolist() == [255, 255, 255]
    assert shown.sum() == 3 * 255


def test_a_large_array_is_stretched_from_a_sample_spread_over_all_of_it() -> None:
    ramp = np.linspace(1000, 3000, 1500).astype(np.uint16)
    with open_raster(np.tile(ramp, (1200, 1))) as raster:
        row = raster.read(Window(0, 600, 1500, 1))[0, :, 0].astype(int)
    assert abs(int(np.argmax(row > 0)) - 30) <= 8
    assert abs(int(np.argmax(row == 255)) - 1470) <= 8


def test_bands_choose_red_green_and_blue() -> None:
    five = np.concatenate([RGB, 255 - RGB[..., :2]], axis=2)
    with open_raster(five) as raster:
        np.testing.assert_array_equal(raster.read(), RGB)
        assert [note.code for note in raster.warnings] == ["bands_selected"]
        assert "5 bands" in raster.warnings[0].message
    with open_raster(five, bands=(5, 1, 4)) as raster:
        np.testing.assert_array_equal(raster.read(), five[..., [4, 0, 3]])
        assert raster.warnings == ()
    np.testing.assert_array_equal(read_all(encoded(".png"), bands=(3, 2, 2)), RGB[..., [2, 1, 1]])


@pytest.mark.parametrize("bands", [(0, 1, 2), (1, 2, 4), (1, 2), (-1, 1, 1), (1.0, 2.0, 3.0), "123"])
def test_bands_that_are_not_there_are_a_wrong_parameter(bands: Any) -> None:
    for image in (RGB, encoded(".png")):
        with pytest.raises(InvalidParameterError):
            open_raster(image, bands=bands)


# --- Windows ---


@pytest.mark.parametrize(
    "window",
    [Window(-1, 0, 4, 4), Window(0, 0, WIDTH_PX + 1, 4), Window(0, 37, 4, 4), Window(0, 0, 0, 4), Window(5, 5, 3, -1)],
)
def test_a_window_that_is_not_inside_is_a_wrong_parameter(window: Window) -> None:
    with open_raster(RGB) as raster, pytest.raises(InvalidParameterError, match="60 x 40"):
        raster.read(window)


@pytest.fixture(scope="module")
def windowed_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("geo") / "tiled.tif"
    mask = np.full(NOISE.shape[:2], 255, np.uint8)
    mask[:20, 100:] = 0
    pixels = NOISE.astype(np.uint16) * 13 + 300
    return geotiff(path, pixels, mask, tiled=True, blockxsize=32, blockysize=16, compress="deflate")


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_windows_are_slices_of_the_whole(windowed_file: Path, data: st.DataObject) -> None:
    height, width = NOISE.shape[:2]
    x, y = data.draw(st.integers(0, width - 1)), data.draw(st.integers(0, height - 1))
    w, h = data.draw(st.integers(1, width - x)), data.draw(st.integers(1, height - y))
    with open_raster(windowed_file) as raster:
        whole = raster.read()
        part = raster.read(Window(x, y, w, h))
    assert part.flags.c_contiguous
    np.testing.assert_array_equal(part, whole[y : y + h, x : x + w])


# --- GeoTIFF ---


def test_a_geotiff_is_read_from_a_path_or_from_bytes(tmp_path: Path) -> None:
    path = geotiff(tmp_path / "a.tif", RGB, tiled=True, blockxsize=16, blockysize=16)
    for image in (path, path.read_bytes(), io.BytesIO(path.read_bytes())):
        with open_raster(image) as raster:
            assert raster.georeference_gsd_m_per_px == pytest.approx(0.25)
            np.testing.assert_array_equal(raster.read(), RGB)


def test_a_cog_with_jpeg_colours_is_read(tmp_path: Path) -> None:
    large = smooth_rgb(512, 256)
    path = geotiff(tmp_path / "a.tif", large, driver="COG", compress="jpeg", quality=95, blocksize=256)
    assert np.abs(read_all(path).astype(int) - large).max() <= 8


def test_more_than_four_bands_are_read_through_rasterio_and_told(tmp_path: Path) -> None:
    five = np.concatenate([RGB, 255 - RGB[..., :2]], axis=2)
    path = geotiff(tmp_path / "a.tif", five, crs=None, transform=None)
    with open_raster(path) as raster:
        assert raster.georeference_gsd_m_per_px is None
        assert [note.code for note in raster.warnings] == ["bands_selected"]
        np.testing.assert_array_equal(raster.read(), RGB)
    np.testing.assert_array_equal(read_all(path, bands=(5, 5, 1)), five[..., [4, 4, 0]])


def test_nodata_masks_and_alpha_are_black(tmp_path: Path) -> None:
    hole = np.s_[5:15, 10:30]
    expected = RGB.copy()
    expected[hole] = 0
    mask = np.full(RGB.shape[:2], 255, np.uint8)
    mask[hole] = 0
    with_mask = geotiff(tmp_path / "mask.tif", RGB, mask)
    with_alpha = geotiff(tmp_path / "alpha.tif", np.dstack([RGB, mask]), photometric="RGB", alpha="YES")
    marked = RGB.copy()
    marked[hole] = 255
    with_nodata = geotiff(tmp_path / "nodata.tif", marked, nodata=255)
    for path in (with_mask, with_alpha, with_nodata):
        np.testing.assert_array_equal(read_all(path), expected)


def test_a_near_infrared_band_does_not_mask(tmp_path: Path) -> None:
    four = np.dstack([RGB, np.zeros_like(RGB[..., 0])])
    np.testing.assert_array_equal(read_all(geotiff(tmp_path / "a.tif", four, photometric="RGB", alpha="NO")), RGB)


def test_values_without_data_do_not_take_part_in_the_stretch(tmp_path: Path) -> None:
    values = RGB.astype(np.uint16) * 20
    values[:20] = 0
    shown = read_all(geotiff(tmp_path / "a.tif", values, nodata=0))
    np.testing.assert_array_equal(shown[20:], read_all(values[20:]))
    assert not shown[:20].any()


def test_nan_in_a_geotiff_is_no_data(tmp_path: Path) -> None:
    values = (RGB / 255).astype(np.float32)
    values[:10] = np.nan
    for nodata in (None, np.nan):
        shown = read_all(geotiff(tmp_path / "a.tif", values, nodata=nodata))
        np.testing.assert_array_equal(shown[10:], RGB[10:])
        assert not shown[:10].any()


def test_a_raster_without_any_data_is_black(tmp_path: Path) -> None:
    for dtype in (np.uint16, np.float32):
        path = geotiff(tmp_path / "a.tif", np.zeros((20, 20, 3), dtype), nodata=0)
        assert not read_all(path).any()


def test_a_large_raster_is_stretched_alike_in_all_windows(tmp_path: Path) -> None:
    ramp = np.tile(np.linspace(1000, 3000, 1500).astype(np.uint16), (1200, 1))
    path = geotiff(tmp_path / "a.tif", ramp[..., np.newaxis], tiled=True, compress="deflate")
    with open_raster(path) as raster:
        whole = raster.read()
        np.testing.assert_array_equal(raster.read(Window(700, 100, 300, 200)), whole[100:300, 700:1000])
    assert whole[0, 10].max() == 0
    assert whole[0, -10].min() == 255


def test_a_palette_geotiff_shows_its_colours(tmp_path: Path) -> None:
    indices = (np.arange(20 * 20, dtype=np.uint8) % 3).reshape(20, 20, 1)
    path = geotiff(tmp_path / "a.tif", indices, photometric="palette")
    colours = {0: (10, 20, 30, 255), 1: (200, 100, 0, 255), 2: (7, 8, 9, 255)}
    with rasterio.open(path, "r+") as dataset:
        dataset.write_colormap(1, colours)
    expected = np.array([colours[i][:3] for i in range(3)])[indices[..., 0]]
    np.testing.assert_array_equal(read_all(path), expected)
    np.testing.assert_array_equal(read_all(path, bands=(3, 2, 1)), expected[..., ::-1])


def test_files_beside_a_tiff_are_not_looked_at(tmp_path: Path) -> None:
    path = geotiff(tmp_path / "a.tif", NOISE[..., [0, 1, 2, 0, 1]], crs=None, transform=None)
    (tmp_path / "a.tfw").write_text("0.5\n0\n0\n-0.5\n100\n200\n")
    aux = "<PAMDataset><SRS>EPSG:32631</SRS><GeoTransform>0, 0.5, 0, 0, 0, -0.5</GeoTransform></PAMDataset>"
    (tmp_path / "a.tif.aux.xml").write_text(aux)
    geotiff(tmp_path / "a.tif.msk", np.zeros((90, 130, 1), np.uint8), crs=None, transform=None)
    before = sorted(tmp_path.iterdir())
    with open_raster(path) as raster:
        assert raster.georeference_gsd_m_per_px is None
        np.testing.assert_array_equal(raster.read(), NOISE)
    assert sorted(tmp_path.iterdir()) == before


@contextmanager
def without_rasterio() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        for name in [name for name in sys.modules if name.partition(".")[0] == "rasterio"]:
            patch.delitem(sys.modules, name)
        patch.setitem(sys.modules, "rasterio", None)
        yield


def test_without_rasterio_a_geotiff_names_the_extra_and_a_plain_tiff_opens(tmp_path: Path) -> None:
    path = geotiff(tmp_path / "a.tif", RGB)
    with without_rasterio():
        for image in (path, path.read_bytes()):
            with pytest.raises(MissingExtraError, match=r"pip install 'vehanchor\[geo\]'") as caught:
                open_raster(image)
            assert caught.value.code == "missing_extra"
        np.testing.assert_array_equal(read_all(encoded(".tif")), RGB)


# --- Limits ---


def png_header(width: int, height: int) -> bytes:
    body = b"IHDR" + struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + body + struct.pack(">I", zlib.crc32(body))


def jpeg_header(width: int, height: int) -> bytes:
    return b"\xff\xd8\xff\xff\xc0" + struct.pack(">HBHHB", 17, 8, height, width, 3) + bytes(9) + b"\xff\xd9"


def bmp_header(width: int, height: int) -> bytes:
    return b"BM" + struct.pack("<IIIIiiHH", 54, 0, 54, 40, width, height, 1, 24) + bytes(24)


def os2_bmp_header(width: int, height: int) -> bytes:
    return b"BM" + struct.pack("<IIIIHHHH", 26, 0, 26, 12, width, height, 1, 24)


def webp(chunk: bytes, body: bytes) -> bytes:
    return b"RIFF" + struct.pack("<I", 12 + len(body)) + b"WEBP" + chunk + struct.pack("<I", len(body)) + body


def webp_header(width: int, height: int) -> bytes:
    return webp(b"VP8X", bytes(4) + (width - 1).to_bytes(3, "little") + (height - 1).to_bytes(3, "little"))


def webp_lossy_header(width: int, height: int) -> bytes:
    return webp(b"VP8 ", b"\0\0\0\x9d\x01\x2a" + struct.pack("<HH", width, height))


def webp_lossless_header(width: int, height: int) -> bytes:
    return webp(b"VP8L", b"\x2f" + struct.pack("<I", (width - 1) | (height - 1) << 14) + b"\0")


def tiff_header(width: int, height: int, order: str = "<") -> bytes:
    entries = [(256, 4, width), (257, 4, height), (258, 3, 8), (262, 3, 1), (277, 3, 1)]
    data = (b"II" if order == "<" else b"MM") + struct.pack(order + "HIH", 42, 8, len(entries))
    for tag, kind, value in entries:
        data += struct.pack(order + ("HHIHxx" if kind == 3 else "HHII"), tag, kind, 1, value)
    return data + bytes(4)


def tiff_header_of_a_mac(width: int, height: int) -> bytes:
    return tiff_header(width, height, ">")


def bigtiff_header(width: int, height: int) -> bytes:
    data = struct.pack("<2sHHHQQ", b"II", 43, 8, 0, 16, 2)
    return data + struct.pack("<HHQQHHQQ", 256, 16, 1, width, 257, 4, 1, height) + bytes(8)


@pytest.mark.parametrize(
    ("make", "side_px"),
    [
        (png_header, 100_000),
        (jpeg_header, 65_500),
        (bmp_header, 100_000),
        (os2_bmp_header, 65_500),
        (webp_header, 100_000),
        (webp_lossy_header, 16_000),
        (webp_lossless_header, 16_000),
        (tiff_header, 200_000),
        (tiff_header_of_a_mac, 200_000),
        (bigtiff_header, 200_000),
    ],
)
def test_a_huge_declared_size_is_refused_before_decoding(
    make: Callable[[int, int], bytes], side_px: int, tmp_path: Path
) -> None:
    data = make(side_px, side_px - 1)
    path = tmp_path / "huge"
    path.write_bytes(data)
    tracemalloc.start()
    try:
        started = time.perf_counter()
        for image in (data, path):
            with pytest.raises(ImageTooLargeError, match=f"{side_px} x {side_px - 1} px") as caught:
                open_raster(image)
            assert caught.value.code == "image_too_large"
        assert time.perf_counter() - started < 1
        assert tracemalloc.get_traced_memory()[1] < 4 << 20
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize(
    "make", [png_header, jpeg_header, bmp_header, os2_bmp_header, webp_lossy_header, tiff_header, bigtiff_header]
)
@pytest.mark.parametrize("size_px", [(0, 0), (0, 50), (50, 0), (1, 1), (MIN_SIDE_PX - 1, 500)])
def test_too_small_a_declared_size_cannot_be_measured(
    make: Callable[[int, int], bytes], size_px: tuple[int, int]
) -> None:
    with pytest.raises(ImageFormatError, match=f"{MIN_SIDE_PX} px a side") as caught:
        open_raster(make(*size_px))
    assert caught.value.code == "image_unsupported"


def test_the_smallest_measurable_image_opens() -> None:
    smallest = RGB[:MIN_SIDE_PX, :MIN_SIDE_PX]
    np.testing.assert_array_equal(read_all(encoded(".png", smallest)), smallest)


def test_the_byte_limit_holds_for_every_kind_of_source(tmp_path: Path) -> None:
    data = encoded(".png", NOISE)
    path = tmp_path / "a.png"
    path.write_bytes(data)
    exact, tight = ImageLimits(max_bytes=len(data)), ImageLimits(max_bytes=len(data) - 1)
    for make in (lambda: data, lambda: bytearray(data), lambda: path, lambda: io.BytesIO(data)):
        read_all(make(), limits=exact)
        with pytest.raises(ImageTooLargeError, match=str(len(data) - 1)):
            open_raster(make(), limits=tight)


def test_an_endless_file_object_is_left_at_the_limit() -> None:
    class Endless(io.RawIOBase):
        given = 0

        def readable(self) -> bool:
            return True

        def read(self, size: int = -1) -> bytes:
            assert size > 0
            self.given += size
            return b"\x89" * size

    stream: Any = Endless()
    with pytest.raises(ImageTooLargeError):
        open_raster(stream, limits=ImageLimits(max_bytes=3_000_000))
    assert stream.given == 3_000_001


def test_a_tiff_over_the_limits_for_whole_decoding_is_read_by_windows(tmp_path: Path) -> None:
    path = geotiff(tmp_path / "a.tif", NOISE, crs=None, transform=None, tiled=True, blockxsize=16, blockysize=16)
    for limits in (ImageLimits(max_pixels=NOISE[..., 0].size - 1), ImageLimits(max_bytes=1000)):
        np.testing.assert_array_equal(read_all(path, limits=limits), NOISE)
        with without_rasterio(), pytest.raises(MissingExtraError):
            open_raster(path, limits=limits)
    with pytest.raises(ImageTooLargeError):
        open_raster(path, limits=ImageLimits(max_windowed_pixels=NOISE[..., 0].size - 1))


def test_a_tiff_stored_in_one_huge_block_is_refused(tmp_path: Path) -> None:
    path = geotiff(tmp_path / "a.tif", NOISE, blockysize=NOISE.shape[0], compress="deflate")
    with pytest.raises(ImageTooLargeError, match="store it tiled"):
        open_raster(path, limits=ImageLimits(max_pixels=2000))


@pytest.mark.parametrize("name", ["max_bytes", "max_pixels", "max_windowed_pixels"])
def test_limits_are_positive(name: str) -> None:
    with pytest.raises(InvalidParameterError, match=name):
        ImageLimits(**{name: 0})


# --- Bad input ---


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
        "url": "https://example.com/a.tif",
        "vsi": "/vsicurl/https://example.com/a.tif",
    }


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("missing", "No such file"),
        ("directory", "is a directory"),
        ("fifo", "is a pipe"),
        ("device", "device"),
        ("below a file", "Not a directory"),
        ("empty name", "No such file"),
        ("nul", "null"),
        ("long", "too long"),
        ("url", "No such file"),
        ("vsi", "No such file"),
    ],
)
def test_what_is_no_file_is_not_found(bad_paths: dict[str, str], name: str, message: str) -> None:
    with pytest.raises(ImageNotFoundError, match=message) as caught:
        open_raster(bad_paths[name])
    assert caught.value.code == "image_not_found"
    assert repr(bad_paths[name]) in str(caught.value)


JPEG, PNG = encoded(".jpg", NOISE), encoded(".png", NOISE)
PROGRESSIVE = encoded(".jpg", NOISE, cv2.IMWRITE_JPEG_PROGRESSIVE, 1)
THUMBNAIL = b"Exif\0\0" + exif(1) + JPEG[:3000] + b"\xff\xd9"
WITH_THUMBNAIL = JPEG[:2] + b"\xff\xe1" + struct.pack(">H", len(THUMBNAIL) + 2) + THUMBNAIL + JPEG[2:]
TRUNCATABLE = {
    "jpeg": JPEG,
    "progressive": PROGRESSIVE,
    "jpeg with a whole thumbnail": WITH_THUMBNAIL,
    "png": PNG,
    "webp": encoded(".webp", NOISE),
    "webp lossless": encoded(".webp", NOISE, cv2.IMWRITE_WEBP_QUALITY, 101),
    "bmp": encoded(".bmp", NOISE),
    "tiff": pillow("TIFF", "RGB", NOISE),
    "tiff lzw": encoded(".tif", NOISE),
}


@pytest.mark.parametrize("share", [0.001, 0.02, 0.2, 0.5, 0.9, 0.99])
@pytest.mark.parametrize("name", TRUNCATABLE)
def test_a_truncated_file_is_not_measured(name: str, share: float, capfd: pytest.CaptureFixture[str]) -> None:
    data = TRUNCATABLE[name]
    with pytest.raises(ImageDecodeError) as caught:
        open_raster(data[: int(len(data) * share)])
    assert caught.value.code == "image_undecodable"
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("missing", [1, 2, 40])
@pytest.mark.parametrize("name", ["jpeg", "progressive", "png", "webp", "bmp"])
def test_the_last_bytes_are_missed(name: str, missing: int) -> None:
    with pytest.raises(ImageDecodeError):
        open_raster(TRUNCATABLE[name][:-missing])


def test_a_download_padded_with_zeros_is_truncated() -> None:
    half = len(JPEG) // 2
    with pytest.raises(ImageDecodeError, match="truncated"):
        open_raster(JPEG[:half] + bytes(half))


def test_bytes_after_the_end_do_no_harm() -> None:
    for data in (JPEG, PNG, WITH_THUMBNAIL, TRUNCATABLE["webp"], TRUNCATABLE["bmp"]):
        np.testing.assert_array_equal(read_all(data + b"trailer \xff\xd8\xff" * 9), read_all(data))


@pytest.mark.parametrize("size", [(1, 1), (2048, 300), (1600, 1200)])
def test_an_end_mark_is_found_wherever_the_scan_is_cut_into_chunks(size: tuple[int, int]) -> None:
    from vehanchor.imagery import header as image_header

    data = encoded(".jpg", np.random.default_rng(1).integers(0, 256, (*size, 3), dtype=np.uint8))
    for chunk_bytes in (2, 3, 64, 1000, 1 << 20)[-2 if len(data) > 100_000 else 0 :]:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(image_header, "_SCAN_CHUNK_BYTES", chunk_bytes)
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


@pytest.mark.parametrize("share", [0.3, 0.8])
def test_a_truncated_geotiff_is_undecodable(share: float, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    path = geotiff(tmp_path / "a.tif", NOISE, tiled=True, blockxsize=16, blockysize=16, compress="deflate")
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * share)])
    for image in (path, path.read_bytes()):
        with pytest.raises(ImageDecodeError), open_raster(image) as raster:
            raster.read()
    assert capfd.readouterr().err == ""


@settings(max_examples=150)
@given(
    name=st.sampled_from(sorted(TRUNCATABLE)),
    at=st.floats(0, 1, exclude_max=True),
    junk=st.binary(min_size=1, max_size=6),
    near_the_start=st.booleans(),
)
def test_damaged_files_give_pixels_or_an_image_error(name: str, at: float, junk: bytes, near_the_start: bool) -> None:
    data = bytearray(TRUNCATABLE[name])
    start = int(at * (200 if near_the_start else len(data)))
    data[start : start + len(junk)] = junk
    with suppress(ImageError):
        read_all(bytes(data))


WITH_NAN = np.where(np.arange(400).reshape(20, 20) < 3, np.nan, 0.5)
BAD_ARRAYS: list[tuple[str, NDArray[Any], str]] = [
    ("nan", WITH_NAN, "3 of 400 pixels are NaN or infinite"),
    ("infinite", np.where(np.isnan(WITH_NAN), np.inf, 0.5), "3 of 400"),
    ("bool", np.zeros((20, 20), bool), "bool"),
    ("int16", np.zeros((20, 20), np.int16), "int16"),
    ("int64", np.zeros((20, 20), np.int64), "int64"),
    ("complex", np.zeros((20, 20), complex), "complex128"),
    ("object", np.zeros((20, 20), object), "object"),
    ("text", np.full((20, 20), "a"), "U1"),
    ("one dimension", np.zeros(400, np.uint8), r"\[400\]"),
    ("four dimensions", np.zeros((1, 20, 20, 3), np.uint8), r"\[1, 20, 20, 3\]"),
    ("no bands", np.zeros((20, 20, 0), np.uint8), r"\[20, 20, 0\]"),
    ("no pixels", np.zeros((0, 0, 3), np.uint8), "0 x 0 px"),
    ("one pixel", np.zeros((1, 1, 3), np.uint8), "1 x 1 px"),
    ("bands first", np.zeros((3, 50, 60), np.uint8), "bands come last"),
    ("floats too far apart", 1.7e308 * np.linspace(-1, 1, 400).reshape(20, 20), "rescale"),
]


@pytest.mark.parametrize(("array", "message"), [case[1:] for case in BAD_ARRAYS], ids=[case[0] for case in BAD_ARRAYS])
def test_arrays_that_cannot_be_measured(array: NDArray[Any], message: str) -> None:
    with pytest.raises(ImageFormatError, match=message) as caught:
        open_raster(array)
    assert caught.value.code == "image_unsupported"


@pytest.mark.parametrize("dtype", ["int16", "int32", "float32"])
def test_tiffs_that_cannot_be_measured(dtype: str, tmp_path: Path) -> None:
    values = np.full((20, 20, 1), np.nan if dtype == "float32" else 7).astype(dtype)
    path = geotiff(tmp_path / "a.tif", values, crs=None, transform=None)
    with pytest.raises(ImageFormatError, match="NaN" if dtype == "float32" else dtype):
        open_raster(path)


def test_a_cmyk_tiff_is_refused_and_told_why() -> None:
    with pytest.raises(ImageFormatError, match="photometric interpretation 5"):
        open_raster(pillow("TIFF", "CMYK"))


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
