"""Draw the ten scenes of ``docs/concepts.md``: each with the densities of its witnesses and the posterior.

Run ``python -m docs.witnesses`` in the root of the project.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import cv2
import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Polygon

from research.scenes import Scene, render_scene
from vehanchor import Engine
from vehanchor.analysis.scale_analysis import ScaleAnalysis
from vehanchor.detection.boxes import box_corners
from vehanchor.pictures.plot import plot_rulers
from vehanchor.records.text import significant

if TYPE_CHECKING:
    from numpy.typing import NDArray

ROOT = Path(__file__).parent.parent
IMAGES = ROOT / "docs" / "images"
PARK = ROOT / "examples" / "car_park.jpg"
STREET = ROOT / "examples" / "scenes" / "safe.jpg"
EMPTY = ROOT / "examples" / "scenes" / "no_cars.jpg"
COARSE = ROOT / "examples" / "scenes" / "too_coarse.jpg"
GSD = 0.12  # of all of them but COARSE, metres per pixel
LINE = (100, 120, 400, 520)  # 500 px, 60 m
FOCAL_PX = 700.0  # 84 m above the ground give 0.12 m/px
FIRST = (120, 260)  # corner of the first pasted vehicle
YELLOW = "#FFD400"
GREEN = "#009E73"
TRUTH = "#D55E00"
_XMP = (
    '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF '
    'xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
    '<rdf:Description rdf:about="" xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/" '
    'drone-dji:RelativeAltitude="{height_m:+.2f}" drone-dji:GimbalPitchDegree="-90.00" '
    'drone-dji:GimbalRollDegree="0.00" drone-dji:CalibratedFocalLength="{focal_px}" '
    'drone-dji:CalibratedOpticalCenterX="{x}" '
    'drone-dji:CalibratedOpticalCenterY="{y}"/></rdf:RDF></x:xmpmeta>'
)


class Example(NamedTuple):
    """A scene, its true scale, and what the caller states."""

    name: str
    image: Path | bytes | NDArray[np.uint8]
    true_gsd_m_per_px: float
    options: dict[str, Any]


def examples() -> list[Example]:
    """Make the ten scenes, in the order of the page."""
    known = {
        factor: {"known_lengths": [(*LINE, 60.0 * factor, "measured")]} for factor in (1.0, 1.3)
    }
    hill = with_height(STREET, 30.0)
    return [
        Example("many_cars", PARK, GSD, {}),
        Example("one_car", _one_car(), GSD, {}),
        Example("one_lorry", _pasted(1.5, 1, 1), GSD, {}),
        Example("look_alikes", _pasted(0.8, 4, 8), GSD, {}),
        Example("line_leads", STREET, GSD, known[1.0]),
        Example("line_wrong", STREET, GSD, known[1.3]),
        Example("line_assumed", EMPTY, GSD, {"known_lengths": [(*LINE, 60.0, "assumed")]}),
        Example("height_contradicts", hill, GSD, {}),
        Example("height_repeated", hill, GSD, {"height_m": 30.0, "height_basis": "measured"}),
        Example("too_coarse", COARSE, 0.5, {}),
    ]


def with_height(photograph: Path, height_m: float) -> bytes:
    """Write a drone's height above take-off, looking straight down, into a copy of a JPEG file."""
    data = photograph.read_bytes()
    pixels = cv2.imread(str(photograph))
    assert pixels is not None
    height_px, width_px = pixels.shape[:2]
    packet = _XMP.format(height_m=height_m, focal_px=FOCAL_PX, x=width_px / 2, y=height_px / 2)
    block = b"http://ns.adobe.com/xap/1.0/\0" + packet.encode()
    return data[:2] + b"\xff\xe1" + (len(block) + 2).to_bytes(2, "big") + block + data[2:]


def _one_car() -> NDArray[np.uint8]:
    return render_scene(
        GSD, width_px=640, height_px=480, seed=2, n_vehicles=1, layout="urban"
    ).image


