from __future__ import annotations

import io
import os
import unicodedata
from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from typing import Any

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

PNG = encoded(".png")


@pytest.fixture
def png_path(tmp_path: Path) -> Path:
    path = tmp_path / "städt isch.png"
    path.write_bytes(PNG)
    return path


SOURCES = [
    pytest.param(lambda path: path, id="path"),
    pytest.param(str, id="text"),
    pytest.param(lambda path: PNG, id="bytes"),
    pytest.param(lambda path: bytearray(PNG), id="bytearray"),
    pytest.param(lambda path: memoryview(PNG), id="memoryview"),
    pytest.param(lambda path: io.BytesIO(PNG), id="file object"),
]


@pytest.mark.parametrize("make", SOURCES)
def test_every_source_is_read(make: Callable[[Path], Any], png_path: Path) -> None:
    with open_raster(make(png_path)) as raster:
        assert (raster.width_px, raster.height_px) == (WIDTH_PX, HEIGHT_PX)
        np.testing.assert_array_equal(raster.read(), RGB)


@pytest.mark.parametrize("make", SOURCES)
def test_a_plain_image_has_no_georeference(make: Callable[[Path], Any], png_path: Path) -> None:
    with open_raster(make(png_path)) as raster:
        assert raster.georeference_gsd_m_per_px is None


@pytest.mark.parametrize("make", SOURCES)
def test_a_plain_image_has_no_warnings(make: Callable[[Path], Any], png_path: Path) -> None:
    with open_raster(make(png_path)) as raster:
        assert raster.warnings == ()


def test_an_open_file_is_read(png_path: Path) -> None:
    with png_path.open("rb") as file:
        np.testing.assert_array_equal(read_all(file), RGB)


@pytest.mark.parametrize("kind", [Path, str])
def test_the_name_of_a_file_is_its_path(kind: Callable[[Path], Any], png_path: Path) -> None:
    with open_raster(kind(png_path)) as raster:
        assert raster.source == str(png_path)


@pytest.mark.parametrize(
    ("make", "name"),
    [
        (lambda: PNG, "bytes"),
        (lambda: bytearray(PNG), "bytes"),
        (lambda: memoryview(PNG), "bytes"),
        (lambda: io.BytesIO(PNG), "file"),
    ],
)
def test_other_sources_have_the_name_of_their_kind(make: Callable[[], Any], name: str) -> None:
    with open_raster(make()) as raster:
        assert raster.source == name


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
def test_a_path_without_a_regular_file_is_not_found(
    bad_paths: dict[str, str], name: str, message: str
) -> None:
    with pytest.raises(ImageNotFoundError, match=message) as caught:
        open_raster(bad_paths[name])
    assert caught.value.code == "image_not_found"
    assert repr(bad_paths[name]) in str(caught.value)


def test_an_address_of_a_local_file_says_to_give_its_path() -> None:
    with pytest.raises(ImageNotFoundError, match="give the path alone"):
        open_raster("file:///photos/a.jpg")


def test_an_image_in_an_address_is_not_repeated() -> None:
    with pytest.raises(ImageNotFoundError, match="pass the bytes") as caught:
        open_raster("data:image/jpeg;base64," + "A" * 3000)
    assert len(str(caught.value)) < 200


@pytest.mark.parametrize("image", [None, 7, ["a.png"], object()])
def test_an_unknown_type_is_a_wrong_parameter(image: Any) -> None:
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


def _n_open_files() -> int:
    return len(list(Path("/proc/self/fd").iterdir()))


@pytest.mark.parametrize("times", [1, 3])
def test_a_closed_raster_holds_no_file(times: int, tmp_path: Path) -> None:
    path = geotiff(tmp_path / "a.tif", RGB)
    before = _n_open_files()
    for _ in range(times):
        read_all(path)
    assert _n_open_files() == before


def _unsupported(folder: Path) -> Path:
    return geotiff(folder / "b.tif", RGB.astype(np.int16))


