"""Draw the ten scenes of ``docs/concepts.md`` with the densities of their witnesses.

Run ``python -m docs.witnesses`` in the root of the project.
"""

from __future__ import annotations

import math
import textwrap
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import cv2
import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Polygon

from research.scenes import Scene, SceneVehicle, render_scene
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
# Scale of all scenes except COARSE, metres per pixel.
GSD = 0.12
COARSE_GSD = 0.5
# A line of 500 px, which is 60 m long.
LINE = (100, 120, 400, 520)
LINE_M = 60.0
# Focal length: 84 m above the ground give 0.12 m/px.
FOCAL_PX = 700.0
# Corner of the first pasted vehicle.
FIRST = (120, 260)
# Space between pasted vehicles, across and down.
GAP_PX = (8, 12)
# Spread of the light among pasted vehicles, and of the dirt among the pixels of one, grey levels.
LIGHT_SD = 4.0
DIRT_SD = 14.0
# Grey level that the yard of pasted vehicles has at least, and the width of its border.
YARD_GREY = 80.0
YARD_BORDER_PX = 6.0
TITLE_CHARS = 90
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
    """Scene with its true scale and the options of the caller."""

    name: str
    image: Path | bytes | NDArray[np.uint8]
    options: dict[str, Any]
    true_gsd_m_per_px: float = GSD


def examples() -> list[Example]:
    """Make the ten scenes, in the order of the page."""
    known_line = {"known_lengths": [(*LINE, LINE_M, "measured")]}
    wrong_line = {"known_lengths": [(*LINE, 1.3 * LINE_M, "measured")]}
    assumed_line = {"known_lengths": [(*LINE, LINE_M, "assumed")]}
    hill = with_height(STREET, 30.0)
    return [
        Example("many_cars", PARK, {}),
        Example("one_car", _one_car(), {}),
        Example("one_lorry", _pasted(1.5, rows=1, columns=1), {}),
        Example("look_alikes", _pasted(0.8, rows=4, columns=8), {}),
        Example("line_leads", STREET, known_line),
        Example("line_wrong", STREET, wrong_line),
        Example("line_assumed", EMPTY, assumed_line),
        Example("height_contradicts", hill, {}),
        Example("height_repeated", hill, {"height_m": 30.0, "height_basis": "measured"}),
        Example("too_coarse", COARSE, {}, COARSE_GSD),
    ]


def with_height(photograph: Path, height_m: float) -> bytes:
    """Copy a JPEG file with the metadata of a drone that looks straight down.

    The height is the one above take-off.
    """
    data = photograph.read_bytes()
    pixels = cv2.imread(str(photograph))
    assert pixels is not None
    height_px, width_px = pixels.shape[:2]
    packet = _XMP.format(height_m=height_m, focal_px=FOCAL_PX, x=width_px / 2, y=height_px / 2)
    block = b"http://ns.adobe.com/xap/1.0/\0" + packet.encode()
    length = (len(block) + 2).to_bytes(2, "big")
    # An APP1 segment after the start of the image.
    return data[:2] + b"\xff\xe1" + length + block + data[2:]


def _one_car() -> NDArray[np.uint8]:
    scene = render_scene(GSD, width_px=640, height_px=480, seed=2, n_vehicles=1, layout="urban")
    return scene.image


