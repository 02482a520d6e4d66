"""``vehanchor view`` with a ruler that another package registers."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.docs.track_package import install_track, write_track, write_track_detector
from tests.server.app_page.conftest import PATIENCE_MS

pytestmark = pytest.mark.browser


def test_the_page_lists_an_installed_ruler_by_its_label(chromium: Any, tmp_path: Path) -> None:
    from playwright.sync_api import expect

    photograph = write_track(tmp_path / "photographs" / "track.png")
    command = [sys.executable, "-m", "vehanchor", "view", str(photograph), "--no-browser"]
    detector = write_track_detector(tmp_path / "tracks.onnx")
    environment = install_track(tmp_path / "installed")
    with subprocess.Popen(
        [*command, "--detector", str(detector)], stderr=subprocess.PIPE, text=True, env=environment
    ) as process:
        try:
            assert process.stderr is not None
            address = re.search(r"http://\S+", process.stderr.readline())
            assert address is not None
            page = chromium.new_page()
            page.goto(address[0])
            rulers = page.locator("section.rulers")
            expect(rulers).to_contain_text("Running track", timeout=PATIENCE_MS)
            expect(rulers).to_contain_text("0.88")
            expect(page.locator("#status")).to_have_text("Safe to use")
            page.close()
        finally:
            process.terminate()
