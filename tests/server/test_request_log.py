from __future__ import annotations

import base64
import json
import logging
import sys
from pathlib import Path
from typing import Any

import pytest
from mcp import Client
from mcp.server import MCPServer

from tests.server.conversation import by_path
from vehanchor_server.request_log import JsonFormatter, RepeatLimit, configure_logging


def lines_of(caplog: pytest.LogCaptureFixture) -> list[dict[str, Any]]:
    formatter = JsonFormatter()
    return [
        json.loads(formatter.format(record))
        for record in caplog.records
        if record.name == "vehanchor_server.calls"
    ]


@pytest.mark.promise("log")
@pytest.mark.anyio
async def test_a_call_is_logged_by_its_outcome_without_its_image(
    server: MCPServer[object], images: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    encoded = base64.b64encode((images / "empty.png").read_bytes()).decode()
    async with Client(server) as client:
        await client.call_tool("estimate_gsd", by_path(images / "cars.png"))
        await client.call_tool("estimate_gsd", {"image": {"kind": "base64", "data": encoded}})
        await client.call_tool("estimate_gsd", {"image": {"kind": "base64", "data": encoded[:-5]}})
        await client.call_tool("estimate_gsd", {"image": {"kind": "base64"}})
        await client.call_tool("estimate_gsd", by_path("/etc/passwd"))
    lines = lines_of(caplog)
    assert [line["status"] for line in lines] == [
        "ok",
        "no_scale",
        "base64_invalid",
        "invalid_arguments",
        "path_not_allowed",
    ]
    assert all(line["tool"] == "estimate_gsd" and line["ms"] >= 0 for line in lines)
    assert lines[0]["megapixels"] == 0.328
    assert "megapixels" not in lines[2]
    assert encoded[:40] not in caplog.text


def test_a_log_line_is_one_line_of_json_with_its_traceback() -> None:
    try:
        raise RuntimeError("two\nlines")
    except RuntimeError:
        record = logging.LogRecord(
            "a.b", logging.ERROR, __file__, 1, "it %s", ("failed",), sys.exc_info()
        )
    text = JsonFormatter().format(record)
    line = json.loads(text)
    assert "\n" not in text
    assert (line["level"], line["logger"], line["message"]) == ("error", "a.b", "it failed")
    assert "RuntimeError: two\nlines" in line["traceback"]
    assert line["time"].endswith("+00:00")


def test_logs_go_to_stderr_only(capsys: pytest.CaptureFixture[str]) -> None:
    root = logging.getLogger()
    before = root.handlers[:]
    level = root.level
    try:
        configure_logging()
        logging.getLogger("vehanchor_server.test").info("hello")
        logging.getLogger("mcp.server").info("chatter")
    finally:
        root.handlers[:] = before
        root.setLevel(level)
        for name in ("httpx2", "httpcore2", "sse_starlette", "mcp", "uvicorn.access"):
            logging.getLogger(name).setLevel(logging.NOTSET)
    captured = capsys.readouterr()
    assert captured.out == ""
    assert json.loads(captured.err)["message"] == "hello"


@pytest.mark.promise("log")
def test_repeated_lines_are_counted_after_the_first_few() -> None:
    limit = RepeatLimit(n_lines=3, period_s=10)

    def passes(name: str, created: float, line: int = 1) -> logging.LogRecord | None:
        record = logging.LogRecord(
            name, logging.WARNING, __file__, line, "Invalid Host header: %s", (created,), None
        )
        record.created = created
        return record if limit.filter(record) else None

    assert sum(passes("mcp", 100 + i / 100) is not None for i in range(50)) == 3
    assert passes("mcp", 101, line=2) is not None  # another place in the code
    assert all(passes("vehanchor_server.calls", 101) for _ in range(50))  # one a call
    later = passes("mcp", 111)
    assert later is not None
    assert json.loads(JsonFormatter().format(later))["not_shown_before"] == 47
