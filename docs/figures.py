"""Draw the icons and the figures of the documentation from real runs.

Run ``python -m docs.figures`` in the root of the repository.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Polygon

from research.scenes import Scene, render_scene
from vehanchor import analyse_scale
from vehanchor.analysis.scale_analysis import ScaleAnalysis
from vehanchor.detection.boxes import box_corners, oriented_iou
from vehanchor.scale.lengths import modal_density

ROOT = Path(__file__).parent.parent
IMAGE = ROOT / "examples" / "car_park.jpg"
SHOWN = ROOT / "examples" / "scenes" / "safe.jpg"
MEASURED = (  # on that page: tool, start and end in pixels of the image
    ("Area", (255, 160), (535, 470)),
    ("Distance", (217, 120), (292, 188)),
)
ICONS = {  # file: side in pixels
    ROOT / "server/vehanchor_server/icon.png": 48,  # small, because every initialisation sends it
    ROOT / "examples/clients/mcpb/icon.png": 512,
}
CROP = (slice(250, 510), slice(380, 760))  # rows and columns of the image, pixels
HIT_IOU = 0.5
BLUE = "#0072B2"
ORANGE = "#D55E00"
INK = "#222222"


def draw(analysis: ScaleAnalysis, pixels: np.ndarray) -> Figure:
    """Draw boxes, lengths and scale in three panels."""
    estimate = analysis.estimate
    assert estimate.gsd_m_per_px is not None
    assert estimate.mode_length_px is not None
    figure = Figure(figsize=(11, 3.4), dpi=150, layout="constrained")
    boxes, lengths, scale = figure.subplots(1, 3, width_ratios=[1.46, 1.1, 0.9])

    rows, columns = CROP
    extent = (columns.start, columns.stop, rows.stop, rows.start)
    boxes.imshow(pixels[rows, columns], extent=extent)
    for corners in box_corners(analysis.detections.boxes):
        boxes.add_patch(Polygon(corners, fill=False, edgecolor="#FFD400", linewidth=1.2))
    boxes.set(xlim=extent[:2], ylim=extent[2:], xticks=[], yticks=[])
    boxes.set_title(
        f"1. Cars as oriented boxes: {estimate.details.n_detections}", loc="left", fontsize=10
    )

    kept = analysis.detections.boxes[analysis.kept, 2]
    scores = analysis.detections.scores[analysis.kept]
    grid = np.linspace(kept.min() * 0.9, kept.max() * 1.1, 400)
    lengths.hist(kept, bins=24, density=True, color="#56B4E9", alpha=0.6)
    lengths.plot(
        grid,
        modal_density(grid, kept, scores=scores, aggregation=estimate.details.aggregation),
        color=BLUE,
    )
    lengths.axvline(estimate.mode_length_px, color=ORANGE)
    lengths.set(xlabel="longer side, pixels", yticks=[])
    lengths.spines[["top", "right", "left"]].set_visible(False)
    lengths.set_title(
        f"2. Their modal length: {estimate.mode_length_px:.1f} px", loc="left", fontsize=10
    )

    low = estimate.gsd_ci95_low_m_per_px
    high = estimate.gsd_ci95_high_m_per_px
    vehicles = next(ruler.gsd_m_per_px for ruler in estimate.rulers if ruler.kind == "vehicles")
    lines = (
        f"{estimate.details.reference_length_m:.2f} m  /  {estimate.mode_length_px:.1f} px",
        f"= {vehicles:.3f} m/px",
        f"with the other rulers: {estimate.gsd_m_per_px:.3f}",
        f"95 %: {low:.3f} to {high:.3f}",
        f"confidence {estimate.confidence:.2f}",
        "true scale: 0.120",
    )
    for i, line in enumerate(lines):
        scale.text(
            0.02,
            0.84 - 0.16 * i,
            line,
            fontsize=15 if i < 2 else 11,
            color=INK,
            weight="bold" if i == 1 else None,
        )
    scale.axis("off")
    scale.set_title("3. Metres per pixel", loc="left", fontsize=10)
    return figure


def draw_hits_and_misses(scene: Scene) -> Figure:
    """Draw hits (green), misses (red) and false alarms (yellow) on a rendered scene."""
    found = analyse_scale(scene.image).detections.boxes
    boxes = {
        hard: np.array(
            [
                (v.x_px, v.y_px, v.length_px, v.width_px, v.angle_rad)
                for v in scene.vehicles
                if (v.difficult or v.kind != "small-vehicle") == hard
            ]
        ).reshape(-1, 5)
        for hard in (False, True)
    }
    hit = oriented_iou(found, boxes[False]).max(axis=1, initial=0.0) >= HIT_IOU
    excused = oriented_iou(found, boxes[True]).max(axis=1, initial=0.0) > 0.1
    missed = oriented_iou(boxes[False], found).max(axis=1, initial=0.0) < HIT_IOU
    groups = {
        "#00A65A": found[hit],
        "#E8112D": boxes[False][missed],
        "#FFD400": found[~hit & ~excused],
    }
    figure = Figure(figsize=(8, 8.4), dpi=110, layout="constrained")
    axes = figure.subplots()
    axes.imshow(scene.image)
    for colour, group in groups.items():
        for corners in box_corners(group):
            axes.add_patch(Polygon(corners, fill=False, edgecolor=colour, linewidth=1.3))
    counts = [len(group) for group in groups.values()]
    axes.set(xticks=[], yticks=[])
    axes.set_title(
        f"{counts[0]} hits (green), {counts[1]} misses (red), {counts[2]} false alarms (yellow)",
        fontsize=11,
    )
    return figure


def photograph_page(image: Path, picture: Path) -> None:
    """Measure an area and a distance on the page of ``vehanchor view`` in Chromium, and save a screenshot."""
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
        height_px, width_px = cv2.imread(str(image)).shape[:2]  # type: ignore[union-attr]
        for n, (tool, start, end) in enumerate(MEASURED, start=1):
            page.get_by_role("button", name=tool, exact=True).click()
            for i, (x, y) in enumerate((start, end)):
                page.mouse.move(
                    box["x"] + x * box["width"] / width_px, box["y"] + y * box["height"] / height_px
                )
                (page.mouse.up if i else page.mouse.down)()
            page.locator(f"ol.measured li:nth-child({n})").wait_for()
        page.keyboard.press("Escape")
        page.screenshot(path=picture, type="jpeg", quality=85)
        browser.close()
        viewer.terminate()


def draw_icon(side_px: int) -> np.ndarray:
    """Draw a car above a measured length, ``[side_px, side_px, 4]`` BGRA."""
    large = 1024
    icon = np.zeros((large, large, 4), np.uint8)
    ground = (0xB2, 0x72, 0x00, 255)
    paint = (255, 255, 255, 255)
    glass = (0x66, 0x44, 0x11, 255)
    line = (0, 0xD4, 255, 255)

    def block(
        left: int, top: int, right: int, bottom: int, radius: int, colour: tuple[int, ...]
    ) -> None:
        cv2.rectangle(icon, (left + radius, top), (right - radius, bottom), colour, -1)
        cv2.rectangle(icon, (left, top + radius), (right, bottom - radius), colour, -1)
        for x in (left + radius, right - radius):
            for y in (top + radius, bottom - radius):
                cv2.circle(icon, (x, y), radius, colour, -1)

    block(0, 0, large - 1, large - 1, 200, ground)
    block(170, 230, 854, 560, 110, paint)
    block(330, 275, 420, 515, 30, glass)
    block(640, 275, 710, 515, 30, glass)
    for left, top, right, bottom in (
        (170, 740, 854, 790),
        (170, 670, 220, 860),
        (804, 670, 854, 860),
    ):
        block(left, top, right, bottom, 20, line)
    return cv2.resize(icon, (side_px, side_px), interpolation=cv2.INTER_AREA)


def main() -> None:
    """Write the icons of server and bundle, and the images of ``docs/images``."""
    for icon, side_px in ICONS.items():
        cv2.imwrite(str(icon), draw_icon(side_px), [cv2.IMWRITE_PNG_COMPRESSION, 9])
    pixels = cv2.imread(str(IMAGE))
    assert pixels is not None
    draw(analyse_scale(IMAGE), pixels[:, :, ::-1]).savefig(
        ROOT / "docs" / "images" / "image_to_number.png"
    )
    draw_hits_and_misses(
        render_scene(0.15, width_px=800, height_px=800, seed=5, layout="urban")
    ).savefig(ROOT / "docs" / "images" / "hits_and_misses.jpg", pil_kwargs={"quality": 88})
    photograph_page(SHOWN, ROOT / "docs" / "images" / "page.jpg")


if __name__ == "__main__":
    main()