def _damaged(folder: Path) -> Path:
    path = folder / "bad.png"
    path.write_bytes(b"bad")
    return path


@pytest.mark.parametrize(
    ("make", "error"),
    [
        (_unsupported, ImageFormatError),
        (lambda folder: folder, ImageNotFoundError),
        (_damaged, ImageDecodeError),
    ],
)
def test_a_refused_image_holds_no_file(
    make: Callable[[Path], Path], error: type[Exception], tmp_path: Path
) -> None:
    path = make(tmp_path)
    before = _n_open_files()
    for _ in range(3):
        with pytest.raises(error):
            open_raster(path)
    assert _n_open_files() == before


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
def test_arrays_are_read(array: NDArray[Any], expected: NDArray[Any]) -> None:
    np.testing.assert_array_equal(read_all(array), expected)


@pytest.mark.parametrize("array", [case[1] for case in ARRAYS], ids=[case[0] for case in ARRAYS])
def test_arrays_are_not_changed(array: NDArray[Any]) -> None:
    before = array.copy()
    read_all(array)
    np.testing.assert_array_equal(array, before)
    assert array.flags.writeable


def test_an_array_has_the_name_of_its_kind() -> None:
    with open_raster(RGB) as raster:
        assert raster.source == "array"


def test_an_rgb_array_is_not_copied() -> None:
    array = RGB.copy()
    with open_raster(array) as raster:
        assert np.shares_memory(raster.read(), array)


def test_an_array_cannot_be_written_through_its_raster() -> None:
    with open_raster(RGB.copy()) as raster:
        assert not raster.read().flags.writeable


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


@pytest.mark.parametrize("pattern", ["", "/**/*.[jJ][pP][gG]"])
def test_copies_that_systems_keep_are_not_photographs(folder: Path, pattern: str) -> None:
    photographs = [str(folder / name) for name in PHOTOGRAPHS]
    assert vehanchor.find_images(f"{folder}{pattern}") == photographs


@pytest.mark.parametrize("name", [".hidden.jpg", "Thumbnails", "__MACOSX/*.JPG"])
def test_a_named_image_is_listed_wherever_it_is(folder: Path, name: str) -> None:
    assert len(vehanchor.find_images(str(folder / name))) == 1


def test_a_pattern_in_a_missing_folder_is_not_found(folder: Path) -> None:
    with pytest.raises(ImageNotFoundError):
        vehanchor.find_images(str(folder / "@missing/*.jpg"))


@pytest.fixture(params=["NFC", "NFD"])
def stored_name(request: pytest.FixtureRequest) -> str:
    """Name of an image in one of the Unicode forms."""
    return unicodedata.normalize(request.param, "été/café.png")


@pytest.fixture
def other_name(stored_name: str) -> str:
    """The same name in the other Unicode form."""
    composed = unicodedata.normalize("NFC", stored_name)
    return unicodedata.normalize("NFD", stored_name) if stored_name == composed else composed


