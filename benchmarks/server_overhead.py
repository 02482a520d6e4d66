"""What a call over stdio costs beyond the library's: ``python -m benchmarks.server_overhead``. Aim: < 15 ms, median.

Also how long the first ``tools/list`` takes after the start. Aim: < 1 s.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import anyio
from mcp import Client, StdioServerParameters
from pydantic import BaseModel

from benchmarks.server_process import SERVE, middle_box, target, write_images
from vehanchor import estimate_gsd, measure_area
from vehanchor.detection.detector import load_detector
from vehanchor.models.zoo import resolve_model, resolve_segmenter
from vehanchor.segmentation.segmenter import load_segmenter


async def overhead(n_calls: int, threads: int) -> None:
    """Library and server in turns, so that both meet the same machine."""
    detector = load_detector(resolve_model(), threads=threads)
    segmenter = load_segmenter(*resolve_segmenter(), threads=threads)
    with tempfile.TemporaryDirectory() as directory:
        image = write_images(Path(directory).resolve())[0]
        by_path, box = {"image": {"kind": "path", "path": str(image)}}, middle_box(image)
        questions: dict[str, tuple[Callable[[], BaseModel], dict[str, Any]]] = {
            "estimate_gsd": (lambda: estimate_gsd(image, detector=detector), by_path),
            "measure_area": (
                lambda: measure_area(image, box=box, gsd_m_per_px=0.15, segmenter=segmenter),
                {**by_path, **target(box), "gsd_m_per_px": 0.15},
            ),
        }
        server = StdioServerParameters(
            command=SERVE[0], args=[*SERVE[1:], "--root", directory, "--threads", str(threads)]
        )
        async with Client(server, read_timeout_seconds=120) as client:
            for tool, (ask_library, arguments) in questions.items():
                library, called = [], []
                for i in range(n_calls + 3):
                    started = time.perf_counter()
                    expected = ask_library()
                    middle = time.perf_counter()
                    result = await client.call_tool(tool, arguments)
                    ended = time.perf_counter()
                    assert result.structured_content == expected.model_dump(mode="json"), result
                    if i >= 3:  # warm
                        library.append(1000 * (middle - started))
                        called.append(1000 * (ended - middle))
                differences = [b - a for a, b in zip(library, called, strict=True)]
                print(
                    f"{tool}: library {statistics.median(library):.1f} ms, over stdio "
                    f"{statistics.median(called):.1f} ms, overhead {statistics.median(differences):.1f} ms at the "
                    f"median of {n_calls} calls on 1024 x 1024"
                )


async def first_list(n_starts: int) -> None:
    """From the start of the process to its first answer."""
    times = []
    for _ in range(n_starts):
        started = time.perf_counter()
        async with Client(StdioServerParameters(command=SERVE[0], args=SERVE[1:])) as client:
            await client.list_tools()
            times.append(time.perf_counter() - started)
    print(f"first tools/list after {statistics.median(times):.2f} s at the median of {n_starts} starts")


def main() -> None:
    """Measure both."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--calls", type=int, default=40)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--starts", type=int, default=7)
    options = parser.parse_args()
    anyio.run(overhead, options.calls, options.threads)
    anyio.run(first_list, options.starts)


if __name__ == "__main__":
    main()
