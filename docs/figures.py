"""Draw the icons and the figures of the documentation from real runs.

Run ``python -m docs.figures`` in the root of the repository; ``python -m docs.figures
image_to_number`` draws one of them.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Polygon

from research.scenes import Scene, SceneVehicle, render_scene
from vehanchor import Engine, analyse_scale
from vehanchor.analysis.scale_analysis import ScaleAnalysis
from vehanchor.detection.boxes import box_corners, oriented_iou
from vehanchor.records.text import significant
from vehanchor.scale.lengths import modal_density

ROOT = Path(__file__).parent.parent
IMAGE = ROOT / "examples" / "car_park.jpg"
PAGE_IMAGE = ROOT / "examples" / "scenes" / "safe.jpg"
IMAGES = ROOT / "docs" / "images"
METHOD_FIGURE = IMAGES / "image_to_number.png"
# The corners of the roof in that image, pixels.
ROOF_CORNERS = ((452, 182), (528, 247), (349, 447), (277, 381))
ROOF = ",".join(f"{x},{y}" for x, y in ROOF_CORNERS)
# What the page measures: tool and clicks, in pixels of the image.
MEASURED = (
    ("Outline", (*ROOF_CORNERS, ROOF_CORNERS[0])),
    ("Distance", ((217, 120), (292, 188))),
)
# Length and width of what must fit on the roof, metres.
MUST_FIT = "12x5"
# Sides of the icons, pixels. That of the server is small, because every initialisation sends it.
ICONS = {
    ROOT / "server/vehanchor_server/icon.png": 48,
    ROOT / "examples/clients/mcpb/icon.png": 512,
}
# Rows and columns of the image that the first panel shows.
CROP = (slice(250, 510), slice(380, 760))
HIT_IOU = 0.5
# A detection that overlaps a difficult vehicle at least so much is neither a hit nor a false alarm.
EXCUSED_IOU = 0.1
BLUE = "#0072B2"
ORANGE = "#D55E00"
INK = "#222222"
YELLOW = "#FFD400"
# Side of an icon before it is reduced, pixels.
ICON_PX = 1024
GREEN = "#00A65A"
RED = "#E8112D"


def draw(analysis: ScaleAnalysis, pixels: np.ndarray) -> Figure:
    """Draw boxes, lengths and scale in three panels."""
    figure = Figure(figsize=(11, 3.4), dpi=150, layout="constrained")
    boxes, lengths, scale = figure.subplots(1, 3, width_ratios=[1.46, 1.1, 0.9])
    _draw_boxes(boxes, analysis, pixels)
    _draw_lengths(lengths, analysis)
    _write_scale(scale, analysis)
    return figure


def drawn_texts(figure: Figure) -> list[str]:
    """List the titles and texts of the panels, as they are drawn."""
    texts = []
    for axes in figure.axes:
        texts.append(axes.get_title(loc="left"))
        texts += [text.get_text() for text in axes.texts]
    return texts


def _draw_boxes(axes: Axes, analysis: ScaleAnalysis, pixels: np.ndarray) -> None:
    rows, columns = CROP
    extent = (columns.start, columns.stop, rows.stop, rows.start)
    axes.imshow(pixels[rows, columns], extent=extent)
    _outline(axes, box_corners(analysis.detections.boxes), YELLOW, 1.2)
    axes.set(xlim=extent[:2], ylim=extent[2:], xticks=[], yticks=[])
    n_detections = analysis.estimate.details.n_detections
    axes.set_title(f"1. Cars as oriented boxes: {n_detections}", loc="left", fontsize=10)


def _outline(axes: Axes, corners: np.ndarray, colour: str, width: float) -> None:
    """Outline boxes ``[n, 4, 2]``."""
    for box in corners:
        axes.add_patch(Polygon(box, fill=False, edgecolor=colour, linewidth=width))


def _draw_lengths(axes: Axes, analysis: ScaleAnalysis) -> None:
    estimate = analysis.estimate
    assert estimate.mode_length_px is not None
    assert estimate.details.aggregation is not None
    kept = analysis.detections.boxes[analysis.kept, 2]
    scores = analysis.detections.scores[analysis.kept]
    grid = np.linspace(kept.min() * 0.9, kept.max() * 1.1, 400)
    density = modal_density(grid, kept, scores=scores, aggregation=estimate.details.aggregation)
    axes.hist(kept, bins=24, density=True, color="#56B4E9", alpha=0.6)
    axes.plot(grid, density, color=BLUE)
    axes.axvline(estimate.mode_length_px, color=ORANGE)
    axes.set(xlabel="longer side, pixels", yticks=[])
    axes.spines[["top", "right", "left"]].set_visible(False)
    title = f"2. Their modal length: {estimate.mode_length_px:.1f} px"
    axes.set_title(title, loc="left", fontsize=10)


def _write_scale(axes: Axes, analysis: ScaleAnalysis) -> None:
    estimate = analysis.estimate
    assert estimate.gsd_m_per_px is not None
    assert estimate.mode_length_px is not None
    assert estimate.gsd_ci95_low_m_per_px is not None
    assert estimate.gsd_ci95_high_m_per_px is not None
    assert estimate.details.reference_length_m is not None
    by_vehicles = next(ruler.gsd_m_per_px for ruler in estimate.rulers if ruler.kind == "vehicles")
    assert by_vehicles is not None
    scene = json.loads(IMAGE.with_suffix(".json").read_text())
    # The command prints the same digits.
    length_m = significant(estimate.details.reference_length_m, 4)
    low = significant(estimate.gsd_ci95_low_m_per_px, 4)
    high = significant(estimate.gsd_ci95_high_m_per_px, 4)
    lines = (
        f"{length_m} m  /  {estimate.mode_length_px:.1f} px",
        f"= {significant(by_vehicles, 4)} m/px",
        f"with the other rulers: {significant(estimate.gsd_m_per_px, 4)}",
        f"95 %: {low} to {high}",
        f"confidence {estimate.confidence:.2f}",
        f"true scale: {significant(scene['gsd_m_per_px'], 4)}",
    )
    for i, line in enumerate(lines):
        size = 15 if i < 2 else 11
        weight = "bold" if i == 1 else None
        axes.text(0.02, 0.84 - 0.16 * i, line, fontsize=size, color=INK, weight=weight)
    axes.axis("off")
    axes.set_title("3. Metres per pixel", loc="left", fontsize=10)


def draw_hits_and_misses(scene: Scene) -> Figure:
    """Draw hits (green), misses (red) and false alarms (yellow) on a rendered scene."""
    detected = analyse_scale(scene.image).detections.boxes
    cars = [vehicle for vehicle in scene.vehicles if _counts(vehicle)]
    others = [vehicle for vehicle in scene.vehicles if not _counts(vehicle)]
    true_boxes = _boxes_of(cars)
    is_hit = oriented_iou(detected, true_boxes).max(axis=1, initial=0.0) >= HIT_IOU
    is_missed = oriented_iou(true_boxes, detected).max(axis=1, initial=0.0) < HIT_IOU
    overlap = oriented_iou(detected, _boxes_of(others)).max(axis=1, initial=0.0)
    is_excused = overlap > EXCUSED_IOU
    hits = detected[is_hit]
    misses = true_boxes[is_missed]
    false_alarms = detected[~is_hit & ~is_excused]
    figure = Figure(figsize=(8, 8.4), dpi=110, layout="constrained")
    axes = figure.subplots()
    axes.imshow(scene.image)
    for colour, boxes in ((GREEN, hits), (RED, misses), (YELLOW, false_alarms)):
        _outline(axes, box_corners(boxes), colour, 1.3)
    axes.set(xticks=[], yticks=[])
    title = (
        f"{len(hits)} hits (green), {len(misses)} misses (red), "
        f"{len(false_alarms)} false alarms (yellow)"
    )
    axes.set_title(title, fontsize=11)
    return figure


def _counts(vehicle: SceneVehicle) -> bool:
    """Test whether the detector must find a vehicle: a car that is not difficult."""
    return vehicle.kind == "small-vehicle" and not vehicle.difficult


def _boxes_of(vehicles: list[SceneVehicle]) -> np.ndarray:
    """Return oriented boxes, ``[n, 5]``."""
    boxes = [(v.x_px, v.y_px, v.length_px, v.width_px, v.angle_rad) for v in vehicles]
    return np.array(boxes).reshape(-1, 5)


def photograph_page(image: Path, picture: Path) -> None:
    """Measure on the page of ``vehanchor view`` in Chromium, and save a screenshot."""
    from playwright.sync_api import sync_playwright  # extra browser

    command = [sys.executable, "-m", "vehanchor", "view", str(image), "--no-browser"]
    with (
        subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as viewer,
        sync_playwright() as playwright,
    ):
        assert viewer.stderr is not None
        url = viewer.stderr.readline().split()[1]
        chromium = os.environ.get("CHROMIUM") or shutil.which("chromium")
        browser = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": 1280, "height": 860}, device_scale_factor=1.25)
        page.goto(url)
        sheet = page.locator(".sheet")
        sheet.wait_for()
        box = sheet.bounding_box()
        assert box is not None
        pixels = cv2.imread(str(image))
        assert pixels is not None
        height_px, width_px = pixels.shape[:2]
        across = box["width"] / width_px
        down = box["height"] / height_px
        page.get_by_label("Must fit").fill(MUST_FIT)
        for number, (tool, points) in enumerate(MEASURED, start=1):
            page.get_by_role("button", name=tool, exact=True).click()
            for x, y in points:
                page.mouse.click(box["x"] + x * across, box["y"] + y * down)
            page.locator(f"ol.measured li:nth-child({number})").wait_for()
        page.keyboard.press("Escape")
        page.screenshot(path=picture, type="jpeg", quality=85)
        browser.close()
        viewer.terminate()


def draw_icon(side_px: int) -> np.ndarray:
    """Draw a car above a measured length, ``[side_px, side_px, 4]`` BGRA."""
    icon = np.zeros((ICON_PX, ICON_PX, 4), np.uint8)
    ground = (0xB2, 0x72, 0x00, 255)
    paint = (255, 255, 255, 255)
    glass = (0x66, 0x44, 0x11, 255)
    line = (0, 0xD4, 255, 255)
    _draw_block(icon, (0, 0), (ICON_PX - 1, ICON_PX - 1), radius=200, colour=ground)
    # The car from above, with its front and rear windows.
    _draw_block(icon, (170, 230), (854, 560), radius=110, colour=paint)
    _draw_block(icon, (330, 275), (420, 515), radius=30, colour=glass)
    _draw_block(icon, (640, 275), (710, 515), radius=30, colour=glass)
    # Its length, as a dimension line with ends.
    _draw_block(icon, (170, 740), (854, 790), radius=20, colour=line)
    _draw_block(icon, (170, 670), (220, 860), radius=20, colour=line)
    _draw_block(icon, (804, 670), (854, 860), radius=20, colour=line)
    return cv2.resize(icon, (side_px, side_px), interpolation=cv2.INTER_AREA)


def _draw_block(
    icon: np.ndarray,
    first: tuple[int, int],
    last: tuple[int, int],
    *,
    radius: int,
    colour: tuple[int, ...],
) -> None:
    """Draw a rectangle with round corners."""
    left, top = first
    right, bottom = last
    cv2.rectangle(icon, (left + radius, top), (right - radius, bottom), colour, -1)
    cv2.rectangle(icon, (left, top + radius), (right, bottom - radius), colour, -1)
    for x in (left + radius, right - radius):
        for y in (top + radius, bottom - radius):
            cv2.circle(icon, (x, y), radius, colour, -1)


def write_icons() -> None:
    """Write the icons of server and bundle."""
    for icon, side_px in ICONS.items():
        cv2.imwrite(str(icon), draw_icon(side_px), [cv2.IMWRITE_PNG_COMPRESSION, 9])


def write_image_to_number() -> None:
    """Write the figure of the method; its description has the texts, for a test to compare."""
    pixels = cv2.imread(str(IMAGE))
    assert pixels is not None
    figure = draw(analyse_scale(IMAGE), pixels[:, :, ::-1])
    description = "\n".join(drawn_texts(figure))
    figure.savefig(METHOD_FIGURE, metadata={"Description": description})


def write_hits_and_misses() -> None:
    """Write the figure of hits and misses."""
    scene = render_scene(0.15, width_px=800, height_px=800, seed=5, layout="urban")
    figure = draw_hits_and_misses(scene)
    figure.savefig(IMAGES / "hits_and_misses.jpg", pil_kwargs={"quality": 88})


def write_own_shape() -> None:
    """Write the overlay of a roof in an outline of the caller's own."""
    write_overlay(IMAGES / "own_shape.jpg", ["--polygon", ROOF])


