"""Images on a web server of this machine."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest

from tests.skill.imagery.files import RGB, encoded, geotiff, smooth_rgb
from vehanchor.errors import ImageDecodeError, ImageNotFoundError, ImageTooLargeError
from vehanchor.imagery.sources import addresses
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.options import ImageLimits


class Served:
    """Files by name, and how much of them was asked for."""

    def __init__(self) -> None:
        self.files: dict[str, bytes] = {}
        self.sent = 0
        self.knows_ranges = True
        self.address = ""


@pytest.fixture
def served() -> Iterator[Served]:
    here = Served()

    class Handler(BaseHTTPRequestHandler):
        def do_HEAD(self) -> None:
            self.do_GET()

        def do_GET(self) -> None:
            data = here.files.get(self.path.lstrip("/"))
            if data is None:
                self.send_error(404)
                return
            wanted = self.headers.get("Range") if here.knows_ranges else None
            first, last = 0, len(data) - 1
            if wanted:
                low, _, high = wanted.removeprefix("bytes=").partition("-")
                first, last = int(low), min(int(high or last), last)
                if first > last:
                    self.send_error(416)
                    return
            self.send_response(206 if wanted else 200)
            if wanted:
                self.send_header("Content-Range", f"bytes {first}-{last}/{len(data)}")
            if here.knows_ranges:
                self.send_header("Accept-Ranges", "bytes")
            self.send_header("Content-Length", str(last + 1 - first))
            self.end_headers()
            if self.command == "GET":
                self.wfile.write(data[first : last + 1])
                here.sent += last + 1 - first

        def log_message(self, *_: object) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True)
    thread.start()
    here.address = f"http://127.0.0.1:{server.server_port}"
    yield here
    server.shutdown()
    server.server_close()


@pytest.mark.parametrize("knows_ranges", [True, False])
def test_a_picture_is_fetched_whole(served: Served, knows_ranges: bool) -> None:
    served.knows_ranges = knows_ranges
    served.files["a.png"] = encoded(".png", RGB)
    with open_raster(f"{served.address}/a.png") as raster:
        np.testing.assert_array_equal(raster.read(), RGB)


def test_of_a_cog_the_windows_come_that_are_read(served: Served, tmp_path: Path) -> None:
    from vehanchor.imagery.raster import Window

    noise = np.random.default_rng(1).integers(0, 255, (2048, 2048, 3), dtype=np.uint8)
    path = geotiff(tmp_path / "a.tif", noise, driver="COG", compress="deflate", blocksize=256, overviews="NONE")
    served.files["a.tif"] = path.read_bytes()
    with open_raster(f"{served.address}/a.tif") as raster:
        assert raster.georeference_gsd_m_per_px == pytest.approx(0.25)
        part = raster.read(Window(300, 500, 64, 64))
    np.testing.assert_array_equal(part, noise[500:564, 300:364])
    assert served.sent < 0.3 * len(served.files["a.tif"])


def test_what_is_not_there_too_large_or_no_image_is_told(served: Served) -> None:
    served.files["large.png"] = encoded(".png", smooth_rgb(300, 300))
    served.files["page.html"] = b"<!doctype html>"
    with pytest.raises(ImageNotFoundError, match=r"answers 404"):
        open_raster(f"{served.address}/none.jpg")
    with pytest.raises(ImageTooLargeError, match="exceeds the limit of 500 bytes"):
        open_raster(f"{served.address}/large.png", limits=ImageLimits(max_bytes=500))
    with pytest.raises(ImageDecodeError, match="starts with"):
        open_raster(f"{served.address}/page.html")
    with pytest.raises(ImageNotFoundError, match="check the address"):
        open_raster("http://127.0.0.1:1/a.png")


_FOREVER = 3 << 30


class Hostile:
    """A server that sends a file's range, and then goes on, or answers in another hostile way."""

    def __init__(self, start: bytes) -> None:
        self.start = start
        self.sent = 0
        self.address = ""


