"""Every door to an image gives the same answer to the same file.

The doors are those of the library (path, bytes, file object), of the server's tools (path, base64)
and of the page of ``vehanchor view``.
"""

from __future__ import annotations

import base64
import io
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import httpx2 as httpx
import numpy as np
import pytest

from tests.bombs import zero_tiff
from tests.server.app_page.viewing import viewing
from tests.skill.imagery.files import (
    HEIC,
    HEIGHT_PX,
    NOISE,
    WIDTH_PX,
    encoded,
    geotiff,
    header_of,
    pillow,
    png_header,
    without_rasterio,
)
from tests.skill.imagery.formats import test_windowed as jpeg2000
from tests.skill.imagery.samples import SAMPLES
from vehanchor.errors import ImageDecodeError, VehAnchorError
from vehanchor.imagery.formats.header import IMAGE_FORMATS, SUFFIXES
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.options import ImageLimits, Reading
from vehanchor_server.errors import CallError
from vehanchor_server.images.argument import Base64Image, PathImage
from vehanchor_server.images.fetch import Fetcher
from vehanchor_server.images.path_access import PathAccess
from vehanchor_server.images.source import ImageSources, library_errors
from vehanchor_server.settings import Settings
from vehanchor_server.transport.viewer import Address

NAME = "photo"
LIMITS = ImageLimits(
    max_bytes=60_000, max_pixels=19_000, max_windowed_pixels=30_000, max_decoded_bytes=300_000
)
"""Limits so small that files of a few kilobytes exceed them."""

READING = Reading(limits=LIMITS)


def _seems_whole(data: bytes) -> bool:
    """Test whether the header of a file is whole, and does not show that the end is missing."""
    try:
        return header_of(data).complete
    except ImageDecodeError:
        return False


_PARTS = {f"truncated {name}": data[:-20] for name, data in SAMPLES.items()}
TRUNCATED = {name: data for name, data in _PARTS.items() if not _seems_whole(data)}
"""Files that end too early, of those formats whose headers show it."""


class Answer(NamedTuple):
    """Answer of a door: the size of the image, or code and message of an error."""

    size_px: tuple[int, int] | None
    code: str = ""
    message: str = ""


class Doors(NamedTuple):
    """What the doors need.

    Attributes:
        folder: a folder for files, the root of the server.
        page: address of the page.
    """

    folder: Path
    page: Address


def _opened(image: Any, source: str) -> Answer:
    """Open an image with the library; ``source`` is its name in messages."""
    try:
        with open_raster(image, READING) as raster:
            return Answer((raster.width_px, raster.height_px))
    except VehAnchorError as error:
        return Answer(None, error.code, str(error).replace(f"({source})", f"({NAME})"))


def _from_path(data: bytes, doors: Doors) -> Answer:
    path = doors.folder / "file"
    path.write_bytes(data)
    return _opened(path, str(path))


def _from_bytes(data: bytes, _: Doors) -> Answer:
    return _opened(data, "bytes")


def _from_file_object(data: bytes, _: Doors) -> Answer:
    return _opened(io.BytesIO(data), "file")


def _from_call(image: PathImage | Base64Image, doors: Doors) -> Answer:
    """Open the argument of a tool as its work does."""
    sources = ImageSources(PathAccess([doors.folder]), Fetcher((), LIMITS.max_bytes))
    try:
        with (
            sources.open(image) as opened,
            library_errors(opened),
            open_raster(opened, READING) as raster,
        ):
            return Answer((raster.width_px, raster.height_px))
    except CallError as error:
        message = error.explanation.removesuffix(".")
        for source in ("image", "bytes"):
            message = message.replace(f"({source})", f"({NAME})")
        return Answer(None, error.code, message)


def _from_path_of_a_call(data: bytes, doors: Doors) -> Answer:
    (doors.folder / "file").write_bytes(data)
    return _from_call(PathImage(kind="path", path="file"), doors)


