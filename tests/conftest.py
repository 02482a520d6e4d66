from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

os.environ["OPENCV_LOG_LEVEL"] = "SILENT"  # as the command line sets it

import cv2
import hypothesis
import numpy as np
import pytest
from numpy.typing import NDArray

from tests.needs import needed_module, needed_program
from vehanchor.courts.find import courts_among
from vehanchor.courts.network import Proposal
from vehanchor.imagery.identity import image_id
from vehanchor.imagery.raster import Raster
from vehanchor.models.session import run_session

ROOT = Path(__file__).parent.parent
MOST_WORKERS = 4  # each loads everything once
CHROMIUM_START_MS = 120_000

# What a test means does not depend on how busy the machine is; the timeout of pytest catches what
# hangs.
hypothesis.settings.register_profile("vehanchor", deadline=None)
hypothesis.settings.load_profile("vehanchor")

# Typer colours its help for GitHub's log where it finds this; the tests read plain text.
os.environ.pop("GITHUB_ACTIONS", None)


@pytest.fixture(scope="session", autouse=True)
def _each_image_is_looked_at_once() -> Iterator[None]:
    """Remember the answers of the slow networks, and the fits of courts, to equal inputs."""
    seen: dict[Any, Any] = {}

    def ran(session: Any, names: Any, feeds: Any, runtime: Any, described: str) -> Any:
        key = described, runtime.threads, hashlib.sha256(feeds["tiles"]).digest()
        if key not in seen:
            seen[key] = run_session(
                session, names, feeds=feeds, runtime=runtime, described=described
            )
        return seen[key]

    def fitted(raster: Raster, proposals: list[Proposal], **sizes: int) -> Any:
        key = image_id(raster), sizes["n_sizes"], *proposals
        if key not in seen:
            seen[key] = courts_among(raster, proposals, **sizes)
        return list(seen[key])

    with pytest.MonkeyPatch.context() as patches:
        for module in ("courts.network", "detection.scene_scale"):
            patches.setattr(f"vehanchor.{module}.run_session", ran)
        patches.setattr("vehanchor.courts.find.courts_among", fitted)
        yield


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
    """Run the quick tests side by side. Longer ones measure time; some files start faster alone."""
    everything = (
        config.args_source is pytest.Config.ArgsSource.TESTPATHS and not config.option.keyword
    )
    quick = config.option.markexpr in config.getini("addopts")
    return min(os.cpu_count() or 1, MOST_WORKERS) if everything and quick else 0


@pytest.fixture(scope="session")
def chromium() -> Iterator[Any]:
    """Start one Chromium for all tests of the page."""
    names = (os.environ.get("CHROMIUM"), "chromium", "google-chrome")
    path = needed_program(
        "chromium", "apt-get install chromium, or name one by CHROMIUM", candidates=names
    )
    api = needed_module("playwright.sync_api", "pip install -e '.[browser]'")
    with api.sync_playwright() as playwright:
        # A sandboxed frame in a process of its own is missing from screenshots.
        arguments = ["--no-sandbox", "--disable-features=IsolateSandboxedIframes"]
        browser = playwright.chromium.launch(
            executable_path=path, args=arguments, timeout=CHROMIUM_START_MS
        )
        yield browser
        browser.close()
