"""Attacks by calls: no form of an image argument opens anything outside the roots."""

from __future__ import annotations

import base64
import contextlib
import os
import threading
from collections.abc import Callable
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any
from urllib.parse import quote

import anyio
import pytest
from mcp import Client
from mcp.server import MCPServer
from mcp.types import CallToolResult

from tests.server.conftest import paint_scene, write_image
from tests.server.conversation import by_path, error_of, text_of
from tests.skill.imagery.files import png_header
from vehanchor_server.app import create_server
from vehanchor_server.errors import CallError
from vehanchor_server.images.fetch import Fetcher
from vehanchor_server.images.path_access import PathAccess
from vehanchor_server.services import create_services
from vehanchor_server.settings import Settings

pytestmark = pytest.mark.anyio


TOOLS = ("estimate_gsd", "measure_area")
# widths: an answer tells which image was read
INSIDE_PX = 64
OUTSIDE_PX = 96


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


@pytest.mark.parametrize(
    ("named", "code"),
    [
        ("{root}/a.png", ""),
        ("{outside}", "path_not_allowed"),
        ("{root}/link.png", "path_not_allowed"),
        ("{root}/" + "a" * 5000, "invalid_arguments"),
        ("{root}/fifo.png", "image_not_found"),
    ],
)
async def test_only_paths_that_stay_inside_are_measured(
    walled: MCPServer[object], root: Path, outside: Path, named: str, code: str
) -> None:
    path = named.format(root=root, outside=outside)
    for result in await called(walled, {"kind": "path", "path": path}):
        if code:
            assert error_of(result) == code
            assert str(outside) not in text_of(result)
        else:
            assert result.structured_content is not None
            assert result.structured_content["image_width_px"] == INSIDE_PX


def test_a_file_swapped_for_a_link_all_the_time_is_never_followed(
    root: Path, outside: Path
) -> None:
    victim = root / "victim.png"
    kept = root / "a.png"
    stop = threading.Event()
    sizes = set()

    def swap() -> None:
        while not stop.is_set():
            for target in (kept, outside):
                spare = root / "spare.png"
                spare.symlink_to(target)
                spare.replace(victim)

    victim.symlink_to(kept)
    swapping = threading.Thread(target=swap)
    swapping.start()
    try:
        for _ in range(300):
            with contextlib.suppress(CallError), PathAccess([root]).open(str(victim)) as opened:
                sizes.add(len(Path(str(opened)).read_bytes()))
    finally:
        stop.set()
        swapping.join()
    assert sizes <= {kept.stat().st_size}, "the image outside was opened"


