"""The skill file for agents: its format as agentskills.io publishes it, and calls that work."""

from __future__ import annotations

import json
import re
import shutil
from importlib.resources import files
from pathlib import Path
from typing import Any

import pytest
import yaml
from mcp import Client
from typer.testing import CliRunner

from tests.conftest import ROOT
from tests.server.conversation import text_of
from vehanchor.cli.app import app
from vehanchor_server.app import create_server
from vehanchor_server.services import create_services
from vehanchor_server.settings import Settings

TEXT = files("vehanchor_server").joinpath("SKILL.md").read_text(encoding="utf-8")
NAME_CHARS, DESCRIPTION_CHARS, COMPATIBILITY_CHARS, LINES = 64, 1024, 500, 500  # agentskills.io/specification
FIELDS = {"name", "description", "license", "compatibility", "metadata", "allowed-tools"}


def front_matter() -> dict[str, Any]:
    found = re.match(r"---\n(.*?)\n---\n", TEXT, re.DOTALL)
    assert found
    told: dict[str, Any] = yaml.safe_load(found[1])
    return told


def test_the_front_matter_is_what_hosts_read() -> None:
    told = front_matter()
    assert set(told) <= FIELDS
    assert re.fullmatch(r"[a-z0-9]+(-[a-z0-9]+)*", told["name"])
    assert len(told["name"]) <= NAME_CHARS
    assert 1 <= len(told["description"]) <= DESCRIPTION_CHARS
    assert "Use when" in told["description"]
    assert len(told["compatibility"]) <= COMPATIBILITY_CHARS
    assert len(TEXT.splitlines()) < LINES


def test_the_command_prints_it() -> None:
    done = CliRunner().invoke(app, ["serve", "--skill"])
    assert (done.exit_code, done.stdout) == (0, TEXT)


@pytest.mark.anyio
async def test_its_worked_calls_work(tmp_path: Path) -> None:
    shutil.copy(ROOT / "examples" / "car_park.jpg", tmp_path / "car_park.jpg")
    calls = [json.loads(block) for block in re.findall(r"```json\n(.*?)\n```", TEXT, re.DOTALL)]
    assert len(calls) == 3
    async with Client(
        create_server(create_services(Settings(roots=(tmp_path.resolve(),), isolation="in-process")))
    ) as client:
        listed = {tool.name: tool for tool in (await client.list_tools()).tools}
        for call in calls:
            assert set(call["arguments"]) <= set(listed[call["tool"]].input_schema["properties"])
            call["arguments"]["image"]["path"] = str(tmp_path.resolve() / "car_park.jpg")
            result = await client.call_tool(call["tool"], call["arguments"])
            assert not result.is_error, text_of(result)
        named = set(re.findall(r"`(view_image|estimate_gsd|measure_\w+)`", TEXT))
    assert named == set(listed)
