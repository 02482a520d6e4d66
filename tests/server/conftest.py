"""A real server with tiny networks, and images with vehicles and a pool for them."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from mcp.server import MCPServer

from tests.models import blank_image, paint_vehicles, write_detector
from tests.sam_models import SamFiles, write_sam
from tests.server.calls.working import TESTS, ready
from tests.server.conversation import ERAS
from tests.tiles import Tiles, watched_tiles
from vehanchor_server.app import create_server
from vehanchor_server.services import Services, create_services
from vehanchor_server.settings import Settings

LENGTH_PX = 33.0
N_VEHICLES = 24
N_TILES_LARGE = 25  # of large.png
# x and y of its corners; the test segmenter finds it to the pixel by POOL_BOX
POOL = (300, 330, 348, 426)
POOL_BOX = {"x_min": 294.0, "y_min": 324.0, "x_max": 354.0, "y_max": 432.0}
_POOL_RGB = (40, 140, 210)
_CELL_PX = 14


@pytest.fixture
def anyio_backend() -> str:
    return "asyncio"


@pytest.fixture(params=ERAS)
def era(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture(autouse=True)
def _no_operator_variables(monkeypatch: pytest.MonkeyPatch) -> None:
    import os

    for name in [name for name in os.environ if name.startswith("VEHANCHOR_")]:
        monkeypatch.delenv(name)


def paint_scene(width_px: int, height_px: int, n_vehicles: int = N_VEHICLES) -> np.ndarray:
    """An RGB image with vehicles of nearly one length on textured ground."""
    # Without noise it is a drawing, which has no scale.
    noise = blank_image(width_px, height_px, level=4, shade_levels=0)
    image = np.clip(_ground(width_px, height_px).astype(int) + noise - 4, 0, 255).astype(np.uint8)
    generator = np.random.default_rng(7)
    columns = max(1, (width_px - 100) // 70)
    boxes = []
    for i in range(n_vehicles):
        x = 60 + 70 * (i % columns)
        y = 60 + 70 * (i // columns)
        length = LENGTH_PX + generator.normal(0, 0.8)
        angle = generator.uniform(0, 3)
        boxes.append((x, y, length, 14, angle))
    if boxes:
        paint_vehicles(image, boxes)
    return image


def _ground(width_px: int, height_px: int) -> np.ndarray:
    """Grey squares: the scene-scale prior takes them for 0.25 m/px, and an even grey for 1 m/px."""
    n_rows = height_px // _CELL_PX + 1
    n_columns = width_px // _CELL_PX + 1
    cells = np.random.default_rng(1).integers(40, 110, (n_rows, n_columns)).astype(np.uint8)
    grey = cells.repeat(_CELL_PX, axis=0).repeat(_CELL_PX, axis=1)
    return np.repeat(grey[:height_px, :width_px, None], 3, axis=2)


def with_pool(image: np.ndarray) -> np.ndarray:
    """The same image with a pool painted in."""
    x_min, y_min, x_max, y_max = POOL
    image[y_min:y_max, x_min:x_max] = _POOL_RGB
    return image


def write_image(path: Path, image: np.ndarray) -> Path:
    """Write an RGB image without loss."""
    assert cv2.imwrite(str(path), image[:, :, ::-1])
    return path


@pytest.fixture(scope="session")
def detector_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    # A small input: many tiles in small images, each of them quick.
    return write_detector(tmp_path_factory.mktemp("models") / "test.onnx", fixed_size=256)


@pytest.fixture(scope="session")
def segmenter_paths(tmp_path_factory: pytest.TempPathFactory) -> SamFiles:
    return write_sam(tmp_path_factory.mktemp("segmenter"))


@pytest.fixture(scope="session")
def _images(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("images").resolve()
    write_image(root / "cars.png", paint_scene(640, 512))
    write_image(root / "empty.png", paint_scene(640, 512, 0))
    write_image(root / "small.png", paint_scene(250, 250, 4))
    write_image(root / "two.png", paint_scene(640, 512, 2))
    write_image(root / "large.png", paint_scene(900, 900))
    write_image(root / "pool.png", with_pool(paint_scene(640, 512)))
    write_image(root / "pool_two.png", with_pool(paint_scene(640, 512, 2)))
    write_image(root / "pool_alone.png", with_pool(paint_scene(640, 512, 0)))
    write_image(root / "pool_large.png", with_pool(paint_scene(900, 900)))
    (root / "sub dir").mkdir()
    write_image(root / "sub dir" / "cars é.png", paint_scene(640, 512))
    (root / "notes.txt").write_text("not an image")
    return root


@pytest.fixture(scope="session")
def images(_images: Path) -> Path:
    """The allowed root. Tests that change files use a directory of their own."""
    return _images


def settings_with_models(
    roots: tuple[Path, ...], detector_path: Path, segmenter_paths: SamFiles
) -> Settings:
    """Settings of a server that works in its own process with the models of the tests."""
    return Settings(
        roots=roots,
        detector=str(detector_path),
        segmenter=segmenter_paths,
        threads=1,
        isolation="in-process",
    )


@pytest.fixture(scope="session")
def settings(images: Path, detector_path: Path, segmenter_paths: SamFiles) -> Settings:
    return settings_with_models((images,), detector_path, segmenter_paths)


@pytest.fixture(scope="session")
def services(settings: Settings) -> Services:
    return create_services(settings)


@pytest.fixture(scope="session")
def server(services: Services) -> MCPServer[object]:
    return create_server(services)


@pytest.fixture(scope="module")
def running(detector_path: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Services]:
    """A server whose worker is confined."""
    root = tmp_path_factory.mktemp("root")
    settings = Settings(
        roots=(root, TESTS), detector=str(detector_path), threads=1, max_concurrency=1
    )
    services = ready(create_services(settings))
    yield services
    services.close()


@pytest.fixture(autouse=True)
def _forgetful(request: pytest.FixtureRequest) -> None:
    """Forget the analyses of earlier tests by the shared server."""
    if "services" in request.fixturenames:
        request.getfixturevalue("services").resources.models.__dict__.pop("memory", None)


@pytest.fixture
def tiles() -> Iterator[Tiles]:
    """The tiles of every call, which a test can hold and count."""
    with watched_tiles() as watched:
        yield watched
