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
from rasterio.transform import Affine

from tests.sam_models import SamFiles
from tests.server.app_page.viewing import Person, viewing
from tests.server.conftest import (
    POOL_BOX,
    paint_scene,
    settings_with_models,
    with_pool,
    write_image,
)
from tests.skill.imagery.files import geotiff, smooth_rgb
from vehanchor.records.columns import COLUMNS
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
    settings = settings_with_models((folder,), detector_path, segmenter_paths)
    with viewing(settings, tmp_path_factory.mktemp("dropped").resolve()) as status_of:
        yield status_of


@pytest.fixture
def person(chromium: Any, address: Address) -> Iterator[Person]:
    tab = chromium.new_page(viewport={"width": 1280, "height": 900})
    person = Person(tab, tab)
    tab.goto(address.url())
    tab.get_by_role("button", name="large.png").wait_for()
    yield person
    person.leave(address.url(), "data:", "blob:")


@pytest.fixture
def surveyor(chromium: Any, detector_path: Path, tmp_path: Path) -> Iterator[Person]:
    """Somebody with two georeferenced photographs of one name: one has cars, of another scale."""
    pictures = {"east": paint_scene(640, 512), "west": smooth_rgb(640, 512)}
    for name, picture in pictures.items():
        (tmp_path / name).mkdir()
        transform = Affine(0.3, 0, 500_000, 0, -0.3, 5_000_000)
        geotiff(tmp_path / name / "map.tif", picture, transform=transform)
    settings = Settings(
        roots=(tmp_path.resolve(),),
        detector=str(detector_path),
        threads=1,
        isolation="in-process",
    )
    with viewing(settings, tmp_path / "dropped") as address:
        tab = chromium.new_page(viewport={"width": 1280, "height": 900})
        person = Person(tab, tab)
        tab.goto(address.url())
        yield person
        person.leave(address.url(), "data:", "blob:")


def choose_pool(person: Person) -> None:
    person.presses("pool.png")
    person.reads("#status", "Safe to use")
    person.page.locator(".picture").scroll_into_view_if_needed()


def saved(person: Person, name: str, folder: Path) -> Path:
    with person.tab.expect_download() as download:
        person.presses(name)
    path = folder / str(download.value.suggested_filename)
    download.value.save_as(path)
    return path


def test_a_person_exports_measurements(person: Person, tmp_path: Path) -> None:
    person.reads("#count", "3 photographs")
    choose_pool(person)
    person.presses("Distance")
    person.drags((100, 300), (300, 300))
    person.reads("ol.measured .number", re.compile(r"^[\d.,]+ m$"))
    person.presses("Area")
    person.drags((POOL_BOX["x_min"], POOL_BOX["y_min"]), (POOL_BOX["x_max"], POOL_BOX["y_max"]))
    person.reads("ol.measured li:last-child .number", re.compile(r"^[\d.,]+ m²$"))
    record = json.loads(saved(person, "Record", tmp_path).read_text())
    layer = json.loads(saved(person, "GeoJSON", tmp_path).read_text())
    distance, area = record["measured"]
    assert distance["length_px"] == pytest.approx(200, abs=3)
    assert distance["distance_m"] == pytest.approx(
        distance["length_px"] * record["estimate"]["gsd_m_per_px"]
    )
    assert area["area_m2"] > 0
    assert [feature["properties"]["kind"] for feature in layer["features"]] == ["vehicle"] * 24 + [
        "distance",
        "area",
    ]
    path = saved(person, "Picture", tmp_path)
    picture = cv2.imread(str(path))
    assert picture is not None
    assert (path.name, picture.shape[1]) == ("pool.scale.png", 1280)
    # vehicles, and what was measured
    for blue_green_red in ((0xE9, 0xB4, 0x56), (0x42, 0xE4, 0xF0)):
        assert (picture == np.array(blue_green_red, np.uint8)).all(axis=2).any()


def test_a_tool_taken_while_something_is_measured_stays_taken(person: Person) -> None:
    choose_pool(person)
    held: list[Any] = []
    person.tab.route(
        "**",
        lambda route: (
            held.append(route)
            if "measure_" in (route.request.post_data or "")
            else route.fallback()
        ),
    )
    person.presses("Distance")
    person.drags((100, 300), (300, 300))
    person.presses("Area")
    while not held:
        person.tab.wait_for_timeout(10)
    held.pop().continue_()
    person.reads("ol.measured li .number", re.compile(r"^[\d.,]+ m$"))
    assert person.page.locator("button[aria-pressed=true]").all_text_contents() == ["Area", "Boxes"]
    person.tab.unroute("**")


