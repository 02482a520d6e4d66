"""The entries for clients follow their formats, start our server, and name its version."""

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


def _server_of(entry: str) -> dict[str, Any]:
    server: dict[str, Any] = _read(CLIENTS / entry)[ENTRIES[entry]]["vehanchor"]
    return server


def _filled_in(server: dict[str, Any], images: Path) -> list[str]:
    """Fill a server's command in: with the client's variables, and the paths of the README."""
    command = server["command"].replace("/absolute/path/to/bin", str(Path(sys.executable).parent))
    *arguments, root = server["args"]
    variables = r"\$\{workspaceFolder\}|\$\{\w+:-/absolute/path/to/images\}"
    root = re.sub(variables, str(images), root)
    root = root.replace("/absolute/path/to/images", str(images))
    return [Path(command).name, *arguments, root]


@pytest.mark.parametrize("entry", ENTRIES)
def test_an_entry_starts_the_server_over_stdio(entry: str) -> None:
    assert _server_of(entry).get("type", "stdio") == "stdio"


def test_all_entries_are_the_same_command(tmp_path: Path) -> None:
    commands = {tuple(_filled_in(_server_of(entry), tmp_path)) for entry in ENTRIES}
    assert len(commands) == 1


@pytest.mark.slow
@pytest.mark.anyio
async def test_the_command_starts_the_server_with_all_tools(tmp_path: Path) -> None:
    command, *arguments = _filled_in(_server_of("claude_code.mcp.json"), tmp_path)
    path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    server = StdioServerParameters(command=command, args=arguments, env={"PATH": path})
    async with Client(server) as client:
        assert {tool.name for tool in (await client.list_tools()).tools} == TOOLS


def _read_project(path: Path) -> dict[str, Any]:
    project: dict[str, Any] = tomllib.loads(path.read_text(encoding="utf-8"))["project"]
    return project


@pytest.fixture(scope="module")
def package_version() -> str:
    package: str = _read_project(ROOT / "pyproject.toml")["version"]
    return package


def test_the_installed_version_is_the_packages(package_version: str) -> None:
    assert version("vehanchor") == package_version


def test_the_registry_has_the_packages_version(package_version: str) -> None:
    registry = _read(CLIENTS / "server.json")
    assert registry["version"] == package_version
    assert [entry["version"] for entry in registry["packages"]] == [package_version]


def test_the_bundle_has_the_packages_version(package_version: str) -> None:
    bundle = _read_project(BUNDLE / "pyproject.toml")
    assert _read(BUNDLE / "manifest.json")["version"] == package_version
    assert bundle["version"] == package_version
    assert bundle["dependencies"] == [f"vehanchor=={package_version}"]


def test_the_registry_names_the_package() -> None:
    (package,) = _read(CLIENTS / "server.json")["packages"]
    assert (package["registryType"], package["identifier"]) == ("pypi", "vehanchor")
    assert package["transport"]["type"] == "stdio"


def test_the_registry_asks_for_a_folder() -> None:
    (package,) = _read(CLIENTS / "server.json")["packages"]
    serve, root = package["packageArguments"]
    assert (serve["value"], root["name"], root["isRequired"]) == ("serve", "--root", True)


def test_the_registry_asks_for_a_host() -> None:
    (remote,) = _read(CLIENTS / "server.json")["remotes"]
    assert remote["url"] == "https://{host}/mcp"
    assert set(remote["variables"]) == {"host"}


def test_the_registry_asks_for_a_secret_token() -> None:
    (remote,) = _read(CLIENTS / "server.json")["remotes"]
    (header,) = remote["headers"]
    assert header["value"] == "Bearer {token}"
    assert header["variables"]["token"]["isSecret"] is True


@pytest.fixture(scope="module")
def manifest() -> dict[str, Any]:
    return _read(BUNDLE / "manifest.json")


def test_the_bundle_names_the_servers_tools(manifest: dict[str, Any]) -> None:
    assert {tool["name"] for tool in manifest["tools"]} == TOOLS


def test_the_bundle_contains_its_entry_point(manifest: dict[str, Any]) -> None:
    assert (BUNDLE / manifest["server"]["entry_point"]).is_file()


def test_the_bundle_asks_for_a_folder(manifest: dict[str, Any]) -> None:
    assert manifest["server"]["mcp_config"]["args"][-1] == "${user_config.images}"
    assert "images" in manifest["user_config"]


def test_the_bundle_has_the_registrys_description(manifest: dict[str, Any]) -> None:
    assert manifest["description"] == _read(CLIENTS / "server.json")["description"]


def test_the_icon_has_the_size_that_bundles_need(manifest: dict[str, Any]) -> None:
    icon = (BUNDLE / manifest["icon"]).read_bytes()
    assert icon.startswith(b"\x89PNG")
    assert struct.unpack(">II", icon[16:24]) == (512, 512)


@pytest.mark.slow
@pytest.mark.anyio
async def test_the_bundles_entry_point_serves_all_tools(
    manifest: dict[str, Any], tmp_path: Path
) -> None:
    # A host would make an environment for it, from the published package.
    arguments = manifest["server"]["mcp_config"]["args"]
    assert arguments[:3] == ["run", "--directory", "${__dirname}"]
    filled = [part.replace("${user_config.images}", str(tmp_path)) for part in arguments[3:]]
    server = StdioServerParameters(command=sys.executable, args=filled, cwd=BUNDLE)
    async with Client(server) as client:
        assert {tool.name for tool in (await client.list_tools()).tools} == TOOLS


@pytest.mark.frameworks
@pytest.mark.skipif(shutil.which("npx") is None, reason="the official tool runs on Node")
def test_the_official_tool_packs_the_bundle(tmp_path: Path) -> None:
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
