"""Send calls from many clients at once: ``python -m research.benchmarks.server_load``. Linux only.

1,000 mixed calls of both tools from 16 clients against two workers: none lost, each answer the library's for that
image, memory of the workers within 10 % after warming up. Then one of the workers is killed under load: the other keeps
answering.
"""

from __future__ import annotations

import argparse
import base64
import json
import os
import random
import signal
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any, NamedTuple

import anyio
from mcp import Client

from research.results.record import add_record_option, recording, values_table
from tests.server_process import (
    child_processes,
    http_server,
    middle_box,
    resident_mib,
    target,
    write_images,
)
from vehanchor import estimate_gsd, measure_area
from vehanchor.detection.detector import load_detector
from vehanchor.models.runtime import Runtime
from vehanchor.models.zoo import resolve_model, resolve_segmenter
from vehanchor.segmentation.segmenter import load_segmenter

BUSY_PAUSE_S = 0.05
WARM_SHARE = 0.3
_WHOLE = {"detail": "full"}  # the library's record


class MixedCall(NamedTuple):
    """A call and the answer that it must get: a record, or an error's code."""

    tool: str
    arguments: dict[str, Any]
    answer: Any


def mixed_calls(images: list[Path]) -> list[MixedCall]:
    """Both tools, images by path and in base64, areas by estimated and by given scale, and calls to be refused."""
    detector = load_detector(resolve_model(), Runtime(threads=1))
    segmenter = load_segmenter(*resolve_segmenter(), Runtime(threads=1))
    calls: list[MixedCall] = []
    for image in images:
        by_path = {"image": {"kind": "path", "path": str(image)}, **_WHOLE}
        in_base64 = {"image": {"kind": "base64", "data": base64.b64encode(image.read_bytes()).decode()}, **_WHOLE}
        box = middle_box(image)
        estimate = estimate_gsd(image, detector=detector).model_dump(mode="json")
        area = measure_area(image, box=box, detector=detector, segmenter=segmenter).model_dump(mode="json")
        known = measure_area(image, box=box, gsd_m_per_px=0.2, segmenter=segmenter).model_dump(mode="json")
        calls += [
            MixedCall("estimate_gsd", by_path, estimate),
            MixedCall("measure_area", {**by_path, **target(box)}, area),
            MixedCall("estimate_gsd", in_base64, estimate),
            MixedCall("measure_area", {**in_base64, **target(box), "gsd_m_per_px": 0.2}, known),
        ]
    small = {"image": {"kind": "path", "path": str(images[0])}}
    calls += [
        MixedCall("estimate_gsd", {"image": {"kind": "path", "path": "/etc/passwd"}}, "path_not_allowed"),
        MixedCall("estimate_gsd", {"image": {"kind": "base64", "data": "%%%"}}, "base64_invalid"),
        MixedCall("estimate_gsd", {"image": {"kind": "url", "url": "https://example.org/a.png"}}, "source_disabled"),
        MixedCall("measure_area", small, "invalid_arguments"),
        MixedCall("measure_area", {**small, **target((-90, 0, 9, 9))}, "invalid_prompt"),
    ]
    return [call._replace(answer=json.loads(json.dumps(call.answer))) for call in calls]


async def answered(url: str, call: MixedCall, tally: Counter[str]) -> Any:
    """The answer to a call; a ``busy`` server is asked again."""
    while True:
        try:
            async with Client(url, read_timeout_seconds=120) as client:
                result = await client.call_tool(call.tool, call.arguments)
        except Exception:  # a connection that broke because its worker was killed
            tally["broken connections, called again"] += 1
            continue
        if not result.is_error:
            return result.structured_content
        code = getattr(result.content[0], "text", "").partition(":")[0]
        if code != "busy":
            return code
        tally["busy, called again"] += 1
        await anyio.sleep(BUSY_PAUSE_S * (0.5 + random.random()))


async def load(url: str, calls: list[MixedCall], n_calls: int, n_clients: int, pid: int) -> bool:
    """Send them all; whether every answer was right and memory flat."""
    tally: Counter[str] = Counter()
    workers = child_processes(pid)
    warm: dict[int, float] = {}
    queue = iter(range(n_calls))
    started = time.perf_counter()

    async def client() -> None:
        for i in queue:
            call = calls[i % len(calls)]
            tally["right" if await answered(url, call, tally) == call.answer else "wrong"] += 1
            if i >= n_calls * WARM_SHARE and not warm:
                warm.update({worker: resident_mib(worker) for worker in workers})

    async with anyio.create_task_group() as group:
        for _ in range(n_clients):
            group.start_soon(client)
    seconds = time.perf_counter() - started
    growth = [100 * (resident_mib(worker) / before - 1) for worker, before in warm.items()]
    values: dict[str, float | str] = {
        "calls": n_calls,
        "clients": n_clients,
        "right": tally["right"],
        "wrong": tally["wrong"],
        "calls a second": n_calls / seconds,
        "largest growth of a worker's memory after warming up, %": max(growth, default=float("nan")),
    }
    print(*values_table(values), "", sep="\n")
    return tally["right"] == n_calls and all(percent < 10 for percent in growth)


async def killed(url: str, calls: list[MixedCall], pid: int, seconds: float) -> bool:
    """Kill one of the workers under load; whether every call was answered, and rightly, by the other."""
    tally: Counter[str] = Counter()
    moments: list[float] = []
    ends = time.monotonic() + seconds
    kill_at = time.monotonic() + seconds / 3

    async def client(offset: int) -> None:
        i = offset
        while time.monotonic() < ends:
            call = calls[i % len(calls)]
            tally["right" if await answered(url, call, tally) == call.answer else "wrong"] += 1
            moments.append(time.monotonic())
            i += 1

    async with anyio.create_task_group() as group:
        for offset in range(8):
            group.start_soon(client, offset)
        await anyio.sleep_until(anyio.current_time() + kill_at - time.monotonic())
        os.kill(child_processes(pid)[0], signal.SIGKILL)
    after = sorted(moment - kill_at for moment in moments if moment > kill_at)
    longest = max(b - a for a, b in zip([0.0, *after], after, strict=False)) if after else seconds
    values = {**tally, "answers after `kill -9` of one of two workers": len(after), "longest silence, s": longest}
    print(*values_table(values), "", sep="\n")
    return tally["wrong"] == 0 and len(after) > 0


def main() -> None:
    """Run both."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--calls", type=int, default=1000)
    parser.add_argument("--clients", type=int, default=16)
    parser.add_argument("--kill-s", type=float, default=30.0)
    options = add_record_option(parser).parse_args()
    with tempfile.TemporaryDirectory() as directory, recording("server", ["load", "load_killed"], options.record):
        calls = mixed_calls(write_images(Path(directory).resolve()))
        with http_server("--root", directory, "--threads", "1", "--workers", "2") as server:
            fine = anyio.run(load, server.url, calls, options.calls, options.clients, server.pid)
        with http_server("--root", directory, "--threads", "1", "--workers", "2") as server:
            fine = anyio.run(killed, server.url, calls, server.pid, options.kill_s) and fine
    sys.exit(0 if fine else 1)


if __name__ == "__main__":
    main()
