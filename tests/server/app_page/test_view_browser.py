"""``vehanchor view`` in a real browser: a person, a folder, and no agent."""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from tests.needs import needed_module
from tests.sam_models import SamFiles
from tests.server.app_page.conftest import PATIENCE_MS
from tests.server.app_page.viewing import viewing
from tests.server.conftest import POOL_BOX, paint_scene, with_pool, write_image
from vehanchor_server.settings import Settings
from vehanchor_server.transport.viewer import Address

pytestmark = pytest.mark.browser

SIZE = (2000, 1600)  # larger than the picture that comes with a result


@pytest.fixture(scope="module")
def address(
    detector_path: Path, segmenter_paths: SamFiles, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Address]:
    folder = tmp_path_factory.mktemp("photographs").resolve()
    write_image(folder / "pool.png", with_pool(paint_scene(640, 512)))
    write_image(folder / "large.png", cv2.resize(paint_scene(1000, 800), SIZE))
    (folder / "broken.png").write_bytes(b"no image")
    settings = Settings(
        roots=(folder,), detector=str(detector_path), segmenter=segmenter_paths, threads=1, isolation="in-process"
    )
    with viewing(settings, tmp_path_factory.mktemp("dropped").resolve()) as found:
        yield found


@pytest.fixture
def page(chromium: Any, address: Address) -> Iterator[Any]:
    page = chromium.new_page(viewport={"width": 1280, "height": 900})
    page.set_default_timeout(PATIENCE_MS)
    complaints: list[str] = []
    requested: list[str] = []
    page.on("console", lambda message: complaints.append(message.text))
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.on("request", lambda request: requested.append(request.url))
    page.goto(address.url())
    page.get_by_role("button", name="large.png").wait_for()
    yield page
    assert all(url.startswith((address.url(), "data:", "blob:")) for url in requested)
    assert complaints == []
    page.close()


def says(page: Any, selector: str, text: str | re.Pattern[str]) -> None:
    from playwright.sync_api import expect

    expect(page.locator(selector)).to_have_text(text, timeout=PATIENCE_MS)


def press(page: Any, name: str) -> None:
    page.get_by_role("button", name=name, exact=True).click()


def drag(page: Any, size: tuple[int, int], start: tuple[float, float], end: tuple[float, float]) -> None:
    sheet = page.locator(".sheet").bounding_box()
    per_pixel = sheet["width"] / size[0]
    page.mouse.move(sheet["x"] + start[0] * per_pixel, sheet["y"] + start[1] * per_pixel)
    page.mouse.down()
    page.mouse.move(sheet["x"] + end[0] * per_pixel, sheet["y"] + end[1] * per_pixel, steps=3)
    page.mouse.up()


def test_a_person_measures_a_distance_and_an_area_and_takes_them_away(page: Any, tmp_path: Path) -> None:
    says(page, "#count", "3 photographs")
    press(page, "pool.png")
    says(page, "#status", "Safe to use")
    page.locator(".picture").scroll_into_view_if_needed()
    press(page, "Distance")
    drag(page, (640, 512), (100, 300), (300, 300))
    says(page, "ol.measured .number", re.compile(r"^[\d.,]+ m$"))
    press(page, "Area")
    box = POOL_BOX
    drag(page, (640, 512), (box["x_min"], box["y_min"]), (box["x_max"], box["y_max"]))
    says(page, "ol.measured li:last-child .number", re.compile(r"^[\d.,]+ m²$"))
    saved = {name: save(page, name, tmp_path) for name in ("Record", "GeoJSON", "Picture")}
    record = json.loads(saved["Record"].read_text())
    distance, area = record["measured"]
    assert distance["length_px"] == pytest.approx(200, abs=3)
    assert distance["distance_m"] == pytest.approx(distance["length_px"] * record["estimate"]["gsd_m_per_px"])
    kinds = [each["properties"]["kind"] for each in json.loads(saved["GeoJSON"].read_text())["features"]]
    assert kinds == ["vehicle"] * 24 + ["distance", "area"]
    assert saved["Picture"].name == "pool.scale.png"
    picture = cv2.imread(str(saved["Picture"]))
    assert picture is not None
    assert picture.shape[1] == 1280
    for blue_green_red in ((0xE9, 0xB4, 0x56), (0x42, 0xE4, 0xF0)):  # vehicles, and what was measured
        assert (picture == np.array(blue_green_red, np.uint8)).all(axis=2).any()
    assert area["area_m2"] > 0


def test_a_tool_taken_while_something_is_measured_stays_taken(page: Any) -> None:
    press(page, "pool.png")
    says(page, "#status", "Safe to use")
    page.locator(".picture").scroll_into_view_if_needed()
    held: list[Any] = []
    page.route(
        "**", lambda route: held.append(route) if "measure_" in (route.request.post_data or "") else route.fallback()
    )
    press(page, "Distance")
    drag(page, (640, 512), (100, 300), (300, 300))
    press(page, "Area")
    while not held:
        page.wait_for_timeout(10)
    held.pop().continue_()
    says(page, "ol.measured li .number", re.compile(r"^[\d.,]+ m$"))
    assert page.get_by_role("button", name="Area", exact=True).get_attribute("aria-pressed") == "true"
    assert page.get_by_role("button", name="Distance", exact=True).get_attribute("aria-pressed") == "false"
    page.unroute("**")


def save(page: Any, name: str, folder: Path) -> Path:
    with page.expect_download() as download:
        press(page, name)
    path = folder / str(download.value.suggested_filename)
    download.value.save_as(path)
    return path