def write_fit() -> None:
    """Write the overlay of a rectangle that fits on the roof."""
    write_overlay(IMAGES / "fit.jpg", ["--polygon", ROOF, "--must-fit", MUST_FIT])


def draw_resampled(image: Path, gsd_m_per_px: float, side_m: float) -> Figure:
    """Draw the middle of a photograph beside the same ground in its copy at another scale."""
    copy = Engine().resample(str(image), gsd_m_per_px=gsd_m_per_px)
    photograph = cv2.imread(str(image))
    assert photograph is not None
    own_gsd = copy.scale.gsd_m_per_px
    assert own_gsd is not None
    figure = Figure(figsize=(8, 4.3), dpi=110, layout="constrained")
    panels = figure.subplots(1, 2)
    pictures = (
        (photograph[:, :, ::-1], own_gsd, "the photograph"),
        (copy.pixels, copy.gsd_m_per_px, "its copy"),
    )
    for axes, (pixels, gsd, name) in zip(panels, pictures, strict=True):
        height, width = pixels.shape[:2]
        side = round(side_m / gsd)
        top = (height - side) // 2
        left = (width - side) // 2
        axes.imshow(pixels[top : top + side, left : left + side], interpolation="nearest")
        axes.set(xticks=[], yticks=[])
        title = f"{name}: {significant(gsd)} m/px, {side} px for {side_m:g} m"
        axes.set_title(title, fontsize=10)
    return figure


