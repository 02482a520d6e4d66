"""Check that hostile images are answered by the deadline.

``python -m research.benchmarks.server_deadline``. Linux only.

Each family of ``tests.image_costs`` at its larger size, and a large photograph, is sent to a server whose deadline is
one second. Another process asks for ``/healthz`` all the time. Aims: an answer within half a second after the deadline,
the longest ``/healthz`` below 200 ms. Prints Markdown; ``--record`` keeps it. Exit status 1 if one is late.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import anyio
from mcp import Client

from research.results.record import add_record_option, recording
from tests.image_costs import FAMILIES
from tests.server_process import HttpServer, health_times_ms, http_server, write_large_image

LATE_S = 0.5
_SETTLE_S = 3.0  # a worker that was killed is replaced meanwhile, and its start is no part of the next reply


async def ask(server: HttpServer, path: Path) -> tuple[float, str]:
    """Seconds until the answer, and what it was."""
    async with Client(server.url, read_timeout_seconds=120) as client:
        started = time.monotonic()
        result = await client.call_tool("estimate_gsd", {"image": {"kind": "path", "path": str(path)}})
        taken = time.monotonic() - started
    return taken, getattr(result.content[0], "text", "").partition(":")[0] if result.is_error else "answered"


def measure(deadline_s: float) -> list[str]:
    """Print the answer to each image; return those that come late."""
    late = []
    print("| image | file, MiB | reply after, s | answer | `/healthz` median, longest, ms |\n|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as directory:
        folder = Path(directory).resolve()
        flags = ("--root", str(folder), "--threads", "1", "--deadline-s", str(deadline_s))
        with http_server(*flags) as server:
            for name, path in _images(folder):
                with health_times_ms(server) as times:
                    taken, answer = anyio.run(ask, server, path)
                shown = f"{times[len(times) // 2]:.0f}, {times[-1]:.0f}" if times else "-"
                print(
                    f"| {name} | {path.stat().st_size / (1 << 20):.2f} | {taken:.2f} | {answer} | {shown} |", flush=True
                )
                if taken > deadline_s + LATE_S:
                    late.append(name)
                path.unlink()
                time.sleep(_SETTLE_S)
    return late


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--deadline", type=float, default=1.0, help="of the server, seconds")
    asked = add_record_option(parser).parse_args()
    with recording("server", ["deadline_images"], asked.record):
        late = measure(asked.deadline)
    if late:
        print(f"later than {LATE_S} s after the deadline: {', '.join(late)}", file=sys.stderr)
    return 1 if late else 0


def _images(folder: Path) -> Iterator[tuple[str, Path]]:
    for name, family in FAMILIES.items():
        path = folder / "bomb"
        path.write_bytes(family.make(4 * family.size))
        yield name, path
    yield "a photograph of 67 megapixels", write_large_image(folder, 8192)


if __name__ == "__main__":
    sys.exit(main())
