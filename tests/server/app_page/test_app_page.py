"""The page that hosts of MCP Apps show to people, and what the server sends for it; the next file opens it."""

from __future__ import annotations

import base64
import hashlib
import re
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from mcp import Client
from mcp.client import advertise
from mcp.server import MCPServer
from mcp.server.apps import APP_MIME_TYPE, EXTENSION_ID
from mcp.types import CallToolResult, TextResourceContents

from tests.server.conftest import POOL_BOX
from tests.server.conversation import ERAS, by_path, picture_of
from vehanchor_server.app_page.page import APP_URI, page_html, view_html
from vehanchor_server.app_page.panel import PANEL_KEY

CAR_AXIS = {"x1": 100.0, "y1": 480.0, "x2": 132.0, "y2": 480.0}  # where cars.png has none
SHOWS_PAGES = [advertise(EXTENSION_ID, {"mimeTypes": [APP_MIME_TYPE]})]


@pytest.mark.anyio
@pytest.mark.parametrize("era", ERAS)
async def test_tools_with_a_panel_name_a_page_that_can_be_read(
    server: MCPServer[object], era: str
) -> None:
    async with Client(server, mode=era) as client:
        tools = (await client.list_tools()).tools
        listed = (await client.list_resources()).resources
        [page] = (await client.read_resource(APP_URI)).contents
    shown = {tool.name for tool in tools if tool.meta == {"ui": {"resourceUri": APP_URI}}}
    assert shown == {"estimate_gsd", "measure_area"}
    assert [(resource.uri, resource.mime_type) for resource in listed] == [
        (APP_URI, "text/html;profile=mcp-app")
    ]
    assert isinstance(page, TextResourceContents)
    assert page.text == page_html()
    assert page.meta == {
        "ui": {"csp": {"connectDomains": [], "resourceDomains": []}, "prefersBorder": True}
    }


@pytest.mark.anyio
@pytest.mark.parametrize("tool", ["estimate_gsd", "measure_area"])
async def test_the_page_gets_the_image_and_what_belongs_over_it_and_the_model_no_picture(
    server: MCPServer[object], images: Path, tool: str
) -> None:
    arguments = {**by_path(images / "pool.png"), "detail": "short"}
    if tool == "measure_area":
        arguments["targets"] = [{"box": POOL_BOX}]
    async with Client(server) as client:
        plain = await client.call_tool(tool, arguments)
    async with Client(server, extensions=SHOWS_PAGES) as client:
        shown = await client.call_tool(tool, arguments)
        full = await client.call_tool(tool, {**arguments, "detail": "full"})
    assert set(panel_of(plain).values()) == {None}
    image = cv2.imdecode(
        np.frombuffer(base64.b64decode(panel_of(shown)["picture_jpeg"]), np.uint8), cv2.IMREAD_COLOR
    )
    photograph = cv2.imread(str(images / "pool.png"))
    assert image is not None
    assert photograph is not None
    assert image.shape == photograph.shape
    assert np.abs(image.astype(float) - photograph).mean() < 3  # nothing is drawn into it
    assert panel_of(shown) == {**panel_of(full), "record": full.structured_content}
    assert plain.content == shown.content
    assert plain.structured_content == shown.structured_content


@pytest.mark.anyio
async def test_the_page_has_a_tool_that_no_model_sees(
    server: MCPServer[object], images: Path
) -> None:
    async with Client(server) as client:
        listed = [tool.name for tool in (await client.list_tools()).tools]
        unknown = await client.call_tool("none", {})
    async with Client(server, extensions=SHOWS_PAGES) as client:
        (tool,) = [tool for tool in (await client.list_tools()).tools if tool.name not in listed]
        names = await client.call_tool(tool.name, {})
        part = {"x_min": 100, "y_min": 50, "x_max": 400, "y_max": 350}
        seen = await client.call_tool(
            tool.name, {"image": by_path(images / "cars.png")["image"], "part": part}
        )
    assert "view_image" in listed
    assert tool.name not in str(unknown.content)
    assert tool.meta == {"ui": {"resourceUri": APP_URI, "visibility": ["app"]}}
    assert names.structured_content is not None
    assert str(images / "cars.png") in names.structured_content["images"]
    assert names.structured_content["next_page"] is None
    picture = picture_of(seen).astype(float)
    photograph = cv2.imread(str(images / "cars.png"))
    assert photograph is not None
    shown = cv2.resize(
        photograph[50:350, 100:400], picture.shape[1::-1], interpolation=cv2.INTER_CUBIC
    )
    assert np.abs(picture - shown).mean() < 3, "no grid"