def _from_base64(data: bytes, doors: Doors) -> Answer:
    text = base64.b64encode(data).decode() or "data:;base64,"
    return _from_call(Base64Image(kind="base64", data=text), doors)


def _from_the_page(data: bytes, doors: Doors) -> Answer:
    reply = httpx.post(
        f"{doors.page.url()}photographs",
        params={"name": NAME},
        content=data,
        headers={"Content-Type": "application/octet-stream"},
    )
    if reply.status_code == 200:
        path = reply.json()["path"]
        return _opened(path, path)
    message = reply.text.removeprefix(f"{NAME} cannot be measured: ")
    assert message != reply.text
    return Answer(None, _PAGE_CODES[reply.status_code], message)


_OTHER = "another code"
_PAGE_CODES = {413: "image_too_large", 415: _OTHER}
"""Codes of errors by the status of the page's answer; 415 stands for all other codes."""

DOORS = {
    "path": _from_path,
    "bytes": _from_bytes,
    "file object": _from_file_object,
    "path of a call": _from_path_of_a_call,
    "base64 of a call": _from_base64,
    "page": _from_the_page,
}


@pytest.fixture(scope="module")
def doors(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Doors]:
    folder = tmp_path_factory.mktemp("doors").resolve()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Settings, "image_limits", LIMITS)
        with viewing(Settings(), folder / "dropped") as page:
            yield Doors(folder, page)


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """The files by name."""
    folder = tmp_path_factory.mktemp("files")
    jp2 = SAMPLES["JPEG 2000"]
    wide = np.zeros((100, 200, 3), np.uint8)
    tiles: dict[str, Any] = {
        "tiled": True,
        "blockxsize": 64,
        "blockysize": 64,
        "compress": "deflate",
    }
    return {
        **SAMPLES,
        "GeoTIFF": geotiff(folder / "geo.tif", NOISE).read_bytes(),
        "large TIFF": geotiff(folder / "large.tif", wide, **tiles).read_bytes(),
        "empty": b"",
        "text": b"no image at all",
        "GIF": pillow("GIF", "P"),
        "video": b"\0\0\0\x18ftypmp42" + bytes(100),
        **TRUNCATED,
        "small PNG": png_header(15, 500),
        "PNG of many pixels": png_header(200, 100),
        "HEIC of many pixels": _heic_of(200, 100),
        "TIFF of many pixels": zero_tiff(200, "uint8", 1, rows=16),
        "deep PNG": encoded(".png", np.zeros((100, 188, 4), np.uint16)),
        "JPEG 2000 of a large tile": jpeg2000.declaring(jp2, tile_width=100_000, right=200),
        "TIFF of a large tile": _tiff_of_a_large_tile(folder / "tile.tif"),
        "CMYK TIFF": pillow("TIFF", "CMYK"),
        "too many bytes": encoded(".bmp") + bytes(60_000),
    }


def _heic_of(width: int, height: int) -> bytes:
    """Declare another size in the container of a HEIC."""
    start = HEIC.index(b"ispe") + 8
    return HEIC[:start] + width.to_bytes(4) + height.to_bytes(4) + HEIC[start + 8 :]


def _tiff_of_a_large_tile(path: Path) -> bytes:
    """Make a TIFF whose only tile is far larger than the image."""
    size: dict[str, Any] = {"blockxsize": 512, "blockysize": 512}
    return geotiff(path, NOISE, tiled=True, compress="deflate", **size).read_bytes()


ACCEPTED = {
    **dict.fromkeys(SAMPLES, (WIDTH_PX, HEIGHT_PX)),
    "HEIC": (48, 64),
    "GeoTIFF": (130, 90),
    "large TIFF": (200, 100),
}
"""Size of each file that can be measured."""

REFUSED = {
    "empty": "image_undecodable",
    "text": "image_undecodable",
    "GIF": "image_undecodable",
    "video": "image_undecodable",
    **dict.fromkeys(TRUNCATED, "image_undecodable"),
    "small PNG": "image_unsupported",
    "PNG of many pixels": "image_too_large",
    "HEIC of many pixels": "image_too_large",
    "TIFF of many pixels": "image_too_large",
    "deep PNG": "image_too_large",
    "JPEG 2000 of a large tile": "image_too_large",
    "TIFF of a large tile": "image_too_large",
    "CMYK TIFF": "image_unsupported",
    "too many bytes": "image_too_large",
}
"""Code of the error of each file that cannot be measured."""


