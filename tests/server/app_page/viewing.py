"""``vehanchor view`` on a port of this machine during a test, and a person in front of a page."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from tests.needs import needed_module
from tests.server.conversation import listening, serving
from vehanchor_server.settings import Settings
from vehanchor_server.transport.viewer import Address, create_viewer

PATIENCE_MS = 60_000
WIDTH_PX = 640  # of the images of these tests in which people draw
Place = tuple[float, float]


@contextlib.contextmanager
def viewing(settings: Settings, dropped: Path) -> Iterator[Address]:
    """The page's address; photographs that are dropped go to a folder of the test."""
    dropped.mkdir(exist_ok=True)
    with listening() as listener:
        address = Address(listener.getsockname()[1])
        with serving(
            create_viewer(replace(settings, roots=(*settings.roots, dropped)), address, dropped),
            listener,
        ):
            yield address


class Person:
    """Somebody who looks at a page in a browser's tab, or in a frame of it."""

    def __init__(self, tab: Any, page: Any) -> None:
        self.tab = tab
        self.page = page
        self.requested: list[str] = []
        self.complaints: list[str] = []
        tab.set_default_timeout(PATIENCE_MS)
        tab.on("console", lambda message: self.complaints.append(message.text))
        tab.on("pageerror", lambda error: self.complaints.append(str(error)))
        tab.on("request", lambda request: self.requested.append(request.url))

    def leave(self, *allowed: str) -> None:
        """Close the tab, which has complained of nothing and asked for nothing from elsewhere."""
        assert all(url.startswith(allowed) for url in self.requested), self.requested
        assert self.complaints == []
        self.tab.close()

    def reads(self, selector: str, text: str | re.Pattern[str]) -> None:
        from playwright.sync_api import expect

        expect(self.page.locator(selector)).to_have_text(text, timeout=PATIENCE_MS)

    def presses(self, *names: str) -> None:
        for name in names:
            self.page.get_by_role("button", name=name, exact=True).click()

    def types(self, *keys: str) -> None:
        for key in keys:
            self.tab.keyboard.press(key)

    def drags(self, start: Place, end: Place) -> None:
        """Drag between two points of an image, or click a point that is both."""
        self.tab.mouse.move(*self._on_screen(start))
        self.tab.mouse.down()
        if end != start:
            self.tab.mouse.move(*self._on_screen(end), steps=3)
        self.tab.mouse.up()

    def _on_screen(self, point: Place) -> Place:
        sheet = self.page.locator(".sheet").bounding_box()
        scale = sheet["width"] / WIDTH_PX
        return sheet["x"] + scale * point[0], sheet["y"] + scale * point[1]

    def clicks(self, *places: Place) -> None:
        for place in places:
            self.drags(place, place)

    def runs(self, script: str) -> Any:
        """JavaScript in the page."""
        return self.tab.frames[-1].evaluate(script)

    def finds_no_fault(self, width: int) -> None:
        """By axe, nor a page wider than the window, nor words that are cut off."""
        axe = needed_module(
            "axe_playwright_python.sync_playwright", "pip install -e '.[browser]'"
        ).Axe()
        violations = axe.run(self.tab.frames[-1]).response["violations"]
        assert [
            (violation["id"], [node["html"] for node in violation["nodes"]])
            for violation in violations
        ] == []
        assert self.runs("document.documentElement.scrollWidth") <= width
        assert self.runs(_CUT_OFF) == []


_CUT_OFF = """[...document.querySelectorAll("section, section *, dl *")]
  .filter((element) => element instanceof HTMLElement && element.clientWidth)
  .filter((element) => element.scrollWidth > element.clientWidth + 1)
  .map((element) => element.outerHTML.slice(0, 80))"""
