"""The server as a child process, over its real stdin and stdout."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from tests.server.conversation import by_path
from vehanchor_server.settings import Settings

pytestmark = [
    pytest.mark.anyio,
    pytest.mark.skipif(sys.platform == "win32", reason="POSIX signals and pipes"),
]

Starter = Callable[..., "subprocess.Popen[bytes]"]

_SERVE = "import typer; from vehanchor_server.command import serve; typer.run(serve)"
_SLOW = (
    "import time; from vehanchor.detection.detector import Detector; original = "
    "Detector.detect_tile\n"
    "Detector.detect_tile = lambda *a, **k: (time.sleep(0.2), original(*a, **k))[1]\n"
)


def command(settings: Settings, *, slow: bool = False) -> list[str]:
    roots = [part for root in settings.roots for part in ("--root", str(root))]
    # a worker would be quick
    prelude, flags = (_SLOW, ["--isolation", "in-process"]) if slow else ("", [])
    return [
        sys.executable,
        "-c",
        prelude + _SERVE,
        *roots,
        "--detector",
        str(settings.detector),
        *flags,
    ]


@pytest.fixture
def start(settings: Settings) -> Iterator[Starter]:
    """Starts servers, and leaves none behind."""
    started: list[subprocess.Popen[bytes]] = []

    def start_one(*, slow: bool = False) -> subprocess.Popen[bytes]:
        process = subprocess.Popen(
            command(settings, slow=slow),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
        )
        started.append(process)
        return process

    yield start_one
    for process in started:
        process.kill()
        process.wait()
        for stream in (process.stdin, process.stdout, process.stderr):
            assert stream is not None
            with contextlib.suppress(BrokenPipeError):
                stream.close()


def message(method: str, **params: Any) -> bytes:
    meta = {
        "io.modelcontextprotocol/protocolVersion": "2026-07-28",
        "io.modelcontextprotocol/clientCapabilities": {},
        "io.modelcontextprotocol/clientInfo": {"name": "test", "version": "1"},
    }
    request = {"jsonrpc": "2.0", "id": 1, "method": method, "params": {"_meta": meta, **params}}
    return json.dumps(request).encode() + b"\n"


def ended(process: subprocess.Popen[bytes], seconds: float = 60) -> tuple[int, str]:
    """Exit status and stderr."""
    status = process.wait(seconds)
    assert process.stderr is not None
    return status, process.stderr.read().decode()


class Session(NamedTuple):
    """A server that listed its tools, answered one call, and ended with its stdin.

    Attributes:
        libraries: memory maps after the listing; empty on systems without them.
        listing: the answer to the listing.
        answer: the answer to the call.
        rest: the rest of stdout.
        status: exit status.
        log: the lines of stderr.
        left_over: files in the temporary folder.
    """

    libraries: str
    listing: dict[str, Any]
    answer: dict[str, Any]
    rest: bytes
    status: int
    log: list[dict[str, Any]]
    left_over: list[Path]


@pytest.fixture(scope="module")
def session(settings: Settings, images: Path, tmp_path_factory: pytest.TempPathFactory) -> Session:
    temporary = tmp_path_factory.mktemp("temporary")
    environment = {
        name: value for name, value in os.environ.items() if not name.startswith("VEHANCHOR_")
    }
    with subprocess.Popen(
        command(settings),
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        env={**environment, "TMPDIR": str(temporary)},
    ) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        try:
            process.stdin.write(message("tools/list"))
            process.stdin.flush()
            listing = json.loads(process.stdout.readline())
            libraries = ""
            if sys.platform == "linux":
                libraries = Path(f"/proc/{process.pid}/maps").read_text()
            arguments = by_path(images / "cars.png")
            process.stdin.write(message("tools/call", name="estimate_gsd", arguments=arguments))
            process.stdin.flush()
            answer = json.loads(process.stdout.readline())
            process.stdin.close()
            status, stderr = ended(process)
            rest = process.stdout.read()
        finally:
            process.kill()
    log = [json.loads(line) for line in stderr.splitlines()]
    left_over = list(temporary.iterdir())
    return Session(libraries, listing, answer, rest, status, log, left_over)


def test_the_tools_are_listed_before_any_model_is_loaded(session: Session) -> None:
    assert session.listing["result"]["tools"][0]["name"] == "estimate_gsd"
    assert not [name for name in ("onnxruntime", "cv2") if name in session.libraries]


def test_stdout_has_only_answers(session: Session) -> None:
    assert session.answer["result"]["structuredContent"]["status"] == "ok"
    assert session.rest == b""


def test_a_call_is_one_line_in_the_log(session: Session) -> None:
    (line,) = [line for line in session.log if line["logger"] == "vehanchor_server.calls"]
    assert line["tool"] == "estimate_gsd"
    assert line["status"] == "ok"
    assert line["megapixels"] == pytest.approx(0.328)
    assert line["ms"] > 0


def test_the_end_of_stdin_ends_the_server(session: Session) -> None:
    assert session.status == 0


def test_the_server_leaves_no_socket_of_its_workers(session: Session) -> None:
    assert session.left_over == []


def _wait_for(condition: Callable[[], bool], seconds: float = 60) -> bool:
    deadline = time.monotonic() + seconds
    while not condition() and time.monotonic() < deadline:
        time.sleep(0.02)
    return condition()


def _until_computing(process: subprocess.Popen[bytes], images: Path) -> None:
    """Start a call that takes seconds, and wait until it searches tiles."""
    assert process.stdin is not None
    assert process.stdout is not None
    call = json.loads(
        message("tools/call", name="estimate_gsd", arguments=by_path(images / "large.png"))
    )
    call["params"]["_meta"]["progressToken"] = 1
    process.stdin.write(json.dumps(call).encode() + b"\n")
    process.stdin.flush()
    while "tiles" not in json.loads(process.stdout.readline())["params"]["message"]:
        pass


@pytest.mark.slow
@pytest.mark.parametrize("by_signal", [True, False])
def test_sigterm_or_the_end_of_stdin_ends_a_running_call(
    start: Starter, images: Path, by_signal: bool
) -> None:
    process = start(slow=True)
    assert process.stdin is not None
    assert process.stdout is not None
    _until_computing(process, images)
    if by_signal:
        process.send_signal(signal.SIGTERM)
    else:
        process.stdin.close()
    status, stderr = ended(process)
    assert status == 0
    assert "Traceback" not in stderr


@pytest.mark.slow
def test_a_killed_parent_ends_it(settings: Settings, tmp_path: Path) -> None:
    parent = (
        "import subprocess, sys, time\n"
        f"child = subprocess.Popen({command(settings)!r}, stdin=subprocess.PIPE, "
        "stdout=subprocess.PIPE)\n"
        f"child.stdin.write({message('tools/list')!r}); child.stdin.flush(); "
        "child.stdout.readline()\n"
        "print(child.pid, flush=True); time.sleep(60)\n"
    )
    process = subprocess.Popen([sys.executable, "-c", parent], stdout=subprocess.PIPE, cwd=tmp_path)
    assert process.stdout is not None
    with process.stdout:
        child = int(process.stdout.readline())
        process.kill()
        process.wait()

    def gone() -> bool:
        try:
            return Path(f"/proc/{child}/stat").read_text().split()[2] == "Z"
        except FileNotFoundError:
            return True

    try:
        assert _wait_for(gone), "the server outlived its parent"
    finally:
        if not gone():
            os.kill(child, signal.SIGKILL)


_CALLS = """
import json, sys
import anyio
from pathlib import Path
from mcp import Client
from vehanchor_server.app import create_server
from vehanchor_server.services import create_services
from vehanchor_server.settings import Settings