def _pasted(factor: float, rows: int, columns: int) -> NDArray[np.uint8]:
    """Paste one vehicle of a scene of 0.06 m/px, enlarged, in rows into fields of 0.12 m/px."""
    chip = _chip(
        render_scene(GSD / 2, width_px=1024, height_px=768, seed=1, layout="parking"), factor
    )
    image = render_scene(
        GSD, width_px=800, height_px=600, seed=1, layout="countryside", n_vehicles=0
    ).image.copy()
    height_px, width_px = chip.shape[:2]
    (left, top) = FIRST
    (across, down) = (width_px + 8, height_px + 12)
    if rows > 1:
        yard = image[top - 10 : top + rows * down, left - 10 : left + columns * across]
        yard[:] = yard.mean((0, 1)) * 0.3 + 80
    for y in range(top, top + rows * down, down):
        for x in range(left, left + columns * across, across):
            image[y : y + height_px, x : x + width_px] = chip
    return image


def _chip(scene: Scene, factor: float) -> NDArray[np.uint8]:
    """Cut out the vehicle in the middle of a scene, turned level and enlarged."""
    middle = np.array([scene.image.shape[1], scene.image.shape[0]]) / 2
    cars = [each for each in scene.vehicles if each.kind == "small-vehicle" and not each.difficult]
    car = min(cars, key=lambda each: float(np.hypot(*(middle - (each.x_px, each.y_px)))))
    width_px = round(car.length_px * 1.12 * factor)
    height_px = round(car.width_px * 1.25 * factor)
    cos = math.cos(car.angle_rad) / factor
    sin = math.sin(car.angle_rad) / factor
    left = car.x_px - (cos * width_px - sin * height_px) / 2
    top = car.y_px - (sin * width_px + cos * height_px) / 2
    turned = np.array([[cos, -sin, left], [sin, cos, top]])
    flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    return np.asarray(
        cv2.warpAffine(scene.image, turned, (width_px, height_px), flags=flags), dtype=np.uint8
    )


def pixels_of(image: Path | bytes | NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Decode an image as RGB."""
    if isinstance(image, np.ndarray):
        return image
    data = image if isinstance(image, bytes) else image.read_bytes()
    decoded = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    assert decoded is not None
    return np.asarray(decoded[:, :, ::-1], dtype=np.uint8)


def sentence(analysis: ScaleAnalysis) -> str:
    """Write the record in one line."""
    record = analysis.estimate
    assert record.gsd_m_per_px is not None
    assert record.gsd_ci95_low_m_per_px is not None
    assert record.gsd_ci95_high_m_per_px is not None
    status = "ok" if record.reason is None else f"{record.status}, {record.reason}"
    low = significant(record.gsd_ci95_low_m_per_px)
    high = significant(record.gsd_ci95_high_m_per_px)
    codes = "".join(sorted({f"; {warning.code}" for warning in record.warnings}))
    value = (
        f"{significant(record.gsd_m_per_px)} m/px ({low} to {high}), chance {record.confidence:.2f}"
    )
    return f"{status}: {value}{codes}"


def draw(analysis: ScaleAnalysis, pixels: NDArray[np.uint8], true_gsd_m_per_px: float) -> Figure:
    """Draw a scene beside the densities of its witnesses and the posterior."""
    figure = Figure(figsize=(10, 2.5), dpi=105, layout="constrained")
    scene, densities = figure.subplots(1, 2, width_ratios=[1, 1.9])
    scene.imshow(pixels)
    for corners in box_corners(analysis.detections.boxes[analysis.kept]):
        scene.add_patch(Polygon(corners, fill=False, edgecolor=YELLOW, linewidth=0.8))
    for mark in analysis.marks:
        if len(mark.points) > 1:
            scene.plot(*np.transpose(mark.points), color=GREEN, linewidth=1.5)
    scene.set(xticks=[], yticks=[], xlim=(0, pixels.shape[1]), ylim=(pixels.shape[0], 0))
    plot_rulers(densities, analysis)
    densities.axvline(
        true_gsd_m_per_px,
        color=TRUTH,
        linestyle="--",
        linewidth=1.4,
        label=f"true {true_gsd_m_per_px:g}",
    )
    densities.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), fontsize=8.5, frameon=False)
    densities.set_title(sentence(analysis), loc="left", fontsize=10)
    return figure


def main() -> None:
    """Write ``docs/images/witnesses_*.jpg``, and print the records."""
    engine = Engine()
    for each in examples():
        analysis = engine.analyse_scale(each.image, **each.options)
        print(f"{each.name}: {sentence(analysis)}")
        figure = draw(analysis, pixels_of(each.image), each.true_gsd_m_per_px)
        figure.savefig(
            IMAGES / f"witnesses_{each.name}.jpg", pil_kwargs={"quality": 82, "optimize": True}
        )


if __name__ == "__main__":
    main()
