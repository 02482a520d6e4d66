"""The page in a real browser, inside a host of MCP Apps that the test plays: sandboxed, under the host's own policy."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import anyio
import pytest
from mcp import Client
from mcp.types import CallToolResult

from tests.models import paint_vehicles
from tests.needs import needed_module
from tests.sam_models import SamFiles
from tests.server.app_page.conftest import PATIENCE_MS
from tests.server.app_page.test_app_page import CAR_AXIS, SHOWS_PAGES
from tests.server.conftest import POOL_BOX, paint_scene, write_image
from tests.server.conversation import by_path
from vehanchor.options.by_hand import vehicle_numbers
from vehanchor.records.digits import significant
from vehanchor_server.app import create_server
from vehanchor_server.app_page import PANEL_KEY, page_html
from vehanchor_server.services import create_services
from vehanchor_server.settings import Settings

pytestmark = pytest.mark.browser

_POLICY = (  # what a host must enforce where a page declares no domains (MCP Apps, 2026-01-26, "Host Behavior")
    "default-src 'none'; script-src 'self' 'unsafe-inline'; style-src 'self' 'unsafe-inline'; img-src 'self' data:; "
    "media-src 'self' data:; connect-src 'none'; frame-src 'self'; object-src 'none'; base-uri 'self'"
)
_HOST = """<!doctype html><title>host</title><style>body { margin: 0 } iframe { border: 0; width: 100%; display: block }
</style><body><script>
const heard = [];
let context = {}, capabilities = {}, answer = null;
const view = () => document.querySelector("iframe").contentWindow;
const tell = (message) => view().postMessage({ jsonrpc: "2.0", ...message }, "*");
addEventListener("message", ({ source, data }) => {
  if (source !== view()) return;
  heard.push(data);
  if (data.method === "ui/initialize") {
    const hostInfo = { name: "test", version: "1" };
    const result = { protocolVersion: "2026-01-26", hostInfo, hostCapabilities: capabilities, hostContext: context };
    tell({ id: data.id, result });
  }
  if (data.method === "tools/call") tell({ id: data.id, ...answer });
  if (data.method === "ui/notifications/size-changed") {
    document.querySelector("iframe").style.height = `${data.params.height}px`;
  }
});
function show(html, itsContext, itsCapabilities) {
  [context, capabilities] = [itsContext, itsCapabilities];
  const frame = document.createElement("iframe");
  frame.sandbox = "allow-scripts";
  frame.srcdoc = html;
  document.body.append(frame);
}
</script>"""

LINE = {"x1": 20, "y1": 20, "x2": 420, "y2": 20, "metres": 400}  # ten times what the cars say
ACROSS = [{"points": [{"x": 200, "y": 200}, {"x": 400, "y": 300}]}]
HALF = {"width_px": 320, "height_px": 256}
Call = tuple[str, dict[str, Any]]
Results = dict[str, dict[str, Any]]


class Host:
    """A host of MCP Apps in a browser's tab, and the page inside it."""

    def __init__(self, tab: Any) -> None:
        self.tab = tab
        self.requested: list[str] = []
        self.complaints: list[str] = []
        self.page = tab.frame_locator("iframe")
        tab.on("console", lambda message: self.complaints.append(message.text))
        tab.on("pageerror", lambda error: self.complaints.append(str(error)))
        tab.route("**/*", self._serve)
        tab.goto("http://host.test/")

    def _serve(self, route: Any) -> None:
        self.requested.append(route.request.url)
        route.fulfill(body=_HOST, content_type="text/html", headers={"Content-Security-Policy": _POLICY})

    def show(self, *, tools: bool = False, **context: Any) -> None:
        """Load the page and wait until it is ready."""
        self.tab.evaluate("(page) => show(...page)", [page_html(), context, {"serverTools": {}} if tools else {}])
        self.until(lambda: "ui/notifications/initialized" in [message.get("method") for message in self.heard()])

    def notify(self, method: str, params: dict[str, Any]) -> None:
        self.tab.evaluate("(message) => tell(message)", {"method": method, "params": params})

    def result(self, call: Call, result: dict[str, Any]) -> None:
        """What a host says once a tool has run."""
        self.notify("ui/notifications/tool-input", {"arguments": call[1]})
        self.notify("ui/notifications/tool-result", result)

    def heard(self) -> list[dict[str, Any]]:
        """Every message from the page so far."""
        return list(self.tab.evaluate("() => heard"))

    def until(self, holds: Callable[[], bool]) -> None:
        for _ in range(PATIENCE_MS // 50):
            if holds():
                return
            self.tab.wait_for_timeout(50)
        raise AssertionError("it never came true")

    def says(self, selector: str, text: str | re.Pattern[str]) -> None:
        from playwright.sync_api import expect

        expect(self.page.locator(selector)).to_have_text(text, timeout=PATIENCE_MS)

    def answers(self, result: dict[str, Any]) -> None:
        """Give the page's next calls this result."""
        self.tab.evaluate("(result) => { answer = { result }; }", result)

    def asked(self) -> list[dict[str, Any]]:
        """The calls of the page so far."""
        return [message["params"] for message in self.heard() if message.get("method") == "tools/call"]

    def press(self, name: str) -> None:
        self.page.get_by_role("button", name=name, exact=True).click()

    def keys(self, *names: str) -> None:
        for name in names:
            self.tab.keyboard.press(name)

    def drag(self, start: tuple[float, float], end: tuple[float, float]) -> None:
        """Drag between two places of the image, or click where they are the same."""
        sheet = self.page.locator(".sheet").bounding_box()
        per_pixel = sheet["width"] / 640
        self.tab.mouse.move(sheet["x"] + start[0] * per_pixel, sheet["y"] + start[1] * per_pixel)
        self.tab.mouse.down()
        if end != start:
            self.tab.mouse.move(sheet["x"] + end[0] * per_pixel, sheet["y"] + end[1] * per_pixel, steps=3)
        self.tab.mouse.up()

    def click(self, x: float, y: float) -> None:
        self.drag((x, y), (x, y))

    @property
    def frame(self) -> Any:
        return self.tab.frames[1]

    def in_page(self, script: str) -> Any:
        return self.frame.evaluate(script)


@pytest.fixture
def host(chromium: Any) -> Iterator[Host]:
    tab = chromium.new_page(viewport={"width": 900, "height": 1200})
    tab.set_default_timeout(PATIENCE_MS)
    host = Host(tab)
    yield host
    assert set(host.requested) == {"http://host.test/"}, "the page asked for something"
    assert host.complaints == []
    tab.close()


@pytest.fixture(scope="module")
def calls(tmp_path_factory: pytest.TempPathFactory, _images: Path) -> dict[str, Call]:
    """What an agent asks, by what comes of it."""
    folder = tmp_path_factory.mktemp("page").resolve()
    short = paint_scene(640, 512, 0)
    paint_vehicles(short, [(60 + 40 * (i % 12), 60 + 60 * (i // 12), 12 + 0.1 * (i % 7), 6, 0.0) for i in range(24)])
    long = paint_scene(640, 512)
    paint_vehicles(long, [(80 + 110 * i, 420, 70, 20, 0.0) for i in range(3)])
    pool = {**by_path(_images / "pool.png"), "target": {"box": POOL_BOX}}
    alone = {**by_path(_images / "pool_alone.png"), "target": {"box": POOL_BOX}}
    return {
        "good": ("estimate_gsd", by_path(_images / "cars.png")),
        "guarded": ("estimate_gsd", by_path(write_image(folder / "short.png", short))),
        "outliers": ("estimate_gsd", by_path(write_image(folder / "long.png", long))),
        "few": ("estimate_gsd", {**by_path(_images / "two.png"), "frame": HALF}),
        "rulers": (
            "estimate_gsd",
            {**by_path(_images / "cars.png"), "known_lengths": [LINE], "height_m": 70, "focal_35mm": 24},
        ),
        "corrected": ("estimate_gsd", {**by_path(_images / "cars.png"), "drop": "1", "add": [CAR_AXIS]}),
        "no ruler": ("estimate_gsd", by_path(_images / "empty.png")),
        "failed": ("estimate_gsd", by_path(folder / "nothing.png")),
        "area": ("measure_area", pool),
        "distance": ("measure_distance", {**by_path(_images / "cars.png"), "lines": ACROSS}),
        "distance, few": ("measure_distance", {**by_path(_images / "two.png"), "lines": ACROSS}),
        "area, scale given": ("measure_area", {**alone, "gsd_m_per_px": 0.2, "gsd_basis": "measured"}),
        "area, no ruler": ("measure_area", alone),
    }


@pytest.fixture(scope="module")
def results(calls: dict[str, Call], _images: Path, detector_path: Path, segmenter_paths: SamFiles) -> Results:
    """What the server answers to a host that shows pages, as on the wire."""
    roots = (_images, Path(calls["guarded"][1]["image"]["path"]).parent)
    settings = Settings(roots=roots, detector=str(detector_path), segmenter=segmenter_paths, threads=1, in_process=True)

    async def ask() -> Results:
        async with Client(create_server(create_services(settings)), extensions=SHOWS_PAGES) as client:
            return {name: on_the_wire(await client.call_tool(*call)) for name, call in calls.items()}

    with ThreadPoolExecutor(1) as thread:  # Playwright has the event loop of this one
        return thread.submit(anyio.run, ask).result()


def on_the_wire(result: CallToolResult) -> dict[str, Any]:
    return {
        "content": [part.model_dump(mode="json", by_alias=True, exclude_none=True) for part in result.content],
        "structuredContent": result.structured_content,
        "isError": result.is_error,
        "_meta": result.meta,
    }


def sentence(result: dict[str, Any]) -> str:
    return str(result["_meta"][PANEL_KEY]["sentence"])


def test_the_page_introduces_itself_before_it_says_anything_else(host: Host) -> None:
    host.show()
    first, second, *_ = host.heard()
    assert first["method"] == "ui/initialize"
    assert first["params"]["protocolVersion"] == "2026-01-26"
    assert set(first["params"]) == {"appInfo", "appCapabilities", "protocolVersion"}
    assert set(first["params"]["appInfo"]) == {"name", "version"}
    assert second == {"jsonrpc": "2.0", "method": "ui/notifications/initialized", "params": {}}


def test_a_good_estimate_is_shown_in_words_numbers_and_boxes(
    host: Host, calls: dict[str, Call], results: Results
) -> None:
    record, jpeg = results["good"]["structuredContent"], results["good"]["_meta"][PANEL_KEY]["picture_jpeg"]
    host.show()
    host.result(calls["good"], results["good"])
    host.says("#sentence", "Measured from 24 vehicles.")
    host.says("#status", "Safe to use")
    gsd = record["gsd_m_per_px"]
    names = ["Scale", "Confidence", "On the ground", "Vehicles measured"]
    values = [f"{gsd:.3g}m/px", f"{record['confidence']:.2f}"]
    values += [f"{significant(640 * gsd)} \u00d7 {significant(512 * gsd)}m", "24"]
    assert host.page.locator(".readings dt").all_text_contents() == names
    assert host.page.locator(".readings .value").all_text_contents() == values
    image = host.page.get_by_role("img", name="The aerial image: 24 measured vehicles.")
    assert image.get_attribute("src") == f"data:image/jpeg;base64,{jpeg}"
    assert image.evaluate("(image) => image.naturalWidth") > 0
    assert host.page.locator(".drawn path.kept").get_attribute("d").count("Z") == 24
    assert host.page.locator(".rulers li").count() == 0  # vehicles alone need no list
    mode = host.page.get_by_text(f"{significant(record['mode_length_px'])} px", exact=True)
    assert not mode.is_visible()
    host.page.get_by_text("Details").click()
    assert mode.is_visible()


def test_every_state_is_told_in_its_own_words(host: Host, calls: dict[str, Call], results: Results) -> None:
    few, area, pixels = (results[name]["structuredContent"] for name in ("few", "area", "area, no ruler"))
    copy = f"{significant(few['frame']['gsd_m_per_px'])} m/px at 320 \u00d7 256 px"
    first, last = ".readings > div:first-child", ".readings > div:last-child"
    circle = ".readings > div:nth-child(2) .value"
    states: dict[str, dict[str, str | re.Pattern[str]]] = {
        "guarded": {"#status": "Low confidence: do not use", f"{first} .warn": "do not use"},
        "outliers": {last: "Vehicles measured24of 27 detected; 3 outliers"},
        "few": {
            "#sentence": re.compile("^2 vehicles alone: too little evidence; give the region, or include one more")
        },
        "no ruler": {"#status": "No metric scale", first: "Scalenoneno ruler found"},
        "area": {f"{first} .value": f"{area['area_m2']:.3g}m²", circle: f"⌀ {area['inscribed_diameter_m']:.3g}m"},
        "area, scale given": {last: "Scale0.2m/pxgiven by the caller", "#subject": "area of an object"},
        "area, no ruler": {first: f"Area{pixels['mask_area_px']:,}pxno scale: pixels only"},
        "failed": {"#status": "No result", "#sentence": results["failed"]["content"][0]["text"].partition(": ")[2]},
    }
    host.show()
    for name, words in states.items():
        host.result(calls[name], results[name])
        for selector, text in words.items():
            host.says(selector, text)
        text = host.page.locator("main").inner_text()
        assert not re.search(r"null|undefined|NaN|[a-z]_[a-z]", text.partition("Details")[0]), f"{name}: {text}"
        assert host.page.locator(".scale-bar").count() == (name in ("outliers", "area", "area, scale given")), name
        assert host.page.locator(".drawn path.object").count() == name.startswith("area")
        assert (copy in (host.page.locator(".record").last.text_content() if name == "few" else "")) == (name == "few")


def test_a_scale_not_to_be_used_is_small(host: Host, calls: dict[str, Call], results: Results) -> None:
    size = "() => parseFloat(getComputedStyle(document.querySelector('.readings > div:first-child .value')).fontSize)"
    host.show()
    host.result(calls["good"], results["good"])
    host.says("#status", "Safe to use")
    trusted = host.in_page(size)
    host.result(calls["guarded"], results["guarded"])
    host.says("#status", "Low confidence: do not use")
    assert host.in_page(size) < 0.7 * trusted


def test_a_call_is_told_from_its_beginning_to_its_end(host: Host, calls: dict[str, Call]) -> None:
    host.show()
    host.notify("ui/notifications/tool-input", {"arguments": calls["good"][1]})
    host.says("#sentence", "Measuring.")
    host.notify("ui/notifications/tool-cancelled", {"reason": "user action"})
    host.says("#sentence", "Cancelled: user action.")
    host.result(calls["good"], {"content": [{"type": "text", "text": "0.1 m/px"}]})  # of a host that passes on no more
    host.says("#sentence", "0.1 m/px")
    assert host.page.locator(".picture").count() == 0


def test_the_keyboard_reaches_and_moves_the_picture(host: Host, calls: dict[str, Call], results: Results) -> None:
    host.show()
    host.result(calls["good"], results["good"])
    host.page.get_by_role("button", name="Zoom in").focus()
    host.keys("Enter", "Tab", "Tab")
    assert host.in_page("() => document.activeElement.className") == "frame zoomed"
    left = "() => parseFloat(document.querySelector('.sheet').style.left)"
    before = host.in_page(left)
    host.keys("ArrowRight")
    assert host.in_page(left) == pytest.approx(before - 60)
    host.keys("0")
    assert host.in_page("() => document.activeElement.className") == "frame"


def test_every_ruler_is_listed_with_its_scale_and_the_chance_that_it_is_right(
    host: Host, calls: dict[str, Call], results: Results
) -> None:
    record = results["rulers"]["structuredContent"]
    host.show()
    host.result(calls["rulers"], results["rulers"])
    rows = host.page.locator(".rulers li")
    rows.first.wait_for()
    words = rows.all_inner_texts()
    names = [row.split("\n")[0] for row in words]
    assert names == ["Vehicles", "Scene-scale prior", "Known length", "Given height"]
    for row, ruler in zip(words, record["rulers"], strict=True):
        assert f"{significant(ruler['gsd_m_per_px'])} m/px" in row
        assert f"right with a chance of {ruler['p_right']:.2f}" in row
        assert (ruler["explanation"] or "") in row
    assert "leading" in words[0]
    wrong = [ruler["p_right"] < 0.5 for ruler in record["rulers"]]
    assert wrong.count(True) == host.page.locator(".disagrees").count() == 1
    [warning] = record["warnings"]
    assert host.page.locator("main").inner_text().count(warning["message"]) == 1


@pytest.mark.parametrize(("copy", "thing"), [(None, ""), (HALF, ""), (None, "iso_container_20ft")])
def test_a_known_length_is_drawn_and_measured_with(
    host: Host, calls: dict[str, Call], results: Results, copy: dict[str, int] | None, thing: str
) -> None:
    tool, arguments = calls["good"]
    arguments = {**arguments, **({"frame": copy} if copy else {})}
    host.show(tools=True)
    host.result((tool, arguments), results["good"])
    host.answers(results["rulers"])
    host.press("Draw a known length")
    host.click(100, 200)
    host.says(".picture [role=status]", "Click the other end.")
    host.click(101, 200)
    host.says(".picture [role=status]", re.compile("Too short"))
    host.click(100, 200)
    host.click(500, 400)
    metres = host.page.get_by_label("Metres between both ends")
    if thing:
        host.page.get_by_label("What the line measures").select_option(thing)
        assert not metres.is_visible()
    else:
        metres.fill("38.5")
        host.page.get_by_label("measured by tape, plan or survey").check()
    host.press("Measure again")
    host.says("#sentence", sentence(results["rulers"]))
    (asked,) = host.asked()
    assert asked["name"] == tool
    (line,) = asked["arguments"].pop("known_lengths")
    assert asked["arguments"] == arguments
    share = 0.5 if copy else 1.0
    ends = [line.pop(name) for name in ("x1", "y1", "x2", "y2")]
    assert ends == pytest.approx([100 * share, 200 * share, 500 * share, 400 * share], abs=2.0)
    assert line == ({"metres": thing} if thing else {"metres": 38.5, "basis": "measured"})
    host.page.locator(".drawn path.mark").wait_for(state="attached")  # a level line has no height


@pytest.mark.parametrize("copy", [None, HALF])
def test_a_distance_is_two_clicks_and_an_area_a_box_and_both_have_the_scales_arguments(
    host: Host, calls: dict[str, Call], results: Results, copy: dict[str, int] | None
) -> None:
    told = {"region": "europe", "height_m": 70, "focal_35mm": 24, "drop": "1", "known_lengths": [LINE]}
    asking = {**calls["good"][1], **told, **({"frame": copy} if copy else {})}
    host.show(tools=True)
    host.result(("estimate_gsd", asking), results["good"])
    host.answers(results["distance"])
    host.press("Distance")
    host.press("Zoom in")
    host.click(200, 200)
    host.click(400, 300)
    metres = results["distance"]["structuredContent"]["distance_m"]
    host.says("ol.measured li:first-child .number", f"{metres:.3g} m")
    host.answers(results["area"])
    host.press("Area")
    host.drag((300, 180), (420, 330))
    host.says("ol.measured li:last-child .number", f"{results['area']['structuredContent']['area_m2']:.3g} m²")
    distance, area = (each["arguments"] for each in host.asked())
    (line,), (target,) = distance.pop("lines"), area.pop("targets")
    assert distance == area == {**asking, "detail": "full"}
    share = 0.5 if copy else 1.0
    places = [each for point in line["points"] for each in point.values()]
    assert places == pytest.approx([share * each for each in (200, 200, 400, 300)], abs=2)
    box = list(target["box"].values())
    assert box == pytest.approx([share * each for each in (300, 180, 420, 330)], abs=2)
    assert host.page.locator(".drawn path.measured").count() == 2
    host.page.get_by_role("button", name="Remove").first.click()
    assert host.page.locator(".drawn path.measured").count() == 1


def test_vehicles_are_dropped_and_added_by_clicks_and_taken_back(
    host: Host, calls: dict[str, Call], results: Results
) -> None:
    vehicles = results["good"]["_meta"][PANEL_KEY]["drawing"]["vehicles"]
    tool, arguments = calls["good"]
    host.show(tools=True)
    host.result(calls["good"], results["good"])
    host.answers(results["corrected"])
    host.press("Drop")
    for n in (1, 2, 7):
        host.click(*vehicles[n - 1][:2])
        host.says(".picture [role=status]", f"Vehicle {n} dropped.")
    host.click(*vehicles[1][:2])
    host.says(".picture [role=status]", "Vehicle 2 as found.")
    host.click(600, 500)
    host.says(".picture [role=status]", "No vehicle here.")
    host.drag((2, 2), (638, 95))
    row = [each[6] for each in vehicles if each[1] < 95]
    host.says(".picture [role=status]", f"{len(row)} vehicles dropped.")
    host.press("Add")
    host.drag((100, 480), (132, 480))
    host.click(200, 480)
    host.click(232, 480)
    host.says(".row.asked span", f"Vehicles by hand: 2 added, {len({1, 7, *row})} dropped")
    host.press("Drop")
    host.click(216, 480)
    host.press("Measure again")
    host.says("#sentence", re.compile(r"Vehicles corrected by hand: 1 added, 1 dropped\.$"))
    host.press("Take all back")
    host.answers(results["good"])
    host.press("Measure again")
    host.says("#sentence", "Measured from 24 vehicles.")
    asked, again = host.asked()
    assert asked["name"] == tool
    (axis,) = asked["arguments"].pop("add")
    assert list(axis.values()) == pytest.approx([100, 480, 132, 480], abs=2)
    assert set(vehicle_numbers("drop", asked["arguments"].pop("drop"))) == {1, 7, *row}
    assert asked["arguments"] == again["arguments"] == arguments


def test_corrections_of_the_call_are_shown(host: Host, calls: dict[str, Call], results: Results) -> None:
    host.show(tools=True)
    host.result(calls["corrected"], results["corrected"])
    host.says(".row.asked span", "Vehicles by hand: 1 added, 1 dropped")
    assert host.page.locator(".drawn path.stated").get_attribute("d").count("Z") == 1
    assert not host.page.get_by_role("button", name="Measure again").is_visible()
    host.press("Drop")
    host.click(CAR_AXIS["x1"] + 16, CAR_AXIS["y1"])
    host.says(".row.asked span", "Vehicles by hand: 1 dropped")


def test_region_and_height_are_those_of_the_call_until_a_person_states_others(
    host: Host, calls: dict[str, Call], results: Results
) -> None:
    told = {"region": "europe", "height_m": 70, "height_basis": "measured", "focal_35mm": 24}
    host.show(tools=True)
    host.result((calls["good"][0], {**calls["good"][1], **told}), results["good"])
    host.page.get_by_text("Region and height").click()
    fields = [host.page.get_by_label(name) for name in ("Region", "Camera height", "Focal length")]
    assert [field.input_value() for field in fields] == ["europe", "70", "24"]
    host.answers(results["rulers"])
    fields[0].select_option(label="India")
    fields[1].fill("0")
    host.press("Measure with these")  # refused: no height
    fields[1].fill("90")
    host.page.get_by_label("height measured").uncheck()
    host.press("Measure with these")
    host.says("#sentence", sentence(results["rulers"]))
    (asked,) = host.asked()
    assert asked["arguments"] == {**calls["good"][1], "region": "IN", "height_m": 90, "focal_35mm": 24}


def test_points_are_set_moved_and_taken_back_by_keys(host: Host, calls: dict[str, Call], results: Results) -> None:
    host.show(tools=True)
    host.result(calls["good"], results["good"])
    host.answers(results["distance"])
    host.page.get_by_role("button", name="Distance").focus()
    host.keys("Enter", "ArrowLeft", "ArrowLeft", "Enter", "Backspace", "ArrowLeft", "Enter")
    host.keys(*["ArrowRight"] * 8, "Shift+ArrowDown", "Enter")
    metres = results["distance"]["structuredContent"]["distance_m"]
    host.says("ol.measured li .number", f"{metres:.3g} m")
    (call,) = host.asked()
    start, end = call["arguments"]["lines"][0]["points"]
    pixel = 640 / host.page.locator(".sheet").bounding_box()["width"]
    assert (start["x"], start["y"]) == pytest.approx((320 - 30 * pixel, 256), abs=0.5)
    assert (end["x"], end["y"]) == pytest.approx((320 + 50 * pixel, 256 + pixel), abs=0.5)
    host.keys("Escape")
    assert host.page.get_by_role("button", name="Distance").get_attribute("aria-pressed") == "false"


def test_a_measurement_that_fails_or_is_not_to_be_used_says_so(
    host: Host, calls: dict[str, Call], results: Results
) -> None:
    host.show(tools=True)
    host.result(calls["few"], results["few"])
    host.answers(results["failed"])
    host.press("Distance")
    host.drag((100, 100), (300, 300))
    host.says(".picture [role=status]", re.compile(r"^Not measured: (?!\w+:)"))
    host.answers(results["distance, few"])
    host.drag((100, 100), (300, 300))
    host.says("ol.measured li.untrusted .note:nth-of-type(3)", "do not use: low confidence")
    host.result(calls["no ruler"], results["no ruler"])
    host.says("#status", "No metric scale")
    assert host.page.get_by_role("button", name="Distance").count() == 0
    host.page.get_by_role("button", name="Draw a known length").wait_for()


@pytest.mark.parametrize(("theme", "width"), [("light", 340), ("dark", 900)])
def test_axe_finds_nothing_in_any_state_and_the_page_is_as_high_as_its_frame(
    host: Host, calls: dict[str, Call], results: Results, theme: str, width: int
) -> None:
    axe = needed_module("axe_playwright_python.sync_playwright", "pip install -e '.[browser]'").Axe()
    host.tab.set_viewport_size({"width": width, "height": 2400})
    host.show(tools=True, theme=theme)
    for name, call in calls.items():
        if call[0] == "measure_distance":
            continue  # shows no page
        host.result(call, results[name])
        host.until(lambda: bool(host.in_page("() => innerHeight === document.documentElement.scrollHeight")))
        found = axe.run(host.frame).response["violations"]
        assert [(each["id"], [node["html"] for node in each["nodes"]]) for each in found] == [], name
        assert host.in_page("() => document.documentElement.scrollWidth") <= width
        assert host.in_page(_CUT_OFF) == []


_CUT_OFF = """() => [...document.querySelectorAll("section, section *, dl *")]
  .filter((each) => each instanceof HTMLElement && each.clientWidth && each.scrollWidth > each.clientWidth + 1)
  .map((each) => each.outerHTML.slice(0, 80))"""


def test_the_theme_follows_the_host_and_takes_its_colours(host: Host, calls: dict[str, Call], results: Results) -> None:
    host.show(theme="dark", styles={"variables": {"--color-background-primary": "light-dark(#fefefe, #010203)"}})
    host.result(calls["good"], results["good"])
    ground = "() => getComputedStyle(document.body).backgroundColor"
    assert host.in_page(ground) == "rgb(1, 2, 3)"
    host.notify("ui/notifications/host-context-changed", {"theme": "light"})
    host.until(lambda: bool(host.in_page(ground) == "rgb(254, 254, 254)"))


def test_words_of_the_server_are_shown_as_words(host: Host, calls: dict[str, Call], results: Results) -> None:
    attack = "<img src=x onerror=\"document.title='taken'\">"
    record = {**results["good"]["structuredContent"], "warnings": [{"code": "x", "message": attack}], "model": attack}
    panel = {**results["good"]["_meta"][PANEL_KEY], "sentence": attack}
    host.show()
    host.result(calls["good"], {"structuredContent": record, "_meta": {PANEL_KEY: panel}})
    host.says("#sentence", attack)
    host.says(".warnings li", attack)
    assert attack in host.page.locator(".record").text_content()
    assert host.in_page("() => document.title") != "taken"


def test_only_the_host_is_listened_to(host: Host, calls: dict[str, Call], results: Results) -> None:
    host.show()
    host.result(calls["good"], results["good"])
    host.says("#status", "Safe to use")
    forged = {"jsonrpc": "2.0", "method": "ui/notifications/tool-result", "params": results["no ruler"]}
    host.in_page(f"() => window.postMessage({json.dumps(forged)}, '*')")
    host.tab.evaluate("() => tell({ jsonrpc: '1.0', method: 'ui/notifications/tool-cancelled', params: {} })")
    host.tab.evaluate("() => tell({ id: 1, method: 'ping' })")
    host.until(lambda: len(answers(host)) == 1)  # it has read all three
    host.says("#status", "Safe to use")


def test_the_host_gets_its_answers(host: Host) -> None:
    host.show()
    for id_, method in ((7, "ping"), (8, "ui/resource-teardown"), (9, "ui/unheard-of")):
        host.tab.evaluate("(message) => tell(message)", {"id": id_, "method": method, "params": {}})
    host.until(lambda: len(answers(host)) == 3)
    seven, eight, nine = answers(host)
    assert seven == {"jsonrpc": "2.0", "id": 7, "result": {}}
    assert eight == {"jsonrpc": "2.0", "id": 8, "result": {}}
    assert nine["error"]["code"] == -32601


def answers(host: Host) -> list[dict[str, Any]]:
    return [message for message in host.heard() if "method" not in message]


def test_opened_by_itself_the_page_says_what_it_is_for(chromium: Any) -> None:
    tab = chromium.new_page()
    tab.set_content(page_html())
    assert "It shows nothing on its own" in tab.locator("#sentence").inner_text()
    tab.close()
