"""Many callers at once: ``python -m benchmarks.server_load``. Linux only.

1,000 mixed calls from 16 clients against two workers: none lost, each answer the library's for that image, memory of
the workers within 10 % after warming up. Then one of the workers is killed under load: the other keeps answering.
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
from typing import Any

import anyio
from mcp import Client

from benchmarks.server_process import child_processes, http_server, resident_mib, write_images
from vehanchor import estimate_gsd
from vehanchor.detection import load_detector
from vehanchor.model_zoo import resolve_model

BUSY_PAUSE_S = 0.05
WARM_SHARE = 0.3


def mixed_calls(images: list[Path]) -> list[tuple[dict[str, Any], Any]]:
    """Arguments and the answers they must get: a record, or an error's code."""
    detector = load_detector(resolve_model(), threads=1)
    calls: list[tuple[dict[str, Any], Any]] = []
    for image in images:
        record = estimate_gsd(image, detector=detector).model_dump(mode="json")
        encoded = base64.b64encode(image.read_bytes()).decode()
        calls += [({"kind": "path", "path": str(image)}, record), ({"kind": "base64", "data": encoded}, record)]
    calls += [
        ({"kind": "path", "path": "/etc/passwd"}, "path_not_allowed"),
        ({"kind": "base64", "data": "%%%"}, "base64_invalid"),
        ({"kind": "url", "url": "https://example.org/a.png"}, "source_disabled"),
        ({"kind": "path"}, "invalid_arguments"),
    ]
    return [({"image": image}, json.loads(json.dumps(answer))) for image, answer in calls]


async def call(url: str, arguments: dict[str, Any], tally: Counter[str]) -> Any:
    """The answer to a call, after as many refusals for want of a place as it takes."""
    while True:
        try:
            async with Client(url, read_timeout_seconds=120) as client:
                result = await client.call_tool("estimate_gsd", arguments)
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


async def load(url: str, calls: list[tuple[dict[str, Any], Any]], n_calls: int, n_clients: int, pid: int) -> bool:
    """Send them all; whether every answer was right and memory flat."""
    tally: Counter[str] = Counter()
    workers = child_processes(pid)
    warm: dict[int, float] = {}
    queue = iter(range(n_calls))
    started = time.perf_counter()

    async def client() -> None:
        for i in queue:
            arguments, expected = calls[i % len(calls)]
            tally["right" if await call(url, arguments, tally) == expected else "wrong"] += 1
            if i >= n_calls * WARM_SHARE and not warm:
                warm.update({worker: resident_mib(worker) for worker in workers})

    async with anyio.create_task_group() as group:
        for _ in range(n_clients):
            group.start_soon(client)
    seconds = time.perf_counter() - started
    growth = [100 * (resident_mib(worker) / before - 1) for worker, before in warm.items()]
    print(
        f"{n_calls} calls from {n_clients} clients in {seconds:.1f} s ({n_calls / seconds:.1f} a second): {dict(tally)}"
    )
    print(
        f"memory of the workers, MiB: {[round(resident_mib(worker)) for worker in workers]}; growth after warming up,"
    )
    print(f"per cent: {[round(percent, 1) for percent in growth]}")
    return tally["right"] == n_calls and all(percent < 10 for percent in growth)


async def killed(url: str, calls: list[tuple[dict[str, Any], Any]], pid: int, seconds: float) -> bool:
    """Kill one of the workers under load; whether every call was answered, and rightly, by the other."""
    tally: Counter[str] = Counter()
    answered: list[float] = []
    ends = time.monotonic() + seconds
    kill_at = time.monotonic() + seconds / 3

    async def client(offset: int) -> None:
        i = offset
        while time.monotonic() < ends:
            arguments, expected = calls[i % len(calls)]
            tally["right" if await call(url, arguments, tally) == expected else "wrong"] += 1
            answered.append(time.monotonic())
            i += 1

    async with anyio.create_task_group() as group:
        for offset in range(8):
            group.start_soon(client, offset)
        await anyio.sleep_until(anyio.current_time() + kill_at - time.monotonic())
        os.kill(child_processes(pid)[0], signal.SIGKILL)
    after = sorted(moment - kill_at for moment in answered if moment > kill_at)
    longest = max(b - a for a, b in zip([0.0, *after], after, strict=False)) if after else seconds
    print(
        f"kill -9 of one of two workers: {dict(tally)}; {len(after)} answers after it, longest silence {longest:.2f} s"
    )
    return tally["wrong"] == 0 and len(after) > 0


def main() -> None:
    """Run both."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--calls", type=int, default=1000)
    parser.add_argument("--clients", type=int, default=16)
    parser.add_argument("--kill-s", type=float, default=30.0)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as directory:
        calls = mixed_calls(write_images(Path(directory).resolve()))
        with http_server("--root", directory, "--threads", "1", "--workers", "2") as (url, pid):
            fine = anyio.run(load, url, calls, options.calls, options.clients, pid)
        with http_server("--root", directory, "--threads", "1", "--workers", "2") as (url, pid):
            fine = anyio.run(killed, url, calls, pid, options.kill_s) and fine
    sys.exit(0 if fine else 1)


if __name__ == "__main__":
    main()
