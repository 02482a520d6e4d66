"""``vehanchor view``: access, and the requests of the page."""

from __future__ import annotations

import json
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx2 as httpx
import pytest
from mcp.server.apps import APP_MIME_TYPE, EXTENSION_ID
from typer.testing import CliRunner

from tests.sam_models import SamFiles
from tests.server.app_page.viewing import viewing
from tests.server.conftest import POOL_BOX, settings_with_models
from tests.server.transport.test_http import discover
from tests.skill.imagery.files import HEIC
from vehanchor.cli.app import app
from vehanchor.options import ImageLimits
from vehanchor_server.app_page.page import view_html
from vehanchor_server.settings import Settings
from vehanchor_server.transport.viewer import Address

# One for all: each looks for certificates, which takes a second. It keeps no connection, because
# no test of another module that uses it would close it.
WEB = httpx.Client(timeout=60, verify=False, limits=httpx.Limits(max_keepalive_connections=0))


@pytest.fixture(scope="module")
def address(
    _images: Path,
    detector_path: Path,
    segmenter_paths: SamFiles,
    tmp_path_factory: pytest.TempPathFactory,
) -> Iterator[Address]:
    settings = settings_with_models((_images,), detector_path, segmenter_paths)
    with viewing(settings, tmp_path_factory.mktemp("view").resolve() / "dropped") as own_address:
        yield own_address


def asked(name: str, arguments: dict[str, Any]) -> dict[str, Any]:
    """A call as the page sends it."""
    request = discover(**{"Mcp-Method": "tools/call", "Mcp-Name": name})
    request["json"] |= {"method": "tools/call"}
    request["json"]["params"] |= {"name": name, "arguments": arguments}
    meta = request["json"]["params"]["_meta"]
    pages = {"extensions": {EXTENSION_ID: {"mimeTypes": [APP_MIME_TYPE]}}}
    meta |= {"progressToken": 1, "io.modelcontextprotocol/clientCapabilities": pages}
    return request


def ask(address: Address, name: str, arguments: dict[str, Any]) -> list[dict[str, Any]]:
    """The messages of an answer: progress, then the result."""
    reply = WEB.post(f"{address.url()}mcp", **asked(name, arguments))
    lines = [line[line.index("{") :] for line in reply.text.splitlines() if "{" in line]
    assert lines, reply.text
    return [json.loads(line) for line in lines]


def test_the_page_comes_with_headers_that_keep_it_to_itself(address: Address) -> None:
    reply = WEB.get(address.url())
    assert reply.text == view_html()
    assert reply.headers["content-security-policy"] == "frame-ancestors 'none'"
    assert reply.headers["referrer-policy"] == "no-referrer"
    assert reply.headers["cross-origin-resource-policy"] == "same-origin"
    assert reply.headers["cache-control"] == "no-store"


@pytest.mark.parametrize(
    "headers",
    [
        {"Host": "rebound.test"},
        {"Host": "localhost:1"},
        {"Origin": "https://elsewhere.test"},
        {"Origin": "null"},
        {"Sec-Fetch-Site": "cross-site"},
        {"Sec-Fetch-Site": "same-site"},  # another port of this machine
    ],
    ids=str,
)
def test_a_page_of_another_origin_gets_nothing_even_if_it_knew_the_address(
    address: Address, headers: dict[str, str], images: Path
) -> None:
    call = asked("view_image", {})
    own = {"Origin": address.origin, "Sec-Fetch-Site": "same-origin"}
    assert (
        WEB.post(f"{address.url()}mcp", **call | {"headers": call["headers"] | own}).status_code
        == 200
    )
    foreign = call["headers"] | own | headers
    assert WEB.post(f"{address.url()}mcp", **call | {"headers": foreign}).status_code == 404
    assert WEB.get(address.url(), headers=headers).status_code == 404


@pytest.mark.parametrize("path", ["", "wrong/", "wrong/mcp", "mcp", "%00/", "\u00e4/"])
def test_without_the_token_there_is_nothing(address: Address, path: str) -> None:
    reply = WEB.get(f"{address.origin}/{path}")
    assert (reply.status_code, reply.text) == (404, "not found")
    assert Address(1).token != Address(1).token