def test_a_dropped_photograph_is_measured_or_refused_with_a_reason(
    person: Person, tmp_path: Path
) -> None:
    person.presses("broken.png")
    person.reads("#status", "No result")
    person.reads("#sentence", re.compile("^not an image in one of the formats"))
    handle = person.tab.evaluate_handle(
        "(bytes) => { const held = new DataTransfer();"
        "held.items.add(new File([new Uint8Array(bytes)], 'dropped one.png')); return held; }",
        [*write_image(tmp_path / "new.png", paint_scene(640, 512)).read_bytes()],
    )
    for event, shown in (("dragover", "dropping"), ("drop", "")):
        person.tab.dispatch_event("body", event, {"dataTransfer": handle})
        assert person.page.locator("body").get_attribute("class") == shown
    person.reads("#photographs li:first-child", "dropped one.png")
    person.reads("#status", "Safe to use")


def test_what_is_seen_closely_comes_in_all_its_pixels(person: Person) -> None:
    person.presses("large.png")
    part = person.page.locator(".part")
    part.wait_for(state="hidden")
    person.presses(*["Zoom in"] * 5)
    part.wait_for()
    shown = part.evaluate("(part) => [part.naturalWidth, parseFloat(part.style.width)]")
    # of the image's share, more pixels than the whole picture has there
    assert shown[0] > 1.3 * 1568 * shown[1] / 100
    person.presses("Show all")
    part.wait_for(state="hidden")


def test_the_list_can_be_searched_or_passed_by_one_tab(person: Person) -> None:
    listed = person.page.locator("#photographs button")
    assert listed.first.get_attribute("aria-current") == "true"
    for name in ("large.png", "pool.png"):
        listed.filter(has_text=name).locator(".mark:not([class*=ok]) + .thumbnail img").wait_for()
    assert listed.filter(has_text="broken.png").locator("img").count() == 0
    person.page.get_by_label("Find a photograph").fill("OO")
    person.page.get_by_role("button", name="large.png").wait_for(state="hidden")
    choose_pool(person)
    person.page.get_by_label("Find a photograph").fill("")
    listed.filter(has_text="pool.png").focus()
    person.types("ArrowUp", "ArrowDown")
    assert person.runs("document.activeElement.textContent") == "pool.png"
    person.types("Tab")
    assert person.runs("document.activeElement.textContent") == "Distance"


def test_a_size_is_placed_in_an_outline_by_hand(person: Person, tmp_path: Path) -> None:
    choose_pool(person)
    person.presses("Outline")
    person.clicks((100, 300), (300, 300), (300, 400), (100, 400), (100, 300))
    person.reads("ol.measured .number", re.compile(r"^[\d.,]+ m²$"))
    person.page.get_by_label("Must fit").fill("12,5 x 5")
    person.types("Enter")
    person.reads(
        "ol.measured .fits",
        re.compile(r"^12\.5\s\S\s5\sm fits with probability 0\.9\d, at least \d in rows$"),
    )
    assert person.page.locator(".drawn path.fit").count() == 1
    record = json.loads(saved(person, "Record", tmp_path).read_text())
    layer = json.loads(saved(person, "GeoJSON", tmp_path).read_text())
    [area] = record["measured"]
    assert area["polygon_area_px"] == pytest.approx(200 * 100, rel=0.02)
    assert (area["fit"]["length_m"], area["fit"]["width_m"]) == (12.5, 5)
    assert layer["features"][-1]["properties"]["kind"] == "fit"


def test_a_known_length_says_that_the_tick_is_missing(person: Person) -> None:
    choose_pool(person)
    person.presses("Draw a known length")
    person.drags((100, 300), (300, 300))
    note = person.page.get_by_text("The tick is missing")
    assert note.is_visible()
    person.page.get_by_label("measured by tape, plan or survey").check()
    assert not note.is_visible()


def test_the_search_finds_a_folder(person: Person) -> None:
    folder = "photographs"
    person.page.get_by_label("Find a photograph").fill(folder)
    assert person.page.get_by_role("button", name="pool.png").is_visible()
    person.page.get_by_label("Find a photograph").fill("")


