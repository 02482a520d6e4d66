"""Trace the system calls of confined workers with ``strace`` while all tools run.

``python -m tests.server.sandbox.trace FOLDER`` prints the calls that workers make on the images of
a folder and that ``vehanchor_server.sandbox.system_calls`` does not allow.
"""

from __future__ import annotations

import re
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

import anyio
from mcp import Client

from vehanchor_server.app import create_server
from vehanchor_server.sandbox.system_calls import ALLOWED
from vehanchor_server.services import create_services
from vehanchor_server.settings import Settings

if TYPE_CHECKING:
    from collections.abc import Iterable

_LINE = re.compile(r"(?P<thread>\d+) +(?:<\.\.\. )?(?P<call>\w+)(?:\(| resumed)(?P<rest>.*)")
_NEW_THREAD = re.compile(r"= (\d+)$")


def confined_calls(lines: Iterable[str]) -> set[str]:
    """Return the system calls of threads that have installed the filter, or inherited it."""
    confined = set()
    calls = set()
    for line in lines:
        parts = _LINE.match(line)
        if parts is None:
            continue
        thread = parts["thread"]
        call = parts["call"]
        if thread in confined:
            calls.add(call)
        if call == "seccomp":
            confined.add(thread)
        elif call == "clone" and thread in confined:
            # A new thread has the filter of the thread that started it.
            new_thread = _NEW_THREAD.search(parts["rest"])
            if new_thread is not None:
                confined.add(new_thread[1])
    return calls


async def _call_all_tools(folder: Path) -> None:
    services = create_services(Settings(roots=(folder,)))
    box = {"x_min": 10, "y_min": 10, "x_max": 60, "y_max": 60}
    line = {"points": [{"x": 10, "y": 10}, {"x": 60, "y": 60}]}
    try:
        async with Client(create_server(services)) as client:
            for path in sorted(folder.iterdir()):
                image = {"image": {"kind": "path", "path": str(path)}}
                estimate = {"tool": "estimate_gsd", "arguments": image}
                area = {"tool": "measure_area", "arguments": {**image, "targets": [{"box": box}]}}
                await client.call_tool("view_image", image)
                await client.call_tool("view_image", {"of": estimate})
                await client.call_tool("view_image", {"of": area})
                await client.call_tool("measure_distance", {**image, "lines": [line]})
    finally:
        services.close()


def main(folder: str, *traced: str) -> None:
    """Trace this module in a process of its own, and print the calls that are not allowed."""
    if traced:
        anyio.run(_call_all_tools, Path(folder).resolve())
        return
    with tempfile.TemporaryDirectory() as temporary:
        trace = Path(temporary, "trace")
        command = [sys.executable, "-m", "tests.server.sandbox.trace", folder, "traced"]
        subprocess.run(["strace", "-f", "-qq", "-o", trace, *command], check=True)
        with trace.open(encoding="utf-8", errors="replace") as lines:
            calls = confined_calls(lines)
    refused = sorted(calls - ALLOWED.keys())
    print(f"{len(calls)} calls; not allowed: {', '.join(refused) or 'none'}")


if __name__ == "__main__":
    main(*sys.argv[1:])
