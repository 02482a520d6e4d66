from __future__ import annotations

import json
from pathlib import Path
from typing import Any, NamedTuple

import anyio
import jsonschema
import pytest
from mcp import Client
from mcp.server import MCPServer
from mcp.server.mcpserver import Context
from mcp.server.mcpserver.utilities.func_metadata import FuncMetadata
from mcp.types import CallToolResult, Tool

from tests.server.conversation import (
    ERAS,
    by_path,
    check_shape,
    error_of,
    input_schema,
    text_of,
)
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.options import Reading
from vehanchor_server.app import create_server
from vehanchor_server.base_model import FrozenModel
from vehanchor_server.calls.job import Job
from vehanchor_server.calls.reply import Reply
from vehanchor_server.calls.task import work
from vehanchor_server.images.argument import ImageArgument
from vehanchor_server.images.source import OpenedImage
from vehanchor_server.resources import Resources
from vehanchor_server.schemas import PUBLISHED, schema_files
from vehanchor_server.services import Services
from vehanchor_server.tools import registry
from vehanchor_server.tools.scale_arguments import DetailArgument
from vehanchor_server.tools.strict_tool import StrictTool

pytestmark = pytest.mark.anyio


# Annotations are evaluated here on purpose: the SDK reads the result's schema from them.


class Size(FrozenModel):
    """Size of an image."""

    width_px: int
    height_px: int


def image_size_tool(services: Services) -> StrictTool:
    """What the module of a new tool holds."""

    async def image_size(
        image: ImageArgument, ctx: Context[Any, Any], detail: DetailArgument = "short"
    ) -> CallToolResult:
        answer = await services.run_call(ctx, image, work=_image_size, question=None)
        return answer.to_result(f"{answer.record.width_px} px wide.")

    title = "Tell an image's size"
    description = "Tells the size of an image."
    return StrictTool.read_only(image_size, title=title, description=description, record=Size)


@work(Size)
def _image_size(resources: Resources, job: Job, source: OpenedImage, _: None) -> Reply[Size]:
    job.stop.check()
    with open_raster(source, Reading(limits=resources.settings.image_limits)) as raster:
        return Reply((Size(width_px=raster.width_px, height_px=raster.height_px),))


class Contract(NamedTuple):
    """What a client reads of a server before its first call."""

    tools: list[Tool]
    instructions: str

    @property
    def text(self) -> str:
        """The instructions and all descriptions."""
        return " ".join([self.instructions, *(tool.description or "" for tool in self.tools)])


@pytest.fixture(scope="module", params=ERAS)
def contract(request: pytest.FixtureRequest, server: MCPServer[object]) -> Contract:
    async def read() -> Contract:
        async with Client(server, mode=request.param) as client:
            tools = (await client.list_tools()).tools
            assert client.instructions is not None
            return Contract(tools, client.instructions)

    return anyio.run(read)


def test_the_tools_are_listed_in_order(contract: Contract) -> None:
    names = [tool.name for tool in contract.tools]
    assert names == ["estimate_gsd", "measure_area", "measure_distance", "view_image"]


def test_every_tool_has_a_title_with_a_short_description(contract: Contract) -> None:
    for tool in contract.tools:
        assert tool.title
        assert tool.description
        assert len(tool.description.encode()) < 2048


def test_only_measuring_tools_have_structured_output(contract: Contract) -> None:
    for tool in contract.tools:
        assert (tool.output_schema is None) == (tool.name == "view_image")


def test_measuring_tools_explain_the_status(contract: Contract) -> None:
    for tool in contract.tools:
        if tool.name != "view_image":
            description = tool.description or ""
            assert "status is ok" in description or "Status ok: use the value" in description


def test_every_tool_has_all_hints(contract: Contract) -> None:
    for tool in contract.tools:
        assert tool.annotations is not None
        assert tool.annotations.read_only_hint
        assert tool.annotations.idempotent_hint
        assert tool.annotations.destructive_hint is False
        assert tool.annotations.open_world_hint is False


def test_the_contract_states_the_rule_once(contract: Contract) -> None:
    assert "with status ok" in contract.instructions
    assert contract.text.count("in at least 9 of 10") == 1
    assert contract.text.count("never a guess") == 1