@pytest.fixture
def hostile(tmp_path: Path) -> Iterator[Hostile]:
    noise = np.random.default_rng(1).integers(0, 255, (1024, 1024, 3), dtype=np.uint8)
    start = geotiff(tmp_path / "a.tif", noise, driver="COG", compress="deflate", blocksize=256, overviews="NONE")
    here = Hostile(start.read_bytes())

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            with contextlib.suppress(OSError):
                getattr(self, self.path.strip("/").partition(".")[0])()

        def endless(self) -> None:
            while here.sent < _FOREVER:
                here.sent += self.wfile.write(bytes(1 << 20))

        def whole(self) -> None:
            self.send_response(200)
            self.end_headers()
            here.sent += self.wfile.write(here.start)
            self.endless()

        def ranged(self) -> None:
            wanted = self.headers["Range"].removeprefix("bytes=")
            self.send_response(206)
            self.send_header("Content-Range", f"bytes {wanted}/{1 << 40}")
            self.end_headers()
            here.sent += self.wfile.write(here.start[int(wanted.partition("-")[0]) :])
            self.endless()

        def slow(self) -> None:
            self.send_response(200)
            self.end_headers()
            self.drip()

        def silent(self) -> None:
            self.drip()

        def drip(self) -> None:
            for _ in range(600):
                self.wfile.write(b"x")
                self.wfile.flush()
                time.sleep(0.05)

        def redirected(self) -> None:
            self.send_response(302)
            self.send_header("Location", f"{here.address}/redirected.png")
            self.end_headers()
            self.endless()

        def elsewhere(self) -> None:
            self.send_response(302)
            self.send_header("Location", "ftp://127.0.0.1/a.png")
            self.end_headers()

        def log_message(self, *_: object) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True).start()
    here.address = f"http://127.0.0.1:{server.server_port}"
    yield here
    server.shutdown()
    server.server_close()


def test_an_endless_file_ends_at_the_limit_of_bytes(hostile: Hostile) -> None:
    with pytest.raises(ImageTooLargeError, match="exceeds the limit of 4000000 bytes"):
        open_raster(f"{hostile.address}/whole.tif", limits=ImageLimits(max_bytes=4_000_000))
    assert hostile.sent < 40_000_000  # sockets buffer some of it


def test_no_more_is_read_than_the_range_that_was_asked_for(hostile: Hostile) -> None:
    from vehanchor.imagery.raster import Window

    with open_raster(f"{hostile.address}/ranged.tif") as raster:
        assert raster.read(Window(0, 0, 300, 300)).shape == (300, 300, 3)
    assert hostile.sent < 400_000_000  # a gigabyte and more of each reply, if it were read


@pytest.mark.timeout(60)
@pytest.mark.parametrize("kind", ["slow", "silent"])
def test_a_server_that_drips_has_so_much_time_and_no_more(
    hostile: Hostile, monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    monkeypatch.setattr(addresses, "MAX_S", 0.5)
    with pytest.raises(ImageDecodeError, match=r"more than 0\.5 s; try again, or download"):
        open_raster(f"{hostile.address}/{kind}.png")


def test_redirects_are_counted_unread_and_end_at_http(hostile: Hostile) -> None:
    with pytest.raises(ImageNotFoundError, match="redirects more than 3 times"):
        open_raster(f"{hostile.address}/redirected.png")
    assert hostile.sent < 400_000_000
    with pytest.raises(ImageNotFoundError, match="redirects to 'ftp:"):
        open_raster(f"{hostile.address}/elsewhere.png")


@pytest.mark.timeout(60)
def test_a_connection_is_cut_from_its_first_byte_on(hostile: Hostile) -> None:
    file = addresses.RemoteFile(f"https://{hostile.address.removeprefix('http://')}/silent", ImageLimits(), max_s=0.3)
    with pytest.raises((ImageDecodeError, ImageNotFoundError)):
        file.fetch()
    assert threading.active_count() < 20
