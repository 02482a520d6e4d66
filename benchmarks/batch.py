"""Throughput of ``vehanchor batch``: ``python -m benchmarks.batch``. Prints Markdown, kept in RESULTS.md.

The same rendered scenes through each engine and number of workers, as whole commands (starting Ray is part of what a
user waits for) and without the start: the difference between all the images and half of them.
"""

from __future__ import annotations

import argparse
import importlib.util
import os
import platform
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import cv2

from vehanchor_scenes import render_scene

SIDE_PX = 1024
N_SCENES = 4  # rendered; the rest are further names of the same files


def write_images(folder: Path, n_images: int) -> None:
    """Write images of one size."""
    for seed in range(min(N_SCENES, n_images)):
        scene = render_scene(0.15, width_px=SIDE_PX, height_px=SIDE_PX, seed=seed, layout="parking")
        cv2.imwrite(str(folder / f"{seed:05}.jpg"), scene.image[:, :, ::-1])
    for number in range(N_SCENES, n_images):
        os.link(folder / f"{number % N_SCENES:05}.jpg", folder / f"{number:05}.jpg")


def command_time(folder: Path, engine: str, workers: int, n_images: int) -> float:
    """Seconds that the command takes for the first images of the folder."""
    images = [str(path) for path in sorted(folder.glob("*.jpg"))[:n_images]]
    with tempfile.TemporaryDirectory() as output:
        command = [sys.executable, "-m", "vehanchor", "batch", *images, "--output", f"{output}/table.csv"]
        started = time.perf_counter()
        subprocess.run([*command, "--engine", engine, "--workers", str(workers)], check=True, capture_output=True)
        return time.perf_counter() - started


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--images", type=int, default=80)
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    options = parser.parse_args()
    engines = ["local", "ray"] if importlib.util.find_spec("ray") else ["local"]
    runs = [("local", 1)] + [(engine, options.workers) for engine in engines]
    print(f"{platform.machine()}, {os.cpu_count()} CPUs, {options.images} images of {SIDE_PX} x {SIDE_PX} px\n")
    print("| engine | workers | whole command | images a second, started |\n|---|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        write_images(Path(folder), options.images)
        for engine, workers in dict.fromkeys(runs):
            half = command_time(Path(folder), engine, workers, options.images // 2)
            whole = command_time(Path(folder), engine, workers, options.images)
            rate = (options.images - options.images // 2) / (whole - half)
            print(f"| {engine} | {workers} | {whole:.1f} s | {rate:.2f} |", flush=True)


if __name__ == "__main__":
    main()
