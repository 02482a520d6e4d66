"""The page in a real browser.

The test plays the host of MCP Apps: the page is sandboxed, under the host's own policy.
"""

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

from tests.models import paint_vehicles
from tests.sam_models import SamFiles
from tests.server.app_page.test_app_page import CAR_AXIS, SHOWS_PAGES
from tests.server.app_page.viewing import PATIENCE_MS, Person
from tests.server.conftest import POOL_BOX, paint_scene, settings_with_models, write_image
from tests.server.conversation import by_path
from vehanchor.records.text import significant
from vehanchor_server.app import create_server
from vehanchor_server.app_page.page import page_html
from vehanchor_server.app_page.panel import PANEL_KEY
from vehanchor_server.services import create_services

pytestmark = pytest.mark.browser

# what a host must enforce where a page declares no domains (MCP Apps, 2026-01-26, "Host Behavior")
_POLICY = (
    "default-src 'none'; script-src 'self' 'unsafe-inline'; style-src 'self' 'unsafe-inline'; "
    "img-src 'self' data:; media-src 'self' data:; connect-src 'none'; frame-src 'self'; "
    "object-src 'none'; base-uri 'self'"
)
_HOST = """<!doctype html><title>host</title><style>
body { margin: 0 }
iframe { border: 0; width: 100%; display: block }
</style><body><script>
const heard = [];
let offered = {}, answer = null;
const view = () => document.querySelector("iframe").contentWindow;
const tell = (message) => view().postMessage({ jsonrpc: "2.0", ...message }, "*");
addEventListener("message", ({ source, data }) => {
  if (source !== view()) return;
  heard.push(data);
  if (data.method === "ui/initialize") {
    tell({ id: data.id, result: { protocolVersion: "2026-01-26", ...offered } });
  }
  if (data.method === "tools/call") tell({ id: data.id, ...answer });
  if (data.method === "ui/notifications/size-changed") {
    document.querySelector("iframe").style.height = `${data.params.height}px`;
  }
});
function show(html, offer) {
  offered = offer;
  document.body.innerHTML = '<iframe sandbox="allow-scripts"></iframe>';
  document.querySelector("iframe").srcdoc = html;
}
</script>"""

LINE = {"x1": 20, "y1": 20, "x2": 420, "y2": 20, "metres": 400}  # ten times what the cars say
ACROSS = [{"points": [{"x": 200, "y": 200}, {"x": 400, "y": 300}]}]
HALF = {"width_px": 320, "height_px": 256}
Call = tuple[str, dict[str, Any]]
Results = dict[str, dict[str, Any]]


