"""Measure speed and memory: ``python -m research.benchmarks.speed``.

Prints Markdown; ``--record`` keeps it. The whole pipeline on a 4096 x 4096 scene is timed against
bare ONNX Runtime on the same tiles, in turns, and against all of its own networks; the value is the
median of the rounds. ``--detector`` names other files that take turns with it.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import onnxruntime

from research.results.record import add_record_option, header, recording, spread
from research.scenes import render_scene
from vehanchor import analyse_scale
from vehanchor.detection.detector import Detector
from vehanchor.detection.levels import search_levels
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.imagery.tiles import read_reduced_window, tile_grid
from vehanchor.models.zoo import resolve_model
from vehanchor.options import ScaleOptions, Search

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from numpy.typing import NDArray

    from vehanchor.detection.card import DetectorCard

# An image of that size is not searched wholly by default.
_EVERY_TILE = ScaleOptions(search=Search(effort="full"))


@contextmanager
def networks_seconds(clock: Callable[[], float]) -> Iterator[dict[str, float]]:
    """Count the seconds in ONNX Runtime, by the names of the networks' inputs and outputs.

    Args:
        clock: ``time.perf_counter``; or ``time.thread_time`` for CPU time, which is all of a
            network's where it runs in one thread.

    Yields:
        Seconds, growing.
    """
    spent: dict[str, float] = defaultdict(float)
    run = onnxruntime.InferenceSession.run

    def timed(session: Any, outputs: Any, feeds: Any, run_options: Any = None) -> Any:
        started = clock()
        try:
            return run(session, outputs, feeds, run_options)
        finally:
            spent[f"{next(iter(feeds))} to {session.get_outputs()[0].name}"] += clock() - started

    onnxruntime.InferenceSession.run = timed
    try:
        yield spent
    finally:
        onnxruntime.InferenceSession.run = run


def large_scene() -> NDArray[np.uint8]:
    """Repeat one rendered 1024 px scene; only the number of pixels and cars matters here."""
    scene = render_scene(0.15, width_px=1024, height_px=1024, seed=5, layout="parking")
    return np.ascontiguousarray(np.tile(scene.image, (4, 4, 1)))


def input_tiles(image: NDArray[np.uint8], card: DetectorCard) -> list[NDArray[np.float32]]:
    """Cut the tiles of an image at all resolutions, as the detector takes them."""
    tiles = []
    with open_raster(image) as raster:
        for level in search_levels(
            raster.width_px,
            raster.height_px,
            card.length_range_px,
            search_scales=card.search_scales,
        ):
            for window in tile_grid(level.width_px, level.height_px):
                pixels = read_reduced_window(raster, window, level.factor)
                tiles.append(np.asarray(cv2.dnn.blobFromImage(pixels, 1 / 255.0), dtype=np.float32))
    return tiles


def bare_seconds(
    session: onnxruntime.InferenceSession,
    tiles: list[NDArray[np.float32]],
    clock: Callable[[], float],
) -> float:
    """Measure the seconds of a network alone."""
    started = clock()
    for tile in tiles:
        session.run(None, {"images": tile})
    return clock() - started


def pipeline(rounds: int, others: list[str]) -> list[str]:
    """Whole pipeline against bare ONNX Runtime, against its own networks, and with other files."""
    image = large_scene()
    detectors = [Detector(resolve_model(name)) for name in (None, *others)]
    tiles = input_tiles(image, detectors[0].card)
    sessions = [
        onnxruntime.InferenceSession(str(each.path), providers=["CPUExecutionProvider"])
        for each in detectors
    ]
    bare: list[list[float]] = [[] for _ in detectors]
    whole: list[list[float]] = [[] for _ in detectors]
    added: list[list[float]] = [[] for _ in detectors]
    for number in range(rounds + 1):
        for k, (detector, session) in enumerate(zip(detectors, sessions, strict=True)):
            alone = bare_seconds(session, tiles, time.perf_counter)
            started = time.perf_counter()
            with networks_seconds(time.perf_counter) as networks:
                n_boxes = len(analyse_scale(image, _EVERY_TILE, detector=detector).detections.boxes)
            seconds = time.perf_counter() - started
            if number:  # the first round warms up
                bare[k].append(alone)
                whole[k].append(seconds)
                added[k].append(seconds / sum(networks.values()))
    lines = []
    for k, detector in enumerate(detectors):
        name = detector.path.stem
        n_tiles = len(tiles)
        lines += [
            _line(f"{name}: pipeline, 4096 x 4096, s", whole[k]),
            _line(f"{name}: vehicles found", [n_boxes], 0),
            _line(f"{name}: bare ONNX Runtime, the same {n_tiles} tiles, s", bare[k]),
            _line(f"{name}: pipeline / bare", _ratios(whole[k], bare[k]), 3),
            _line(f"{name}: pipeline / all its networks", added[k], 3),
        ]
        if k:
            for what, times in (("pipeline", whole), ("bare", bare)):
                shares = _ratios(times[k], times[0])
                lines.append(_line(f"{what}, {name} / {detectors[0].path.stem}", shares, 3))
    return lines


def _line(name: str, values: Sequence[float], decimals: int = 2) -> str:
    """Write a line of the table."""
    return f"| {name} | {' | '.join(spread(values, decimals))} |"


def _ratios(times: Sequence[float], others: Sequence[float]) -> list[float]:
    """Compute the ratios of two runs that took turns."""
    return [time / other for time, other in zip(times, others, strict=True)]


def peak_memory() -> str:
    """Peak resident memory of a fresh process that estimates a 4096 x 4096 PNG."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "large.png"
        cv2.imwrite(str(path), large_scene()[:, :, ::-1])
        # VmHWM and not getrusage: a child inherits its parent's ru_maxrss.
        code = (
            f"import vehanchor; vehanchor.estimate_gsd({str(path)!r}); "
            "print(next(line.split()[1] for line in open('/proc/self/status') if "
            "line.startswith('VmHWM')))"
        )
        kib = int(
            subprocess.run(
                [sys.executable, "-c", code], check=True, capture_output=True, text=True
            ).stdout
        )
    return _line("peak memory, 4096 x 4096 PNG, MiB", [kib / 1024], 0)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument(
        "--detector", action="append", default=[], help="file or name; may be repeated"
    )
    options = add_record_option(parser).parse_args()
    with recording("speed", ["pipeline_all"], options.record, rounds=options.rounds):
        print(header("quantity", "least", "value", "most"))
        for line in [*pipeline(options.rounds, options.detector), peak_memory()]:
            print(line, flush=True)


if __name__ == "__main__":
    main()
