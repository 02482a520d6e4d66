"""Compare the search for vehicles with other tools.

``python -m research.benchmarks.peers``. Prints Markdown; ``--record`` keeps it.

Bare ONNX Runtime, ultralytics, SAHI, supervision and this library search the same 4096 x 4096 px image with the same
oriented-box file, tile by tile. The others run in an environment of their own, which the first call makes
(``--environment``, 6 GB): ultralytics is under the AGPL and no part of this project; what runs there is
``peers_inside.py``. Every pass is a fresh process, the tools in turns, each divided by the bare pass of its round.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from importlib import metadata
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import onnxruntime

from research.benchmarks.speed import large_scene
from research.results.record import add_record_option, recording
from vehanchor.detection.detector import Detector
from vehanchor.detection.search import search
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.imagery.tiles import tile_grid
from vehanchor.models.zoo import resolve_model
from vehanchor.options import Search

ENVIRONMENT = Path("~/.cache/vehanchor/peers").expanduser()
_PACKAGES = ("ultralytics==8.4.190", "sahi==0.12.8", "supervision==0.31.2", "onnx", "torch", "torchvision")
_OURS = "vehanchor"
_BARE = "ONNX Runtime alone"
_TILE_PX = 1024


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
    """The interpreter of the peers' environment, made where there is none."""
    python = folder / "bin" / "python"
    wanted = (*_PACKAGES, f"onnxruntime=={metadata.version('onnxruntime')}")
    stamp = folder / "requirements.txt"
    if not stamp.exists() or stamp.read_text().split() != list(wanted):
        print(f"making {folder} ...", file=sys.stderr)
        subprocess.run([sys.executable, "-m", "venv", str(folder)], check=True)
        subprocess.run([str(python), "-m", "pip", "install", "-q", *wanted], check=True)
        stamp.write_text("\n".join(wanted))
    return python


def search_here(model: Path, image: Path) -> Pass:
    """This library's search: every tile at full resolution, merged exactly. Run in a fresh process."""
    read = cv2.imread(str(image))
    if read is None:
        raise FileNotFoundError(image)
    pixels = np.ascontiguousarray(read[:, :, ::-1]).astype(np.uint8, copy=False)
    detector = Detector(model)
    detector.detect_tile(detector.prepared(pixels[:_TILE_PX, :_TILE_PX]), 0.5)
    wall, cpu = time.perf_counter(), time.process_time()
    with open_raster(pixels) as raster:
        found = search(raster, detector, Search(search_scales=False, effort="full"))
    spent = time.perf_counter() - wall, time.process_time() - cpu
    status = Path("/proc/self/status").read_text().splitlines()
    peak_kib = next(int(line.split()[1]) for line in status if line.startswith("VmHWM"))
    return Pass(_OURS, *spent, peak_kib / 1024, len(found.boxes), found.n_tiles)


def run_pass(command: list[str], tool: str) -> Pass:
    """One pass in a process of its own; the last line that it prints is the result."""
    quiet = {**os.environ, "YOLO_VERBOSE": "False", "YOLO_AUTOINSTALL": "False", "YOLO_OFFLINE": "True"}
    done = subprocess.run(command, capture_output=True, text=True, env=quiet, check=False)
    if done.returncode:
        raise SystemExit(f"{tool} failed:\n{done.stderr}")
    return Pass(tool, **json.loads(done.stdout.strip().splitlines()[-1]))


