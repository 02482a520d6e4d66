"""Measure all figures of speed in one run: ``python -m research.benchmarks.seconds``.

Prints Markdown; ``--record`` keeps it. It takes seven minutes on two quiet cores and needs no
network access, if ``peers.py`` has made its environment (``--environment``). The speed of the bare
network is measured before and after all others, so that a machine which changed its speed is
noticed. ``starts.py`` measures the starts of commands.
"""

from __future__ import annotations

import argparse
import math
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

import cv2
import numpy as np
import onnxruntime

from research.benchmarks.batch import run_rows
from research.benchmarks.peers import ENVIRONMENT
from research.benchmarks.speed import bare_seconds, input_tiles, large_scene
from research.results.record import add_record_option, header, recording, tables_of
from research.scenes import render_scene
from vehanchor.engine import Engine
from vehanchor.models.runtime import Runtime
from vehanchor.models.zoo import resolve_model

if TYPE_CHECKING:
    from collections.abc import Sequence

    from research.results.record import Cell, Table
    from research.scenes import Layout

_SIZE_PX = (4000, 3000)
_SCENES: tuple[tuple[Layout, float], ...] = (
    ("urban", 0.04),
    ("urban", 0.15),
    ("countryside", 0.1),
    ("sports", 0.08),
)
_N_BATCH = 8
_OURS = "vehanchor"
_TOOLS = (_OURS, "ultralytics, tile by tile, no merge", "SAHI", "supervision")
Row: TypeAlias = "tuple[str, str, Sequence[Cell]]"
"""Name of a figure, its aim, and its value for this library and the others, if they have it."""


def printed(module: str, *options: str) -> list[Table]:
    """Run another benchmark, and read its tables."""
    command = [sys.executable, "-m", f"research.benchmarks.{module}", *options]
    return tables_of(subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout)


def tile_ms() -> float:
    """Measure the milliseconds of the bare network for a tile, all cores; median of 15."""
    session = onnxruntime.InferenceSession(str(resolve_model()), providers=["CPUExecutionProvider"])
    tile = np.random.default_rng(0).random((1, 3, 1024, 1024), np.float32)
    return 1000 * statistics.median(
        bare_seconds(session, [tile], time.perf_counter) for _ in range(15)
    )


def search(environment: Path, rounds: int) -> list[Row]:
    """Compare the search with one detector with the other tools."""
    (table,) = printed("peers", "--environment", str(environment), "--rounds", str(rounds))
    rows: list[Row] = []
    for vehicles in ("200", "2,000", "15,000"):
        for column in ("wall / bare", "CPU time / bare"):
            values = [
                table.value(f"{int(vehicles.replace(',', ''))} / {tool}", column) for tool in _TOOLS
            ]
            rows.append((f"search with {vehicles} vehicles: {column}", "1.05", values))
    values = [f"{table.value(f'2000 / {tool}', 'peak MiB')} MiB" for tool in _TOOLS]
    return [*rows, ("peak memory with 2,000 vehicles", "", values)]


def photographs(folder: Path) -> list[Row]:
    """Compare adaptive with full search of 12 megapixels, and two workers with one."""
    engine = Engine(runtime=Runtime(threads=1))
    ratios = []
    changes = []
    same = 0
    for number, (layout, gsd) in enumerate(_SCENES):
        path = folder / f"{layout}-{gsd}.jpg"
        width, height = _SIZE_PX
        scene = render_scene(
            gsd,
            width_px=width,
            height_px=height,
            seed=1000 + number,
            layout=layout,
            fleet_kind="mixed",
        )
        cv2.imwrite(str(path), scene.image[:, :, ::-1])
        started = time.process_time()
        full = engine.estimate(str(path), effort="full")
        between = time.process_time()
        auto = engine.estimate(str(path), effort="auto")
        ratios.append((time.process_time() - between) / (between - started))
        changes.append(abs((auto.gsd_m_per_px or 0.0) / (full.gsd_m_per_px or math.inf) - 1))
        same += full.status == auto.status
    copies = folder / "copies"
    copies.mkdir()
    for number in range(_N_BATCH):
        os.link(path, copies / f"{number:02}.jpg")
    before, two, after = (run_rows(copies, "local", workers).rate for workers in (1, 2, 1))
    n = f"{len(_SCENES)} rendered photographs, 12 megapixels"
    return [
        (f"{n}: CPU time, `auto` / `full`, median", "0.4", [round(statistics.median(ratios), 2)]),
        (f"{n}: largest change of a value, %", "2", [round(100 * max(changes), 1)]),
        (f"{n}: equal statuses", "all", [f"{same} of {len(_SCENES)}"]),
        (
            f"batch of {_N_BATCH} photographs, 12 megapixels: rate of two workers / one",
            "1.9",
            [round(2 * two / (before + after), 2)],
        ),
        ("the same: images a second of two workers", "", [round(two, 2)]),
    ]


def car_park() -> list[Row]:
    """Compare all networks, adaptively, with the bare detector on all tiles; one thread."""
    image = large_scene()
    engine = Engine(runtime=Runtime(threads=1))
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    session = onnxruntime.InferenceSession(
        str(engine.detector.path), options, providers=["CPUExecutionProvider"]
    )
    tiles = input_tiles(image, engine.detector.card)
    engine.estimate(image[:1024, :1024])  # loads the models
    bare = bare_seconds(session, tiles, time.process_time)
    started = time.process_time()
    estimate = engine.estimate(image)
    ratio = (time.process_time() - started) / bare
    search = estimate.details
    name = (
        f"car park of 4096 x 4096 px, {search.tiles_searched} of {search.tiles_total} tiles: "
        "CPU time / bare"
    )
    return [(name, "1.3", [round(ratio, 2)])]


def calls() -> list[Row]:
    """Measure what a warm call over stdio costs beyond the library."""
    (overhead,) = printed("server_overhead", "--calls", "15")
    beyond = overhead.value("`estimate_gsd`", "overhead, median, ms")
    return [("warm `estimate_gsd` over stdio beyond the library, ms", "10", [beyond])]


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--environment", type=Path, default=ENVIRONMENT, help="of the other tools: see peers.py"
    )
    parser.add_argument("--rounds", type=int, default=2, help="of the other tools")
    options = add_record_option(parser).parse_args()
    title = "The figures of speed in one run, beside other tools"
    with (
        recording("speed", ["seconds"], options.record, title=title),
        tempfile.TemporaryDirectory() as name,
    ):
        before = tile_ms()
        rows = [
            *search(options.environment, options.rounds),
            *car_park(),
            *photographs(Path(name)),
            *calls(),
        ]
        bare: list[Row] = [
            (f"bare network, {when}: ms a tile", "", [round(tile_time, 1)])
            for when, tile_time in (("before", before), ("after", tile_ms()))
        ]
        print(header("figure", _OURS, "ultralytics", "SAHI", "supervision", "aim"))
        for figure, aim, values in [*bare, *rows]:
            cells = [*map(str, values), *[""] * (len(_TOOLS) - len(values))]
            print(f"| {figure} | {' | '.join(cells)} | {aim} |", flush=True)


if __name__ == "__main__":
    main()
