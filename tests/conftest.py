from __future__ import annotations

import os
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent


@pytest.fixture(scope="session")
def real_data() -> Path:
    """The folder of real images; a test that asks for it is skipped where there is none."""
    folder = Path(os.environ.get("VEHANCHOR_DATA", ROOT.parent / "shared" / "data"))
    if not (folder / "gsd" / "table.csv").is_file():
        pytest.skip(f"no real images at {folder}; set VEHANCHOR_DATA")
    return folder
