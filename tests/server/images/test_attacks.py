"""Attacks on what the server may read, sent as calls: whatever the form, nothing outside the root is ever opened."""

from __future__ import annotations

import base64
import os
import struct
import threading
import zlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import anyio
import pytest
from mcp import Client
from mcp.server import MCPServer
from mcp.types import CallToolResult

from tests.server.conftest import paint_scene, write_image
from tests.server.conversation import by_path, error_of, text_of
from vehanchor_server.app import create_server
from vehanchor_server.images import path_access as sandbox_module
from vehanchor_server.services import create_services
from vehanchor_server.settings import Settings

pytestmark = pytest.mark.anyio

TOOLS = ("estimate_gsd", "measure_area")
INSIDE_PX, OUTSIDE_PX = 64, 96  # widths: an answer tells which image was read


@pytest.fixture
def outside(tmp_path: Path) -> Path:
    """An image that the server could measure, were it allowed to."""
    (tmp_path / "outside").mkdir()
    return write_image(tmp_path / "outside" / "secret.png", paint_scene(OUTSIDE_PX, 64, 0))


@pytest.fixture
def root(tmp_path: Path, outside: Path) -> Path:
    directory = tmp_path / "root"
    directory.mkdir()
    write_image(directory / "a.png", paint_scene(INSIDE_PX, 64, 0))
    (directory / "link.png").symlink_to(outside)
    (directory / "folder").symlink_to(outside.parent, target_is_directory=True)
    os.mkfifo(directory / "fifo.png")
    return directory.resolve()


@pytest.fixture
def walled(settings: Settings, root: Path) -> MCPServer[object]:
    return create_server(create_services(replace(settings, roots=(root,))))


def arguments_for(tool: str, image: dict[str, Any]) -> dict[str, Any]:
    """A call that nothing but its image can fail."""
    if tool == "estimate_gsd":
        return {"image": image, "detail": "full"}
    box = {"x_min": 16, "y_min": 16, "x_max": 48, "y_max": 48}
    return {"image": image, "targets": [{"box": box}], "gsd_m_per_px": 0.2, "detail": "full"}


async def called(server: MCPServer[object], image: dict[str, Any]) -> list[CallToolResult]:
    """What each tool answers."""
    async with Client(server) as client:
        with anyio.fail_after(100):  # a pipe would keep it for ever
            return [await client.call_tool(tool, arguments_for(tool, image)) for tool in TOOLS]


async def test_the_image_inside_is_measured(walled: MCPServer[object], root: Path) -> None:
    for result in await called(walled, by_path(root / "a.png")["image"]):
        assert not result.is_error, text_of(result)
        assert result.structured_content is not None
        assert result.structured_content["image_width_px"] == INSIDE_PX


@pytest.mark.parametrize(
    ("named", "code"),
    [
        ("{outside}", "path_not_allowed"),
        ("{root}/../outside/secret.png", "path_not_allowed"),
        ("{root}/link.png", "path_not_allowed"),
        ("{root}/folder/secret.png", "path_not_allowed"),
        ("file://{outside}", "path_not_allowed"),
        ("file://evil.example{root}/a.png", "path_not_allowed"),
        ("file://127.0.0.1{root}/a.png", "path_not_allowed"),
        ("file://{root}/%2e%2e/outside/secret.png", "path_not_allowed"),
        ("file://{root}/..%2foutside%2fsecret.png", "path_not_allowed"),
        ("file://{root}/%252e%252e/outside/secret.png", "image_not_found"),
        ("{root}/%2e%2e/outside/secret.png", "image_not_found"),
        ("{root}/a.png\0.jpg", "path_not_allowed"),
        ("file://{root}/a.png%00.jpg", "path_not_allowed"),
        ("{root}/" + "a" * 300, "path_not_allowed"),
        ("{root}/" + "a/" * 1500, "image_not_found"),
        ("{root}/" + "a" * 5000, "invalid_arguments"),
        ("/proc/self/environ", "path_not_allowed"),
        ("/proc/self/root{outside}", "path_not_allowed"),
        ("/dev/zero", "path_not_allowed"),
        ("{root}/fifo.png", "image_not_found"),
        ("{root}", "image_not_found"),
        ("https://127.0.0.1/a.png", "image_not_found"),
        ("../outside/secret.png", "path_not_allowed"),
        ("folder/secret.png", "path_not_allowed"),
    ],
)
async def test_paths_that_lead_elsewhere_are_refused(
    walled: MCPServer[object], root: Path, outside: Path, named: str, code: str
) -> None:
    path = named.format(root=root, outside=outside)
    for result in await called(walled, {"kind": "path", "path": path}):
        assert error_of(result) == code
        assert result.structured_content is None
        assert str(outside) not in text_of(result)


