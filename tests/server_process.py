"""Servers to measure, and images to send them."""

from __future__ import annotations

import contextlib
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from tests.packaging.container import free_port, wait_until_ready

SERVE = [
    sys.executable,
    "-c",
    "import typer; from vehanchor_server.command import serve; typer.run(serve)",
]


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
    # Confined workers unpickle work of modules that import this one, and may not read research.
    from research.scenes import render_scene

    paths = []
    for name, gsd, side, seed in (
        ("parking", 0.15, 1024, 5),
        ("town", 0.12, 768, 6),
        ("coarse", 0.28, 512, 7),
    ):
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
    return {"targets": [{"box": dict(zip(("x_min", "y_min", "x_max", "y_max"), box, strict=True))}]}


def _write(path: Path, image: np.ndarray) -> None:
    assert cv2.imwrite(str(path), image[:, :, ::-1])


@contextlib.contextmanager
def http_server(*flags: str) -> Iterator[HttpServer]:
    """A server on a free port, ready."""
    port = free_port()
    process = subprocess.Popen(
        [*SERVE, "--http", "--port", str(port), *flags], stderr=subprocess.DEVNULL
    )
    try:
        wait_until_ready(port, process)
        yield HttpServer(f"http://127.0.0.1:{port}/mcp", process)
    finally:
        process.terminate()
        try:
            process.wait(20)
        except subprocess.TimeoutExpired:
            process.kill()