def test_the_files_own_scale_measures_unless_cars_contradict_it(surveyor: Person) -> None:
    scales = {"east/map.tif": "differs from the estimate", "west/map.tif": "by its georeference"}
    for name, note in scales.items():
        surveyor.presses(name)
        says = "^The file's own scale is 0.3 m/px" if note.startswith("differs") else "^No car"
        surveyor.reads("#sentence", re.compile(says))
        surveyor.reads(".readings > div:has-text('own scale')", re.compile(f"0.300m/px{note}$"))
        surveyor.presses("Distance")
        surveyor.drags((100, 300), (300, 300))
        by_file = re.compile("by the file's own scale")
        measured = surveyor.page.locator("ol.measured li")
        measured.wait_for()
        assert bool(by_file.search(measured.inner_text())) == (name == "west/map.tif")


def test_facts_hold_for_all_photographs_corrections_for_one(person: Person) -> None:
    choose_pool(person)
    numbers = person.page.locator(".drawn .number")
    assert sorted(map(int, numbers.all_text_contents())) == list(range(1, 25))
    assert float(numbers.first.evaluate("(text) => getComputedStyle(text).opacity")) == 1, (
        "33 px long"
    )
    person.presses("Boxes")
    assert not numbers.first.is_visible()
    person.presses("Boxes", "Distance")
    person.drags((100, 300), (300, 300))
    person.reads("ol.measured .number", "31.5 m")
    person.presses("Drop")
    first = numbers.first.bounding_box()
    person.tab.mouse.click(first["x"] + first["width"] / 2, first["y"] + first["height"] / 2)
    person.reads(".picture [role=status]", "Vehicle 1 dropped.")
    person.page.get_by_label("Region").select_option("north_america")
    person.presses("Measure with these")
    by_hand = re.compile(r"Vehicles corrected by hand: 1 dropped\.$")
    person.reads("#sentence", by_hand)
    person.reads(".record dd:nth-of-type(3)", re.compile("of the region$"))
    person.reads("ol.measured .number", re.compile("^3[3-5]"))
    person.presses("large.png")
    person.reads("#status", "No metric scale")
    person.page.get_by_label("Region").select_option("")
    person.presses("pool.png")
    person.reads("ol.measured .number", re.compile("^31"))
    person.reads("#sentence", by_hand)


def test_all_photographs_are_measured_into_a_table(person: Person, tmp_path: Path) -> None:
    person.presses("Measure all")
    person.reads("#sentence", re.compile(r"^\d photographs: \d with a usable scale\.$"))
    assert "not an image" in person.page.locator(".overview tr", has_text="broken.png").inner_text()
    with saved(person, "Save table", tmp_path).open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == list(COLUMNS), "as the tables of 'vehanchor batch'"
    status_of = {Path(row["photograph"]).name: row["status"] or "error" for row in rows}
    reasons = person.page.locator(".overview tr", has_text="large.png").inner_text()
    assert "No car was found" in reasons
    assert (status_of["broken.png"], status_of["pool.png"], status_of["large.png"]) == (
        "error",
        "ok",
        "no_scale",
    )
    assert all(float(row["gsd_m_per_px"]) > 0 for row in rows if row["status"] == "ok")
    usable = sum(row["status"] == "ok" for row in rows)
    person.reads("#sentence", f"{len(rows)} photographs: {usable} with a usable scale.")
    person.page.locator(".overview").get_by_role("button", name="pool.png").first.click()
    person.reads("#subject", "metric scale")
    assert person.page.locator(".overview").count() == 0


@pytest.mark.parametrize("theme", ["light", "dark"])
@pytest.mark.parametrize("width", [400, 1280, 1920])
def test_no_state_has_a_fault(person: Person, width: int, theme: str) -> None:
    person.tab.emulate_media(color_scheme=theme)
    person.tab.set_viewport_size({"width": width, "height": 800})
    choose_pool(person)
    person.finds_no_fault(width)
    frame = person.page.locator(".frame")
    for tool in ("Drop", "Add", "Draw a known length"):
        person.presses(tool)
        for key in ("Enter", "ArrowRight", "Enter"):
            frame.press(key)
        person.finds_no_fault(width)
    for name, words in {
        "broken.png": "^not an image",
        "Measure all": "with a usable scale",
    }.items():
        person.presses(name)
        person.reads("#sentence", re.compile(words))
        person.finds_no_fault(width)
