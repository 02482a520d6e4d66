"""An agents' framework calls the tools of a real server, in an environment of its own, over pipes and over HTTP.

No model is needed: the driver in ``frameworks/`` does what the framework does once a model has chosen a tool. With a
model, five frameworks are in ``tests/examples/test_agents.py``.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

import vehanchor
from tests.needs import environment
from tests.sam_models import SamFiles
from tests.server.conftest import POOL_BOX
from tests.server.conversation import by_path
from tests.server.transport.test_http import served
from vehanchor.detection.detector import load_detector
from vehanchor.models.runtime import Runtime
from vehanchor_server.settings import Settings

pytestmark = [pytest.mark.frameworks, pytest.mark.timeout(600)]

PATH = (10, 20), (310, 420)
LINES = [{"points": [{"x": x, "y": y} for x, y in PATH]}]
_FOLDER = Path(__file__).parent / "frameworks"


def driven(asked: dict[str, Any]) -> dict[str, Any]:
    """What the framework's driver saw, by transport."""
    done = subprocess.run(
        [environment(packages=("fastmcp==4.1.2",)), _FOLDER / "drive_fastmcp.py"],
        input=json.dumps(asked),
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    seen: dict[str, Any] = json.loads(done.stdout)
    return seen


def test_a_framework_gets_the_librarys_records_and_reads_what_went_wrong(
    settings: Settings, images: Path, detector_path: Path, segmenter_paths: SamFiles, tmp_path: Path
) -> None:
    detector = load_detector(detector_path, Runtime(threads=1))
    box = POOL_BOX["x_min"], POOL_BOX["y_min"], POOL_BOX["x_max"], POOL_BOX["y_max"]
    estimate = vehanchor.estimate_gsd(images / "cars.png", detector=detector)
    records = [
        estimate,
        vehanchor.measure_area(images / "pool.png", box=box, detector=detector, segmenter=segmenter_paths),
        vehanchor.measure_distance(images / "cars.png", PATH, detector=detector),
    ]
    calls = [
        ("estimate_gsd", by_path(images / "cars.png")),
        ("measure_area", {**by_path(images / "pool.png"), "targets": [{"box": POOL_BOX}]}),
        ("measure_distance", {**by_path(images / "cars.png"), "lines": LINES}),
        ("view_image", {"image": by_path(images / "cars.png")["image"], "long_side_px": 640}),
        ("estimate_gsd", by_path(tmp_path / "elsewhere.png")),
    ]
    models = ["--detector", str(detector_path), "--segmenter", *map(str, segmenter_paths), "--threads", "1"]
    serve = ["-m", "vehanchor", "serve", "--root", str(images), *models]
    command: dict[str, Any] = {"command": sys.executable, "args": serve, "env": {}}
    with served(settings) as address:
        seen = driven({"stdio": command, "url": f"{address}/mcp", "calls": calls})
    print(json.dumps(seen["versions"]))
    for transport in ("stdio", "http"):
        assert seen[transport]["tools"] == ["estimate_gsd", "measure_area", "measure_distance", "view_image"]
        *results, shown, refused = seen[transport]["results"]
        assert shown["picture"] == "image/jpeg"
        assert shown["text"].startswith("Image of 640 x 512 px. The picture of 640 x 512 px shows all of it")
        assert [result["record"] for result in results] == [record.model_dump(mode="json") for record in records]
        assert "path_not_allowed" in refused["text"]