DECODERS = ("cv2", "onnxruntime", "rasterio", "PIL", "pi_heif", "numpy", "scipy")

async def called(server, images, calls):
    answers = []
    async with Client(server) as client:
        listed = [tool.name for tool in (await client.list_tools()).tools]
        for name, arguments in calls:
            answers.append([name, (await client.call_tool(name, arguments)).is_error])
    return listed, answers

def main():
    images, detector, encoder, decoder, calls = sys.argv[1:]
    segmenter = (Path(encoder), Path(decoder))
    settings = Settings(roots=(Path(images),), detector=detector, segmenter=segmenter, threads=1)
    services = create_services(settings)
    try:
        listed, answers = anyio.run(called, create_server(services), images, json.loads(calls))
    finally:
        services.close()
    print(json.dumps([listed, answers, [name for name in DECODERS if name in sys.modules]]))

if __name__ == "__main__":
    main()
"""


@pytest.mark.promise("listener")
@pytest.mark.slow
def test_no_decoder_is_imported_after_every_tool_was_called(
    images: Path, detector_path: Path, segmenter_paths: tuple[Path, Path], tmp_path: Path
) -> None:
    root = tmp_path / "images"
    root.mkdir()
    for name in ("cars.png", "pool.png", "notes.txt"):
        shutil.copy(images / name, root)
    cars = {"kind": "path", "path": str(root / "cars.png")}
    pool = {"kind": "path", "path": str(root / "pool.png")}
    box = {"box": {"x_min": 294, "y_min": 324, "x_max": 354, "y_max": 432}}
    calls = [
        ("view_image", {}),
        ("view_image", {"image": cars}),
        ("view_image", {"image": {"kind": "path", "path": str(root / "notes.txt")}}),
        ("view_image", {"of": {"tool": "estimate_gsd", "arguments": {"image": cars}}}),
        ("estimate_gsd", {"image": cars, "more_images": [pool], "detail": "full"}),
        ("measure_area", {"image": pool, "targets": [box]}),
        (
            "measure_distance",
            {"image": cars, "lines": [{"points": [{"x": 10, "y": 10}, {"x": 90, "y": 90}]}]},
        ),
    ]
    models = [str(detector_path), *map(str, segmenter_paths)]
    command = [sys.executable, "-c", _CALLS, str(root), *models, json.dumps(calls)]
    printed = subprocess.run(
        command, capture_output=True, text=True, timeout=300, check=True
    ).stdout
    listed, answers, imported = json.loads(printed.splitlines()[-1])
    assert {name for name, _ in answers} == set(listed), "a tool was not called"
    assert [failed for _, failed in answers] == [False, False, True, False, False, False, False]
    assert imported == []
