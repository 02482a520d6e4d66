"""Measure what a call over stdio costs beyond the library.

``python -m research.benchmarks.server_overhead``. Aim: < 10 ms, median.

Also how long the first ``tools/list`` takes after the start. Aim: 0.8 s. With ``--workers`` instead: what a warm call
over HTTP costs in a worker beyond one with ``--in-process``, and the memory of both servers. Aims: 10 ms, 1.3 times.
"""

from __future__ import annotations

import argparse
import os
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import anyio
import cv2
import numpy as np
from mcp import Client, StdioServerParameters
from pydantic import BaseModel

from research.results.record import add_record_option, header, recording, values_table
from tests.server_process import (
    IDLE_S,
    SERVE,
    http_server,
    memory_mib,
    middle_box,
    processor_s,
    target,
    write_images,
)
from vehanchor import estimate_gsd, measure_area
from vehanchor.detection.detector import load_detector
from vehanchor.models.runtime import Runtime
from vehanchor.models.zoo import resolve_model, resolve_segmenter
from vehanchor.segmentation.segmenter import load_segmenter


async def overhead(n_calls: int, threads: int) -> None:
    """Library and server in turns, so that both meet the same machine."""
    detector = load_detector(resolve_model(), Runtime(threads=threads))
    segmenter = load_segmenter(*resolve_segmenter(), Runtime(threads=threads))
    with tempfile.TemporaryDirectory() as directory:
        image = write_images(Path(directory).resolve())[0]
        by_path = {"image": {"kind": "path", "path": str(image)}, "detail": "full"}
        box, known = middle_box(image), estimate_gsd(image, detector=detector).scale
        assert known is not None
        questions: dict[str, tuple[Callable[[], BaseModel], dict[str, Any]]] = {
            "estimate_gsd": (lambda: estimate_gsd(image, detector=detector), by_path),
            "measure_area": (
                lambda: measure_area(image, box=box, gsd_m_per_px=0.15, segmenter=segmenter),
                {**by_path, **target(box), "gsd_m_per_px": 0.15},
            ),
            "measure_area, its scale given back": (
                lambda: measure_area(image, box=box, scale=known, segmenter=segmenter),
                {**by_path, **target(box), "scale": known.model_dump(mode="json", exclude_none=True)},
            ),
        }
        server = StdioServerParameters(
            command=SERVE[0],
            args=[*SERVE[1:], "--root", directory, "--threads", str(threads)],
            env=dict(os.environ),  # variables of a linear algebra library change last digits
        )
        async with Client(server, read_timeout_seconds=120) as client:
            for words, (ask_library, arguments) in questions.items():
                tool, _, manner = words.partition(",")
                measured = "area_m2" if tool == "measure_area" else "gsd_m_per_px"
                library, called = [], []
                for i in range(n_calls + 3):
                    started = time.perf_counter()
                    expected = ask_library()
                    middle = time.perf_counter()
                    result = await client.call_tool(tool, arguments)
                    ended = time.perf_counter()
                    assert not result.is_error, result
                    assert (result.structured_content or {})[measured] == getattr(expected, measured)
                    if i >= 3:  # warm
                        library.append(1000 * (middle - started))
                        called.append(1000 * (ended - middle))
                differences = [b - a for a, b in zip(library, called, strict=True)]
                medians = [statistics.median(each) for each in (library, called, differences)]
                shown = " | ".join(f"{median:.1f}" for median in medians)
                print(f"| `{tool}`{manner} | {n_calls} | {shown} |", flush=True)


