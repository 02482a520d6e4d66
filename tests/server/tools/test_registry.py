# Annotations are evaluated here on purpose: the SDK reads the result's schema from them.

import json
from pathlib import Path
from typing import Annotated, Any

import pytest
from mcp import Client
from mcp.server import MCPServer
from mcp.server.mcpserver import Context
from mcp.types import CallToolResult

from tests.server.conversation import by_path, error_of, text_of
from vehanchor.imagery.sources.opening import open_raster
from vehanchor_server.app import create_server
from vehanchor_server.calls.call import run_call
from vehanchor_server.calls.job import Job
from vehanchor_server.calls.reply import Reply
from vehanchor_server.calls.task import work
from vehanchor_server.frozen import FrozenModel
from vehanchor_server.images.argument import ImageArgument
from vehanchor_server.images.source import OpenedImage
from vehanchor_server.schemas import schema_files
from vehanchor_server.services import Services
from vehanchor_server.tools import registry
from vehanchor_server.tools.scale_question import DetailArgument
from vehanchor_server.tools.strict_tool import StrictTool

pytestmark = pytest.mark.anyio


class Size(FrozenModel):
    """Size of an image."""

    width_px: int
    height_px: int


def image_size_tool(services: Services) -> StrictTool:
    """What the module of a new tool holds."""

    async def image_size(
        image: ImageArgument, ctx: Context[Any, Any], detail: DetailArgument = "short"
    ) -> Annotated[CallToolResult, Size]:
        answer = await run_call(services, ctx, image, _image_size, None)
        return answer.to_result(f"{answer.record.width_px} px wide.")

    return StrictTool.read_only(image_size, title="Tell an image's size", description="Tells the size of an image.")


@work(Size)
def _image_size(services: Services, job: Job, source: OpenedImage, _: None) -> Reply[Size]:
    job.stop.check()
    with open_raster(source, limits=services.settings.image_limits) as raster:
        return Reply((Size(width_px=raster.width_px, height_px=raster.height_px),))


async def test_the_contract_names_every_hint(server: MCPServer[object], era: str) -> None:
    async with Client(server, mode=era) as client:
        listed = (await client.list_tools()).tools
        instructions = client.instructions
    assert [tool.name for tool in listed] == ["estimate_gsd", "measure_area", "measure_distance", "view_image"]
    for tool in listed:
        assert tool.title
        assert tool.description
        assert len(tool.description.encode()) < 2048
        measures_nothing = tool.name == "view_image"
        assert measures_nothing or "status is ok" in tool.description or "status ok: use it" in tool.description
        assert tool.annotations is not None
        assert tool.annotations.read_only_hint
        assert tool.annotations.idempotent_hint
        assert tool.annotations.destructive_hint is False
        assert tool.annotations.open_world_hint is False
    assert instructions is not None
    assert "with status ok" in instructions
    said = " ".join([instructions, *(tool.description or "" for tool in listed)])
    assert said.count("in at least 9 of 10") == said.count("never a guess") == 1, "the rule stands once"
    assert "0.5" not in said, "the status decides, never a confidence of 0.5"


async def test_a_new_tool_needs_its_module_and_a_line_in_the_registry(
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
    files = schema_files()
    assert set(files) - set(published) == {"image_size.input.json", "image_size.output.json"}
    for provider in ("anthropic", "openai"):
        names = [tool["name"] for tool in json.loads(files[f"{provider}.json"])]
        assert names == ["estimate_gsd", "measure_area", "measure_distance", "view_image", "image_size"]