def write_resampled() -> None:
    """Write the figure of a photograph and its copy at the scale of a model."""
    figure = draw_resampled(PAGE_IMAGE, 0.3, side_m=25)
    figure.savefig(IMAGES / "resampled.jpg", pil_kwargs={"quality": 85})


def write_overlay(figure: Path, options: Sequence[str]) -> None:
    """Write the overlay of ``vehanchor measure`` with options as a figure."""
    with tempfile.TemporaryDirectory() as folder:
        overlay = Path(folder) / "overlay.png"
        command = [sys.executable, "-m", "vehanchor", "measure", str(PAGE_IMAGE), *options]
        subprocess.run([*command, "--overlay", str(overlay)], check=True, capture_output=True)
        picture = cv2.imread(str(overlay))
    assert picture is not None
    cv2.imwrite(str(figure), picture, [cv2.IMWRITE_JPEG_QUALITY, 85])


def write_page() -> None:
    """Write the screenshot of the page."""
    photograph_page(PAGE_IMAGE, IMAGES / "page.jpg")


WRITERS = {
    "icons": write_icons,
    "image_to_number": write_image_to_number,
    "hits_and_misses": write_hits_and_misses,
    "own_shape": write_own_shape,
    "fit": write_fit,
    "resampled": write_resampled,
    "page": write_page,
}


def main(names: Sequence[str]) -> None:
    """Write the named icons and figures; all of them without a name."""
    for name in names or WRITERS:
        WRITERS[name]()


if __name__ == "__main__":
    main(sys.argv[1:])
