from __future__ import annotations

import io
import os
import unicodedata
from io import BytesIO
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

import vehanchor
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
    ImageTooLargeError,
    InvalidParameterError,
    OutOfMemoryError,
)
from vehanchor.imagery.sources.files import canonical_path, spelled_as_stored
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.options import ImageLimits, Reading


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


ARRAYS: list[tuple[str, NDArray[Any], NDArray[Any]]] = [
    ("rgb", RGB, RGB),
    ("grey", RGB[..., 0], RGB[..., [0, 0, 0]]),
    ("grey and alpha", RGB[..., :2], RGB[..., [0, 0, 0]]),
    ("four bands", np.concatenate([RGB, RGB[..., :1]], axis=2), RGB),
    ("floats of 0..1", RGB / 255, RGB),
    ("float32", (RGB / 255).astype(np.float32), RGB),
    ("a strided view", np.repeat(RGB, 2, axis=1)[:, ::2], RGB),
    ("a mirrored view", RGB[:, ::-1], RGB[:, ::-1]),
    ("BGR turned by a view", RGB[..., ::-1], RGB[..., ::-1]),
    ("all zero", np.zeros((20, 20), np.uint16), np.zeros((20, 20, 3))),
]


@pytest.mark.parametrize(
    ("array", "expected"), [case[1:] for case in ARRAYS], ids=[case[0] for case in ARRAYS]
)
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


WITH_NAN = np.where(np.arange(400).reshape(20, 20) < 3, np.nan, 0.5)

BAD_ARRAYS: list[tuple[str, NDArray[Any], str]] = [
    ("nan", WITH_NAN, "3 of 400 pixels are NaN or infinite"),
    ("bool", np.zeros((20, 20), bool), "bool"),
    ("int16", np.zeros((20, 20), np.int16), "int16"),
    ("complex", np.zeros((20, 20), complex), "complex128"),
    ("text", np.full((20, 20), "a"), "U1"),
    ("one dimension", np.zeros(400, np.uint8), r"\[400\]"),
    ("four dimensions", np.zeros((1, 20, 20, 3), np.uint8), r"\[1, 20, 20, 3\]"),
    ("no bands", np.zeros((20, 20, 0), np.uint8), r"\[20, 20, 0\]"),
    ("no pixels", np.zeros((0, 0, 3), np.uint8), "0 x 0 px"),
    ("one pixel", np.zeros((1, 1, 3), np.uint8), "1 x 1 px"),
    ("bands first", np.zeros((3, 50, 60), np.uint8), "bands come last"),
    ("floats too far apart", 1.7e308 * np.linspace(-1, 1, 400).reshape(20, 20), "rescale"),
]


@pytest.mark.parametrize(
    ("array", "message"), [case[1:] for case in BAD_ARRAYS], ids=[case[0] for case in BAD_ARRAYS]
)
def test_arrays_that_cannot_be_measured(array: NDArray[Any], message: str) -> None:
    with pytest.raises(ImageFormatError, match=message) as caught:
        open_raster(array)
    assert caught.value.code == "image_unsupported"


PHOTOGRAPHS = ["DJI_0001.JPG", "deep/DJI_0002.jpg"]
OTHERS = [
    "._DJI_0001.JPG",
    ".hidden.jpg",
    ".thumbnails/DJI_0001.JPG",
    "__MACOSX/DJI_0001.JPG",
    "deep/@eaDir/DJI_0002.jpg/SYNOPHOTO_THUMB_XL.jpg",
    "#recycle/old.jpg",
    "$RECYCLE.BIN/old.jpg",
    "Thumbnails/DJI_0001.JPG",
]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name in (*PHOTOGRAPHS, *OTHERS):
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"")
    return tmp_path


def test_copies_of_systems_and_viewers_are_no_photographs(folder: Path) -> None:
    photographs = [str(folder / name) for name in PHOTOGRAPHS]
    assert vehanchor.find_images(folder) == photographs
    assert vehanchor.find_images(f"{folder}/**/*.[jJ][pP][gG]") == photographs


def test_what_is_named_is_listed_wherever_it_is(folder: Path) -> None:
    for name in (".hidden.jpg", "Thumbnails", "@missing/*.jpg", "__MACOSX/*.JPG"):
        named = str(folder / name)
        if "missing" in name:
            with pytest.raises(ImageNotFoundError):
                vehanchor.find_images(named)
        else:
            assert len(vehanchor.find_images(named)) == 1