@pytest.mark.parametrize("kind", ["path", "base64"])
async def test_a_decompression_bomb_is_refused_by_its_header(
    walled: MCPServer[object], root: Path, kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    decoded: list[object] = []
    monkeypatch.setattr("cv2.imdecode", lambda data, *_: decoded.append(data))
    data = png_header(60_000, 60_000)
    (root / "bomb.png").write_bytes(data)
    image = {"kind": "base64", "data": base64.b64encode(data).decode()}
    for result in await called(
        walled, by_path(root / "bomb.png")["image"] if kind == "path" else image
    ):
        assert error_of(result) == "image_too_large"
    assert decoded == []


async def test_names_in_which_a_file_points_to_others_are_not_followed(
    walled: MCPServer[object], root: Path, outside: Path
) -> None:
    """A GDAL virtual raster names its source; formats that do so are not read at all."""
    (root / "a.vrt").write_text(
        '<VRTDataset rasterXSize="96" rasterYSize="64"><VRTRasterBand dataType="Byte" '
        'band="1"><SimpleSource>'
        f"<SourceFilename>{outside}</SourceFilename><SourceBand>1</SourceBand></SimpleSource></VRTRasterBand>"
        "</VRTDataset>"
    )
    (root / "renamed.tif").write_bytes((root / "a.vrt").read_bytes())
    for name in ("a.vrt", "renamed.tif"):
        for result in await called(walled, by_path(root / name)["image"]):
            assert error_of(result) in ("image_undecodable", "image_unsupported"), text_of(result)


UP = "../" * 12
PATTERNS = (
    "{path}",
    "/{path}",
    "//{path}",
    "/.{path}",
    "{path}/",
    "{path}/.",
    "{path}\x00.png",
    "{path}%00.png",
    "~{path}",
    "file://{path}",
    "FILE://{path}",
    "file://localhost{path}",
    "file:///{path}",
    "file:{path}",
    "file://.{path}",
    "file://[{path}",
    "file://user@localhost{path}",
    "file://{path}?a=1",
    "file://{path}#a",
    "http://localhost{path}",
    "{root}/..{path}",
    "{root}/{up}{path}",
    "{root}//{up}{path}",
    "{root}/./{up}{path}",
    "{root}/deep/{up}{path}",
    "{root}/a.png/{up}{path}",
    "{root}/missing/{up}{path}",
    "file://{root}/{up}{path}",
    "{root}\x00{path}",
    "{root}{path}",
    "{root}/{path}",
    "file://{root}{path}",
    "{root}/out{path}",
    "{root}/up{path}",
    "{root}/up/up{path}",
    "/proc/self/root{path}",
    "/proc/1/root{path}",
    "/proc/thread-self/root{path}",
    "/proc/self/cwd/{up}{path}",
    "/dev/fd/../../..{path}",
    "{root}/proc{path}",
    "\\\\?\\{path}",
    "{root}\\..{path}",
)
"""Forms of a path, with a root and a way up from it."""


def _from_pattern(pattern: str) -> Callable[[str, str], str]:
    return lambda root, path: pattern.format(root=root, path=path, up=UP)


FORMS: tuple[Callable[[str, str], str], ...] = (
    *map(_from_pattern, PATTERNS),
    lambda root, path: quote(path),
    lambda root, path: f"file://{quote(path, safe='')}",
    lambda root, path: f"{root}/{quote(UP + path, safe='')}",
    lambda root, path: f"file://{root}/{quote(UP + path, safe='')}",
    lambda root, path: f"file://{root}/{quote(quote(UP + path, safe=''), safe='')}",
    lambda root, path: f"file://{root}/{UP.replace('.', '%2e')}{path}",
    lambda root, path: f"{root}/{UP.replace('.', chr(0x2024))}{path}",
)


@pytest.mark.promise("roots")
def test_no_form_of_a_path_leaves_a_root_or_reveals_what_exists(tmp_path: Path) -> None:
    root = (tmp_path / "root").resolve()
    (root / "deep").mkdir(parents=True)
    (root / "a.png").write_bytes(b"inside")
    (root / "out").symlink_to("/")
    (root / "up").symlink_to("..")
    (root / "proc").symlink_to("/proc/self/root")
    (tmp_path / "secret.png").write_bytes(b"outside")
    pairs = [
        (str(tmp_path / "secret.png"), str(tmp_path / "absent.png")),
        ("/etc/passwd", "/etc/passwx"),
    ]
    pairs += [("/proc/1/status", "/proc/999999999/status"), (str(tmp_path), f"{tmp_path}x")]
    ways = list(product(FORMS, pairs))
    for form, (present, absent) in ways:
        answers = []
        for path in (present, absent):
            named = form(str(root), path)
            with pytest.raises(CallError) as caught, PathAccess([root]).open(named) as opened:
                pytest.fail(f"{named!r} was opened: {opened!r}")
            message = (
                str(caught.value)
                .replace(f"server: {root}.", "server.")
                .replace(repr(named)[1:-1], "NAMED")
                .replace(named[-80:], "NAMED")
            )
            answers.append(
                caught.value.code
                if caught.value.code == "image_not_found"
                else message.replace(path, "PATH")
            )
            assert caught.value.code in ("path_not_allowed", "image_not_found"), named
        assert answers[0] == answers[1], (form("ROOT", present), answers)
    assert 2 * len(ways) >= 350


@pytest.mark.promise("fetch")
async def test_no_other_host_is_looked_up_or_asked() -> None:
    async def resolve(host: str, port: int) -> list[str]:
        assert (host, port) == ("images.test", 443)
        return ["10.0.0.1"]

    fetcher = Fetcher(("images.test",), 1000, 5.0, resolve=resolve)
    hosts = (
        "127.0.0.1",
        "localhost",
        "[::1]",
        "2130706433",
        "0x7f.1",
        "0177.0.0.1",
        "169.254.169.254",
        "[::ffff:127.0.0.1]",
        "images.test.",
        "images.test.evil.test",
        "evil.test",
        "images.test@evil.test",
        "images.test:80",
        "images.test:0",
        "images.test:99999",
        "images.test:22",
        "images.test:0x1BB",
        "[::1",
        "evil.test\\@images.test",
        "imag\u0435s.test",
        "user@images.test",
        "user:pw@images.test",
        "[images.test]",
        "images.test%00.evil.test",
        "images.test%2eevil.test",
        "",
    )
    urls = [
        f"{scheme}{host}/a.png"
        for scheme, host in product(("https://", "http://", "HTTPS:", "ftp://", "//"), hosts)
    ]
    urls += [
        f"{scheme}images.test/a.png"
        for scheme in ("http://", "ftp://", "file://", "gopher://", "data:", "//", "")
    ]
    urls += [
        "https://images.test/a b.png",
        "https://images.test/a\r\nHost: evil.test",
        "https://evil.test/images.test",
    ]
    for url in [*urls, *(url.replace("/a.png", "") for url in urls)]:
        with pytest.raises(CallError) as caught:
            await fetcher.fetch(url)
        assert caught.value.code == "url_not_allowed", url
    assert 2 * len(urls) >= 200
