from __future__ import annotations

import os
from pathlib import Path

import hypothesis
import pytest

ROOT = Path(__file__).parent.parent

# What a test means does not depend on how busy the machine is; the timeout of pytest catches what hangs.
hypothesis.settings.register_profile("vehanchor", deadline=None)
hypothesis.settings.load_profile("vehanchor")

# Typer colours its help for GitHub's log where it finds this; the tests read plain text.
os.environ.pop("GITHUB_ACTIONS", None)


@pytest.fixture(scope="session")
def real_data() -> Path:
    """The folder of real images; a test that asks for it is skipped where there is none."""
    folder = Path(os.environ.get("VEHANCHOR_DATA", ROOT.parent / "shared" / "data"))
    if not (folder / "gsd" / "table.csv").is_file():
        pytest.skip(f"no real images at {folder}; set VEHANCHOR_DATA")
    return folder