@pytest.fixture
def stored_path(stored_name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The image, in the working directory."""
    path = tmp_path / stored_name
    path.parent.mkdir()
    path.write_bytes(PNG)
    monkeypatch.chdir(tmp_path)
    return path


def test_an_image_is_opened_by_either_unicode_form(
    stored_path: Path, other_name: str, tmp_path: Path
) -> None:
    open_raster(tmp_path / other_name).close()


def test_a_relative_path_without_a_working_directory_is_not_found(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def gone() -> str:
        raise FileNotFoundError

    monkeypatch.setattr("os.getcwd", gone)
    assert canonical_path("a.jpg") == "a.jpg"


def test_both_unicode_forms_have_one_canonical_path(
    stored_path: Path, other_name: str, tmp_path: Path
) -> None:
    assert canonical_path(tmp_path / other_name) == str(stored_path.resolve())


def test_an_image_is_listed_in_its_stored_unicode_form(
    stored_path: Path, stored_name: str, other_name: str
) -> None:
    assert vehanchor.find_images(other_name) == [stored_name]


def test_a_folder_is_listed_in_its_stored_unicode_form(
    stored_path: Path, stored_name: str, other_name: str
) -> None:
    assert vehanchor.find_images(str(Path(other_name).parent)) == [stored_name]


def test_a_path_in_its_stored_unicode_form_stays(stored_path: Path, stored_name: str) -> None:
    assert spelled_as_stored(stored_name) == stored_name


def test_the_folder_of_a_missing_file_is_spelled_as_stored(
    stored_path: Path, stored_name: str, other_name: str
) -> None:
    missing = f"{Path(other_name).name}x"
    assert Path(spelled_as_stored(f"{other_name}x")) == Path(stored_name).parent / missing


PIXELS = np.random.default_rng(0).integers(0, 255, (40, 60, 3), dtype=np.uint8)


@pytest.mark.parametrize("mode", ["RGB", "RGBA", "L", "P", "CMYK", "1"])
def test_an_image_of_pillow_is_read_in_every_mode(mode: str) -> None:
    image = Image.fromarray(PIXELS).convert(mode)
    pixels = open_raster(image).read()
    expected = np.asarray(image.convert("RGB"))
    assert np.abs(pixels.astype(int) - expected).max() <= 1


def test_an_image_of_pillow_is_turned_as_its_file(tmp_path: Path) -> None:
    path = tmp_path / "turned.png"
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.fromarray(PIXELS).save(path, exif=exif)
    with Image.open(path) as image:
        assert (open_raster(image).read() == open_raster(path).read()).all()


def test_a_truncated_image_of_pillow_is_undecodable() -> None:
    file = BytesIO()
    Image.fromarray(PIXELS).save(file, "PNG")
    truncated = Image.open(BytesIO(file.getvalue()[:2000]))
    with pytest.raises(ImageDecodeError, match="Pillow"):
        open_raster(truncated)


def test_too_large_an_image_of_pillow_is_refused() -> None:
    limits = ImageLimits(max_pixels=2000)
    with pytest.raises(ImageTooLargeError, match="--max-megapixels"):
        open_raster(Image.fromarray(PIXELS), Reading(limits=limits))


@pytest.mark.parametrize(
    ("mode", "pixel_bytes"), [("L", 3), ("RGB", 10), ("RGBA", 12), ("F", 12), ("CMYK", 10)]
)
def test_the_memory_of_an_image_of_pillow_is_limited(mode: str, pixel_bytes: int) -> None:
    image = Image.fromarray(PIXELS).convert(mode)
    n_bytes = 2400 * pixel_bytes
    open_raster(image, Reading(limits=ImageLimits(max_decoded_bytes=n_bytes)))
    with pytest.raises(ImageTooLargeError, match=f"takes {n_bytes} bytes"):
        open_raster(image, Reading(limits=ImageLimits(max_decoded_bytes=n_bytes - 1)))


def test_lack_of_memory_for_an_image_of_pillow_has_its_own_error(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def fail(self: Image.Image) -> None:
        raise MemoryError

    monkeypatch.setattr(Image.Image, "getexif", fail)
    with pytest.raises(OutOfMemoryError):
        open_raster(Image.fromarray(PIXELS))


def test_megapixels_limit_the_pixels() -> None:
    assert Reading(max_megapixels=0.002).limits.max_pixels == 2000
    assert Reading(max_megapixels=500).limits.max_pixels == 500_000_000


def test_megapixels_limit_the_memory() -> None:
    assert Reading(max_megapixels=500).limits.max_decoded_bytes == 5_000_000_000


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
def test_an_unsupported_file_is_refused_with_advice(start: bytes, words: str) -> None:
    with pytest.raises(ImageDecodeError, match=words.replace("'", ".")):
        open_raster(start)
