"""Compare the search for vehicles with other tools.

``python -m research.benchmarks.peers``. Prints Markdown; ``--record`` keeps it.

Bare ONNX Runtime, ultralytics, SAHI, supervision and this library search the same 4096 x 4096 px
images with the same oriented-box file, tile by tile. The images show few, many and very many
vehicles. The others run in an environment of their own, which the first call makes
(``--environment``, 6 GB): ultralytics is under the AGPL and no part of this project; what runs
there is ``peers_inside.py``. Every pass is a fresh process, the tools in turns, each divided by the
mean of the bare passes before and after its round. ``--alone`` leaves the others out, and needs no
further environment.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from importlib import metadata
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np

from research.results.record import add_record_option, header, recording
from research.scenes import render_scene
from vehanchor.detection.detector import Detector
from vehanchor.detection.search import ImageSearch
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.imagery.tiles import tile_grid
from vehanchor.models.zoo import resolve_model
from vehanchor.options import Search

if TYPE_CHECKING:
    from collections.abc import Sequence

ENVIRONMENT = Path("~/.cache/vehanchor/peers").expanduser()
_PACKAGES = (
    "ultralytics==8.4.190",
    "sahi==0.12.8",
    "supervision==0.31.2",
    "onnx",
    "torch",
    "torchvision",
)
_OURS = "vehanchor"
_PEERS = ("ultralytics, tile by tile, no merge", "SAHI", "supervision")
_BARE = "ONNX Runtime alone"
_ALONE = "The search for vehicles beside bare ONNX Runtime, 25 tiles"
_SIDE_PX = 4096
_TILE_PX = 1024
_SCENES = {"200": (0.15, 12), "2,000": (0.1, None), "15,000": (0.3, None)}
"""Images by number of vehicles: metres a pixel, and vehicles in a sixteenth of it (None: full)."""


class Pass(NamedTuple):
    """One search of the image by one tool.

    Attributes:
        tool: its name.
        wall_s: seconds, without loading and a first tile.
        cpu_s: of all cores.
        peak_mib: of the process.
        n_boxes: that it found.
        n_tiles: that it looked at.
    """

    tool: str
    wall_s: float
    cpu_s: float
    peak_mib: float
    n_boxes: int
    n_tiles: int


def make_environment(folder: Path) -> Path:
    """Return the interpreter of the peers' environment; make it if necessary."""
    python = folder / "bin" / "python"
    packages = (*_PACKAGES, f"onnxruntime=={metadata.version('onnxruntime')}")
    stamp = folder / "requirements.txt"
    if not stamp.exists() or stamp.read_text().split() != list(packages):
        print(f"making {folder} ...", file=sys.stderr)
        subprocess.run([sys.executable, "-m", "venv", str(folder)], check=True)
        subprocess.run([str(python), "-m", "pip", "install", "-q", *packages], check=True)
        stamp.write_text("\n".join(packages))
    return python


def write_work(folder: Path) -> tuple[Path, list[Path], Path]:
    """Write the detector alone, the images and the corners of their tiles.

    Each image is a rendered car park of 1024 x 1024 px, repeated: what matters is the number of
    vehicles.
    """
    model = folder / "vehicles.onnx"
    tiles = folder / "tiles.json"
    written = list[Path]()
    shutil.copyfile(resolve_model(), model)  # without the networks beside it
    tiles.write_text(
        json.dumps(
            [(tile.x_px, tile.y_px) for tile in tile_grid(_SIDE_PX, _SIDE_PX, tile_px=_TILE_PX)]
        )
    )
    for number, (gsd, n_vehicles) in enumerate(_SCENES.values()):
        scene = render_scene(gsd, seed=5, layout="parking", n_vehicles=n_vehicles)
        path = folder / f"scene{number}.png"
        n_tiles = _SIDE_PX // _TILE_PX
        picture = np.tile(scene.image[:, :, ::-1], (n_tiles, n_tiles, 1))
        cv2.imwrite(str(path), picture)
        written.append(path)
    return model, written, tiles


def search_here(model: Path, image: Path) -> Pass:
    """Search with this library: every tile at full resolution. Run it in a fresh process."""
    read = cv2.imread(str(image))
    if read is None:
        raise FileNotFoundError(image)
    pixels = np.ascontiguousarray(read[:, :, ::-1]).astype(np.uint8, copy=False)
    detector = Detector(model)
    detector.detect_tile(detector.prepared(pixels[:_TILE_PX, :_TILE_PX]), 0.5)
    wall = time.perf_counter()
    cpu = time.process_time()
    with open_raster(pixels) as raster:
        vehicles = ImageSearch(
            raster, detector, Search(search_scales=False, effort="full")
        ).searched()
    spent = time.perf_counter() - wall, time.process_time() - cpu
    status = Path("/proc/self/status").read_text().splitlines()
    peak_kib = next(int(line.split()[1]) for line in status if line.startswith("VmHWM"))
    return Pass(_OURS, *spent, peak_kib / 1024, len(vehicles.boxes), vehicles.n_tiles)


