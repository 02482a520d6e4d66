"""What the process that listens imports."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

_CALLS = """
import json, sys
import anyio
from pathlib import Path
from mcp import Client
from vehanchor_server.app import create_server
from vehanchor_server.services import create_services
from vehanchor_server.settings import Settings

DECODERS = ("cv2", "onnxruntime", "rasterio", "PIL", "pi_heif", "numpy", "scipy")

async def called(server, images, calls):
    answers = []
    async with Client(server) as client:
        listed = [tool.name for tool in (await client.list_tools()).tools]
        for name, arguments in calls:
            answers.append([name, (await client.call_tool(name, arguments)).is_error])
    return listed, answers

def main():
    images, detector, encoder, decoder, calls = sys.argv[1:]
    settings = Settings(roots=(Path(images),), detector=detector, segmenter=(Path(encoder), Path(decoder)), threads=1)
    services = create_services(settings)
    try:
        listed, answers = anyio.run(called, create_server(services), images, json.loads(calls))
    finally:
        services.close()
    print(json.dumps([listed, answers, [name for name in DECODERS if name in sys.modules]]))

if __name__ == "__main__":
    main()
"""


@pytest.mark.promise("listener")
@pytest.mark.slow
def test_no_decoder_is_imported_after_every_tool_was_called(
    images: Path, detector_path: Path, segmenter_paths: tuple[Path, Path], tmp_path: Path
) -> None:
    root = tmp_path / "images"
    root.mkdir()
    for name in ("cars.png", "pool.png", "notes.txt"):
        shutil.copy(images / name, root)
    cars, pool = ({"kind": "path", "path": str(root / name)} for name in ("cars.png", "pool.png"))
    box = {"box": {"x_min": 294, "y_min": 324, "x_max": 354, "y_max": 432}}
    calls = [
        ("view_image", {}),
        ("view_image", {"image": cars}),
        ("view_image", {"image": {"kind": "path", "path": str(root / "notes.txt")}}),
        ("view_image", {"of": {"tool": "estimate_gsd", "arguments": {"image": cars}}}),
        ("estimate_gsd", {"image": cars, "more_images": [pool], "detail": "full"}),
        ("measure_area", {"image": pool, "targets": [box]}),
        ("measure_distance", {"image": cars, "lines": [{"points": [{"x": 10, "y": 10}, {"x": 90, "y": 90}]}]}),
    ]
    models = [str(detector_path), *map(str, segmenter_paths)]
    command = [sys.executable, "-c", _CALLS, str(root), *models, json.dumps(calls)]
    printed = subprocess.run(command, capture_output=True, text=True, timeout=300, check=True).stdout
    listed, answers, imported = json.loads(printed.splitlines()[-1])
    assert {name for name, _ in answers} == set(listed), "a tool was not called"
    assert [failed for _, failed in answers] == [False, False, True, False, False, False, False]
    assert imported == []
