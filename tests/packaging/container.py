"""Our Dockerfile, read stage by stage, and calls to a server in another environment."""

from __future__ import annotations

import json
import re
import shlex
import socket
import subprocess
import time
import urllib.error
import urllib.request
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import anyio
from mcp import Client, StdioServerParameters


@dataclass(frozen=True)
class Instruction:
    """Instruction: its keyword, flags such as ``--from=build`` and the rest of the line."""

    keyword: str
    flags: tuple[str, ...]
    text: str

    @property
    def words(self) -> list[str]:
        """Return the words of an exec form (``["a", "b"]``) or of a plain line."""
        if self.text.startswith("["):
            return list(json.loads(self.text))
        return shlex.split(self.text)


@dataclass
class Stage:
    """Stage of a build: the instructions after one FROM."""

    base: str
    name: str | None
    instructions: list[Instruction] = field(default_factory=list)

    def all(self, keyword: str) -> list[Instruction]:
        """Return the instructions with this keyword."""
        return [instruction for instruction in self.instructions if instruction.keyword == keyword]

    def last(self, keyword: str) -> Instruction:
        """Return the last instruction with this keyword, which replaces earlier ones."""
        return self.all(keyword)[-1]

    @property
    def environment(self) -> dict[str, str]:
        """Return the variables that the ENV instructions set."""
        assignments = [word for instruction in self.all("ENV") for word in instruction.words]
        return dict(assignment.split("=", 1) for assignment in assignments)


def read_dockerfile(path: Path) -> list[Stage]:
    """Return the stages of a Dockerfile."""
    text = path.read_text(encoding="utf-8")
    without_comments = re.sub(r"^\s*#.*\n", "", text, flags=re.MULTILINE)
    lines = without_comments.replace("\\\n", " ").splitlines()
    stages: list[Stage] = []
    for line in lines:
        if not line.strip():
            continue
        keyword, rest = line.strip().split(None, 1)
        if keyword == "FROM":
            # FROM base AS name
            base, *as_name = rest.split()
            stages.append(Stage(base, as_name[1] if as_name else None))
        else:
            stages[-1].instructions.append(_read_instruction(keyword, rest))
    return stages


def _read_instruction(keyword: str, rest: str) -> Instruction:
    flags = re.match(r"(?:--\S+\s+)*", rest)
    assert flags is not None
    return Instruction(keyword, tuple(flags.group().split()), rest[flags.end() :].strip())


_CLIENT = {
    "io.modelcontextprotocol/protocolVersion": "2026-07-28",
    "io.modelcontextprotocol/clientCapabilities": {},
    "io.modelcontextprotocol/clientInfo": {"name": "packaging", "version": "1"},
}


def free_port() -> int:
    """Return a free port of the loopback interface."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


def wait_until_ready(port: int, process: subprocess.Popen[Any], seconds: float = 120) -> None:
    """Wait for /readyz, as a readiness probe does."""
    deadline = time.monotonic() + seconds
    while True:
        try:
            with urllib.request.urlopen(f"http://127.0.0.1:{port}/readyz", timeout=5):
                return
        except OSError:
            assert process.poll() is None, f"the server ended with {process.returncode}"
            assert time.monotonic() < deadline, "the server did not get ready"
            time.sleep(0.1)


def tools_over_http(port: int, token: str | None = None) -> list[str]:
    """Return the names of the server's tools."""
    call = {"jsonrpc": "2.0", "id": 1, "method": "tools/list", "params": {"_meta": _CLIENT}}
    headers = {
        "Accept": "application/json, text/event-stream",
        "Content-Type": "application/json",
        "MCP-Protocol-Version": "2026-07-28",
        "Mcp-Method": "tools/list",
    }
    if token is not None:
        headers["Authorization"] = f"Bearer {token}"
    request = urllib.request.Request(
        f"http://127.0.0.1:{port}/mcp", data=json.dumps(call).encode(), headers=headers
    )
    with urllib.request.urlopen(request, timeout=30) as answer:
        return [tool["name"] for tool in json.load(answer)["result"]["tools"]]


def stdio_answers(command: list[str], image: str, **options: Any) -> tuple[list[str], Any]:
    """Return the tools of a server on its standard input, and its estimate of an image."""
    server = StdioServerParameters(command=command[0], args=command[1:], **options)
    arguments = {"image": {"kind": "path", "path": image}}

    async def answers() -> tuple[list[str], Any]:
        async with Client(server) as client:
            result = await client.call_tool("estimate_gsd", arguments)
            tools = (await client.list_tools()).tools
            return [tool.name for tool in tools], result.structured_content

    return anyio.run(answers)