async def workers_cost(n_calls: int, threads: int) -> None:
    """The same calls to a server with workers and to one without, in turns, so that both meet the same machine."""
    with tempfile.TemporaryDirectory() as directory:
        folder = Path(directory).resolve()
        image = write_images(folder)[0]
        small = folder / "small.png"
        assert cv2.imwrite(str(small), np.full((96, 96, 3), 90, np.uint8))
        flags = ("--root", directory, "--threads", str(threads))
        known = {"gsd_m_per_px": 0.15}
        questions: dict[str, tuple[str, dict[str, Any]]] = {
            "measure_distance, 96 x 96 px": ("measure_distance", {**_path(small), **_LINE, **known}),
            "view_image, 96 x 96 px": ("view_image", _path(small)),
            "measure_area, 1024 x 1024 px": ("measure_area", {**_path(image), **target(middle_box(image)), **known}),
        }
        with http_server(*flags) as isolated, http_server(*flags, "--in-process") as single:
            async with Client(isolated.url) as first, Client(single.url) as second:
                for words, (tool, arguments) in questions.items():
                    taken: list[tuple[float, float]] = []
                    used = [0.0, 0.0]
                    for i in range(n_calls + 3):
                        pair = [0.0, 0.0]
                        for k in (0, 1) if i % 2 else (1, 0):  # who comes first finds another machine
                            server, before = (isolated, single)[k], processor_s((isolated, single)[k].pid)
                            started = time.perf_counter()
                            result = await (first, second)[k].call_tool(tool, arguments)
                            pair[k] = 1000 * (time.perf_counter() - started)
                            used[k] += 1000 * (processor_s(server.pid) - before) * (i >= 3)
                            assert not result.is_error, result.content
                        if i >= 3:  # warm
                            taken.append((pair[0], pair[1]))
                    differences = sorted(a - b for a, b in taken)
                    quarter = len(differences) // 4
                    medians = [statistics.median(each) for each in (*zip(*taken, strict=True), differences)]
                    shown = " | ".join(f"{median:.1f}" for median in medians)
                    quartiles = f"{differences[quarter]:+.1f}, {differences[-1 - quarter]:+.1f}"
                    spent = " | ".join(f"{each / n_calls:.1f}" for each in used)
                    print(f"| {words} | {shown} | {quartiles} | {spent} |", flush=True)
            await anyio.sleep(IDLE_S)
            held = [sum(memory_mib(server.pid)) for server in (isolated, single)]
            values = {"with a worker, MiB": held[0], "in process, MiB": held[1], "times": held[0] / held[1]}
            print("", *values_table(values), sep="\n")


_LINE: dict[str, Any] = {"lines": [{"points": [{"x": 5, "y": 5}, {"x": 90, "y": 90}]}]}


def _path(image: Path) -> dict[str, Any]:
    return {"image": {"kind": "path", "path": str(image)}}


async def first_list(n_starts: int) -> None:
    """From the start of the process to its first answer."""
    times = []
    for _ in range(n_starts):
        started = time.perf_counter()
        async with Client(StdioServerParameters(command=SERVE[0], args=SERVE[1:])) as client:
            await client.list_tools()
            times.append(time.perf_counter() - started)
    values = {"first `tools/list` after the start, median, s": statistics.median(times), "starts": n_starts}
    print("", *values_table(values), sep="\n")


def main() -> None:
    """Measure both."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--calls", type=int, default=40)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--starts", type=int, default=7)
    parser.add_argument("--workers", action="store_true", help="measure what workers cost over HTTP")
    options = add_record_option(parser).parse_args()
    if options.workers:
        with recording("server", ["workers", "workers_idle"], options.record):
            times = ("worker, ms", "in process, ms", "difference, median, ms", "quartiles, ms")
            print(header("call", *times, "worker, CPU ms", "in process, CPU ms"))
            anyio.run(workers_cost, options.calls, options.threads)
        return
    with recording("server", ["overhead_stdio", "first_list"], options.record):
        print(header("call, 1024 x 1024 px", "calls", "library, ms", "over stdio, ms", "overhead, median, ms"))
        anyio.run(overhead, options.calls, options.threads)
        anyio.run(first_list, options.starts)


if __name__ == "__main__":
    main()
