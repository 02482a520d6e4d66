"""Some hosts show a model only the text, others only the structured content: both are complete."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, NamedTuple

import anyio
import pytest
from mcp import Client
from mcp.server import MCPServer
from mcp.types import CallToolResult

from tests.server.conftest import POOL_BOX
from tests.server.conversation import by_path, text_of
from vehanchor.records.text import significant
from vehanchor.scale.defaults import INTERVAL_PREMISE

AREA: dict[str, Any] = {"targets": [{"box": POOL_BOX}]}
POINT: dict[str, Any] = {"targets": [{"points": [{"x": 324, "y": 378}]}]}
LINE: dict[str, Any] = {"lines": [{"points": [{"x": 20, "y": 500}, {"x": 320, "y": 100}]}]}
TOOLS = {"estimate_gsd": {}, "measure_area": AREA, "measure_distance": LINE}
VERDICTS = {
    "ok": "safe to use",
    "low_confidence": "do not rely on it",
    "no_scale": "no metric scale",
}
VALUES = {
    "estimate_gsd": (
        "gsd_m_per_px",
        "gsd_ci95_low_m_per_px",
        "gsd_ci95_high_m_per_px",
        "confidence",
    ),
    "measure_area": ("area_m2", "area_ci95_low_m2", "area_ci95_high_m2", "scale_confidence"),
    "measure_distance": (
        "distance_m",
        "distance_ci95_low_m",
        "distance_ci95_high_m",
        "scale_confidence",
    ),
}


CALLS: list[tuple[str, str, dict[str, Any]]] = [
    *(("pool", tool, arguments) for tool, arguments in TOOLS.items()),
    ("pool", "measure_area", POINT),
    *(("pool_two", tool, arguments) for tool, arguments in TOOLS.items()),
    ("pool_alone", "estimate_gsd", {}),
    ("pool_alone", "measure_distance", LINE),
]


class Answer(NamedTuple):
    """The text and the structured content of a call's short answer, and its full record."""

    tool: str
    text: str
    record: dict[str, Any]
    full: dict[str, Any]


@pytest.fixture(scope="module", params=CALLS, ids=lambda call: f"{call[0]}-{call[1]}")
def answer(request: pytest.FixtureRequest, server: MCPServer[object], images: Path) -> Answer:
    image, tool, more = request.param
    arguments = {"image": by_path(images / f"{image}.png")["image"], **more}
    if (image, tool) == ("pool", "estimate_gsd"):
        # A line that contradicts the vehicles: the answer has a warning.
        line = {"x1": 10, "y1": 500, "x2": 400, "y2": 500, "metres": 300}
        arguments["known_lengths"] = [line]

    async def ask() -> tuple[CallToolResult, CallToolResult]:
        async with Client(server) as client:
            short = await client.call_tool(tool, arguments)
            full = await client.call_tool(tool, {**arguments, "detail": "full"})
        return short, full

    short, full = anyio.run(ask)
    assert short.structured_content is not None
    assert full.structured_content is not None
    return Answer(tool, text_of(short), short.structured_content, full.structured_content)


def test_the_text_states_the_verdict(answer: Answer) -> None:
    assert VERDICTS[answer.record["status"]].casefold() in answer.text.casefold()


def test_the_text_states_the_value_with_its_interval(answer: Answer) -> None:
    record = answer.record
    value, low, high, _ = VALUES[answer.tool]
    if record["status"] == "no_scale":
        assert record[value] is None
        return
    assert f"{significant(record[value])} m" in answer.text
    interval = re.search(r"\(95 % interval ([\d.]+) to ([\d.]+)( .+?)?\)", answer.text)
    assert interval is not None
    *ends_in_words, premise = interval.groups()
    ends = [float(end) for end in ends_in_words]
    is_scale = answer.tool == "estimate_gsd"
    assert premise == (f" {INTERVAL_PREMISE}" if is_scale else None)
    assert ends == pytest.approx([record[low], record[high]], rel=0.005)


def test_the_text_states_the_confidence(answer: Answer) -> None:
    confidence = answer.record[VALUES[answer.tool][-1]]
    if answer.record["status"] == "no_scale":
        assert confidence == 0
        assert "confidence 0" in answer.text
        return
    # The record rounds downward, the text to the nearest.
    shown = (f"confidence {confidence:.2f}", f"confidence {confidence + 0.005:.2f}")
    assert any(words in answer.text for words in shown)


def test_the_text_has_the_advice(answer: Answer) -> None:
    if answer.record["status"] != "ok":
        assert answer.record["advice"] in answer.text


def test_the_record_has_the_reason(answer: Answer) -> None:
    estimate = answer.full.get("estimate", answer.full)
    assert answer.record.get("reason") == estimate["reason"]


def test_the_record_names_all_warnings(answer: Answer) -> None:
    codes = [notice["code"] for notice in answer.full["warnings"]]
    warnings = answer.record.get("warnings", ())
    named = [words.rstrip(".").partition(":")[0] for words in warnings]
    assert ", ".join(named) == ", ".join(codes)


def test_the_text_has_the_warnings(answer: Answer) -> None:
    for words in answer.record.get("warnings", ()):
        # The first line states a contradiction, without its code.
        message = words.partition(": ")[2]
        assert f"Warning {words}" in answer.text or answer.text.startswith(message)


def test_the_text_has_the_alternatives(answer: Answer) -> None:
    for alternative in answer.record.get("alternatives", ()):
        if "area_m2" in alternative:
            size = f"{significant(alternative['area_m2'])} m2"
        else:
            size = f"{alternative['mask_area_px']} px"
        assert size in answer.text
