from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import anyio
import numpy as np
import onnx
import onnxruntime
import pytest
from mcp import Client
from mcp.server import MCPServer
from mcp.server.mcpserver import Context
from onnx import TensorProto, helper, numpy_helper
from opentelemetry import trace
from opentelemetry.sdk.trace import ReadableSpan, TracerProvider
from opentelemetry.sdk.trace.export import SimpleSpanProcessor
from opentelemetry.sdk.trace.export.in_memory_span_exporter import InMemorySpanExporter

from tests.server.test_tools import by_path
from vehanchor_server.capacity import Capacity, Stop
from vehanchor_server.errors import CallError
from vehanchor_server.job import Job

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


async def test_the_stages_of_a_call_are_children_of_the_calls_span(
    spans: InMemorySpanExporter, server: MCPServer[object], images: Path
) -> None:
    async with Client(server) as client:
        await client.call_tool("estimate_gsd", {**by_path(images / "cars.png"), "include_overlay": True})
    finished = {span.name: span for span in spans.get_finished_spans()}
    stages = [finished[f"vehanchor.{stage}"] for stage in ("decode", "detect", "scale", "overlay")]
    call = finished["tools/call estimate_gsd"]
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


@pytest.fixture(scope="module")
def slow_session(tmp_path_factory: pytest.TempPathFactory) -> onnxruntime.InferenceSession:
    """A model of many layers that takes long."""
    weights = numpy_helper.from_array(np.full((64, 64, 3, 3), 1e-3, np.float32), "w")
    nodes = [
        helper.make_node("Conv", [f"x{i}", "w"], [f"x{i + 1}"], pads=[1, 1, 1, 1], kernel_shape=[3, 3])
        for i in range(200)
    ]
    shape = [1, 64, 512, 512]
    graph = helper.make_graph(
        nodes,
        "slow",
        [helper.make_tensor_value_info("x0", TensorProto.FLOAT, shape)],
        [helper.make_tensor_value_info("x200", TensorProto.FLOAT, shape)],
        [weights],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)])
    model.ir_version = 8
    path = tmp_path_factory.mktemp("slow") / "slow.onnx"
    onnx.save(model, str(path))
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    options.log_severity_level = 4
    return onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])


@pytest.mark.slow
async def test_a_running_model_is_stopped_within_a_layer(slow_session: onnxruntime.InferenceSession) -> None:
    capacity = Capacity(1, 1.0)
    image = np.zeros((1, 64, 512, 512), np.float32)

    async def call(stop: Stop) -> Any:
        job = Job(cast("Context[Any, Any]", None), stop)
        return await capacity.in_thread(stop, lambda: slow_session.run(None, {"x0": image}, job.run_options))

    started = time.monotonic()
    with pytest.raises(CallError, match="deadline_exceeded"), anyio.fail_after(30):
        await capacity.run(call)
    assert time.monotonic() - started < 5, "the model ran on"
    assert capacity.running == 0