async def test_a_file_swapped_for_a_link_between_check_and_opening_is_refused(
    walled: MCPServer[object], root: Path, outside: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    original = sandbox_module._open_part

    def swapped(part: str, flags: int, directory: int) -> int:
        (root / "a.png").unlink()
        (root / "a.png").symlink_to(outside)
        return original(part, flags, directory)

    monkeypatch.setattr(sandbox_module, "_open_part", swapped)
    (result, _) = await called(walled, by_path(root / "a.png")["image"])
    assert error_of(result) == "path_not_allowed"


async def test_a_file_swapped_for_a_link_all_the_time_is_never_followed(
    walled: MCPServer[object], root: Path, outside: Path
) -> None:
    victim, kept = root / "victim.png", root / "a.png"
    stop = threading.Event()

    def swap() -> None:
        while not stop.is_set():
            for target in (kept, outside):
                spare = root / "spare.png"
                spare.symlink_to(target)
                spare.replace(victim)

    victim.symlink_to(kept)
    swapping = threading.Thread(target=swap)
    swapping.start()
    widths, codes = set(), set()
    try:
        async with Client(walled) as client:
            for _ in range(20):
                result = await client.call_tool(TOOLS[1], arguments_for(TOOLS[1], by_path(victim)["image"]))
                if result.is_error:
                    codes.add(error_of(result))
                else:
                    assert result.structured_content is not None
                    widths.add(result.structured_content["image_width_px"])
    finally:
        stop.set()
        swapping.join()
    assert widths <= {INSIDE_PX}, "the image outside was measured"
    assert codes <= {"path_not_allowed", "image_not_found"}
    assert widths or codes


def bomb_png(width_px: int, height_px: int) -> bytes:
    """A PNG of a few hundred bytes that declares any number of pixels."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width_px, height_px, 8, 2, 0, 0, 0)
    body = zlib.compress(bytes(100_000))
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", body) + chunk(b"IEND", b"")


@pytest.mark.parametrize("kind", ["path", "base64"])
@pytest.mark.parametrize("size", [(60_000, 60_000), (2**31 - 1, 1), (2**31 - 1, 2**31 - 1)])
async def test_a_decompression_bomb_is_refused_by_its_header(
    walled: MCPServer[object], root: Path, kind: str, size: tuple[int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    decoded: list[object] = []
    monkeypatch.setattr("cv2.imdecode", lambda data, *_: decoded.append(data))
    data = bomb_png(*size)
    (root / "bomb.png").write_bytes(data)
    image = {"kind": "base64", "data": base64.b64encode(data).decode()}
    for result in await called(walled, by_path(root / "bomb.png")["image"] if kind == "path" else image):
        assert error_of(result) == "image_too_large"
    assert decoded == []


@pytest.mark.parametrize(
    ("image", "code"),
    [
        ({"kind": "base64", "data": "not base64!"}, "base64_invalid"),
        ({"kind": "base64", "data": "data:image/svg+xml,<svg/>"}, "base64_invalid"),
        ({"kind": "base64", "data": base64.b64encode(b"root:x:0:0").decode()}, "image_undecodable"),
        ({"kind": "url", "url": "https://127.0.0.1/a.png"}, "source_disabled"),
        ({"kind": "url", "url": "file:///etc/passwd"}, "source_disabled"),
        ({"kind": "url", "url": "http://169.254.169.254/latest/meta-data/"}, "source_disabled"),
    ],
)
async def test_what_is_no_image_of_an_allowed_kind_is_refused(
    walled: MCPServer[object], image: dict[str, Any], code: str
) -> None:
    assert [error_of(result) for result in await called(walled, image)] == [code, code]


async def test_names_in_which_a_file_points_to_others_are_not_followed(
    walled: MCPServer[object], root: Path, outside: Path
) -> None:
    """A GDAL virtual raster names its source; formats that do so are not read at all."""
    (root / "a.vrt").write_text(
        f'<VRTDataset rasterXSize="96" rasterYSize="64"><VRTRasterBand dataType="Byte" band="1"><SimpleSource>'
        f"<SourceFilename>{outside}</SourceFilename><SourceBand>1</SourceBand></SimpleSource></VRTRasterBand>"
        "</VRTDataset>"
    )
    (root / "renamed.tif").write_bytes((root / "a.vrt").read_bytes())
    for name in ("a.vrt", "renamed.tif"):
        for result in await called(walled, by_path(root / name)["image"]):
            assert error_of(result) in ("image_undecodable", "image_unsupported"), text_of(result)
