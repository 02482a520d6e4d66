"""Make the list of system calls anew: trace confined workers with ``strace`` while all tools run.

``python -m vehanchor_server.sandbox.trace FOLDER`` prints the calls that workers made on the images
of a folder but ``system_calls`` does not allow.
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


def confined_calls(lines: Iterable[str]) -> set[str]:
    """Return the system calls of processes, with their threads, after each has installed its filter."""
    confined = set()
    made = set()
    for line in lines:
        found = _LINE.match(line)
        if found is None:
            continue
        if found["thread"] in confined:
            made.add(found["call"])
        started = re.search(r"= (\d+)$", found["rest"])
        if (found["call"] == "clone" and found["thread"] in confined and started) or found[
            "call"
        ] == "seccomp":
            confined.add(started[1] if started and found["call"] == "clone" else found["thread"])
    return made


async def _call_all_tools(folder: Path) -> None:
    services = create_services(Settings(roots=(folder,)))
    try:
        async with Client(create_server(services)) as client:
            for path in sorted(folder.iterdir()):
                image = {"image": {"kind": "path", "path": str(path)}}
                box = {"x_min": 10, "y_min": 10, "x_max": 60, "y_max": 60}
                line = {"points": [{"x": 10, "y": 10}, {"x": 60, "y": 60}]}
                await client.call_tool("view_image", image)
                await client.call_tool(
                    "view_image", {"of": {"tool": "estimate_gsd", "arguments": image}}
                )
                asked = {**image, "targets": [{"box": box}]}
                await client.call_tool(
                    "view_image", {"of": {"tool": "measure_area", "arguments": asked}}
                )
                await client.call_tool("measure_distance", {**image, "lines": [line]})
    finally:
        services.close()


def main(folder: str, *traced: str) -> None:
    """Trace this module in a process of its own, and print what it made and may not."""
    if traced:
        anyio.run(_call_all_tools, Path(folder).resolve())
        return
    with tempfile.TemporaryDirectory() as place:
        trace = Path(place, "trace")
        command = [sys.executable, "-m", "vehanchor_server.sandbox.trace", folder, "traced"]
        subprocess.run(["strace", "-f", "-qq", "-o", trace, *command], check=True)
        with trace.open(encoding="utf-8", errors="replace") as lines:
            made = confined_calls(lines)
    print(f"{len(made)} calls; not allowed: {', '.join(sorted(made - ALLOWED.keys())) or 'none'}")


if __name__ == "__main__":
    main(*sys.argv[1:])
