"""Send calls from many clients while workers are killed: ``python -m research.benchmarks.server_chaos --calls 10000``.

Four cheap scenes and seven bombs. Aim: every call is answered, right or with a code that says to try again; none later
than half a second after the deadline; ``/healthz`` below 200 ms at the 99th percentile; the whole server below
2 GiB. Ends after that many answers, some seven minutes on two quiet cores, or after ``--minutes``; where that comes
first, ``--state FILE`` keeps what was seen, and the same command goes on from there. ``--record`` keeps what was seen.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import signal
import sys
import tempfile
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeAlias

import anyio
import cv2
from mcp import Client

from research.results.record import add_record_option, recording, values_table
from tests import bombs
from tests.server_process import (
    HttpServer,
    child_processes,
    health_times_ms,
    http_server,
    memory_mib,
    middle_box,
    target,
)
from vehanchor.storage.atomic import whole_file
from vehanchor_scenes import render_scene

Question: TypeAlias = tuple[str, dict[str, Any]]
Reply: TypeAlias = tuple[Any, str | None]

RETRYABLE = ("busy", "worker_killed", "worker_unavailable", "deadline_exceeded")
DEADLINE_S = 20.0
_AIMS: dict[str, float | str] = {
    "wrong": 0,
    "lost": 0,
    "`/healthz` 99th percentile, ms": 200,
    "slowest reply, s": DEADLINE_S + 0.5,
    "memory, most, MiB": 2048,
}
BACK_OFF_S = 1.5, 5.0  # before a client that was told to try again does
N_PLACES = 4
_SIDE_PX = 320


@dataclass
class Tally:
    """Tally of the answers."""

    ends: Counter[str] = field(default_factory=Counter)
    codes: Counter[str] = field(default_factory=Counter)
    healthy_ms: list[float] = field(default_factory=list)
    peak_mib: float = 0.0
    slowest_s: float = 0.0
    seconds: float = 0.0

    @property
    def n_answered(self) -> int:
        """Calls that got an answer: right, wrong, or told to try again."""
        return self.ends["right"] + self.ends["wrong"] + sum(self.codes.values())

    @classmethod
    def read(cls, path: Path | None) -> Tally:
        """Read the counts of an earlier run, if there is one."""
        if path is None or not path.exists():
            return cls()
        kept = json.loads(path.read_text())
        return cls(**{**kept, "ends": Counter(kept["ends"]), "codes": Counter(kept["codes"])})

    def table(self) -> list[str]:
        """Format the tally as lines of a table."""
        times = sorted(self.healthy_ms) or [float("nan")]
        values: dict[str, float | str] = {
            "calls answered": self.n_answered,
            "minutes": self.seconds / 60,
            **{name: self.ends[name] for name in ("right", "wrong", "lost")},
            "told to try again": sum(self.codes.values()),
            **{f"of these {code}": count for code, count in self.codes.most_common()},
            "workers killed": self.ends["kills"],
            "`/healthz` median, ms": round(times[len(times) // 2]),
            "`/healthz` 99th percentile, ms": round(times[-1 - len(times) // 100]),
            "slowest reply, s": self.slowest_s,
            "memory, most, MiB": round(self.peak_mib),
        }
        return values_table(values, _AIMS)


async def chaos(n_calls: int, n_clients: int, period_s: float, minutes: float, state: Path | None) -> Tally:
    """Send calls until enough are answered or the time is up."""
    tally = Tally.read(state)
    with tempfile.TemporaryDirectory() as directory:
        asked = questions(Path(directory).resolve())
        flags = ("--root", directory, "--threads", "1", "--max-concurrency", str(N_PLACES))
        limits = ("--deadline-s", str(DEADLINE_S), "--max-worker-mb", "512")
        with http_server(*flags, *limits) as server:
            async with Client(server.url, read_timeout_seconds=120) as client:
                expected = [await _final_reply(client, question) for question in asked]
            began = time.monotonic()
            ends = began + 60 * minutes
            with health_times_ms(server) as times:
                async with anyio.create_task_group() as group:
                    group.start_soon(_kill, server, period_s, tally)
                    group.start_soon(_weigh, server, tally)
                    numbers = iter(range(tally.n_answered, n_calls))
                    async with anyio.create_task_group() as clients:
                        for _ in range(n_clients):
                            clients.start_soon(_ask, server, asked, expected, numbers, ends, tally)
                    group.cancel_scope.cancel()
            tally.healthy_ms += times
            tally.seconds += time.monotonic() - began
    if state is not None:
        with whole_file(state) as partial:
            partial.write_text(json.dumps(vars(tally)))
    return tally


def questions(directory: Path) -> list[Question]:
    """Calls with known answers."""
    scenes = []
    for name, gsd, cars in (("a", 0.15, True), ("b", 0.12, True), ("c", 0.2, True), ("blank", 0.15, False)):
        path = directory / f"{name}.png"
        image = render_scene(gsd, width_px=_SIDE_PX, height_px=_SIDE_PX, seed=5).image
        assert cv2.imwrite(str(path), image[:, :, ::-1] if cars else 0 * image + 90)
        scenes.append(path)
    hostile = {
        "scans.jpg": bombs.jpeg_of_scans(2500),
        "text.png": bombs.png_of_text(100),
        "sizes.tif": bombs.tiff_with_two_sizes(),
        **{f"{i}.bin": make(1 << 20) for i, make in enumerate(list(bombs.HEADER_BOMBS.values())[:4])},
    }
    for name, data in hostile.items():
        (directory / name).write_bytes(data)
    found: list[Question] = [("estimate_gsd", _by_path(path)) for path in [*scenes, *map(directory.joinpath, hostile)]]
    known = {**target(middle_box(scenes[0])), "gsd_m_per_px": 0.15}
    return [*found, *[("measure_area", {**_by_path(path), **known}) for path in scenes]]


async def _ask(
    server: HttpServer, asked: list[Question], expected: list[Reply], numbers: Any, ends: float, tally: Tally
) -> None:
    async with Client(server.url, read_timeout_seconds=120) as client:
        for i in numbers:
            if time.monotonic() >= ends:
                return
            k = i % len(asked)
            started = time.monotonic()
            try:
                reply = await _reply(client, asked[k])
            except Exception as error:  # no answer at all, whatever the reason
                print(f"lost: {error!r}", file=sys.stderr, flush=True)
                tally.ends["lost"] += 1
                continue
            tally.slowest_s = max(tally.slowest_s, time.monotonic() - started)
            if reply[1] in RETRYABLE:
                tally.codes[str(reply[1])] += 1
                await anyio.sleep(random.uniform(*BACK_OFF_S))
            else:
                tally.ends["right" if reply == expected[k] else "wrong"] += 1


async def _kill(server: HttpServer, period_s: float, tally: Tally) -> None:
    while True:
        await anyio.sleep(period_s)
        victims = child_processes(server.pid)
        if victims:
            os.kill(random.choice(victims), signal.SIGKILL)
            tally.ends["kills"] += 1


async def _weigh(server: HttpServer, tally: Tally) -> None:
    while True:
        tally.peak_mib = max(tally.peak_mib, sum(await anyio.to_thread.run_sync(memory_mib, server.pid)))
        await anyio.sleep(2)


async def _final_reply(client: Client, question: Question) -> Reply:
    while True:
        reply = await _reply(client, question)
        if reply[1] not in RETRYABLE:
            return reply
        await anyio.sleep(0.5)


async def _reply(client: Client, question: Question) -> Reply:
    """The record, or the error's code."""
    result = await client.call_tool(*question)
    if result.is_error:
        return None, getattr(result.content[0], "text", "").partition(":")[0]
    return result.structured_content, None


def _by_path(path: Path) -> dict[str, Any]:
    return {"image": {"kind": "path", "path": str(path)}}


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--calls", type=int, default=10_000)
    parser.add_argument("--clients", type=int, default=64)
    parser.add_argument("--period", type=float, default=5.0, help="seconds between kills")
    parser.add_argument("--minutes", type=float, default=7.5, help="no call is begun after")
    parser.add_argument("--state", type=Path, help="file that keeps what was seen, to go on from")
    given = add_record_option(parser).parse_args()
    with recording("server", ["chaos"], given.record):
        seen = anyio.run(chaos, given.calls, given.clients, given.period, given.minutes, given.state)
        print(*seen.table(), sep="\n")
    return 1 if seen.ends["wrong"] or seen.ends["lost"] else 0


if __name__ == "__main__":
    sys.exit(main())
