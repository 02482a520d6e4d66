"""The page for hosts of MCP Apps, and its data; ``test_app_page_browser`` opens it in a browser."""

from __future__ import annotations

import base64
import hashlib
import re
from pathlib import Path
from typing import Any, NamedTuple

import anyio
import cv2
import numpy as np
import pytest
from mcp import Client
from mcp.client import advertise
from mcp.server import MCPServer
from mcp.server.apps import APP_MIME_TYPE, EXTENSION_ID
from mcp.types import CallToolResult, TextResourceContents, Tool

from tests.server.conftest import POOL_BOX
from tests.server.conversation import ERAS, by_path, picture_of
from vehanchor.scale.defaults import INTERVAL_PREMISE
from vehanchor_server.app_page.page import APP_URI, page_html, scale_arguments, view_html
from vehanchor_server.app_page.panel import PANEL_KEY
from vehanchor_server.services import create_services
from vehanchor_server.settings import Settings
from vehanchor_server.tools.registry import create_tools
from vehanchor_server.tools.target import MAX_POLYGON_NUMBERS

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


class Answers(NamedTuple):
    """Answers to one call: for a host without pages; short and full ones for a host with pages."""

    plain: CallToolResult
    shown: CallToolResult
    full: CallToolResult


@pytest.fixture(scope="module", params=["estimate_gsd", "measure_area"])
def answers(request: pytest.FixtureRequest, server: MCPServer[object], images: Path) -> Answers:
    tool = request.param
    arguments = {**by_path(images / "pool.png"), "detail": "short"}
    if tool == "measure_area":
        arguments["targets"] = [{"box": POOL_BOX}]

    async def ask() -> Answers:
        async with Client(server) as client:
            plain = await client.call_tool(tool, arguments)
        async with Client(server, extensions=SHOWS_PAGES) as client:
            shown = await client.call_tool(tool, arguments)
            full = await client.call_tool(tool, {**arguments, "detail": "full"})
        return Answers(plain, shown, full)

    return anyio.run(ask)


def test_a_host_without_pages_gets_no_page_data(answers: Answers) -> None:
    assert set(panel_of(answers.plain).values()) == {None}


def test_the_page_gets_the_image_without_marks(answers: Answers, images: Path) -> None:
    data = base64.b64decode(panel_of(answers.shown)["picture_jpeg"])
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    photograph = cv2.imread(str(images / "pool.png"))
    assert image is not None
    assert photograph is not None
    assert image.shape == photograph.shape
    assert np.abs(image.astype(float) - photograph).mean() < 3


def test_the_page_gets_the_whole_record_beside_a_short_one(answers: Answers) -> None:
    whole = {**panel_of(answers.full), "record": answers.full.structured_content}
    assert panel_of(answers.shown) == whole


def test_the_page_does_not_change_what_a_model_reads(answers: Answers) -> None:
    assert answers.plain.content == answers.shown.content
    assert answers.plain.structured_content == answers.shown.structured_content


class PageTool(NamedTuple):
    """The page's tool, the tools of models, and their answers.

    Attributes:
        tool: the page's tool.
        listed: names of the tools that a client without pages sees.
        unknown: the error of an unknown tool.
        listing: the answer without an image.
        viewed: the answer about a part of an image.
    """

    tool: Tool
    listed: list[str]
    unknown: CallToolResult
    listing: CallToolResult
    viewed: CallToolResult


@pytest.fixture(scope="module")
def page_tool(server: MCPServer[object], images: Path) -> PageTool:
    part = {"x_min": 100, "y_min": 50, "x_max": 400, "y_max": 350}
    arguments = {"image": by_path(images / "cars.png")["image"], "part": part}

    async def ask() -> PageTool:
        async with Client(server) as client:
            listed = [tool.name for tool in (await client.list_tools()).tools]
            unknown = await client.call_tool("none", {})
        async with Client(server, extensions=SHOWS_PAGES) as client:
            tools = (await client.list_tools()).tools
            (tool,) = [tool for tool in tools if tool.name not in listed]
            listing = await client.call_tool(tool.name, {})
            viewed = await client.call_tool(tool.name, arguments)
        return PageTool(tool, listed, unknown, listing, viewed)

    return anyio.run(ask)