def run_pass(command: list[str], tool: str) -> list[Pass]:
    """Search the images by one tool in a process of its own, which prints a line for each."""
    quiet = {
        **os.environ,
        "YOLO_VERBOSE": "False",
        "YOLO_AUTOINSTALL": "False",
        "YOLO_OFFLINE": "True",
    }
    done = subprocess.run(command, capture_output=True, text=True, env=quiet, check=False)
    if done.returncode:
        raise SystemExit(f"{tool} failed:\n{done.stderr}")
    return [
        Pass(tool, **json.loads(line)) for line in done.stdout.splitlines() if line.startswith("{")
    ]


def passes(
    python: Path,
    model: Path,
    images: list[Path],
    tiles: Path,
    tools: Sequence[str],
    rounds: int,
) -> dict[str, list[list[Pass]]]:
    """Search the images by tools in turns; bare ONNX Runtime comes first and last.

    Args:
        python: interpreter of the peers.
        model: file of the detector.
        images: files of the images.
        tiles: file of the tiles' corners.
        tools: the first one is bare ONNX Runtime.
        rounds: number of passes of each tool.

    Returns:
        By tool the passes of each round, one per image.
    """
    here = [sys.executable, "-m", "research.benchmarks.peers", "--here", str(model)]
    inside = [str(python), str(Path(__file__).with_name("peers_inside.py"))]
    by_tool: dict[str, list[list[Pass]]] = {tool: [] for tool in tools}
    for tool in [*by_tool] * rounds + [_BARE]:
        command = here if tool == _OURS else [*inside, tool, str(model), str(tiles)]
        by_tool[tool].append(run_pass([*command, *map(str, images)], tool))
    return by_tool


def table(by_tool: dict[str, list[list[Pass]]]) -> list[str]:
    """Write the passes as lines of Markdown; medians of the rounds."""
    lines = [
        header(
            "vehicles",
            "tool",
            "tiles",
            "boxes",
            "wall / bare",
            "CPU time / bare",
            "CPU s",
            "peak MiB",
        )
    ]
    for k, vehicles in enumerate(_SCENES):
        bare = [of_round[k] for of_round in by_tool[_BARE]]
        for tool, rounds in by_tool.items():
            of_image = [of_round[k] for of_round in rounds]
            cells = [
                vehicles,
                tool,
                str(of_image[0].n_tiles),
                str(of_image[0].n_boxes),
                f"{_median_ratio(of_image, bare, 'wall_s'):.2f}",
                f"{_median_ratio(of_image, bare, 'cpu_s'):.2f}",
                f"{statistics.median(result.cpu_s for result in of_image):.2f}",
                f"{statistics.median(result.peak_mib for result in of_image):.0f}",
            ]
            lines.append(f"| {' | '.join(cells)} |")
    return lines


def _median_ratio(results: list[Pass], bare: list[Pass], field: str) -> float:
    """Compute the median ratio to the mean of the bare passes before and after each round."""
    ratios = []
    for result, (before, after) in zip(results, pairwise(bare), strict=False):
        mean = statistics.mean((getattr(before, field), getattr(after, field)))
        ratios.append(getattr(result, field) / mean)
    return float(statistics.median(ratios))


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--environment", type=Path, default=ENVIRONMENT, help="folder of the peers' environment"
    )
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument(
        "--alone", action="store_true", help="compare with bare ONNX Runtime, in this environment"
    )
    parser.add_argument(
        "--here", nargs="+", type=Path, metavar="MODEL IMAGE", help=argparse.SUPPRESS
    )
    options = add_record_option(parser).parse_args()
    if options.here:
        model, *images = options.here
        for image in images:
            result = search_here(model, image)._asdict()
            del result["tool"]
            print(json.dumps(result), flush=True)
        return
    if options.alone:
        tools: tuple[str, ...] = (_BARE, _OURS)
        python = Path(sys.executable)
        recorded = recording("speed", ["bare"], options.record, title=_ALONE)
    else:
        tools = (_BARE, _OURS, *_PEERS)
        python = make_environment(options.environment)
        recorded = recording("speed", ["peers"], options.record, packages=list(_PACKAGES))
    with tempfile.TemporaryDirectory() as name:
        model, images, tiles = write_work(Path(name))
        with recorded:
            measured = passes(python, model, images, tiles, tools=tools, rounds=options.rounds)
            print(*table(measured), sep="\n", flush=True)


if __name__ == "__main__":
    main()
