"""The harness that plays a lost worker notices what a worker does."""

from __future__ import annotations

import platform
import subprocess
import sys
from pathlib import Path

import pytest

CHMOD, TRUNCATE, OPEN, KILL = 90, 76, 2, 62  # on x86_64
_RUN = """
from research.benchmarks import server_lost_worker as harness
from vehanchor_server.sandbox.confinement import Confinement
{before}
found = harness.try_system_calls([{numbers}])
print(found["effects outside"])
"""
_FREE = "harness.confine = lambda readable: Confinement(landlock=1, seccomp=True)"

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(sys.platform != "linux" or platform.machine() != "x86_64", reason="numbers of Linux on x86_64"),
]


def effects(before: str, *numbers: int) -> str:
    """What the harness finds, in a process of its own: it takes all signals."""
    code = _RUN.format(before=before, numbers=", ".join(map(str, numbers)))
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.strip()


def test_an_effect_outside_is_found_without_the_border() -> None:
    found = effects(_FREE, CHMOD, TRUNCATE, KILL)
    for part in ("90 with path: ", "76 with path: ", "62 with process: signals"):
        assert part in found
    assert "file image.png" in found


def test_behind_the_border_there_is_none(tmp_path: Path) -> None:
    held = subprocess.run(
        [sys.executable, "-c", "from vehanchor_server.sandbox.confinement import confine; print(confine([]).lacks)"],
        capture_output=True,
        text=True,
        check=True,
        cwd=tmp_path,
    ).stdout.strip()
    if held:
        pytest.skip(held)
    assert effects("", CHMOD, TRUNCATE, OPEN, KILL) == "0"
