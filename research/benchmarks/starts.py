"""Measure how long commands take from their start: ``python -m research.benchmarks.starts``.

Prints Markdown; ``--record`` keeps it. Each run is a new process; the first one of each command is
not counted, because it compiles what has no byte code. ``--other`` names a checkout of another
commit, whose commands take turns with these.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import cv2

from research.results.record import add_record_option, header, recording, spread
from research.scenes import render_scene

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

_ROOT = Path(__file__).parents[2]
_MESSAGES = (
    {
        "jsonrpc": "2.0",
        "id": 1,
        "method": "initialize",
        "params": {
            "protocolVersion": "2025-06-18",
            "capabilities": {},
            "clientInfo": {"name": "starts", "version": "1"},
        },
    },
    {"jsonrpc": "2.0", "method": "notifications/initialized"},
    {"jsonrpc": "2.0", "id": 2, "method": "tools/list"},
)


class Start(NamedTuple):
    """Command whose start is measured.

    Attributes:
        name: its name in the table.
        arguments: arguments of the interpreter.
        aim: seconds, or nothing.
        messages: whether it answers messages: the time ends with the last answer.
    """

    name: str
    arguments: Sequence[str]
    aim: str = ""
    messages: bool = False


def environment(checkout: Path) -> Mapping[str, str]:
    """Make the environment in which the packages of a checkout are imported, with byte code."""
    variables = dict(os.environ)
    variables.pop("PYTHONDONTWRITEBYTECODE", None)
    variables["PYTHONPATH"] = os.pathsep.join(str(checkout / name) for name in ("skill", "server"))
    return variables


def commit_of(checkout: Path) -> str:
    """Name the commit of a checkout."""
    command = ["git", "-C", str(checkout), "rev-parse", "--short", "HEAD"]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()


def seconds(start: Start, variables: Mapping[str, str]) -> float:
    """Run a command, and measure the seconds to its end or to its last answer."""
    command = [sys.executable, *start.arguments]
    began = time.perf_counter()
    with subprocess.Popen(
        command,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        env=variables,
        text=True,
    ) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        if start.messages:
            for message in _MESSAGES:
                process.stdin.write(json.dumps(message) + "\n")
            process.stdin.flush()
            answers = [process.stdout.readline() for message in _MESSAGES if "id" in message]
            assert '"tools"' in answers[-1], answers
        else:
            process.communicate()
        taken = time.perf_counter() - began
        process.stdin.close()
    assert process.returncode == 0, command
    return taken


def starts(folder: Path) -> list[Start]:
    """List the commands; write the image that one of them reads."""
    small = folder / "small.png"
    scene = render_scene(0.15, width_px=256, height_px=256, seed=5)
    cv2.imwrite(str(small), scene.image[:, :, ::-1])
    estimate = ("-m", "vehanchor", "estimate")
    car_park = _ROOT / "examples" / "car_park.jpg"
    return [
        Start("`vehanchor estimate examples/car_park.jpg`", (*estimate, str(car_park)), "0.75"),
        Start("`vehanchor estimate`, 256 x 256 px", (*estimate, str(small))),
        Start("first `tools/list` over stdio", ("-m", "vehanchor", "serve"), "0.5", messages=True),
        Start("`import mcp` alone", ("-c", "import mcp")),
        Start("`vehanchor --help`", ("-m", "vehanchor", "--help")),
    ]


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=9)
    parser.add_argument("--other", type=Path, help="checkout of another commit")
    options = add_record_option(parser).parse_args()
    checkouts = [_ROOT]
    columns = ["seconds", "least", "median", "most", "aim"]
    facts: dict[str, Any] = {"title": "Starts of commands", "runs": options.runs}
    if options.other is not None:
        checkouts.append(options.other.resolve())
        columns += ["other commit: median", "over the other commit's"]
        facts["other_commit"] = commit_of(options.other)
    with (
        recording("speed", ["starts"], options.record, **facts),
        tempfile.TemporaryDirectory() as folder,
    ):
        print(header(*columns))
        for start in starts(Path(folder)):
            times: list[list[float]] = [[] for _ in checkouts]
            for number in range(options.runs + 1):
                for checkout, measured in zip(checkouts, times, strict=True):
                    taken = seconds(start, environment(checkout))
                    if number:  # the first one compiles
                        measured.append(taken)
            own = times[0]
            cells = [start.name, *spread(own), start.aim]
            if len(times) > 1:
                other = times[1]
                ratios = [mine / theirs for mine, theirs in zip(own, other, strict=True)]
                cells += [f"{statistics.median(other):.2f}", f"{statistics.median(ratios):.2f}"]
            print(f"| {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