@pytest.mark.anyio
async def test_vehicles_and_lines_are_drawn_where_they_are_with_the_vehicles_numbers(
    server: MCPServer[object], images: Path
) -> None:
    line = {"x1": 20, "y1": 30, "x2": 420, "y2": 30, "metres": 400}
    asked = {
        **by_path(images / "cars.png"),
        "known_lengths": [line],
        "drop": "1",
        "add": [CAR_AXIS],
    }
    async with Client(server, extensions=SHOWS_PAGES) as client:
        result = await client.call_tool("estimate_gsd", asked)
    drawing = panel_of(result)["drawing"]
    record = result.structured_content
    assert record is not None
    assert len(drawing["vehicles"]) == record["details"]["n_detections"] == 24
    lengths = [length for _, _, length, _, _, kept, *_ in drawing["vehicles"] if kept]
    assert len(lengths) == record["n_vehicles"]
    assert np.median(lengths) == pytest.approx(record["mode_length_px"], abs=1)
    assert {"points": [[20, 30], [420, 30]], "label": "400 m", "closed": False} in drawing["lines"]
    numbers = [(number, added) for *_, number, added in drawing["vehicles"]]
    assert numbers == [*((n, 0) for n in range(2, 25)), (25, 1)]
    assert drawing["vehicles"][-1][:2] == [CAR_AXIS["x1"] + 16, CAR_AXIS["y1"]]


@pytest.mark.anyio
async def test_people_get_a_sentence_without_warnings_or_argument_names(
    server: MCPServer[object], images: Path
) -> None:
    line = {"x1": 20, "y1": 30, "x2": 420, "y2": 30, "metres": 400, "basis": "measured"}
    said = {}
    async with Client(server, extensions=SHOWS_PAGES) as client:
        for name, more in {
            "two": {},
            "empty": {},
            "cars": {"known_lengths": [line], "drop": "2-9"},
        }.items():
            result = await client.call_tool(
                "estimate_gsd", {**by_path(images / f"{name}.png"), **more}
            )
            said[name] = panel_of(result)["sentence"]
    assert said == {
        "two": "2 vehicles alone: too little evidence; give the region, or include one more car.",
        "empty": "No car was found; draw a line over something of known size, or take a picture "
        "with cars.",
        "cars": "Vehicles and known length contradict each other; check them, or draw a line "
        "over something of known "
        "size. Vehicles corrected by hand: 8 dropped.",
    }


def panel_of(result: CallToolResult) -> dict[str, Any]:
    assert result.meta is not None
    panel: dict[str, Any] = result.meta[PANEL_KEY]
    return panel


@pytest.mark.parametrize(
    ("page", "more"), [(page_html(), {}), (view_html(), {"connect-src": "'self'"})]
)
def test_the_page_names_no_other_place_and_its_policy_allows_nothing_but_its_own_parts(
    page: str, more: dict[str, str]
) -> None:
    # the name of a vocabulary
    assert re.findall(r"https?://[^\"'\s]+", page) == ["http://www.w3.org/2000/svg"]
    assert not re.findall(r"\s(?:on\w+|style|src|href)=", page)
    [policy] = re.findall(r'http-equiv="Content-Security-Policy" content="([^"]+)"', page)
    rules = dict(rule.split(" ", 1) for rule in policy.split("; "))
    assert rules.pop("style-src") == hash_of(page, "style")
    assert rules.pop("script-src") == hash_of(page, "script")
    common = {
        "default-src": "'none'",
        "img-src": "data:",
        "base-uri": "'none'",
        "form-action": "'none'",
    }
    assert rules == common | more


def hash_of(page: str, tag: str) -> str:
    [text] = re.findall(f"<{tag}>(.*?)</{tag}>", page, re.DOTALL)
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"
