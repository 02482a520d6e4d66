"""The README's commands, run by a shell as they stand, in a clone and an environment without anything else."""

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

pytestmark = [pytest.mark.packaging, pytest.mark.timeout(1800)]  # the development tools are 1.4 GB

_CONSOLE = [block for block in blocks(ROOT / "README.md") if block.language == "console"]
Shell = Callable[[str], "subprocess.CompletedProcess[str]"]


@pytest.fixture(scope="module")
def shell(tmp_path_factory: pytest.TempPathFactory) -> Shell:
    """Runs a line in the clone; pytest only collects there."""
    place = tmp_path_factory.mktemp("readme")
    subprocess.run(
        ["git", "clone", "--quiet", "--no-local", str(ROOT), str(place / "clone")], check=True
    )
    for name in _changed():  # not committed yet
        if (ROOT / name).is_file():
            (place / "clone" / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, place / "clone" / name)
    subprocess.run([sys.executable, "-m", "venv", str(place / "env")], check=True)
    path = os.pathsep.join((str(place / "env/bin"), os.environ["PATH"]))
    alone = {
        name: value
        for name, value in os.environ.items()
        if name not in ("PYTHONPATH", "VIRTUAL_ENV")
    }
    alone |= {"PATH": path, "PYTEST_ADDOPTS": "--collect-only --quiet -n 0", "PIP_QUIET": "1"}

    def run(line: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            line, shell=True, cwd=place / "clone", env=alone, capture_output=True, text=True
        )

    return run


def _changed() -> list[str]:
    command = ["git", "ls-files", "--modified", "--others", "--exclude-standard"]
    return subprocess.run(
        command, cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout.splitlines()


def _lines(reason: str | None) -> list[str]:
    return [
        line[2:] for block in _CONSOLE if block.reason == reason for line in block.text.splitlines()
    ]


def test_each_line_works_as_it_stands(shell: Shell) -> None:
    lines = _lines(None)
    assert lines[0].startswith("pip install . && vehanchor ")
    assert lines[1] == "pip install -e '.[dev]' && pytest"
    for line in lines:
        done = shell(line)
        assert done.returncode == 0, f"{line}: {done.stdout[-500:]} {done.stderr[-2000:]}"


def test_the_page_opens_as_it_stands(shell: Shell) -> None:
    (line,) = _lines("runs until it is stopped")
    shell("pip install .")
    done = shell(f"timeout 30 {line} --no-browser")
    assert "http://127.0.0.1:" in done.stdout + done.stderr


@pytest.mark.parametrize("program", ["pipx", "uvx"])
def test_it_runs_without_an_installation(shell: Shell, program: str) -> None:
    needed_program(
        program, f"pip install {program.removesuffix('x') if program == 'uvx' else program}"
    )
    (line,) = [line for line in _lines("needs pipx and uvx") if line.startswith(f"{program} ")]
    done = shell(line)
    assert done.returncode == 0, done.stderr[-2000:]
    assert "m/px" in done.stdout