def _pasted(factor: float, *, rows: int, columns: int) -> NDArray[np.uint8]:
    """Paste one enlarged vehicle in rows into fields of 0.12 m/px; its own scene has 0.06 m/px.

    Each pasted vehicle has its own light and dirt, because equal pixels count as one vehicle.
    """
    parking = render_scene(GSD / 2, width_px=1024, height_px=768, seed=1, layout="parking")
    chip = _chip(parking, factor)
    fields = render_scene(
        GSD, width_px=800, height_px=600, seed=1, layout="countryside", n_vehicles=0
    )
    image = fields.image.copy()
    height_px, width_px = chip.shape[:2]
    generator = np.random.default_rng(1)
    left, top = FIRST
    across = width_px + GAP_PX[0]
    down = height_px + GAP_PX[1]
    if rows > 1:
        # Many vehicles stand on a grey yard, whose border fades into the fields.
        is_yard = np.zeros(image.shape[:2], np.float32)
        is_yard[top - 10 : top + rows * down, left - 10 : left + columns * across] = 1
        share = cv2.GaussianBlur(is_yard, (0, 0), YARD_BORDER_PX)[:, :, None]
        yard = image * 0.3 + YARD_GREY
        image = np.asarray(image + share * (yard - image), np.uint8)
    for y in range(top, top + rows * down, down):
        for x in range(left, left + columns * across, across):
            image[y : y + height_px, x : x + width_px] = _weathered(chip, generator)
    return image


def _weathered(chip: NDArray[np.uint8], generator: np.random.Generator) -> NDArray[np.uint8]:
    """Give a vehicle its own light and dirt."""
    light = generator.normal(0, LIGHT_SD)
    dirt = generator.normal(0, DIRT_SD, chip.shape[:2])
    changed = chip + light + dirt[:, :, None]
    return np.asarray(changed.clip(0, 255), dtype=np.uint8)


def _chip(scene: Scene, factor: float) -> NDArray[np.uint8]:
    """Cut out the car in the middle of a scene, turned upright and enlarged."""
    height_px, width_px = scene.image.shape[:2]
    middle = np.array([width_px, height_px]) / 2
    cars = [
        vehicle
        for vehicle in scene.vehicles
        if vehicle.kind == "small-vehicle" and not vehicle.difficult
    ]

    def distance_to_middle(vehicle: SceneVehicle) -> float:
        return float(np.hypot(*(middle - (vehicle.x_px, vehicle.y_px))))

    car = min(cars, key=distance_to_middle)
    chip_width_px = round(car.length_px * 1.12 * factor)
    chip_height_px = round(car.width_px * 1.25 * factor)
    # Affine transform from the chip to the scene, around the car's centre.
    cos = math.cos(car.angle_rad) / factor
    sin = math.sin(car.angle_rad) / factor
    left = car.x_px - (cos * chip_width_px - sin * chip_height_px) / 2
    top = car.y_px - (sin * chip_width_px + cos * chip_height_px) / 2
    to_scene = np.array([[cos, -sin, left], [sin, cos, top]])
    chip = cv2.warpAffine(
        scene.image,
        to_scene,
        (chip_width_px, chip_height_px),
        flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP,
    )
    return np.asarray(chip, dtype=np.uint8)


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
    gsd = significant(record.gsd_m_per_px)
    low = significant(record.gsd_ci95_low_m_per_px)
    high = significant(record.gsd_ci95_high_m_per_px)
    codes = "".join(sorted({f"; {warning.code}" for warning in record.warnings}))
    return f"{status}: {gsd} m/px ({low} to {high}), chance {record.confidence:.2f}{codes}"


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
    title = textwrap.fill(sentence(analysis), TITLE_CHARS)
    densities.set_title(title, loc="left", fontsize=10)
    return figure


def picture_of(example: Example) -> Path:
    """Return the path of the picture of a scene."""
    return IMAGES / f"witnesses_{example.name}.jpg"


def main() -> None:
    """Write ``docs/images/witnesses_*.jpg``, and print the records."""
    engine = Engine()
    for example in examples():
        analysis = engine.analyse_scale(example.image, **example.options)
        print(f"{example.name}: {sentence(analysis)}")
        figure = draw(analysis, pixels_of(example.image), example.true_gsd_m_per_px)
        # A test compares the comment with the answer of the present version.
        options = {"quality": 82, "optimize": True, "comment": sentence(analysis)}
        figure.savefig(picture_of(example), pil_kwargs=options)


if __name__ == "__main__":
    main()