def test_the_page_has_a_tool_that_no_model_sees(page_tool: PageTool) -> None:
    assert "view_image" in page_tool.listed
    assert page_tool.tool.name not in str(page_tool.unknown.content)
    assert page_tool.tool.meta == {"ui": {"resourceUri": APP_URI, "visibility": ["app"]}}


def test_the_page_can_list_images(page_tool: PageTool, images: Path) -> None:
    content = page_tool.listing.structured_content
    assert content is not None
    assert str(images / "cars.png") in content["images"]
    assert content["next_page"] is None


def test_the_page_gets_a_part_without_a_grid(page_tool: PageTool, images: Path) -> None:
    picture = picture_of(page_tool.viewed).astype(float)
    photograph = cv2.imread(str(images / "cars.png"))
    assert photograph is not None
    part = photograph[50:350, 100:400]
    expected = cv2.resize(part, picture.shape[1::-1], interpolation=cv2.INTER_CUBIC)
    assert np.abs(picture - expected).mean() < 3


@pytest.fixture(scope="module")
def drawn(server: MCPServer[object], images: Path) -> CallToolResult:
    """The answer to a call with a line, a dropped vehicle and an added one, for a page."""
    line = {"x1": 20, "y1": 30, "x2": 420, "y2": 30, "metres": 400}
    corrections = {"known_lengths": [line], "drop": "1", "add": [CAR_AXIS]}

    async def ask() -> CallToolResult:
        async with Client(server, extensions=SHOWS_PAGES) as client:
            arguments = {**by_path(images / "cars.png"), **corrections}
            return await client.call_tool("estimate_gsd", arguments)

    return anyio.run(ask)


def test_all_vehicles_are_drawn(drawn: CallToolResult) -> None:
    record = drawn.structured_content
    assert record is not None
    assert len(panel_of(drawn)["drawing"]["vehicles"]) == record["details"]["n_detections"] == 24


def test_measured_vehicles_are_marked(drawn: CallToolResult) -> None:
    record = drawn.structured_content
    assert record is not None
    vehicles = panel_of(drawn)["drawing"]["vehicles"]
    lengths = [length for _, _, length, _, _, kept, *_ in vehicles if kept]
    assert len(lengths) == record["n_vehicles"]
    assert np.median(lengths) == pytest.approx(record["mode_length_px"], abs=1)


def test_lines_are_drawn_with_their_length(drawn: CallToolResult) -> None:
    lines = panel_of(drawn)["drawing"]["lines"]
    assert {"points": [[20, 30], [420, 30]], "label": "400 m", "closed": False} in lines


def test_the_page_gets_the_proportions_of_the_detectors_boxes(drawn: CallToolResult) -> None:
    ratio = panel_of(drawn)["drawing"]["length_over_width"]
    *_, added = panel_of(drawn)["drawing"]["vehicles"]
    _, _, length, width, *_ = added
    assert length / width == pytest.approx(ratio, abs=0.02)


def test_vehicles_have_the_numbers_of_drop(drawn: CallToolResult) -> None:
    vehicles = panel_of(drawn)["drawing"]["vehicles"]
    numbers = [(number, added) for *_, number, added in vehicles]
    assert numbers == [*((n, 0) for n in range(2, 25)), (25, 1)]


def test_an_added_vehicle_is_drawn_at_its_place(drawn: CallToolResult) -> None:
    vehicles = panel_of(drawn)["drawing"]["vehicles"]
    assert vehicles[-1][:2] == [CAR_AXIS["x1"] + 16, CAR_AXIS["y1"]]