def test_a_form_of_another_page_is_no_call(address: Address) -> None:
    call = asked("view_image", {})
    body = json.dumps(call["json"])
    # what a page may send without being asked
    for kind in ("text/plain", "application/x-www-form-urlencoded"):
        headers = call["headers"] | {"Content-Type": kind}
        assert WEB.post(f"{address.url()}mcp", content=body, headers=headers).status_code == 400


def test_a_photograph_that_is_dropped_is_measured_as_one_of_the_folder(
    address: Address, images: Path
) -> None:
    data = (images / "pool.png").read_bytes()
    paths = [
        drop(address, name, data).json()["path"]
        for name in ("my pool.png", "my pool.png", "../../.ssh/x y\n.png")
    ]
    assert paths[0] == paths[1]
    assert Path(paths[0]).name == "my pool.png"
    assert Path(paths[2]).name == "x y_.png"
    assert Path(paths[2]).parent == Path(paths[0]).parent
    *_, listed = ask(address, "page_image", {})
    assert set(paths) <= set(listed["result"]["structuredContent"]["images"])
    image = {"kind": "path", "path": paths[0]}
    *_, measured = ask(address, "measure_area", {"image": image, "targets": [{"box": POOL_BOX}]})
    assert measured["result"]["structuredContent"]["area_m2"] > 0


def test_a_heic_that_is_dropped_is_measured(address: Address) -> None:
    path = drop(address, "photo.heic", HEIC).json()["path"]
    arguments = {
        "image": {"kind": "path", "path": path},
        "lines": [{"points": [{"x": 10, "y": 10}, {"x": 40, "y": 10}]}],
        "gsd_m_per_px": 0.1,
        "gsd_basis": "measured",
    }
    *_, measured = ask(address, "measure_distance", arguments)
    distance = measured["result"]["structuredContent"]
    assert distance["distance_m"] == pytest.approx(3)


def drop(address: Address, name: str, data: bytes) -> httpx.Response:
    headers = {"Content-Type": "application/octet-stream"}
    return WEB.post(
        f"{address.url()}photographs", params={"name": name}, content=data, headers=headers
    )


def test_only_photographs_are_kept(address: Address) -> None:
    for name, data in (
        ("notes.txt", b"no picture"),
        ("empty.jpg", b""),
        ("v.mp4", b"\0\0\0\x18ftypmp42" + bytes(100)),
    ):
        reply = drop(address, name, data)
        assert reply.status_code == 415, name
        assert reply.text.startswith(f"{name} cannot be measured: ")


def test_a_photograph_above_the_limit_is_not_kept(
    detector_path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = Settings(detector=str(detector_path))
    monkeypatch.setattr(Settings, "image_limits", ImageLimits(max_bytes=1 << 20))
    with viewing(settings, tmp_path / "dropped") as address:
        reply = drop(address, "large.png", bytes((1 << 20) + 1))
    assert reply.status_code == 413
    assert reply.text.startswith(
        "large.png cannot be measured: the image has more than 1048576 bytes"
    )
    assert list((tmp_path / "dropped").iterdir()) == []


@pytest.mark.slow
def test_the_command_serves_the_page_until_a_signal(images: Path, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "vehanchor", "view", str(images / "cars.png"), "--no-browser"]
    environment = {"TMPDIR": str(tmp_path), "PATH": "/usr/bin:/bin"}
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=environment) as process:
        assert process.stderr is not None
        line = process.stderr.readline()
        (url,) = re.findall(r"http://127\.0\.0\.1:\d+/[\w-]{32}/#\S+", line)
        assert url.endswith("/cars.png")
        assert WEB.get(url, timeout=20).status_code == 200
        assert len(list(tmp_path.glob("vehanchor-view-*"))) == 1
        process.send_signal(signal.SIGTERM)
        assert process.wait(20) == 128 + signal.SIGTERM
    assert list(tmp_path.iterdir()) == []


def test_a_missing_folder_is_refused(tmp_path: Path) -> None:
    result = CliRunner().invoke(app, ["view", str(tmp_path / "none"), "--no-browser"])
    assert result.exit_code == 2
    assert "give an existing directory" in result.stderr


def test_a_port_that_is_taken_is_refused(tmp_path: Path, address: Address) -> None:
    arguments = ["view", str(tmp_path), "--no-browser", "--port", str(address.port)]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 2
    assert "use another --port" in result.stderr