def test_the_contract_names_no_limit_of_confidence(contract: Contract) -> None:
    assert "0.5" not in contract.text, "the status decides, never a confidence of 0.5"


async def test_a_new_tool_needs_one_line_in_the_registry(
    monkeypatch: pytest.MonkeyPatch, services: Services, images: Path
) -> None:
    published = schema_files()
    monkeypatch.setattr(registry, "TOOLS", (*registry.TOOLS, image_size_tool))
    async with Client(create_server(services)) as client:
        assert client.instructions is not None
        assert "Tell an image's size: image_size." in client.instructions
        result = await client.call_tool("image_size", by_path(images / "cars.png"))
        refused = await client.call_tool("image_size", by_path(images / "notes.txt"))
    assert result.structured_content == {"width_px": 640, "height_px": 512}
    assert text_of(result) == "640 px wide."
    assert error_of(refused) == "image_undecodable"
    files = schema_files((*PUBLISHED, "image_size"))
    assert set(files) - set(published) == {"image_size.input.json", "image_size.output.json"}
    for provider in ("anthropic", "openai"):
        names = [tool["name"] for tool in json.loads(files[f"{provider}.json"])]
        assert names == [
            "estimate_gsd",
            "measure_area",
            "measure_distance",
            "image_size",
            "view_image",
        ]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({}, "image: it is required"),
        ({"image": {"path": "/a"}}, "image: give an object with kind path or base64 or url"),
        (
            {"image": {"kind": "ftp", "path": "/a"}},
            "image: give an object with kind path or base64 or url",
        ),
        ({"image": "/a.jpg"}, "give an object"),
        (
            {"image": {"kind": "path", "path": "/a", "url": "x"}},
            "image.url: there is no such argument",
        ),
        ({"image": {"kind": "path", "path": ""}}, "image.path: give a text"),
        (
            {"image": {"kind": "path", "path": "/a"}, "detector": "/etc/passwd"},
            "detector: there is no such argument",
        ),
        (
            {"image": {"kind": "path", "path": "/a"}, "reference_length_m": -1},
            "reference_length_m: give a number >= 2",
        ),
        (
            {"image": {"kind": "path", "path": "/a"}, "reference_length_m": "inf"},
            "reference_length_m",
        ),
        (
            {"image": {"kind": "path", "path": "/a"}, "reference_length_m": "nan"},
            "reference_length_m",
        ),
        (
            {"image": {"kind": "path", "path": "/a"}, "frame": {"width_px": 3}},
            "frame.height_px: it is required",
        ),
        (
            {"image": {"kind": "path", "path": "/a"}, "frame": {"width_px": 0, "height_px": 3}},
            "frame.width_px",
        ),
    ],
)
async def test_wrong_arguments_are_refused_in_one_line(
    server: MCPServer[object], arguments: dict[str, Any], words: str
) -> None:
    async with Client(server) as client:
        result = await client.call_tool("estimate_gsd", arguments)
    assert error_of(result) == "invalid_arguments"
    assert words in text_of(result)
    assert "\n" not in text_of(result)
    with pytest.raises(jsonschema.ValidationError):
        check_shape(arguments, input_schema("estimate_gsd"))


_BOX = {"x_min": 1, "y_min": 1, "x_max": 90, "y_max": 90}
_LINE = {"x1": 1, "y1": 1, "x2": 90, "y2": 90, "metres": 5}
_KNOWN = {
    **dict.fromkeys(
        ("gsd_m_per_px", "gsd_ci95_low_m_per_px", "gsd_ci95_high_m_per_px", "confidence"), 0.5
    ),
    "image_id": "x",
    "model_id": "x",
}


