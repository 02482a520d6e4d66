from __future__ import annotations

import gc
import hashlib
import math
import os
import re
import tomllib
from collections.abc import Iterator
from functools import cache
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
_OPTIONS = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["pytest"]
LONGER = frozenset(re.findall(r"not (\w+)", _OPTIONS["ini_options"]["addopts"]))
"""Markers of the tests that a plain ``pytest`` leaves out."""
MOST_WORKERS = 4  # each loads everything once
CHROMIUM_START_MS = 120_000
_MODULES_OF_NETWORKS = (
    "courts.network",
    "detection.detector",
    "detection.scene_scale",
    "detection.verifier",
)
_BUNDLED = f"{os.sep}bundled{os.sep}"
_REMEMBERED_BYTES = 100 << 20

# What a test means does not depend on how busy the machine is; the timeout of pytest catches what
# hangs.
hypothesis.settings.register_profile("vehanchor", deadline=None)
hypothesis.settings.load_profile("vehanchor")

# The modules and tests that are collected stay to the end; to look through them again and again for
# garbage took as long as to collect them.
gc.disable()

# Typer colours its help for GitHub's log where it finds this; the tests read plain text.
os.environ.pop("GITHUB_ACTIONS", None)


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Import only the files of a marker: ``-m nginx`` needs one of two hundred."""
    marker = config.option.markexpr
    is_test = collection_path.match("test_*.py")
    if marker in LONGER and is_test and not has_marker(collection_path, marker):
        return True
    return None


@cache
def has_marker(path: Path, marker: str) -> bool:
    """Test whether a file of tests names a marker, or imports a module of ``tests`` that does."""
    text = path.read_text(encoding="utf-8")
    return any(name in text for name in (f"mark.{marker}", *_modules_with(marker)))


@cache
def _modules_with(marker: str) -> tuple[str, ...]:
    paths = [path for path in ROOT.glob("tests/**/*.py") if not path.name.startswith("test_")]
    return tuple(
        ".".join(path.relative_to(ROOT).with_suffix("").parts)
        for path in paths
        if f"mark.{marker}" in path.read_text(encoding="utf-8")
    )


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Refuse a test that ``pytest_ignore_collect`` would not find by its marker."""
    for item in items:
        for marker in LONGER.intersection(mark.name for mark in item.iter_markers()):
            if not has_marker(item.path, marker):
                raise pytest.UsageError(
                    f"{item.nodeid} is marked {marker} by what its file does not name: write "
                    f"pytest.mark.{marker} in the file, or import the module of tests that does"
                )


@pytest.hookimpl(tryfirst=True)
def pytest_runtestloop() -> None:
    """Keep what was collected out of the search for garbage, which goes on here."""
    gc.enable()
    gc.freeze()


class _Remembered:
    """Answers of the bundled networks to equal inputs; the oldest are forgotten."""

    def __init__(self) -> None:
        self._answers: dict[Any, list[Any]] = {}
        self._n_bytes = 0

    def run(self, session: Any, names: Any, feeds: Any, runtime: Any, described: str) -> list[Any]:
        def ran() -> list[Any]:
            return run_session(session, names, feeds=feeds, runtime=runtime, described=described)

        cancelled = runtime.cancellation is not None and runtime.cancellation.requested
        if cancelled or _BUNDLED not in described:
            return ran()
        inputs = [hashlib.sha256(feed.tobytes()).digest() for feed in feeds.values()]
        key = described, runtime.threads, *inputs
        if key not in self._answers:
            self._keep(key, ran())
        return [np.array(answer) for answer in self._answers[key]]

    def _keep(self, key: Any, answers: list[Any]) -> None:
        self._answers[key] = answers
        self._n_bytes += sum(answer.nbytes for answer in answers)
        while self._n_bytes > _REMEMBERED_BYTES:
            oldest = self._answers.pop(next(iter(self._answers)))
            self._n_bytes -= sum(answer.nbytes for answer in oldest)


@pytest.fixture(scope="session", autouse=True)
def _each_image_is_looked_at_once() -> Iterator[None]:
    """Remember what the bundled networks, and the fits of courts, answer to equal inputs."""
    fits: dict[Any, Any] = {}

    def fitted(raster: Raster, proposals: list[Proposal], **sizes: int) -> Any:
        key = image_id(raster), sizes["n_sizes"], *proposals
        if key not in fits:
            fits[key] = courts_among(raster, proposals, **sizes)
        return list(fits[key])

    with pytest.MonkeyPatch.context() as patches:
        remembered = _Remembered()
        for module in _MODULES_OF_NETWORKS:
            patches.setattr(f"vehanchor.{module}.run_session", remembered.run)
        patches.setattr("vehanchor.courts.find.courts_among", fitted)
        yield


@pytest.fixture(scope="session", autouse=True)
def _progress_says_no_line() -> Iterator[None]:
    """Let no line of progress come into what a command writes because a machine is slow."""
    with pytest.MonkeyPatch.context() as patches:
        patches.setattr("vehanchor.cli.terminal._LINE_EVERY_S", math.inf)
        yield


@pytest.fixture(scope="session")
def real_data() -> Path:
    """The folder of real images; a test that asks for it is skipped where there is none."""
    folder = Path(os.environ.get("VEHANCHOR_DATA", ROOT.parent / "shared" / "data"))
    if not (folder / "gsd" / "table.csv").is_file():
        pytest.skip(f"no real images at {folder}; set VEHANCHOR_DATA")
    return folder


@pytest.fixture
def plain_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    """Print commands as to a terminal of 120 columns without colours, and errors in short."""
    monkeypatch.setenv("COLUMNS", "120")
    monkeypatch.setenv("NO_COLOR", "1")
    monkeypatch.delenv("VEHANCHOR_TRACEBACK", raising=False)


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