class Host(Person):
    """A host of MCP Apps in a browser's tab, with the page inside it."""

    def __init__(self, tab: Any, calls: dict[str, Call], results: Results) -> None:
        super().__init__(tab, tab.frame_locator("iframe"))
        self.calls = calls
        self.results = results
        tab.route("**/*", self._serve)
        tab.goto("http://host.test/")

    def _serve(self, route: Any) -> None:
        route.fulfill(
            body=_HOST, content_type="text/html", headers={"Content-Security-Policy": _POLICY}
        )

    def show(self, name: str = "", *, tools: bool = False, **context: Any) -> None:
        """Load the page, and give it a result once it is ready."""
        offered = {"hostContext": context, "hostCapabilities": {"serverTools": {}} if tools else {}}
        self.tab.evaluate(
            "(page) => show(...page)",
            [page_html(), offered | {"hostInfo": {"name": "a", "version": "1"}}],
        )
        self.until(
            lambda: (
                "ui/notifications/initialized"
                in [message.get("method") for message in self.heard()]
            )
        )
        if name:
            self.result(name)

    def sends(self, **message: Any) -> None:
        self.tab.evaluate("(message) => tell(message)", message)

    def result(self, name: str, more: dict[str, Any] | None = None, **other: Any) -> None:
        """Send a result as a host does, with more arguments or other parts of the result."""
        self.sends(
            method="ui/notifications/tool-input",
            params={"arguments": self.calls[name][1] | (more or {})},
        )
        self.sends(method="ui/notifications/tool-result", params=self.results[name] | other)

    def answers(self, name: str) -> None:
        """Give the page's next calls this result."""
        self.tab.evaluate("(result) => { answer = { result }; }", self.results[name])

    def record(self, name: str) -> dict[str, Any]:
        return dict(self.results[name]["structuredContent"])

    def panel(self, name: str) -> dict[str, Any]:
        return dict(self.results[name]["_meta"][PANEL_KEY])

    def heard(self) -> list[dict[str, Any]]:
        """Every message from the page so far."""
        return list(self.tab.evaluate("() => heard"))

    def asked(self) -> list[dict[str, Any]]:
        """The calls among them."""
        return [
            message["params"] for message in self.heard() if message.get("method") == "tools/call"
        ]

    def replies(self) -> list[dict[str, Any]]:
        return [message for message in self.heard() if "method" not in message]

    def until(self, holds: Callable[[], bool]) -> None:
        for _ in range(PATIENCE_MS // 50):
            if holds():
                return
            self.tab.wait_for_timeout(50)
        raise AssertionError("it never came true")


@pytest.fixture(scope="module")
def calls(tmp_path_factory: pytest.TempPathFactory, _images: Path) -> dict[str, Call]:
    """What an agent asks, by what comes of it."""
    folder = tmp_path_factory.mktemp("page").resolve()
    short = paint_scene(640, 512, 0)
    paint_vehicles(
        short,
        [(60 + 40 * (i % 12), 60 + 60 * (i // 12), 12 + 0.1 * (i % 7), 6, 0.0) for i in range(24)],
    )
    long = paint_scene(640, 512)
    paint_vehicles(long, [(80 + 110 * i, 420, 70, 20, 0.0) for i in range(3)])
    pool = {**by_path(_images / "pool.png"), "targets": [{"box": POOL_BOX}]}
    alone = {**by_path(_images / "pool_alone.png"), "targets": [{"box": POOL_BOX}]}
    return {
        "good": ("estimate_gsd", by_path(_images / "cars.png")),
        "guarded": ("estimate_gsd", by_path(write_image(folder / "short.png", short))),
        "outliers": ("estimate_gsd", by_path(write_image(folder / "long.png", long))),
        "few": ("estimate_gsd", {**by_path(_images / "two.png"), "frame": HALF}),
        "rulers": (
            "estimate_gsd",
            {
                **by_path(_images / "cars.png"),
                "known_lengths": [LINE],
                "height_m": 70,
                "focal_35mm": 24,
            },
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
        "area, scale given": (
            "measure_area",
            {**alone, "gsd_m_per_px": 0.2, "gsd_basis": "measured"},
        ),
        "area, no ruler": ("measure_area", alone),
    }


@pytest.fixture(scope="module")
def results(
    calls: dict[str, Call], _images: Path, detector_path: Path, segmenter_paths: SamFiles
) -> Results:
    """What the server answers to a host that shows pages, as on the wire."""
    roots = (_images, Path(calls["guarded"][1]["image"]["path"]).parent)
    settings = settings_with_models(roots, detector_path, segmenter_paths)

    async def ask() -> Results:
        async with Client(
            create_server(create_services(settings)), extensions=SHOWS_PAGES
        ) as client:
            return {
                name: (await client.call_tool(*call)).model_dump(
                    mode="json", by_alias=True, exclude_none=True
                )
                for name, call in calls.items()
            }

    with ThreadPoolExecutor(1) as thread:  # Playwright has the event loop of this one
        return thread.submit(anyio.run, ask).result()


@pytest.fixture
def host(chromium: Any, calls: dict[str, Call], results: Results) -> Iterator[Host]:
    host = Host(chromium.new_page(viewport={"width": 900, "height": 1200}), calls, results)
    yield host
    host.leave("http://host.test/")


def test_a_good_estimate_is_shown_in_words_numbers_boxes(host: Host) -> None:
    record = host.record("good")
    jpeg = host.panel("good")["picture_jpeg"]
    host.show("good")
    host.reads("#sentence", "Measured from vehicles.")
    host.reads("#status", "Safe to use")
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


def test_every_state_is_told_in_its_own_words(host: Host) -> None:
    few, area, pixels = map(host.record, ("few", "area", "area, no ruler"))
    copy = f"{significant(few['frame']['gsd_m_per_px'])} m/px at 320 \u00d7 256 px"
    first = ".readings > div:first-child"
    last = ".readings > div:last-child"
    circle = ".readings > div:nth-child(2) .value"
    states: dict[str, dict[str, str | re.Pattern[str]]] = {
        "guarded": {"#status": "Low confidence: do not use", f"{first} .warn": "do not use"},
        # The long ones stand together: there the image may have another scale.
        "outliers": {last: "Vehicles measured24of 27 detected; 3 outliers"},
        "few": {"#sentence": re.compile("^2 vehicles alone: too little evidence; ")},
        "no ruler": {"#status": "No metric scale", first: "Scalenoneno ruler found"},
        "area": {
            f"{first} .value": f"{area['area_m2']:.3g}m²",
            circle: f"⌀ {area['inscribed_diameter_m']:.3g}m",
        },
        "area, scale given": {
            last: "Scale0.2m/pxgiven by the caller",
            "#subject": "area of an object",
        },
        "area, no ruler": {first: f"Area{pixels['mask_area_px']:,}pxno scale: pixels only"},
        "failed": {"#status": "No result", "#sentence": re.compile(r"^(?!\w+: )")},
    }
    host.show(tools=True)
    for name, words in states.items():
        host.result(name)
        for selector, text in words.items():
            host.reads(selector, text)
        text = host.page.locator("main").inner_text()
        assert not re.search(r"null|undefined|NaN|[a-z]_[a-z]", text.partition("Details")[0]), (
            f"{name}: {text}"
        )
        assert host.page.locator(".scale-bar").count() == (name in ("area", "area, scale given")), (
            name
        )
        assert host.page.locator(".drawn path.object").count() == name.startswith("area")
        has_scale = name not in ("no ruler", "area, no ruler", "failed")
        assert host.page.get_by_role("button", name="Distance").count() == has_scale, name
        assert (
            copy in (host.page.locator(".record").last.text_content() if name == "few" else "")
        ) == (name == "few")


def test_a_call_is_told_from_its_beginning_to_its_end(host: Host) -> None:
    host.show()
    host.sends(method="ui/notifications/tool-input", params={"arguments": host.calls["good"][1]})
    host.reads("#sentence", "Measuring.")
    host.sends(method="ui/notifications/tool-cancelled", params={"reason": "user action"})
    host.reads("#sentence", "Cancelled: user action.")
    text = [{"type": "text", "text": "0.1 m/px"}]  # of a host that passes on no more
    host.result("good", content=text, structuredContent=None, _meta={})
    host.reads("#sentence", "0.1 m/px")
    assert host.page.locator(".picture").count() == 0


def test_rulers_are_listed_with_their_chances(host: Host) -> None:
    record = host.record("rulers")
    host.show("rulers")
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


@pytest.mark.parametrize("thing", ["", "iso_container_20ft"])
def test_a_drawn_known_length_is_a_ruler(host: Host, thing: str) -> None:
    host.show("good", tools=True)
    host.answers("rulers")
    host.presses("Draw a known length")
    host.clicks((100, 200))
    host.reads(".picture [role=status]", "Click the other end.")
    host.clicks((101, 200))
    host.reads(".picture [role=status]", re.compile("Too short"))
    host.clicks((100, 200), (500, 400))
    metres = host.page.get_by_label("Metres between both ends")
    if thing:
        host.page.get_by_label("What the line measures").select_option(thing)
        assert not metres.is_visible()
    else:
        metres.fill("38.5")
        host.page.get_by_label("measured by tape, plan or survey").check()
    host.presses("Measure again")
    host.reads("#sentence", host.panel("rulers")["sentence"])
    (asked,) = host.asked()
    (line,) = asked["arguments"].pop("known_lengths")
    assert asked["arguments"] == host.calls["good"][1]
    ends = [line.pop(name) for name in ("x1", "y1", "x2", "y2")]
    assert ends == pytest.approx([100, 200, 500, 400], abs=2.0)
    assert line == ({"metres": thing} if thing else {"metres": 38.5, "basis": "measured"})
    host.page.locator(".drawn path.mark").wait_for(state="attached")  # a level line has no height


def test_measurements_by_clicks_have_the_arguments_of_the_scale(
    host: Host,
) -> None:
    facts = {
        "region": "europe",
        "height_m": 70,
        "focal_35mm": 24,
        "drop": "1",
        "known_lengths": [LINE],
        "frame": HALF,
    }
    host.show(tools=True)
    host.result("good", facts)
    host.answers("distance")
    host.presses("Distance", "Zoom in")
    host.clicks((200, 200), (400, 300))
    metres = host.record("distance")["distance_m"]
    host.reads("ol.measured li:first-child .number", f"{metres:.3g} m")
    host.answers("area")
    host.presses("Area")
    host.drags((300, 180), (420, 330))
    host.reads("ol.measured li:last-child .number", f"{host.record('area')['area_m2']:.3g} m²")
    distance, area = [call["arguments"] for call in host.asked()]
    (line,) = distance.pop("lines")
    (target,) = area.pop("targets")
    assert distance == area == {**host.calls["good"][1], **facts}
    places = [value for point in line["points"] for value in point.values()]
    places += target["box"].values()
    assert places == pytest.approx([100, 100, 200, 150, 150, 90, 210, 165], abs=1), (
        "in pixels of the copy"
    )
    assert host.page.locator(".drawn path.measured").count() == 2
    host.page.get_by_role("button", name="Remove").first.click()
    assert host.page.locator(".drawn path.measured").count() == 1


def test_an_outline_has_the_pixels_of_the_caller_and_what_must_fit(host: Host) -> None:
    host.show(tools=True)
    host.result("good", {"frame": HALF})
    host.page.get_by_label("Must fit").fill("9")
    host.answers("failed")
    host.presses("Outline")
    host.clicks((100, 100), (300, 100), (300, 200), (300, 200))
    host.reads(".picture [role=status]", re.compile("^Not measured"))
    assert host.page.get_by_role("button", name="Close the outline").is_visible(), "corners stay"
    host.answers("area")
    host.presses("Take back the last corner")
    host.clicks((300, 250), (100, 250))
    host.presses("Close the outline")
    host.page.locator("ol.measured li").wait_for()
    _, asked = host.asked()
    [target] = asked["arguments"]["targets"]
    corners = [50, 50, 150, 50, 150, 125, 50, 125]
    assert target["polygon"] == pytest.approx(corners, abs=1), "in pixels of the copy"
    assert asked["arguments"]["must_fit"] == {"diameter_m": 9}


def test_a_size_that_is_none_is_refused_in_words(host: Host) -> None:
    host.show("good", tools=True)
    host.page.get_by_label("Must fit").fill("12 x 5 x 3")
    host.types("Tab")
    host.reads(".picture [role=status]", re.compile("^Type a diameter"))


@pytest.mark.parametrize(
    ("typed", "shape"),
    [
        ("30 ft", {"diameter_m": pytest.approx(9.144)}),
        ("12 x 5 m", {"length_m": 12, "width_m": 5}),
    ],
)
def test_a_size_may_have_its_own_unit(host: Host, typed: str, shape: dict[str, float]) -> None:
    host.show(tools=True)
    host.result("area")
    other = "ft" if typed.endswith("m") else "m"
    host.page.get_by_label("Lengths in").select_option(other)
    host.answers("area")
    host.page.get_by_label("Must fit").fill(typed)
    host.types("Tab")
    host.until(lambda: bool(host.asked()))
    [asked] = host.asked()
    assert asked["arguments"]["must_fit"] == shape


def test_people_choose_feet_and_centimetres(host: Host) -> None:
    host.show(tools=True)
    host.result("good", {"height_m": 30.48})
    host.page.get_by_label("Lengths in").select_option("ft")
    host.page.get_by_label("Scale in").select_option("cm/px")
    record = host.record("good")
    scale = f"{record['gsd_m_per_px'] * 100:#.3g}"
    host.reads(".readings > div:first-child .value", f"{scale}cm/px")
    host.page.get_by_text("Region and height").click()
    height = host.page.get_by_label("Camera height above ground, ft")
    assert height.input_value() == "100"
    height.fill("200")
    host.answers("rulers")
    host.presses("Measure with these")
    host.reads("#sentence", host.panel("rulers")["sentence"])
    [asked] = host.asked()
    assert asked["arguments"]["height_m"] == pytest.approx(60.96)


def test_corrections_of_vehicles_follow_those_of_the_call(host: Host) -> None:
    vehicles = {each[6]: each for each in host.panel("corrected")["drawing"]["vehicles"]}
    row = [n for n, each in vehicles.items() if each[1] < 95]
    host.show("corrected", tools=True)
    host.reads(".row.asked span:not(.note)", "Vehicles by hand: 1 added, 1 dropped")
    assert host.page.locator(".drawn path.stated").get_attribute("d").count("Z") == 1
    assert not host.page.get_by_role("button", name="Measure again").is_visible()
    host.presses("Drop")
    for place, words in (
        (vehicles[2][:2], "Vehicle 2 dropped."),
        (vehicles[12][:2], "Vehicle 12 dropped."),
        (vehicles[2][:2], "Vehicle 2 as found."),
        ((600, 500), "No vehicle here."),
        ((CAR_AXIS["x1"] + 16, CAR_AXIS["y1"]), "1 vehicle dropped."),
    ):
        host.clicks(place)
        host.reads(".picture [role=status]", words)
    host.drags((2, 2), (638, 95))
    host.reads(".picture [role=status]", f"{len(row)} vehicles dropped.")
    host.presses("Add")
    host.drags((100, 480), (132, 480))
    host.clicks((200, 480), (232, 480))
    host.reads(
        ".row.asked span:not(.note)", f"Vehicles by hand: 2 added, {len({1, 12, *row})} dropped"
    )
    host.answers("corrected")
    host.presses("Measure again")
    host.reads("#sentence", re.compile(r"Vehicles corrected by hand: 1 added, 1 dropped\.$"))
    host.presses("Take all back")
    host.answers("good")
    host.presses("Measure again")
    host.reads("#sentence", "Measured from vehicles.")
    asked, again = host.asked()
    ends = [end for axis in asked["arguments"].pop("add") for end in axis.values()]
    assert ends == pytest.approx([100, 480, 132, 480, 200, 480, 232, 480], abs=2)
    assert set(map(int, asked["arguments"].pop("drop").split(","))) == {1, 12, *row}
    assert asked == again == {"name": "estimate_gsd", "arguments": host.calls["good"][1]}


def test_facts_are_those_of_the_call_until_a_person_changes_them(host: Host) -> None:
    facts = {"region": "europe", "height_m": 70, "height_basis": "measured", "focal_35mm": 24}
    host.show(tools=True)
    host.result("good", facts)
    host.page.get_by_text("Region and height").click()
    fields = [host.page.get_by_label(name) for name in ("Region", "Camera height", "Focal length")]
    assert [field.input_value() for field in fields] == ["europe", "70", "24"]
    host.answers("rulers")
    fields[0].select_option(label="India")
    fields[1].fill("0")
    host.presses("Measure with these")  # refused: no height
    fields[1].fill("90")
    host.page.get_by_label("height measured").uncheck()
    host.presses("Measure with these")
    host.reads("#sentence", host.panel("rulers")["sentence"])
    (asked,) = host.asked()
    assert asked["arguments"] == {
        **host.calls["good"][1],
        "region": "IN",
        "height_m": 90,
        "focal_35mm": 24,
    }


def test_keys_move_the_picture_or_set_points(host: Host) -> None:
    host.show("good", tools=True)
    host.page.get_by_role("button", name="Zoom in").focus()
    host.types("Enter", "Tab", "Tab")
    assert host.runs("document.activeElement.className") == "frame zoomed"
    left = "parseFloat(document.querySelector('.sheet').style.left)"
    before = host.runs(left)
    host.types("ArrowRight")
    assert host.runs(left) == pytest.approx(before - 60)
    host.types("0")
    assert host.runs("document.activeElement.className") == "frame"
    host.answers("distance")
    host.page.get_by_role("button", name="Distance").focus()
    host.types("Enter", "ArrowLeft", "ArrowLeft", "Enter", "Backspace", "ArrowLeft", "Enter")
    host.types(*["ArrowRight"] * 8, "Shift+ArrowDown", "Enter")
    metres = host.record("distance")["distance_m"]
    host.reads("ol.measured li .number", f"{metres:.3g} m")
    (call,) = host.asked()
    start, end = call["arguments"]["lines"][0]["points"]
    pixel = 640 / host.page.locator(".sheet").bounding_box()["width"]
    assert (start["x"], start["y"]) == pytest.approx((320 - 30 * pixel, 256), abs=0.5)
    assert (end["x"], end["y"]) == pytest.approx((320 + 50 * pixel, 256 + pixel), abs=0.5)
    host.types("Escape")
    assert host.page.get_by_role("button", name="Distance").get_attribute("aria-pressed") == "false"


def test_a_measurement_that_fails_or_is_not_to_be_used_says_so(host: Host) -> None:
    host.show("few", tools=True)
    host.answers("failed")
    host.presses("Distance")
    host.drags((100, 100), (300, 300))
    host.reads(".picture [role=status]", re.compile(r"^Not measured: (?!\w+:)"))
    host.answers("distance, few")
    host.drags((100, 100), (300, 300))
    host.reads("ol.measured li.untrusted .note:nth-of-type(3)", "do not use: low confidence")


@pytest.mark.parametrize(("theme", "width"), [("light", 340), ("dark", 900)])
def test_no_state_has_a_fault_or_another_height_than_its_frame(
    host: Host, theme: str, width: int
) -> None:
    host.tab.set_viewport_size({"width": width, "height": 2400})
    host.show(tools=True, theme=theme)
    for name, (tool, _) in host.calls.items():
        if tool == "measure_distance":
            continue  # shows no page
        host.result(name)
        host.until(lambda: bool(host.runs("innerHeight === document.documentElement.scrollHeight")))
        host.finds_no_fault(width)


def test_the_theme_has_the_colours_of_the_host(host: Host) -> None:
    host.show(
        theme="dark",
        styles={"variables": {"--color-background-primary": "light-dark(#fefefe, #010203)"}},
    )
    ground = "getComputedStyle(document.body).backgroundColor"
    assert host.runs(ground) == "rgb(1, 2, 3)"
    host.sends(method="ui/notifications/host-context-changed", params={"theme": "light"})
    host.until(lambda: bool(host.runs(ground) == "rgb(254, 254, 254)"))


def test_words_of_the_server_are_shown_as_words(host: Host) -> None:
    attack = "<img src=x onerror=\"document.title='taken'\">"
    record = {
        **host.record("good"),
        "warnings": [{"code": "x", "message": attack}],
        "model": attack,
    }
    host.show()
    host.result(
        "good",
        structuredContent=record,
        _meta={PANEL_KEY: {**host.panel("good"), "sentence": attack}},
    )
    host.reads("#sentence", attack)
    host.reads(".warnings li", attack)
    assert attack in host.page.locator(".record").text_content()
    assert host.runs("() => document.title") != "taken"


def test_the_page_talks_to_its_host_alone(host: Host) -> None:
    host.show("good")
    first, second, *_ = host.heard()
    assert first["method"] == "ui/initialize"
    assert first["params"]["protocolVersion"] == "2026-01-26"
    assert set(first["params"]) == {"appInfo", "appCapabilities", "protocolVersion"}
    assert set(first["params"]["appInfo"]) == {"name", "version"}
    assert second == {"jsonrpc": "2.0", "method": "ui/notifications/initialized", "params": {}}
    forged = {
        "jsonrpc": "2.0",
        "method": "ui/notifications/tool-result",
        "params": host.results["no ruler"],
    }
    host.runs(f"window.postMessage({json.dumps(forged)}, '*')")
    host.sends(jsonrpc="1.0", method="ui/notifications/tool-cancelled", params={})
    for id_, method in ((7, "ping"), (8, "ui/resource-teardown"), (9, "ui/unheard-of")):
        host.sends(id=id_, method=method, params={})
    host.until(lambda: len(host.replies()) == 3)
    *known, unknown = host.replies()
    assert known == [{"jsonrpc": "2.0", "id": id_, "result": {}} for id_ in (7, 8)]
    assert unknown["error"]["code"] == -32601
    host.reads("#status", "Safe to use")


def test_opened_by_itself_the_page_says_what_it_is_for(chromium: Any) -> None:
    tab = chromium.new_page()
    tab.set_content(page_html())
    assert "It shows nothing on its own" in tab.locator("#sentence").inner_text()
    tab.close()