_NUMBERS: list[tuple[str, str, Any]] = [  # tool, argument, and where in it a number stands
    *[
        ("estimate_gsd", name, ...)
        for name in ("reference_length_m", "height_m", "focal_35mm", "max_seconds")
    ],
    ("estimate_gsd", "max_tiles", ...),
    *[("measure_area", name, ...) for name in ("gsd_m_per_px", "object_height_m")],
    *[("view_image", name, ...) for name in ("page", "long_side_px")],
    ("view_image", "part", {**_BOX, "x_min": ...}),
    ("estimate_gsd", "frame", {"width_px": ..., "height_px": 3}),
    *[("estimate_gsd", "known_lengths", [{**_LINE, name: ...}]) for name in ("x1", "metres")],
    ("measure_area", "targets", [{"box": {**_BOX, "x_min": ...}}]),
    ("measure_area", "targets", [{"points": [{"x": ..., "y": 3}]}]),
    ("measure_distance", "lines", [{"points": [{"x": ..., "y": 1}, {"x": 9, "y": 9}]}]),
    *[("measure_area", "scale", {**_KNOWN, name: ...}) for name in ("gsd_m_per_px", "confidence")],
    (
        "measure_area",
        "scale",
        {**_KNOWN, "plane": {"tilt_deg": ..., "roll_deg": 1, "focal_length_px": 900}},
    ),
]


def _filled(part: Any, value: Any) -> Any:
    """The same with a value in the place of ``...``."""
    if isinstance(part, dict):
        return {key: _filled(item, value) for key, item in part.items()}
    if isinstance(part, list):
        return [_filled(item, value) for item in part]
    return value if part is ... else part


async def test_absurd_numbers_are_refused(
    server: MCPServer[object],
) -> None:
    absurd: list[tuple[str, str, Any]] = [
        ("estimate_gsd", "max_tiles", 10**400),
        ("estimate_gsd", "max_seconds", 1e308),
        ("estimate_gsd", "metadata", 1),
        ("estimate_gsd", "same_scale", "yes"),
        ("measure_area", "gsd_m_per_px", 1e-300),
        ("measure_area", "gsd_m_per_px", 1e9),
        *[
            (tool, name, _filled(place, value))
            for tool, name, place in _NUMBERS
            for value in (True, "4.5 kg", "-")
        ],
    ]
    required = {"measure_area": {"targets": [{"box": _BOX}]}}
    taken = []
    async with Client(server) as client:
        for tool, name, value in absurd:
            arguments = {
                "image": {"kind": "path", "path": "/a"},
                **required.get(tool, {}),
                name: value,
            }
            result = await client.call_tool(tool, arguments)
            if error_of(result) != "invalid_arguments" or name not in text_of(result):
                taken.append((tool, name, str(value)[:40], text_of(result)))
    assert taken == []


async def test_a_wrong_argument_is_not_repeated_to_the_caller(server: MCPServer[object]) -> None:
    async with Client(server) as client:
        result = await client.call_tool(
            "estimate_gsd", {"image": {"kind": "base64", "data": 7, "secret": "hunter2"}}
        )
    assert "hunter2" not in text_of(result)


async def test_only_the_log_has_the_details_of_a_bug(
    server: MCPServer[object],
    images: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    def broken(*_: object, **__: object) -> None:
        raise RuntimeError("password is hunter2")

    monkeypatch.setattr("vehanchor.analysis.memory.AnalysisMemory.analyse", broken)
    async with Client(server) as client:
        result = await client.call_tool("estimate_gsd", by_path(images / "cars.png"))
    assert error_of(result) == "internal_error"
    assert "hunter2" not in text_of(result)
    assert "hunter2" in caplog.text


@pytest.mark.parametrize("deep", [False, True])
async def test_too_many_values_are_refused_without_validation(
    server: MCPServer[object], deep: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    validated: list[object] = []
    monkeypatch.setattr(
        FuncMetadata, "validate_arguments", lambda _, arguments: validated.append(arguments)
    )
    many = {f"a{i}": 0 for i in range(100_000)}
    async with Client(server) as client:
        result = await client.call_tool("estimate_gsd", {"image": many} if deep else many)
    assert text_of(result).startswith("invalid_arguments: more than 7000 values.")
    assert validated == []


async def test_long_names_are_shortened_before_they_are_told(server: MCPServer[object]) -> None:
    long = "n" * 100_000
    async with Client(server) as client:
        for arguments in (
            {long: 1},
            {"image": {"kind": long}},
            {"image": {"kind": "path", "path": "/a", long: 1}},
        ):
            result = await client.call_tool("estimate_gsd", arguments)
            assert error_of(result) == "invalid_arguments"
            assert len(text_of(result)) < 700
        result = await client.call_tool(long, {})
    assert error_of(result) == "unknown_tool"
    assert len(text_of(result)) < 300
