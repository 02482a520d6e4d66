from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.models import car_park, write_detector


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two images with cars, one without, one that is broken, and a file that is not an image."""
    path = tmp_path_factory.mktemp("batch")
    (path / "deep" / "below").mkdir(parents=True)
    for name, n_vehicles in (("cars.png", 20), ("empty.png", 0), ("deep/below/cars.PNG", 12)):
        image = car_park(29 + 0.1 * np.arange(n_vehicles), 800, 300)
        cv2.imwrite(str(path / name), image[:, :, ::-1])
    (path / "broken.jpg").write_text("this is not an image")
    (path / "notes.txt").write_text("this is not one either, by its name")
    return path


@pytest.fixture(autouse=True)
def _in_folder(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)


@pytest.fixture(scope="module")
def detector(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Path of a detector of painted vehicles."""
    return write_detector(tmp_path_factory.mktemp("model") / "painted.onnx")


@pytest.fixture(scope="session")
def _hasty_ray() -> Iterator[None]:
    """Start Ray so that its workers get their share of a full machine, and it sees a node die.

    Its workers have niceness 15: beside the other lanes of ``.ci/run`` they got a thirtieth of a
    core. It knocks at a node every 3 s, and gives it up at the fifth knock that is refused.
    """
    with pytest.MonkeyPatch.context() as patches:
        patches.setenv("RAY_worker_niceness", "0")
        patches.setenv("RAY_health_check_initial_delay_ms", "0")
        patches.setenv("RAY_health_check_period_ms", "200")
        yield


@pytest.fixture
def table(tmp_path: Path) -> Path:
    """Path of a table of JSON lines."""
    return tmp_path / "table.jsonl"