@pytest.mark.parametrize("form", ["NFC", "NFD"])
def test_a_name_is_found_in_either_unicode_form(
    form: Literal["NFC", "NFD"], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stored = unicodedata.normalize(form, "été/café.png")
    (other,) = {unicodedata.normalize(each, stored) for each in ("NFC", "NFD")} - {stored}
    path = tmp_path / stored
    path.parent.mkdir()
    path.write_bytes(encoded(".png"))
    open_raster(tmp_path / other).close()
    assert canonical_path(tmp_path / other) == str(path.resolve())
    monkeypatch.chdir(tmp_path)
    assert vehanchor.find_images(other) == [stored]
    assert vehanchor.find_images(str(Path(other).parent)) == [stored]
    assert spelled_as_stored(stored) == stored
    assert Path(spelled_as_stored(f"{other}x")) == Path(stored).parent / f"{Path(other).name}x"


PIXELS = np.random.default_rng(0).integers(0, 255, (40, 60, 3), dtype=np.uint8)


@pytest.mark.parametrize("mode", ["RGB", "RGBA", "L", "P", "CMYK", "1"])
def test_an_image_of_pillow_is_read_in_every_mode(mode: str) -> None:
    image = Image.fromarray(PIXELS).convert(mode)
    read = open_raster(image).read()
    assert np.abs(read.astype(int) - np.asarray(image.convert("RGB"))).max() <= 1


def test_it_is_turned_as_its_file_would_be(tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.fromarray(PIXELS).save(tmp_path / "turned.png", exif=exif)
    with Image.open(tmp_path / "turned.png") as image:
        assert (open_raster(image).read() == open_raster(tmp_path / "turned.png").read()).all()


def test_a_truncated_one_and_one_that_is_too_large_are_refused_by_their_codes() -> None:
    encoded = BytesIO()
    Image.fromarray(PIXELS).save(encoded, "PNG")
    with pytest.raises(ImageDecodeError, match="Pillow"):
        open_raster(Image.open(BytesIO(encoded.getvalue()[:2000])))
    with pytest.raises(ImageTooLargeError, match="--max-megapixels"):
        open_raster(Image.fromarray(PIXELS), Reading(limits=ImageLimits(max_pixels=2000)))


def test_the_memory_that_it_takes_is_limited_by_its_mode_and_told_by_its_code(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for mode, n_bytes in (("L", 3), ("RGB", 10), ("RGBA", 12), ("F", 12), ("CMYK", 10)):
        image = Image.fromarray(PIXELS).convert(mode)
        open_raster(image, Reading(limits=ImageLimits(max_decoded_bytes=2400 * n_bytes)))
        with pytest.raises(ImageTooLargeError, match=f"takes {2400 * n_bytes} bytes"):
            open_raster(image, Reading(limits=ImageLimits(max_decoded_bytes=2400 * n_bytes - 1)))

    def fail(self: Image.Image) -> None:
        raise MemoryError

    monkeypatch.setattr(Image.Image, "getexif", fail)
    with pytest.raises(OutOfMemoryError):
        open_raster(Image.fromarray(PIXELS))


def test_megapixels_are_a_limit_of_pixels_and_of_memory() -> None:
    assert Reading(max_megapixels=0.002).limits.max_pixels == 2000
    large = Reading(max_megapixels=500).limits
    assert (large.max_pixels, large.max_decoded_bytes) == (500_000_000, 5_000_000_000)


@pytest.mark.parametrize(
    ("start", "words"),
    [
        (b"GIF89a" + bytes(40), "a GIF has at most 256 colours"),
        (b"%PDF-1.7" + bytes(40), "pdfimages"),
        (b"\0\0\0\x18ftyphevc" + bytes(40), "a HEIC sequence; save one image"),
        (b"\0\0\0\x18ftypmif1" + bytes(40), "neither AVIF nor HEIC; convert"),
        (b"\0\0\0\x18ftypavis" + bytes(40), "an animation; save one frame"),
        (b"\0\0\0\x18ftypisom" + bytes(40), "a video; save a frame"),
        (b"RIFF\0\0\0\0AVI LIST" + bytes(40), "a video; save a frame"),
        (b"\x1aE\xdf\xa3" + bytes(40), "a video; save a frame"),
        (b"what is this" + bytes(40), "it starts with b'what is '"),
    ],
)
def test_what_is_no_image_of_ours_is_named_with_what_to_do(start: bytes, words: str) -> None:
    with pytest.raises(ImageDecodeError, match=words.replace("'", ".")):
        open_raster(start)
