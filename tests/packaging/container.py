"""Our Dockerfile, read stage by stage, and calls to a server that runs from somewhere else."""

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
    """One instruction: its keyword, flags such as ``--from=build`` and the rest of the line."""

    keyword: str
    flags: tuple[str, ...]
    text: str

    @property
    def words(self) -> list[str]:
        """The words of an exec form (``["a", "b"]``) or of a plain line."""
        return list(json.loads(self.text)) if self.text.startswith("[") else shlex.split(self.text)


@dataclass
class Stage:
    """The instructions after one FROM."""

    base: str
    name: str | None
    instructions: list[Instruction] = field(default_factory=list)

    def all(self, keyword: str) -> list[Instruction]:
        """The instructions with this keyword."""
        return [instruction for instruction in self.instructions if instruction.keyword == keyword]

    def last(self, keyword: str) -> Instruction:
        """The one that counts where a later one replaces an earlier one."""
        return self.all(keyword)[-1]

    @property
    def environment(self) -> dict[str, str]:
        """What its ENV instructions set."""
        return dict(
            word.split("=", 1) for instruction in self.all("ENV") for word in instruction.words
        )


def read_dockerfile(path: Path) -> list[Stage]:
    """The stages of a Dockerfile."""
    text = re.sub(r"^\s*#.*\n", "", path.read_text(encoding="utf-8"), flags=re.MULTILINE)
    stages: list[Stage] = []
    for line in text.replace("\\\n", " ").splitlines():
        if not line.strip():
            continue
        keyword, rest = line.strip().split(None, 1)
        if keyword == "FROM":
            base, *name = rest.split()
            stages.append(Stage(base, name[1] if name else None))
            continue
        flags = re.match(r"(?:--\S+\s+)*", rest)
        assert flags is not None
        given = flags.group().split()
        stages[-1].instructions.append(
            Instruction(keyword, tuple(given), rest[flags.end() :].strip())
        )
    return stages


_CLIENT = {
    "io.modelcontextprotocol/protocolVersion": "2026-07-28",
    "io.modelcontextprotocol/clientCapabilities": {},
    "io.modelcontextprotocol/clientInfo": {"name": "packaging", "version": "1"},
}


def free_port() -> int:
    """A port of the loopback interface that nobody listens on."""
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
    """The names of the server's tools."""
    request = urllib.request.Request(
        f"http://127.0.0.1:{port}/mcp",
        data=json.dumps(
            {"jsonrpc": "2.0", "id": 1, "method": "tools/list", "params": {"_meta": _CLIENT}}
        ).encode(),
        headers={
            "Accept": "application/json, text/event-stream",
            "Content-Type": "application/json",
            "MCP-Protocol-Version": "2026-07-28",
            "Mcp-Method": "tools/list",
            **({"Authorization": f"Bearer {token}"} if token else {}),
        },
    )
    with urllib.request.urlopen(request, timeout=30) as answer:
        return [tool["name"] for tool in json.load(answer)["result"]["tools"]]


def stdio_answers(command: list[str], image: str, **options: Any) -> tuple[list[str], Any]:
    """The names of the tools of a server on its standard input, and its estimate of an image."""

    async def answers() -> tuple[list[str], Any]:
        async with Client(
            StdioServerParameters(command=command[0], args=command[1:], **options)
        ) as client:
            called = await client.call_tool(
                "estimate_gsd", {"image": {"kind": "path", "path": image}}
            )
            return [
                tool.name for tool in (await client.list_tools()).tools
            ], called.structured_content

    return anyio.run(answers)
