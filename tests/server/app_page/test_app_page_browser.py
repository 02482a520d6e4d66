"""The page in a real browser, inside a host of MCP Apps that the test plays: sandboxed, under the host's own policy."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import anyio
import cv2
import numpy as np
import pytest
from mcp import Client
from mcp.types import CallToolResult

from tests.models import paint_vehicles
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
Call = tuple[str, dict[str, Any]]


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

    def shows_all(self) -> bool:
        """Whether the frame is as high as the page in it."""
        return bool(self.in_page("() => innerHeight === document.documentElement.scrollHeight"))

    def in_page(self, script: str) -> Any:
        [frame] = self.tab.frames[1:]
        return frame.evaluate(script)


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
        "few": ("estimate_gsd", {**by_path(_images / "two.png"), "frame": {"width_px": 320, "height_px": 256}}),
        "rulers": (
            "estimate_gsd",
            {**by_path(_images / "cars.png"), "known_lengths": [LINE], "height_m": 70, "focal_35mm": 24},
        ),
        "corrected": (
            "estimate_gsd",
            {**by_path(_images / "cars.png"), "drop": "1", "add": [CAR_AXIS]},
        ),
        "no ruler": ("estimate_gsd", by_path(_images / "empty.png")),
        "failed": ("estimate_gsd", by_path(folder / "nothing.png")),
        "area": ("measure_area", pool),
        "distance": ("measure_distance", {**by_path(_images / "cars.png"), "lines": ACROSS}),
        "distance, few": ("measure_distance", {**by_path(_images / "two.png"), "lines": ACROSS}),
        "area, scale given": ("measure_area", {**alone, "gsd_m_per_px": 0.2, "gsd_basis": "measured"}),
        "area, no ruler": ("measure_area", alone),
    }


@pytest.fixture(scope="module")
def results(
    calls: dict[str, Call], _images: Path, detector_path: Path, segmenter_paths: SamFiles
) -> dict[str, dict[str, Any]]:
    """What the server answers to a host that shows pages, as on the wire."""
    roots = (_images, Path(calls["guarded"][1]["image"]["path"]).parent)
    settings = Settings(
        roots=roots, detector=str(detector_path), segmenter=segmenter_paths, threads=1, isolation="in-process"
    )

    async def ask() -> dict[str, dict[str, Any]]:
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


def without_picture(result: dict[str, Any]) -> dict[str, Any]:
    return {**result, "_meta": {PANEL_KEY: {**result["_meta"][PANEL_KEY], "picture_jpeg": None}}}


def test_the_page_introduces_itself_before_it_says_anything_else(host: Host) -> None:
    host.show()
    first, second, *_ = host.heard()
    assert first["method"] == "ui/initialize"
    assert first["params"]["protocolVersion"] == "2026-01-26"
    assert set(first["params"]) == {"appInfo", "appCapabilities", "protocolVersion"}
    assert set(first["params"]["appInfo"]) == {"name", "version"}
    assert second == {"jsonrpc": "2.0", "method": "ui/notifications/initialized", "params": {}}


def test_a_good_estimate_is_shown_in_words_and_numbers(
    host: Host, calls: dict[str, Call], results: dict[str, dict[str, Any]]
) -> None:
    record, panel = results["good"]["structuredContent"], results["good"]["_meta"][PANEL_KEY]
    host.show()
    host.result(calls["good"], results["good"])
    host.says("#sentence", results["good"]["content"][0]["text"])
    host.says("#status", "Safe to use")
    host.says(".readings > div:first-child .value", f"{record['gsd_m_per_px']:.3g}m/px")
    host.says(".gauge .reading", f"{record['confidence']:.2f}")
    image = host.page.get_by_role("img", name="24 measured vehicles outlined in blue, a scale bar.")
    assert image.get_attribute("src") == f"data:image/jpeg;base64,{panel['picture_jpeg']}"
    assert host.page.locator(".drawn path.kept").get_attribute("d").count("Z") == 24
    assert image.evaluate("(image) => image.naturalWidth") > 0


def test_a_scale_not_to_be_used_is_small_and_has_no_bar(
    host: Host, calls: dict[str, Call], results: dict[str, dict[str, Any]]
) -> None:
    assert results["guarded"]["structuredContent"]["resolution_guard"]
    host.show()
    host.result(calls["good"], results["good"])
    host.page.locator(".scale-bar").wait_for()
    size = "() => parseFloat(getComputedStyle(document.querySelector('.readings > div:first-child .value')).fontSize)"
    trusted = host.in_page(size)
    host.result(calls["guarded"], results["guarded"])
    host.says("#status", "Low confidence: do not use")
    host.says(".readings > div:first-child .warn", "do not use")
    assert host.in_page(size) < 0.7 * trusted
    assert host.page.locator(".scale-bar").count() == 0
    host.says(".tick", "0.9usable")
    meter = host.page.get_by_role("meter", name="Confidence")
    assert float(meter.get_attribute("aria-valuenow")) < 0.9


def test_outliers_are_shown_apart(host: Host, calls: dict[str, Call], results: dict[str, dict[str, Any]]) -> None:
    host.show()
    host.result(calls["outliers"], results["outliers"])
    host.says(".readings > div:nth-child(2)", "Vehicles measured24of 27 detected; 3 outliers")


def test_the_callers_copy_has_its_scale(host: Host, calls: dict[str, Call], results: dict[str, dict[str, Any]]) -> None:
    host.show()
    host.result(calls["few"], results["few"])
    host.says("#status", "Low confidence: do not use")
    frame = results["few"]["structuredContent"]["frame"]
    assert f"{frame['gsd_m_per_px']:.3g} m/px at 320 \u00d7 256 px" in host.page.locator(".record").inner_text()


def test_no_anchor_shows_no_number(host: Host, calls: dict[str, Call], results: dict[str, dict[str, Any]]) -> None:
    host.show()
    host.result(calls["no ruler"], results["no ruler"])
    host.says("#status", "No metric scale")
    host.says(".readings > div:first-child", "Scalenoneno ruler found")
    host.says(".gauge .reading", "0.00")
    assert "null" not in host.page.locator("main").inner_text()


def test_an_area_is_shown_with_its_outline_and_the_largest_circle_inside(
    host: Host, calls: dict[str, Call], results: dict[str, dict[str, Any]]
) -> None:
    record = results["area"]["structuredContent"]
    host.show()
    host.result(calls["area"], results["area"])
    host.says("#subject", "area of an object")
    host.says(".readings > div:first-child .value", f"{record['area_m2']:.3g}m²")
    host.says(".readings > div:nth-child(2) .value", f"⌀ {record['inscribed_diameter_m']:.3g}m")
    assert host.page.locator(".drawn path.object").count() == 1


def test_an_area_of_a_given_scale_shows_no_confidence(
    host: Host, calls: dict[str, Call], results: dict[str, dict[str, Any]]
) -> None:
    host.show()
    host.result(calls["area, scale given"], results["area, scale given"])
    host.says(".readings > div:last-child", "Scale0.2m/pxgiven by the caller")
    assert host.page.get_by_role("meter").count() == 0


def test_an_area_without_a_scale_is_in_pixels(
    host: Host, calls: dict[str, Call], results: dict[str, dict[str, Any]]
) -> None:
    pixels = results["area, no ruler"]["structuredContent"]["mask_area_px"]
    host.show()
    host.result(calls["area, no ruler"], results["area, no ruler"])
    host.says(".readings > div:first-child", f"Area{pixels:,}pxno scale: pixels only")


def test_what_went_wrong_is_told(host: Host, calls: dict[str, Call], results: dict[str, dict[str, Any]]) -> None:
    assert results["failed"]["isError"]
    host.show()
    host.notify("ui/notifications/tool-input", {"arguments": calls["failed"][1]})
    host.says("#sentence", "Measuring.")
    host.notify("ui/notifications/tool-result", results["failed"])
    host.says("#status", "No result")
    host.says("#sentence", results["failed"]["content"][0]["text"])


def test_a_cancelled_call_is_told(host: Host, calls: dict[str, Call]) -> None:
    host.show()
    host.notify("ui/notifications/tool-input", {"arguments": calls["good"][1]})
    host.notify("ui/notifications/tool-cancelled", {"reason": "user action"})
    host.says("#sentence", "Cancelled: user action.")


def test_a_host_that_passes_on_the_text_alone_still_shows_it(host: Host, calls: dict[str, Call]) -> None:
    host.show()
    for_the_model = {"type": "text", "text": "give back scale {}", "annotations": {"audience": ["assistant"]}}
    host.result(calls["good"], {"content": [{"type": "text", "text": "0.1 m/px"}, for_the_model]})
    host.says("#sentence", "0.1 m/px")


def test_without_a_way_to_a_picture_nothing_is_offered(
    host: Host, calls: dict[str, Call], results: dict[str, dict[str, Any]]
) -> None:
    host.show(tools=False)
    host.result(calls["good"], without_picture(results["good"]))
    host.page.locator(".gauge").wait_for()
    assert host.page.locator(".picture").count() == 0


def test_the_keyboard_reaches_and_moves_the_picture(
    host: Host, calls: dict[str, Call], results: dict[str, dict[str, Any]]
) -> None:
    host.show()
    host.result(calls["good"], results["good"])
    zoom = host.page.get_by_role("button", name="Zoom in")
    zoom.focus()
    host.tab.keyboard.press("Enter")
    host.tab.keyboard.press("Tab")
    host.tab.keyboard.press("Tab")
    assert host.in_page("() => document.activeElement.className") == "frame zoomed"
    left = "() => parseFloat(document.querySelector('.sheet').style.left)"
    before = host.in_page(left)
    host.tab.keyboard.press("ArrowRight")
    assert host.in_page(left) == pytest.approx(before - 60)
    host.tab.keyboard.press("0")
    assert host.in_page("() => document.activeElement.className") == "frame"


def test_every_ruler_is_listed_with_what_it_says_and_the_chance_that_it_is_right(
    host: Host, calls: dict[str, Call], results: dict[str, dict[str, Any]]
) -> None:
    rulers = results["rulers"]["structuredContent"]["rulers"]
    host.show()
    host.result(calls["rulers"], results["rulers"])
    rows = host.page.locator(".rulers li")
    rows.first.wait_for()
    assert [row.split("\n")[0] for row in rows.all_inner_texts()] == ["Vehicles", "Known length", "Given height"]
    for row, ruler in zip(rows.all_inner_texts(), rulers, strict=True):
        assert f"{significant(ruler['gsd_m_per_px'])} m/px" in row
        assert f"right with a chance of {ruler['p_right']:.2f}" in row
    assert [ruler["p_right"] < 0.5 for ruler in rulers].count(True) == host.page.locator(".disagrees").count() == 1
    assert host.page.get_by_text("Chance that the scale is right within 20 %, by all rulers.").count() == 1
    host.result(calls["good"], results["good"])
    host.says("#sentence", results["good"]["content"][0]["text"])
    assert rows.count() == 0


@pytest.mark.parametrize("copy", [None, {"width_px": 320, "height_px": 256}])
def test_a_known_length_is_drawn_with_two_clicks_and_measured_with(
    host: Host, calls: dict[str, Call], results: dict[str, dict[str, Any]], copy: dict[str, int] | None
) -> None:
    tool, arguments = calls["good"]
    arguments = {**arguments, **({"frame": copy} if copy else {})}
    host.show(tools=True)
    host.result((tool, arguments), results["good"])
    host.tab.evaluate("(result) => { answer = { result }; }", results["rulers"])
    host.page.get_by_role("button", name="Draw a known length").click()
    click_at(host, 100, 200)
    host.says(".picture [role=status]", "Click the other end.")
    click_at(host, 101, 200)
    host.says(".picture [role=status]", re.compile("Too short"))
    click_at(host, 100, 200)
    click_at(host, 500, 400)
    host.page.get_by_role("spinbutton").fill("38.5")
    host.page.get_by_role("button", name="Measure again").click()
    host.says("#sentence", results["rulers"]["content"][0]["text"])
    (asked,) = tool_calls(host)
    assert asked["name"] == tool
    line = asked["arguments"].pop("known_lengths")[0]
    assert asked["arguments"] == arguments  # the page gets its picture without asking
    share = 0.5 if copy else 1.0
    assert line.pop("metres") == 38.5
    assert list(line.values()) == pytest.approx([100 * share, 200 * share, 500 * share, 400 * share], abs=2.0)
    host.page.locator(".drawn path.mark").wait_for(state="attached")  # a level line has no height


@pytest.mark.parametrize("thing", ["iso_container_20ft", ""])
def test_a_drawn_line_is_a_thing_of_known_size_or_a_measured_length(
    host: Host, calls: dict[str, Call], results: dict[str, dict[str, Any]], thing: str
) -> None:
    host.show(tools=True)
    host.result(calls["good"], results["good"])
    host.tab.evaluate("(result) => { answer = { result }; }", results["rulers"])
    host.page.get_by_role("button", name="Draw a known length").click()
    click_at(host, 100, 200)
    click_at(host, 500, 400)
    if thing:
        host.page.get_by_label("What the line measures").select_option(thing)
        assert not host.page.get_by_role("spinbutton").is_visible()
    else:
        host.page.get_by_role("spinbutton").fill("38.5")
        host.page.get_by_label("measured by tape, plan or survey").check()
    host.page.get_by_role("button", name="Measure again").click()
    host.says("#sentence", results["rulers"]["content"][0]["text"])
    (asked,) = tool_calls(host)
    (line,) = asked["arguments"]["known_lengths"]
    size = {"metres": thing} if thing else {"metres": 38.5, "basis": "measured"}
    assert {key: line[key] for key in line if len(key) > 2} == size


@pytest.mark.parametrize("copy", [None, {"width_px": 320, "height_px": 256}])
def test_a_distance_is_two_clicks_and_an_area_a_box_and_both_have_the_scales_arguments(
    host: Host, calls: dict[str, Call], results: dict[str, dict[str, Any]], copy: dict[str, int] | None
) -> None:
    share = 0.5 if copy else 1.0
    line = {**LINE, **{end: share * LINE[end] for end in ("x1", "y1", "x2", "y2")}}
    told = {"region": "europe", "height_m": 70, "focal_35mm": 24, "drop": "1"}
    asking = {**calls["good"][1], **told, "known_lengths": [line], **({"frame": copy} if copy else {})}
    frame = {"frame": {**copy, "gsd_m_per_px": 0.3}} if copy else {}
    record = {**results["good"]["structuredContent"], **frame}
    host.show(tools=True)
    host.result(("estimate_gsd", asking), {**results["good"], "structuredContent": record})
    host.tab.evaluate("(result) => { answer = { result }; }", results["distance"])
    host.page.get_by_role("button", name="Distance").click()
    host.page.get_by_role("button", name="Zoom in").click()
    click_at(host, 200, 200)
    click_at(host, 400, 300)
    metres = results["distance"]["structuredContent"]["distance_m"]
    host.says("ol.measured li:first-child .number", f"{metres:.3g} m")
    host.tab.evaluate("(result) => { answer = { result }; }", results["area"])
    host.page.get_by_role("button", name="Area").click()
    drag(host, (300, 180), (420, 330))
    host.says("ol.measured li:last-child .number", f"{results['area']['structuredContent']['area_m2']:.3g} m²")
    distance, area = tool_calls(host)
    assert distance["name"] == "measure_distance"
    for each in (distance, area):
        given = {name: each["arguments"][name] for name in each["arguments"] if name not in ("lines", "targets")}
        assert given == {**calls["good"][1], **told, "known_lengths": [LINE]}, "in pixels of the image"
    (line,) = distance["arguments"]["lines"]
    places = [each for point in line["points"] for each in point.values()]
    assert places == pytest.approx([200, 200, 400, 300], abs=2)
    (target,) = area["arguments"]["targets"]
    assert list(target["box"].values()) == pytest.approx([300, 180, 420, 330], abs=2)
    assert host.page.locator(".drawn path.measured").count() == 2
    host.page.get_by_role("button", name="Remove").first.click()
    assert host.page.locator(".drawn path.measured").count() == 1


def test_vehicles_are_dropped_and_added_by_clicks(
    host: Host, calls: dict[str, Call], results: dict[str, dict[str, Any]]
) -> None:
    vehicles = results["good"]["_meta"][PANEL_KEY]["drawing"]["vehicles"]
    tool, arguments = calls["good"]
    host.show(tools=True)
    host.result(calls["good"], results["good"])
    host.tab.evaluate("(result) => { answer = { result }; }", results["corrected"])
    press(host, "Drop")
    for n in (1, 2, 7):
        click_at(host, *vehicles[n - 1][:2])
        host.says(".picture [role=status]", f"Vehicle {n} dropped.")
    click_at(host, *vehicles[1][:2])
    host.says(".picture [role=status]", "Vehicle 2 as found.")
    click_at(host, 600, 500)
    host.says(".picture [role=status]", "No vehicle here.")
    drag(host, (2, 2), (640, 95))
    row = [each[6] for each in vehicles if each[1] < 95]
    host.says(".picture [role=status]", f"{len(row)} vehicles dropped.")
    press(host, "Add")
    drag(host, (100, 480), (132, 480))
    click_at(host, 200, 480)
    click_at(host, 232, 480)
    host.says(".row.asked span", f"Vehicles by hand: 2 added, {len({1, 7, *row})} dropped")
    assert host.page.locator(".drawn path.stated").get_attribute("d").count("Z") == 2
    press(host, "Drop")
    click_at(host, 216, 480)
    press(host, "Measure again")
    host.says("#sentence", results["corrected"]["content"][0]["text"])
    (asked,) = tool_calls(host)
    assert asked["name"] == tool
    (axis,) = asked["arguments"].pop("add")
    assert list(axis.values()) == pytest.approx([100, 480, 132, 480], abs=2)
    assert numbers(asked["arguments"].pop("drop")) == {1, 7, *row}
    assert asked["arguments"] == arguments


def test_corrections_of_the_call_are_shown_and_can_be_taken_back(
    host: Host, calls: dict[str, Call], results: dict[str, dict[str, Any]]
) -> None:
    host.show(tools=True)
    host.result(calls["corrected"], results["corrected"])
    host.says(".row.asked span", "Vehicles by hand: 1 added, 1 dropped")
    assert host.page.locator(".drawn path.stated").get_attribute("d").count("Z") == 1
    assert not host.page.get_by_role("button", name="Measure again").is_visible()
    press(host, "Drop")
    click_at(host, CAR_AXIS["x1"] + 16, CAR_AXIS["y1"])
    host.says(".row.asked span", "Vehicles by hand: 1 dropped")
    press(host, "Take all back")
    host.tab.evaluate("(result) => { answer = { result }; }", results["good"])
    press(host, "Measure again")
    host.says("#sentence", results["good"]["content"][0]["text"])
    (asked,) = tool_calls(host)
    assert asked["arguments"] == calls["good"][1]


def test_points_are_set_moved_and_taken_back_by_keys(
    host: Host, calls: dict[str, Call], results: dict[str, dict[str, Any]]
) -> None:
    host.show(tools=True)
    host.result(calls["good"], results["good"])
    host.tab.evaluate("(result) => { answer = { result }; }", results["distance"])
    host.page.get_by_role("button", name="Distance").focus()
    keys(host, "Enter", "ArrowLeft", "ArrowLeft", "Enter", "Backspace", "ArrowLeft", "Enter")
    keys(host, *["ArrowRight"] * 8, "Shift+ArrowDown", "Enter")
    metres = results["distance"]["structuredContent"]["distance_m"]
    host.says("ol.measured li .number", f"{metres:.3g} m")
    (call,) = tool_calls(host)
    start, end = call["arguments"]["lines"][0]["points"]
    pixel = 640 / host.page.locator(".sheet").bounding_box()["width"]
    assert (start["x"], start["y"]) == pytest.approx((320 - 30 * pixel, 256), abs=0.5)
    assert (end["x"], end["y"]) == pytest.approx((320 + 50 * pixel, 256 + pixel), abs=0.5)
    keys(host, "Escape")
    assert host.page.get_by_role("button", name="Distance").get_attribute("aria-pressed") == "false"


def keys(host: Host, *names: str) -> None:
    for name in names:
        host.tab.keyboard.press(name)


def press(host: Host, name: str) -> None:
    host.page.get_by_role("button", name=name, exact=True).click()


def numbers(text: str) -> set[int]:
    return set(vehicle_numbers("drop", text))


def test_a_measurement_that_fails_or_is_not_to_be_used_says_so(
    host: Host, calls: dict[str, Call], results: dict[str, dict[str, Any]]
) -> None:
    host.show(tools=True)
    host.result(calls["few"], results["few"])
    host.tab.evaluate("(result) => { answer = { result }; }", results["failed"])
    host.page.get_by_role("button", name="Distance").click()
    drag(host, (100, 100), (300, 300))
    host.says(".picture [role=status]", f"Not measured: {results['failed']['content'][0]['text']}")
    host.tab.evaluate("(result) => { answer = { result }; }", results["distance, few"])
    drag(host, (100, 100), (300, 300))
    host.says("ol.measured li.untrusted .note:nth-of-type(3)", "do not use: low confidence")
    host.result(calls["no ruler"], results["no ruler"])
    host.says("#status", "No metric scale")
    assert host.page.get_by_role("button", name="Distance").count() == 0
    host.page.get_by_role("button", name="Draw a known length").wait_for()


def for_people(result: dict[str, Any]) -> str:
    """The sentence of a result without the names of arguments, which are for models."""
    return re.sub(r" \(known_lengths[^)]*\)", "", result["content"][0]["text"])


def place_of(host: Host, x: float, y: float) -> tuple[float, float]:
    """Where a place of the image of 640 x 512 px is in the frame of the picture."""
    sheet, frame = (host.page.locator(name).bounding_box() for name in (".sheet", ".frame"))
    return (
        sheet["x"] - frame["x"] + x * sheet["width"] / 640,
        sheet["y"] - frame["y"] + y * sheet["height"] / 512,
    )


def click_at(host: Host, x: float, y: float) -> None:
    left, top = place_of(host, x, y)
    host.page.locator(".frame").click(position={"x": left, "y": top})


def drag(host: Host, start: tuple[float, float], end: tuple[float, float]) -> None:
    host.page.locator(".frame").scroll_into_view_if_needed()
    frame = host.page.locator(".frame").bounding_box()
    first, last = ([frame["x"] + x, frame["y"] + y] for x, y in (place_of(host, *start), place_of(host, *end)))
    host.tab.mouse.move(*first)
    host.tab.mouse.down()
    host.tab.mouse.move(*last, steps=3)
    host.tab.mouse.up()


def tool_calls(host: Host) -> list[dict[str, Any]]:
    return [message["params"] for message in host.heard() if message.get("method") == "tools/call"]


@pytest.mark.parametrize("theme", ["light", "dark"])
def test_every_letter_can_be_read_in_both_themes(
    host: Host, calls: dict[str, Call], results: dict[str, dict[str, Any]], theme: str
) -> None:
    host.show(theme=theme)
    for name in ("guarded", "good", "rulers", "area", "no ruler", "failed"):
        host.result(calls[name], results[name])
        host.says("#sentence", for_people(results[name]))
        for where, ink, ground in host.in_page(_LETTERS):
            assert contrast(ink, ground) >= 4.5, f"{where} on {name}: {ink} on {ground}"
    assert (luminance(host.in_page("() => getComputedStyle(document.body).backgroundColor")) < 0.1) == (theme == "dark")


_LETTERS = """() => [...document.querySelectorAll("body *:not(script):not(style)")]
  .filter((each) => [...each.childNodes].some((node) => node.nodeType === 3 && node.data.trim()))
  .filter((each) => each.getClientRects().length)
  .map((each) => {
    const style = getComputedStyle(each);
    const ink = each instanceof SVGElement ? style.fill : style.color;
    const ground = (under) => {
      const own = getComputedStyle(under).backgroundColor;
      return own === "rgba(0, 0, 0, 0)" ? ground(under.parentElement) : own;
    };
    return [`${each.tagName} ${each.textContent.slice(0, 30)}`, ink, ground(each)];
  })"""


def luminance(colour: str) -> float:
    """Relative luminance of a CSS colour, WCAG 2."""
    shares = np.array([float(number) for number in re.findall(r"[\d.]+", colour)[:3]]) / 255
    linear = np.where(shares <= 0.04045, shares / 12.92, ((shares + 0.055) / 1.055) ** 2.4)
    return float(linear @ [0.2126, 0.7152, 0.0722])


def contrast(one: str, other: str) -> float:
    high, low = sorted((luminance(one), luminance(other)), reverse=True)
    return (high + 0.05) / (low + 0.05)


def test_the_theme_follows_the_host_and_takes_its_colours(
    host: Host, calls: dict[str, Call], results: dict[str, dict[str, Any]]
) -> None:
    host.show(theme="dark", styles={"variables": {"--color-background-primary": "light-dark(#fefefe, #010203)"}})
    host.result(calls["good"], results["good"])
    ground = "() => getComputedStyle(document.body).backgroundColor"
    assert host.in_page(ground) == "rgb(1, 2, 3)"
    host.notify("ui/notifications/host-context-changed", {"theme": "light"})
    host.until(lambda: bool(host.in_page(ground) == "rgb(254, 254, 254)"))


@pytest.mark.parametrize("width", [340, 900])
def test_the_page_tells_its_height_and_never_scrolls_sideways(
    host: Host, calls: dict[str, Call], results: dict[str, dict[str, Any]], width: int, tmp_path: Path
) -> None:
    host.tab.set_viewport_size({"width": width, "height": 2400})
    host.show()
    for name, call in calls.items():
        if call[0] == "measure_distance":
            continue  # shows no page
        host.result(call, results[name])
        host.says("#sentence", for_people(results[name]))
        host.until(host.shows_all)
        assert host.in_page("() => document.documentElement.scrollWidth") <= width
        assert host.in_page(_CUT_OFF) == []
        host.tab.screenshot(path=tmp_path / f"{name}.png")
    picture = cv2.imread(str(tmp_path / "good.png"))
    assert picture is not None
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 100  # it is really painted


_CUT_OFF = """() => [...document.querySelectorAll("section, section *, dl *")]
  .filter((each) => each instanceof HTMLElement && each.clientWidth && each.scrollWidth > each.clientWidth + 1)
  .map((each) => each.outerHTML.slice(0, 80))"""


def test_words_of_the_server_are_shown_as_words(
    host: Host, calls: dict[str, Call], results: dict[str, dict[str, Any]]
) -> None:
    attack = "<img src=x onerror=\"document.title='taken'\">"
    record = {**results["good"]["structuredContent"], "warnings": [{"code": "x", "message": attack}], "model": attack}
    host.show()
    host.result(calls["good"], {**results["good"], "structuredContent": record})
    host.says(".warnings li", attack)
    assert attack in host.page.locator(".record").inner_text()
    assert host.in_page("() => document.title") != "taken"


def test_only_the_host_is_listened_to(host: Host, calls: dict[str, Call], results: dict[str, dict[str, Any]]) -> None:
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
