"""Compare Ray with local workers: ``python -m research.benchmarks.batch``.

Prints Markdown; ``--record`` keeps it. Ray runs on simulated nodes of one CPU each (its own cluster
utility: all of them processes of this machine), beside as many local workers, by the rows from the
first to the last; rows lost and doubled are counted.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import cv2

from research.results.record import add_record_option, recording
from research.scenes import render_scene
from vehanchor.batch import run_batch
from vehanchor.models.runtime import Runtime

SIDE_PX = 1024
# Rendered scenes; the others are further names of the same files.
N_SCENES = 4


def write_images(folder: Path, n_images: int, side_px: int) -> None:
    """Write images of one size."""
    for seed in range(min(N_SCENES, n_images)):
        scene = render_scene(0.15, width_px=side_px, height_px=side_px, seed=seed, layout="parking")
        cv2.imwrite(str(folder / f"{seed:05}.jpg"), scene.image[:, :, ::-1])
    for number in range(N_SCENES, n_images):
        os.link(folder / f"{number % N_SCENES:05}.jpg", folder / f"{number:05}.jpg")


class Run(NamedTuple):
    """One run of a batch.

    Attributes:
        rate: rows a second, once there are as many rows as workers.
        n_lost: images without a row.
        n_doubled: rows beyond one an image.
    """

    rate: float
    n_lost: int
    n_doubled: int


@contextmanager
def simulated_cluster(n_nodes: int) -> Iterator[None]:
    """Start a head without work and nodes of one CPU each, and connect this process to it."""
    import ray
    from ray.cluster_utils import Cluster

    cluster = Cluster(
        initialize_head=True, head_node_args={"num_cpus": 0, "include_dashboard": False}
    )
    for _ in range(n_nodes):
        cluster.add_node(num_cpus=1)
    cluster.wait_for_nodes()
    ray.init(cluster.address, log_to_driver=False, logging_level="CRITICAL")
    try:
        yield
    finally:
        ray.shutdown()
        cluster.shutdown()


def run_rows(folder: Path, engine: str, workers: int) -> Run:
    """Run the folder's images."""
    times: list[float] = []

    def tell(_done: int, _total: int) -> None:
        times.append(time.perf_counter())

    with tempfile.TemporaryDirectory() as output:
        table = Path(output) / "table.jsonl"
        # As on the command line, one worker has a process of its own, too.
        run_batch(
            [str(folder)],
            table,
            engine=engine,
            workers=workers,
            runtime=Runtime(progress=tell),
            isolated=True,
        )
        rows = Counter(json.loads(line)["photograph"] for line in table.read_text().splitlines())
    images = {str(path) for path in folder.glob("*.jpg")}
    came = times[1:]  # the first call tells that there is none yet
    # Timing starts after the first row, so rows that come with it do not count.
    warm = came[workers - 1 :]
    rate = (len(warm) - 1) / (warm[-1] - warm[0])
    n_missing = len(images - rows.keys())
    n_rows = max(len(came), rows.total())
    return Run(rate, n_missing, n_rows - len(images))


def compare_nodes(folder: Path, sizes: list[int]) -> None:
    """Print the table of clusters."""
    print(
        "| nodes | local, as many workers | Ray | Ray / local | lost, doubled "
        "|\n|---|---|---|---|---|"
    )
    for n_nodes in sizes:
        local = run_rows(folder, "local", n_nodes)
        with simulated_cluster(n_nodes):
            ray = run_rows(folder, "ray", n_nodes)
        share = ray.rate / local.rate
        print(
            f"| {n_nodes} | {local.rate:.2f}/s | {ray.rate:.2f}/s | {share:.2f} | {ray.n_lost}, "
            f"{ray.n_doubled} |",
            flush=True,
        )


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--images", type=int, default=80)
    parser.add_argument("--side", type=int, default=SIDE_PX, help="of the images, pixels")
    parser.add_argument(
        "--nodes", type=int, nargs="+", default=[1, 2, 4], help="nodes of each simulated cluster"
    )
    options = add_record_option(parser).parse_args()
    with tempfile.TemporaryDirectory() as folder, recording("speed", ["ray"], options.record):
        write_images(Path(folder), options.images, options.side)
        compare_nodes(Path(folder), options.nodes)


if __name__ == "__main__":
    main()