def compare(python: Path, model: Path, image: Path, tiles: Path, rounds: int) -> list[str]:
    """Markdown of all tools."""
    inside = [str(python), str(Path(__file__).with_name("peers_inside.py"))]
    tools = [_BARE, _OURS, "ultralytics, tile by tile, no merge", "SAHI", "SAHI, default", "supervision"]
    passes: dict[str, list[Pass]] = {tool: [] for tool in tools}
    for _ in range(rounds):
        for tool in tools:
            command = [*inside, tool, str(model), str(image), str(tiles)]
            if tool == _OURS:
                command = [sys.executable, "-m", "research.benchmarks.peers", "--here", str(model), str(image)]
            passes[tool].append(run_pass(command, tool))
    lines = [
        "| tool | tiles | boxes | wall / bare | CPU time / bare | CPU s | peak MiB |",
        "|---|---|---|---|---|---|---|",
    ]
    for tool in tools:
        mine, bare = passes[tool], passes[_BARE]
        wall, cpu = (
            statistics.median(getattr(m, part) / getattr(b, part) for m, b in zip(mine, bare, strict=True))
            for part in ("wall_s", "cpu_s")
        )
        lines.append(
            f"| {tool} | {mine[0].n_tiles} | {mine[0].n_boxes} | {wall:.2f} | {cpu:.2f} "
            f"| {statistics.median(m.cpu_s for m in mine):.2f} | {statistics.median(m.peak_mib for m in mine):.0f} |"
        )
    return lines


def tile_times(ours: Path, other: Path, rounds: int) -> str:
    """A tile by the bundled detector and by YOLO11n-OBB, 2 threads, in turns."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 2
    sessions = [onnxruntime.InferenceSession(str(path), options) for path in (ours, other)]
    tile = np.random.default_rng(0).random((1, 3, _TILE_PX, _TILE_PX), np.float32)
    wall: list[list[float]] = [[], []]
    cpu: list[list[float]] = [[], []]
    for _ in range(rounds + 1):
        for k, session in enumerate(sessions):
            started = time.perf_counter(), time.process_time()
            session.run(None, {session.get_inputs()[0].name: tile})
            wall[k].append(time.perf_counter() - started[0])
            cpu[k].append(time.process_time() - started[1])
    by_wall, by_cpu = (
        [statistics.median(each[0][1:]) / statistics.median(each[1][1:]), min(each[0][1:]) / min(each[1][1:])]
        for each in (wall, cpu)
    )
    return (
        f"One {_TILE_PX} px tile, bundled over YOLO11n-OBB, {rounds} in turns: wall {by_wall[0]:.2f} (best of each "
        f"{by_wall[1]:.2f}), CPU {by_cpu[0]:.2f} (best {by_cpu[1]:.2f}); best wall {1000 * min(wall[0][1:]):.0f} ms "
        f"against {1000 * min(wall[1][1:]):.0f} ms"
    )


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--environment", type=Path, default=ENVIRONMENT, help="folder of the peers' environment")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--here", nargs=2, type=Path, metavar=("MODEL", "IMAGE"), help=argparse.SUPPRESS)
    options = add_record_option(parser).parse_args()
    if options.here:
        print(json.dumps({k: v for k, v in search_here(*options.here)._asdict().items() if k != "tool"}))
        return
    python = make_environment(options.environment)
    print(
        f"{platform.machine()}, {os.cpu_count()} CPUs, onnxruntime {onnxruntime.__version__}, {', '.join(_PACKAGES)}\n"
    )
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        model, image, tiles = folder / "vehicles.onnx", folder / "scene.png", folder / "tiles.json"
        shutil.copyfile(resolve_model(), model)  # alone: without the networks beside it
        pixels = large_scene()
        cv2.imwrite(str(image), pixels[:, :, ::-1])
        grid = tile_grid(pixels.shape[1], pixels.shape[0], tile_px=_TILE_PX)
        tiles.write_text(json.dumps([(tile.x_px, tile.y_px) for tile in grid]))
        with recording("speed", ["peers"], options.record, packages=list(_PACKAGES)):
            print("\n".join(compare(python, model, image, tiles, options.rounds)), flush=True)
        other = folder / "yolo11n-obb.onnx"  # random weights: its time is that of any
        inside = Path(__file__).with_name("peers_inside.py").resolve()
        subprocess.run([str(python), str(inside), "export", str(other)], check=True, capture_output=True, cwd=folder)
        print(f"\n{tile_times(model, other, 3 * options.rounds)}")


if __name__ == "__main__":
    main()