def test_a_dropped_photograph_is_measured_and_one_that_cannot_be_read_says_why(page: Any, tmp_path: Path) -> None:
    press(page, "broken.png")
    says(page, "#status", "No result")
    says(page, "#sentence", re.compile("^image_undecodable: "))
    bytes_of = [*write_image(tmp_path / "new.png", paint_scene(640, 512)).read_bytes()]
    handle = page.evaluate_handle(
        "(bytes) => { const held = new DataTransfer();"
        "held.items.add(new File([new Uint8Array(bytes)], 'dropped one.png')); return held; }",
        bytes_of,
    )
    page.dispatch_event("body", "dragover", {"dataTransfer": handle})
    assert "dropping" in page.locator("body").get_attribute("class")
    page.dispatch_event("body", "drop", {"dataTransfer": handle})
    says(page, "#photographs li:first-child", "dropped one.png")
    says(page, "#status", "Safe to use")
    assert "dropping" not in page.locator("body").get_attribute("class")


def test_what_is_seen_closely_comes_in_all_its_pixels(page: Any) -> None:
    press(page, "large.png")
    page.locator(".frame").wait_for()
    assert page.locator(".part").is_hidden()
    for _ in range(5):
        press(page, "Zoom in")
    part = page.locator(".part")
    part.wait_for()
    shown = part.evaluate("(part) => [part.naturalWidth, parseFloat(part.style.width)]")
    assert shown[0] > 1.3 * 1568 * shown[1] / 100  # of the image's share, more pixels than the whole picture has there
    press(page, "Show all")
    part.wait_for(state="hidden")


def test_a_photograph_is_chosen_at_once(page: Any) -> None:
    page.locator("#photographs button[aria-current=true]").wait_for()
    assert page.locator("#photographs button").first.get_attribute("aria-current") == "true"


def test_photographs_have_thumbnails_before_they_are_measured(page: Any) -> None:
    for name in ("large.png", "pool.png"):
        page.locator("#photographs button", has_text=name).first.locator(
            ".mark:not([class*=ok]) + .thumbnail img"
        ).wait_for()
    assert page.locator("#photographs button", has_text="broken.png").locator("img").count() == 0


def test_corrected_vehicles_are_measured_and_stay_with_their_photograph(page: Any) -> None:
    press(page, "pool.png")
    says(page, "#status", "Safe to use")
    numbers = page.locator(".drawn .number")
    assert sorted(map(int, numbers.all_text_contents())) == list(range(1, 25))
    assert float(numbers.first.evaluate("(text) => getComputedStyle(text).opacity")) == 1, "33 px long"
    press(page, "Boxes")
    assert not numbers.first.is_visible()
    press(page, "Boxes")
    press(page, "Drop")
    first = numbers.first.bounding_box()
    page.mouse.click(first["x"] + first["width"] / 2, first["y"] + first["height"] / 2)
    says(page, ".picture [role=status]", "Vehicle 1 dropped.")
    press(page, "Measure again")
    says(page, "#sentence", re.compile(r"Vehicles corrected by hand: 1 dropped\."))
    press(page, "large.png")
    says(page, "#sentence", re.compile(r"^No ruler was found(?!.*known_lengths)"))
    press(page, "pool.png")
    says(page, "#sentence", re.compile(r"Vehicles corrected by hand: 1 dropped\."))
    press(page, "Take all back")
    press(page, "Measure again")
    says(page, "#sentence", re.compile(r"^(?!.*by hand).*safe to use"))


def test_all_photographs_are_measured_into_a_table(page: Any, tmp_path: Path) -> None:
    press(page, "Measure all")
    says(page, "#sentence", re.compile(r"^\d photographs: \d with a usable scale\.$"))
    assert "not an image" in page.locator(".overview tr", has_text="broken.png").inner_text()
    for name in ("large.png", "pool.png"):
        assert page.locator("#photographs button", has_text=name).first.locator("img").count() == 1
    with page.expect_download() as saving:
        press(page, "Save table")
    saving.value.save_as(tmp_path / "scales.csv")
    with (tmp_path / "scales.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    found = {Path(row["file"]).name: row["status"] for row in rows}
    assert (found["broken.png"], found["pool.png"], "large.png" in found) == ("failed", "ok", True)
    assert all(float(row["gsd_m_per_px"]) > 0 for row in rows if row["status"] == "ok")
    usable = sum(row["status"] == "ok" for row in rows)
    assert page.locator("#sentence").inner_text() == f"{len(rows)} photographs: {usable} with a usable scale."
    page.locator(".overview").get_by_role("button", name="pool.png").first.click()
    says(page, "#subject", "metric scale")
    assert page.locator(".overview").count() == 0


@pytest.mark.parametrize("theme", ["light", "dark"])
@pytest.mark.parametrize("width", [400, 1280, 1920])
def test_axe_finds_nothing_in_any_state(page: Any, width: int, theme: str) -> None:
    axe = needed_module("axe_playwright_python.sync_playwright", "pip install -e '.[browser]'").Axe()
    page.emulate_media(color_scheme=theme)
    page.set_viewport_size({"width": width, "height": 800})

    def check() -> None:
        found = axe.run(page).response["violations"]
        assert [(each["id"], [node["html"] for node in each["nodes"]]) for each in found] == []
        assert page.evaluate("document.documentElement.scrollWidth") <= width

    press(page, "pool.png")
    says(page, "#status", "Safe to use")
    check()
    frame = page.locator(".frame")
    for tool in ("Drop", "Add"):
        press(page, tool)
        for key in ("ArrowRight", "Enter"):
            frame.press(key)
    check()
    press(page, "Draw a known length")
    for key in ("Enter", *["ArrowRight"] * 5, "Enter"):
        frame.press(key)
    page.get_by_label("What the line measures").wait_for()
    check()
    press(page, "broken.png")
    says(page, "#status", "No result")
    check()
    press(page, "Measure all")
    says(page, "#sentence", re.compile("with a usable scale"))
    check()
