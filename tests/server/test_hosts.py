"""Hosts that show a model only one of text and structured content: both tell a planner everything."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
from mcp import Client
from mcp.server import MCPServer

from tests.server.conftest import POOL_BOX
from tests.server.conversation import by_path, text_of
from vehanchor.records.text import significant

pytestmark = pytest.mark.anyio

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


@pytest.mark.parametrize(
    ("image", "tool", "asked"),
    [
        *(("pool", tool, asked) for tool, asked in TOOLS.items()),
        ("pool", "measure_area", POINT),
        *(("pool_two", tool, asked) for tool, asked in TOOLS.items()),
        ("pool_alone", "estimate_gsd", {}),
        ("pool_alone", "measure_distance", LINE),
    ],
)
async def test_text_and_structured_content_say_the_same(
    server: MCPServer[object], images: Path, image: str, tool: str, asked: dict[str, Any]
) -> None:
    contradiction = {"known_lengths": [{"x1": 10, "y1": 500, "x2": 400, "y2": 500, "metres": 300}]}
    more = contradiction if image == "pool" and tool == "estimate_gsd" else {}
    arguments = {"image": by_path(images / f"{image}.png")["image"], **asked, **more}
    async with Client(server) as client:
        result = await client.call_tool(tool, arguments)
        full = await client.call_tool(tool, {**arguments, "detail": "full"})
    record = result.structured_content
    text = text_of(result)
    assert record is not None
    assert full.structured_content is not None
    assert VERDICTS[record["status"]].casefold() in text.casefold()
    value, low, high, confidence = VALUES[tool]
    if record["status"] == "no_scale":
        assert record[value] is None
        assert record[confidence] == 0
        assert "confidence 0" in text
    else:
        assert f"{significant(record[value])} m" in text
        told = re.search(r"\(95 % interval ([\d.]+) to ([\d.]+)\)", text)
        assert told is not None
        assert [float(end) for end in told.groups()] == pytest.approx(
            [record[low], record[high]], rel=0.005
        )
        assert (
            f"confidence {record[confidence]:.2f}" in text
            or f"confidence {record[confidence] + 0.005:.2f}" in text
        )
    if record["status"] != "ok":
        assert record["advice"] in text
    estimate = full.structured_content.get("estimate", full.structured_content)
    assert record.get("reason") == estimate["reason"]
    codes = [notice["code"] for notice in full.structured_content["warnings"]]
    named = [words.rstrip(".").partition(":")[0] for words in record.get("warnings", ())]
    assert ", ".join(named) == ", ".join(codes)
    for words in record.get("warnings", ()):
        assert f"Warning {words}" in text
    for choice in record.get("alternatives", ()):
        size = (
            f"{significant(choice['area_m2'])} m2"
            if "area_m2" in choice
            else f"{choice['mask_area_px']} px"
        )
        assert size in text
