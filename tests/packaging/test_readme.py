"""A shell runs the README's commands as written, in a clone and an empty environment."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Callable

import pytest

from tests.conftest import ROOT
from tests.docs.documents import blocks
from tests.needs import needed_program

# The development tools are large.
pytestmark = [pytest.mark.packaging, pytest.mark.timeout(1800)]

_CONSOLE = [block for block in blocks(ROOT / "README.md") if block.language == "console"]
Shell = Callable[[str], "subprocess.CompletedProcess[str]"]


@pytest.fixture(scope="module")
def shell(tmp_path_factory: pytest.TempPathFactory) -> Shell:
    """Return a function that runs a line in the clone; pytest only collects there."""
    place = tmp_path_factory.mktemp("readme")
    clone = place / "clone"
    subprocess.run(["git", "clone", "--quiet", "--no-local", str(ROOT), str(clone)], check=True)
    # Changes that are not committed yet.
    for name in _changed():
        if (ROOT / name).is_file():
            (clone / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, clone / name)
    subprocess.run([sys.executable, "-m", "venv", str(place / "env")], check=True)
    variables = dict(os.environ)
    variables.pop("PYTHONPATH", None)
    variables.pop("VIRTUAL_ENV", None)
    variables["PATH"] = os.pathsep.join((str(place / "env/bin"), os.environ["PATH"]))
    variables["PYTEST_ADDOPTS"] = "--collect-only --quiet -n 0"
    variables["PIP_QUIET"] = "1"

    def run(line: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            line, shell=True, cwd=clone, env=variables, capture_output=True, text=True
        )

    return run


def _changed() -> list[str]:
    command = ["git", "ls-files", "--modified", "--others", "--exclude-standard"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    return done.stdout.splitlines()


def _lines(reason: str | None) -> list[str]:
    """Return the commands of all blocks with a reason."""
    texts = [block.text for block in _CONSOLE if block.reason == reason]
    return [line[2:] for text in texts for line in text.splitlines()]


def test_each_line_works_as_written(shell: Shell) -> None:
    lines = _lines(None)
    assert lines[0].startswith("pip install . && vehanchor ")
    assert lines[1] == "pip install -e '.[dev]' && pytest"
    for line in lines:
        done = shell(line)
        assert done.returncode == 0, f"{line}: {done.stdout[-500:]} {done.stderr[-2000:]}"


def test_the_page_opens_as_written(shell: Shell) -> None:
    (line,) = _lines("runs until it is stopped")
    shell("pip install .")
    done = shell(f"timeout 30 {line} --no-browser")
    assert "http://127.0.0.1:" in done.stdout + done.stderr


@pytest.mark.parametrize(("program", "package"), [("pipx", "pipx"), ("uvx", "uv")])
def test_the_command_runs_without_an_installation(shell: Shell, program: str, package: str) -> None:
    needed_program(program, f"pip install {package}")
    (line,) = [line for line in _lines("needs pipx and uvx") if line.startswith(f"{program} ")]
    done = shell(line)
    assert done.returncode == 0, done.stderr[-2000:]
    assert "m/px" in done.stdout
