"""Python environments beside this one, for what cannot or should not be installed with us: agents' SDKs, mcp 1.x.

Each is made once from a requirements file, by uv, and kept in ``.venv-environments/`` until the file changes.
"""

from __future__ import annotations

import hashlib
import shutil
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence

_FOLDER = Path(__file__).parent.parent / ".venv-environments"


def environment(*requirements: Path, packages: Sequence[str] = ()) -> Path:
    """The Python of an environment that holds what the files and ``packages`` ask for.

    Args:
        requirements: requirements files.
        packages: further requirements, such as ``mcp<2``.
    """
    texts = [path.read_text(encoding="utf-8") for path in requirements]
    asked = "\n".join([sys.version, *texts, *packages])
    folder = _FOLDER / hashlib.sha256(asked.encode()).hexdigest()[:16]
    python = folder / "bin" / "python"
    complete = folder / "complete"
    if not complete.exists():
        shutil.rmtree(folder, ignore_errors=True)
        uv = [sys.executable, "-m", "uv", "--quiet"]
        subprocess.run([*uv, "venv", "--python", sys.executable, str(folder)], check=True)
        files = [part for path in requirements for part in ("--requirement", str(path))]
        subprocess.run([*uv, "pip", "install", "--python", str(python), *files, *packages], check=True)
        complete.touch()
    return python
