"""Measure what a call over stdio costs beyond the library.

``python -m research.benchmarks.server_overhead``. Aim: < 8 ms, median.
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
from mcp import Client, StdioServerParameters

from research.results.record import add_record_option, header, recording
from tests.server_process import SERVE, middle_box, target, write_images
from vehanchor.analysis.memory import AnalysisMemory
from vehanchor.engine import Engine
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.models.runtime import Runtime
from vehanchor.records import AreaMeasurement, GsdEstimate


async def overhead(n_calls: int, threads: int) -> None:
    """Run library and server in turns, so that both meet the same machine with warm caches."""
    engine = Engine(runtime=Runtime(threads=threads))
    memory = AnalysisMemory()
    with tempfile.TemporaryDirectory() as directory:
        image = write_images(Path(directory).resolve())[0]
        box = middle_box(image)
        by_path = {"image": {"kind": "path", "path": str(image)}, "detail": "full"}
        stated = {"gsd_m_per_px": 0.15, "gsd_basis": "measured"}

        def estimate() -> GsdEstimate:
            with open_raster(image) as raster:
                return memory.analyse(engine.detector, raster, engine.options).estimate

        questions: dict[str, tuple[Callable[[], GsdEstimate | AreaMeasurement], dict[str, Any]]] = {
            "estimate_gsd": (estimate, by_path),
            "measure_area": (
                lambda: engine.measure_area(image, box=box, gsd_m_per_px=0.15),
                {**by_path, **target(box), **stated},
            ),
        }
        server = StdioServerParameters(
            command=SERVE[0],
            args=[*SERVE[1:], "--root", directory, "--threads", str(threads)],
            env=dict(os.environ),  # variables of a linear algebra library change last digits
        )
        async with Client(server, read_timeout_seconds=120) as client:
            for tool, (ask_library, arguments) in questions.items():
                measured = "area_m2" if tool == "measure_area" else "gsd_m_per_px"
                library = []
                called = []
                for i in range(n_calls + 3):
                    started = time.perf_counter()
                    expected = ask_library()
                    middle = time.perf_counter()
                    result = await client.call_tool(tool, arguments)
                    ended = time.perf_counter()
                    assert not result.is_error, result
                    assert (result.structured_content or {})[measured] == getattr(
                        expected, measured
                    )
                    if i >= 3:  # warm
                        library.append(1000 * (middle - started))
                        called.append(1000 * (ended - middle))
                differences = [b - a for a, b in zip(library, called, strict=True)]
                medians = [statistics.median(each) for each in (library, called, differences)]
                shown = " | ".join(f"{median:.1f}" for median in medians)
                print(f"| `{tool}` | {n_calls} | {shown} |", flush=True)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--calls", type=int, default=40)
    parser.add_argument("--threads", type=int, default=1)
    options = add_record_option(parser).parse_args()
    with recording("server", ["overhead_stdio"], options.record):
        print(
            header(
                "call, 1024 x 1024 px",
                "calls",
                "library, ms",
                "over stdio, ms",
                "overhead, median, ms",
            )
        )
        anyio.run(overhead, options.calls, options.threads)


if __name__ == "__main__":
    main()
