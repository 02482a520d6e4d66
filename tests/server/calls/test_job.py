from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from mcp import Client
from mcp.server import MCPServer
from opentelemetry import trace
from opentelemetry.sdk.trace import ReadableSpan, TracerProvider
from opentelemetry.sdk.trace.export import SimpleSpanProcessor
from opentelemetry.sdk.trace.export.in_memory_span_exporter import InMemorySpanExporter

from tests.server.conftest import POOL_BOX
from tests.server.conversation import by_path

pytestmark = pytest.mark.anyio

_exporter = InMemorySpanExporter()


@pytest.fixture
def spans() -> Iterator[InMemorySpanExporter]:
    if not isinstance(trace.get_tracer_provider(), TracerProvider):  # a process can set its provider only once
        provider = TracerProvider()
        provider.add_span_processor(SimpleSpanProcessor(_exporter))
        trace.set_tracer_provider(provider)
    _exporter.clear()
    yield _exporter
    _exporter.clear()


@pytest.mark.parametrize(
    ("tool", "more", "names"),
    [
        ("estimate_gsd", {}, ["decode", "detect", "scale", "overlay"]),
        ("measure_area", {"target": {"box": POOL_BOX}}, ["decode", "segment", "detect", "scale", "overlay"]),
        (
            "measure_area",
            {"target": {"box": POOL_BOX}, "gsd_m_per_px": 0.2, "gsd_basis": "measured"},
            ["decode", "segment", "overlay"],
        ),
    ],
)
async def test_the_stages_of_a_call_are_children_of_the_calls_span(
    spans: InMemorySpanExporter,
    server: MCPServer[object],
    images: Path,
    tool: str,
    more: dict[str, Any],
    names: list[str],
) -> None:
    async with Client(server) as client:
        await client.call_tool(tool, {**by_path(images / "pool.png"), "include_overlay": True, **more})
    finished = {span.name: span for span in spans.get_finished_spans()}
    assert sorted(name for name in finished if name.startswith("vehanchor.")) == sorted(
        f"vehanchor.{name}" for name in names
    )
    stages = [finished[f"vehanchor.{stage}"] for stage in names]
    call = finished[f"tools/call {tool}"]
    assert call.context is not None
    for stage in stages:
        assert stage.parent is not None
        assert stage.parent.span_id == call.context.span_id
    assert [_started(stage) for stage in stages] == sorted(_started(stage) for stage in stages)


def _started(span: ReadableSpan) -> int:
    assert span.start_time is not None
    return span.start_time


async def test_a_failed_stage_is_marked(spans: InMemorySpanExporter, server: MCPServer[object], images: Path) -> None:
    async with Client(server) as client:
        await client.call_tool("estimate_gsd", by_path(images / "notes.txt"))
    (stage,) = [span for span in spans.get_finished_spans() if span.name == "vehanchor.decode"]
    assert stage.status.status_code is trace.StatusCode.ERROR
    assert stage.status.description == "CallError"
