"""One Chromium for all tests of the page."""

from __future__ import annotations

import os
from collections.abc import Iterator
from typing import Any

import pytest

from tests.needs import needed_module, needed_program
from tests.server.app_page.viewing import PATIENCE_MS


@pytest.fixture(scope="package")
def chromium() -> Iterator[Any]:
    names = (os.environ.get("CHROMIUM"), "chromium", "google-chrome")
    path = needed_program(
        "chromium", "apt-get install chromium, or name one by CHROMIUM", candidates=names
    )
    api = needed_module("playwright.sync_api", "pip install -e '.[browser]'")
    with api.sync_playwright() as playwright:
        # A sandboxed frame in a process of its own is missing from screenshots.
        arguments = ["--no-sandbox", "--disable-features=IsolateSandboxedIframes"]
        browser = playwright.chromium.launch(
            executable_path=path, args=arguments, timeout=2 * PATIENCE_MS
        )
        yield browser
        browser.close()
