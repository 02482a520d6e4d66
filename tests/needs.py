"""What a test needs beside us: programs and packages that a developer may lack, and CI may not."""

from __future__ import annotations

import hashlib
import importlib
import os
import shutil
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pytest


def needed_program(name: str, advice: str, *, candidates: Iterable[str | None] = ()) -> str:
    """The path of a program.

    Where there is none, the test is skipped; but it fails where ``CI`` is set, as ``.ci/run`` does,
    unless ``VEHANCHOR_CI_WITHOUT`` names the program (several are divided by blanks).

    Args:
        name: what the program is called, on the PATH and in ``VEHANCHOR_CI_WITHOUT``.
        advice: how to get it.
        candidates: other names and paths that will do; None is passed over. They are tried first.
    """
    path = f"{os.environ.get('PATH', '')}{os.pathsep}/usr/sbin"
    for candidate in (*candidates, name):
        found = candidate and shutil.which(candidate, path=path)
        if found:
            return found
    raise _missing(name, advice)


def needed_module(name: str, advice: str) -> Any:
    """A module, with the same consequences where it is missing."""
    try:
        return importlib.import_module(name)
    except ImportError:
        raise _missing(name.partition(".")[0], advice) from None


def _missing(name: str, advice: str) -> BaseException:
    if not os.environ.get("CI") or name in os.environ.get("VEHANCHOR_CI_WITHOUT", "").split():
        return pytest.skip.Exception(f"no {name} here; {advice}")
    return pytest.fail.Exception(
        f"CI runs this, and there is no {name}: {advice}, or say VEHANCHOR_CI_WITHOUT={name}"
    )


_FOLDER = Path(__file__).parent.parent / ".venv-environments"


def environment(*requirements: Path, dependencies: bool = True) -> Path:
    """The Python of an environment that holds what files of requirements ask for.

    Args:
        *requirements: files of requirements.
        dependencies: also what these packages depend on, without which few can be imported.
    """
    texts = [path.read_text(encoding="utf-8") for path in requirements]
    asked = "\n".join([sys.version, *texts])
    folder = _FOLDER / hashlib.sha256(asked.encode()).hexdigest()[:16]
    python = folder / "bin" / "python"
    complete = folder / "complete"
    if not complete.exists():
        shutil.rmtree(folder, ignore_errors=True)
        uv = [sys.executable, "-m", "uv", "--quiet"]
        subprocess.run([*uv, "venv", "--python", sys.executable, str(folder)], check=True)
        files = [part for path in requirements for part in ("--requirement", str(path))]
        if not dependencies:
            files.append("--no-deps")
        subprocess.run([*uv, "pip", "install", "--python", str(python), *files], check=True)
        complete.touch()
    return python
