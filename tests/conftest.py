from __future__ import annotations

import os
from pathlib import Path

os.environ["OPENCV_LOG_LEVEL"] = "SILENT"  # as the command line sets it

import cv2
import hypothesis
import numpy as np
import pytest
from numpy.typing import NDArray

ROOT = Path(__file__).parent.parent
MOST_WORKERS = 4  # each loads everything once

# What a test means does not depend on how busy the machine is; the timeout of pytest catches what hangs.
hypothesis.settings.register_profile("vehanchor", deadline=None)
hypothesis.settings.load_profile("vehanchor")

# Typer colours its help for GitHub's log where it finds this; the tests read plain text.
os.environ.pop("GITHUB_ACTIONS", None)


@pytest.fixture(scope="session")
def real_data() -> Path:
    """The folder of real images; a test that asks for it is skipped where there is none."""
    folder = Path(os.environ.get("VEHANCHOR_DATA", ROOT.parent / "shared" / "data"))
    if not (folder / "gsd" / "table.csv").is_file():
        pytest.skip(f"no real images at {folder}; set VEHANCHOR_DATA")
    return folder


@pytest.fixture(scope="session")
def car_park() -> NDArray[np.uint8]:
    """``[640, 640, 3]`` RGB of ``examples/car_park.jpg``, at 0.12 m/px, with more than 80 cars."""
    picture = cv2.imread(str(ROOT / "examples/car_park.jpg"))
    assert picture is not None
    return np.ascontiguousarray(picture[:640, :640, ::-1], dtype=np.uint8)


def pytest_xdist_auto_num_workers(config: pytest.Config) -> int:
    """Run the quick tests side by side; the longer ones measure time, and a few files start faster alone."""
    everything = config.args_source is pytest.Config.ArgsSource.TESTPATHS and not config.option.keyword
    quick = config.option.markexpr in config.getini("addopts")
    return min(os.cpu_count() or 1, MOST_WORKERS) if everything and quick else 0
