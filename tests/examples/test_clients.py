"""The entries for clients are what their formats ask for, start our server, and name its version."""

from __future__ import annotations

import json
import os
import re
import shutil
import struct
import subprocess
import sys
import tomllib
from importlib.metadata import version
from pathlib import Path
from typing import Any

import pytest
from mcp import Client, StdioServerParameters

from tests.conftest import ROOT

CLIENTS = ROOT / "examples" / "clients"
BUNDLE = CLIENTS / "mcpb"
TOOLS = {"estimate_gsd", "measure_area", "measure_distance", "view_image"}
_MCPB = "@anthropic-ai/mcpb@2.1.2"


def _read(path: Path) -> dict[str, Any]:
    document: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return document


@pytest.fixture
def anyio_backend() -> str:
    return "asyncio"


ENTRIES = {
    "claude_code.mcp.json": "mcpServers",
    "claude_desktop_config.json": "mcpServers",
    "vscode.mcp.json": "servers",
    "cursor.mcp.json": "mcpServers",
}


@pytest.mark.slow
@pytest.mark.anyio
async def test_each_entry_is_the_same_command_which_starts_the_server_with_all_tools(
    tmp_path: Path,
) -> None:
    commands = set()
    for entry, key in ENTRIES.items():
        server = _read(CLIENTS / entry)[key]["vehanchor"]
        assert server.get("type", "stdio") == "stdio"
        command = server["command"].replace(
            "/absolute/path/to/bin", str(Path(sys.executable).parent)
        )
        # What the client fills in: its own variables, and the paths that the README says to
        # replace.
        images = re.sub(
            r"\$\{workspaceFolder\}|\$\{\w+:-/absolute/path/to/images\}",
            str(tmp_path),
            server["args"][-1],
        )
        commands.add(
            (
                Path(command).name,
                *server["args"][:-1],
                images.replace("/absolute/path/to/images", str(tmp_path)),
            )
        )
    ((command, *arguments),) = commands
    path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    async with Client(
        StdioServerParameters(command=command, args=arguments, env={"PATH": path})
    ) as client:
        assert {tool.name for tool in (await client.list_tools()).tools} == TOOLS


def test_every_version_is_the_packages() -> None:
    package = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"][
        "version"
    ]
    registry = _read(CLIENTS / "server.json")
    bundle = tomllib.loads((BUNDLE / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert version("vehanchor") == package
    assert (registry["version"], [entry["version"] for entry in registry["packages"]]) == (
        package,
        [package],
    )
    assert _read(BUNDLE / "manifest.json")["version"] == package
    assert (bundle["version"], bundle["dependencies"]) == (package, [f"vehanchor=={package}"])


def test_the_registrys_file_asks_for_a_host_a_secret_token_and_a_folder() -> None:
    server = _read(CLIENTS / "server.json")
    (package,) = server["packages"]
    (remote,) = server["remotes"]
    assert (package["registryType"], package["identifier"], package["transport"]["type"]) == (
        "pypi",
        "vehanchor",
        "stdio",
    )
    (header,) = remote["headers"]
    assert (remote["url"], header["value"]) == ("https://{host}/mcp", "Bearer {token}")
    assert (set(remote["variables"]), header["variables"]["token"]["isSecret"]) == ({"host"}, True)
    serve, root = package["packageArguments"]
    assert (serve["value"], root["name"], root["isRequired"]) == ("serve", "--root", True)


def test_the_bundle_names_the_servers_tools() -> None:
    manifest = _read(BUNDLE / "manifest.json")
    assert {tool["name"] for tool in manifest["tools"]} == TOOLS
    assert (BUNDLE / manifest["server"]["entry_point"]).is_file()
    assert manifest["server"]["mcp_config"]["args"][-1] == "${user_config.images}"
    assert "images" in manifest["user_config"]
    registry = _read(CLIENTS / "server.json")
    assert manifest["description"] == registry["description"]
    icon = (BUNDLE / manifest["icon"]).read_bytes()
    assert icon.startswith(b"\x89PNG")
    assert struct.unpack(">II", icon[16:24]) == (512, 512), "what the bundle's format recommends"


@pytest.mark.slow
@pytest.mark.anyio
async def test_the_bundles_entry_point_serves_both_tools(tmp_path: Path) -> None:
    """As the host runs it, but in this environment: the one it would make needs the package to be published."""
    manifest = _read(BUNDLE / "manifest.json")
    arguments = manifest["server"]["mcp_config"]["args"]
    assert arguments[:3] == ["run", "--directory", "${__dirname}"]
    filled = [part.replace("${user_config.images}", str(tmp_path)) for part in arguments[3:]]
    async with Client(
        StdioServerParameters(command=sys.executable, args=filled, cwd=BUNDLE)
    ) as client:
        assert {tool.name for tool in (await client.list_tools()).tools} == TOOLS


@pytest.mark.frameworks
@pytest.mark.skipif(shutil.which("npx") is None, reason="the official tool runs on Node")
def test_the_official_tool_accepts_and_packs_the_bundle(tmp_path: Path) -> None:
    mcpb = ["npx", "--yes", _MCPB]
    validated = subprocess.run(
        [*mcpb, "validate", str(BUNDLE / "manifest.json")],
        capture_output=True,
        text=True,
        check=False,
    )
    assert validated.returncode == 0, validated.stdout + validated.stderr
    bundle = tmp_path / "vehanchor.mcpb"
    packed = subprocess.run(
        [*mcpb, "pack", str(BUNDLE), str(bundle)], capture_output=True, text=True, check=False
    )
    assert packed.returncode == 0, packed.stdout + packed.stderr
    assert 0 < bundle.stat().st_size < 100_000