@pytest.mark.parametrize("door", DOORS)
@pytest.mark.parametrize("name", ACCEPTED)
def test_every_door_accepts_the_same_files(
    name: str, door: str, files: dict[str, bytes], doors: Doors
) -> None:
    assert DOORS[door](files[name], doors) == Answer(ACCEPTED[name])


@pytest.mark.promise("bombs")
@pytest.mark.parametrize("door", DOORS)
@pytest.mark.parametrize("name", REFUSED)
def test_every_door_refuses_the_same_files_for_the_same_reason(
    name: str, door: str, files: dict[str, bytes], doors: Doors
) -> None:
    answer = DOORS[door](files[name], doors)
    reference = _from_bytes(files[name], doors)
    code = REFUSED[name]
    assert reference.code == code
    if door == "page" and code != "image_too_large":
        code = _OTHER
    assert answer == Answer(None, code, reference.message)


@contextmanager
def _without(modules: tuple[str, ...]) -> Iterator[None]:
    """Hide modules as if they were not installed."""
    with pytest.MonkeyPatch.context() as patch:
        for name in modules:
            patch.setitem(sys.modules, name, None)
        yield


_OF_EXTRAS = [
    (name, partial(_without, image_format.extra.modules), image_format.extra.name)
    for name, image_format in IMAGE_FORMATS.items()
    if image_format.extra is not None
]
"""Formats that need an extra, how to hide their decoders, and the names of their extras."""


@pytest.mark.parametrize("door", DOORS)
@pytest.mark.parametrize(
    ("name", "without", "extra"),
    [
        *_OF_EXTRAS,
        ("GeoTIFF", without_rasterio, "geo"),
        ("JPEG 2000", without_rasterio, "geo"),
    ],
)
def test_every_door_names_the_missing_extra(
    name: str,
    without: Callable[[], AbstractContextManager[None]],
    extra: str,
    door: str,
    files: dict[str, bytes],
    doors: Doors,
) -> None:
    with without():
        answer = DOORS[door](files[name], doors)
    assert answer.size_px is None
    assert f"pip install '.[{extra}]'" in answer.message


def test_a_file_on_disk_may_have_more_bytes_if_it_is_read_by_windows(
    files: dict[str, bytes], doors: Doors
) -> None:
    path = doors.folder / "file"
    path.write_bytes(files["large TIFF"] + bytes(LIMITS.max_bytes))
    assert _opened(path, str(path)) == Answer((200, 100))
    for door in ("bytes", "file object", "base64 of a call", "page"):
        answer = DOORS[door](path.read_bytes(), doors)
        assert answer.code == "image_too_large", door


def test_the_page_offers_the_suffixes_of_all_formats(doors: Doors) -> None:
    page = httpx.get(doors.page.url()).text
    for suffix in SUFFIXES:
        assert f"{suffix}," in page or f'{suffix}"' in page


@pytest.mark.promise("listener")
def test_the_check_of_a_file_imports_no_decoder() -> None:
    code = """
import sys
from vehanchor.imagery.file_check import check_file
from vehanchor.options import ImageLimits

data = open(sys.argv[1], "rb").read()
read_at = lambda offset, count: data[offset : offset + count]
check_file(read_at, len(data), "x", limits=ImageLimits(), on_disk=False)
print(*sys.modules)
"""
    loaded = subprocess.run(
        [sys.executable, "-c", code, "/dev/stdin"],
        input=HEIC,
        capture_output=True,
        check=True,
    ).stdout.split()
    decoders = {b"cv2", b"numpy", b"rasterio", b"pi_heif", b"pillow_heif", b"PIL"}
    assert not decoders.intersection(loaded)
