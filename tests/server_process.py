"""Servers to measure, and images to send them."""

from __future__ import annotations

import contextlib
import os
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from vehanchor_scenes import render_scene

SERVE = [sys.executable, "-c", "import typer; from vehanchor_server.command import serve; typer.run(serve)"]
START_S = 120
IDLE_S = 7.0  # by then an idle worker has given back what it does not need


class HttpServer(NamedTuple):
    """A server that listens.

    Attributes:
        url: of its tools.
        process: the one that was started; with several workers they are its children.
    """

    url: str
    process: subprocess.Popen[bytes]

    @property
    def pid(self) -> int:
        """Of that process."""
        return self.process.pid


def write_images(directory: Path) -> list[Path]:
    """Scenes of several sizes and scales, one of them without vehicles."""
    paths = []
    for name, gsd, side, seed in (("parking", 0.15, 1024, 5), ("town", 0.12, 768, 6), ("coarse", 0.28, 512, 7)):
        path = directory / f"{name}.png"
        _write(path, render_scene(gsd, width_px=side, height_px=side, seed=seed).image)
        paths.append(path)
    _write(directory / "blank.png", np.full((640, 640, 3), 90, np.uint8))
    return [*paths, directory / "blank.png"]


def middle_box(image: Path) -> tuple[float, float, float, float]:
    """A box around the middle of an image, for what there is: x1, y1, x2, y2."""
    pixels = cv2.imread(str(image))
    assert pixels is not None, image
    height, width = pixels.shape[:2]
    return 0.4 * width, 0.4 * height, 0.6 * width, 0.6 * height


def target(box: tuple[float, float, float, float]) -> dict[str, Any]:
    """The argument of ``measure_area`` that names a box."""
    return {"target": {"box": dict(zip(("x_min", "y_min", "x_max", "y_max"), box, strict=True))}}


def _write(path: Path, image: np.ndarray) -> None:
    assert cv2.imwrite(str(path), image[:, :, ::-1])


@contextlib.contextmanager
def http_server(*flags: str) -> Iterator[HttpServer]:
    """A server on a free port, ready."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    process = subprocess.Popen([*SERVE, "--http", "--port", str(port), *flags], stderr=subprocess.DEVNULL)
    deadline = time.monotonic() + START_S
    try:
        while True:
            with contextlib.suppress(OSError), urllib.request.urlopen(f"http://127.0.0.1:{port}/readyz"):
                break
            if process.poll() is not None or time.monotonic() > deadline:
                sys.exit("the server did not start")
            time.sleep(0.1)
        yield HttpServer(f"http://127.0.0.1:{port}/mcp", process)
    finally:
        process.terminate()
        try:
            process.wait(20)
        except subprocess.TimeoutExpired:
            process.kill()


def child_processes(pid: int) -> list[int]:
    """The children of a process that serve or work (Linux); multiprocessing's resource tracker is not one of them."""
    found = []
    for child in _children(pid):
        with contextlib.suppress(OSError):  # it has just ended
            command = Path(f"/proc/{child}/cmdline").read_bytes()
            if b"spawn_main" in command:
                found.append(child)
            elif b"forkserver" in command:
                found += _children(child)
    return found


def _children(pid: int) -> list[int]:
    found: list[int] = []
    for thread in Path(f"/proc/{pid}/task").glob("*"):
        with contextlib.suppress(OSError):  # a thread has just ended
            found += map(int, (thread / "children").read_text().split())
    return found


def memory_mib(pid: int) -> list[float]:
    """Memory of a process and of all below it, MiB (Linux); what they share is counted once (PSS)."""
    return [_pss_mib(pid), *(each for child in _children(pid) for each in memory_mib(child))]


def processor_s(pid: int) -> float:
    """Processor time of a process and of all below it that live, seconds (Linux)."""
    used = 0.0
    with contextlib.suppress(OSError):  # it has just ended
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        used = (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    return used + sum(map(processor_s, _children(pid)))


def _pss_mib(pid: int) -> float:
    with contextlib.suppress(OSError):  # it has just ended
        for line in Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines():
            if line.startswith("Pss:"):
                return int(line.split()[1]) / 1024
    return 0.0