@pytest.mark.anyio
async def test_people_get_a_sentence_without_warnings_or_argument_names(
    server: MCPServer[object], images: Path
) -> None:
    line = {"x1": 20, "y1": 30, "x2": 420, "y2": 30, "metres": 400, "basis": "measured"}
    sentences = {}
    async with Client(server, extensions=SHOWS_PAGES) as client:
        for name, more in {
            "two": {},
            "empty": {},
            "cars": {"known_lengths": [line], "drop": "2-9"},
        }.items():
            result = await client.call_tool(
                "estimate_gsd", {**by_path(images / f"{name}.png"), **more}
            )
            sentences[name] = panel_of(result)["sentence"]
            assert sentences[name].startswith(panel_of(result)["reason"])
    assert sentences == {
        "two": "2 vehicles alone: too little evidence; draw a line over parking bays or another "
        "thing of known size, or measure one length, on the ground or on a map, or give other "
        "photographs of the same flight, with cars.",
        "empty": "No car was found; include the cars, or draw lines over two different things of "
        "known size, if they are in sight, or measure one length, on the ground or on a map, or "
        "give other photographs of the same flight, with cars, or give the camera's height and "
        "focal length.",
        "cars": "Vehicles and known length contradict each other; check the facts that you gave, "
        "or measure one length, on the ground or on a map, or give the camera's height and focal "
        "length. Vehicles corrected by hand: 8 dropped.",
    }


def panel_of(result: CallToolResult) -> dict[str, Any]:
    assert result.meta is not None
    panel: dict[str, Any] = result.meta[PANEL_KEY]
    return panel


@pytest.mark.parametrize("page", [page_html(), view_html()], ids=["host", "view"])
def test_the_page_has_the_premise_of_the_interval(page: str) -> None:
    assert f'data-interval-premise="{INTERVAL_PREMISE}"' in page
    assert "${bounds} ${PREMISE}" in page


@pytest.mark.parametrize("page", [page_html(), view_html()], ids=["host", "view"])
def test_the_page_knows_the_arguments_of_a_scale(page: str) -> None:
    [names] = re.findall(r'<body data-scale-arguments="([^"]+)"', page)
    assert names.split(" ") == scale_arguments()
    assert {"image", "region", "drop", "gsd_m_per_px"} <= set(scale_arguments())


@pytest.mark.parametrize("page", [page_html(), view_html()], ids=["host", "view"])
def test_the_page_draws_as_many_corners_as_a_polygon_may_have(page: str) -> None:
    [corners] = re.findall(r"MAX_CORNERS = (\d+);", page)
    assert int(corners) == MAX_POLYGON_NUMBERS // 2


@pytest.mark.parametrize("tool", ["measure_area", "measure_distance"])
def test_a_measurement_takes_all_arguments_of_a_scale(tool: str) -> None:
    tools = {each.name: each for each in create_tools(create_services(Settings()))}
    assert set(scale_arguments()) <= set(tools[tool].full_parameters["properties"])


@pytest.mark.parametrize("page", [page_html(), view_html()], ids=["host", "view"])
def test_the_page_refers_to_nothing_outside(page: str) -> None:
    vocabulary = "http://www.w3.org/2000/svg"
    assert re.findall(r"https?://[^\"'\s]+", page) == [vocabulary]
    assert not re.findall(r"\s(?:on\w+|style|src|href)=", page)


@pytest.mark.parametrize(
    ("page", "more"),
    [(page_html(), {}), (view_html(), {"connect-src": "'self'"})],
    ids=["host", "view"],
)
def test_the_policy_of_the_page_allows_only_its_own_parts(page: str, more: dict[str, str]) -> None:
    [policy] = re.findall(r'http-equiv="Content-Security-Policy" content="([^"]+)"', page)
    rules = dict(rule.split(" ", 1) for rule in policy.split("; "))
    assert rules == {
        "default-src": "'none'",
        "img-src": "data:",
        "base-uri": "'none'",
        "form-action": "'none'",
        "style-src": hash_of(page, "style"),
        "script-src": hash_of(page, "script"),
        **more,
    }


def hash_of(page: str, tag: str) -> str:
    [text] = re.findall(f"<{tag}>(.*?)</{tag}>", page, re.DOTALL)
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"
