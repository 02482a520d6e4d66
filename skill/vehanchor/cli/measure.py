"""``vehanchor measure``: areas of objects."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeAlias, cast

import typer

from vehanchor.cli.cli_options import ParsedOptions, Photograph, scale_command
from vehanchor.cli.measurement import show_measurement
from vehanchor.cli.multi_value import parse_point
from vehanchor.cli.scale_option import (
    GivenGsd,
    ObjectHeight,
    ScaleFile,
    SearchAnyway,
    read_scale,
)
from vehanchor.cli.terminal import AsJson, Strict
from vehanchor.errors import PromptError
from vehanchor.options.models import SEGMENTER
from vehanchor.records.text import fit_in_words, significant, with_interval
from vehanchor.scale.defaults import SHORT_SHA

if TYPE_CHECKING:
    from collections.abc import Sequence

    from vehanchor.analysis.measurement_analysis import AreaAnalysis, AreaCollection
    from vehanchor.cli.terminal import Facts
    from vehanchor.measure.shapes import CallerShape, Orientation
    from vehanchor.models.runtime import Progress
    from vehanchor.options import ScaleOptions
    from vehanchor.records import AreaMeasurement, OtherObject


SegmenterFiles: TypeAlias = Annotated[
    tuple[str, str] | None,
    typer.Option(metavar=SEGMENTER.metavar, help=SEGMENTER.help),
]

TightBox: TypeAlias = Annotated[
    tuple[float, float, float, float] | None,
    typer.Option(
        metavar="X1 Y1 X2 Y2", help="A box around the object, pixels; otherwise give points."
    ),
]
OwnPolygons: TypeAlias = Annotated[
    list[str] | None,
    typer.Option(
        metavar="X1,Y1,X2,Y2,...",
        help="An outline that you have already, pixels; no segmenter runs; repeatable.",
    ),
]
OwnShapes: TypeAlias = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        help="Your own shapes: COCO JSON (by file_name), GeoJSON, or a PNG of ids.",
    ),
]
EdgeError: TypeAlias = Annotated[
    float | None,
    typer.Option(
        metavar="PX",
        help="How far the edge of your shapes may be off. Default: 0.5 of polygons, 1 of masks.",
    ),
]
ShapeOrientation: TypeAlias = Annotated[
    str | None,
    typer.Option(
        metavar="WORD",
        help="Your shapes are of the upright picture (oriented) or of the pixels as stored "
        "(stored).",
    ),
]
FittingShape: TypeAlias = Annotated[
    str | None,
    typer.Option(
        metavar="METRES",
        help="Does it fit inside? A diameter such as 12, or length x width such as 12x5.",
    ),
]
MaskFile: TypeAlias = Annotated[
    Path | None,
    typer.Option(metavar="OUT.png", help="Write the object's mask, white on black, in full size."),
]
OutlineFile: TypeAlias = Annotated[
    Path | None,
    typer.Option(
        metavar="OUT.geojson",
        help="Write the outline with its area as GeoJSON: degrees if georeferenced, else pixels.",
    ),
]


@scale_command()
def measure(
    image: Photograph,
    box: TightBox = None,
    point: Annotated[
        list[str] | None,
        typer.Option(metavar="X Y", help="A point on the object, pixels; repeatable."),
    ] = None,
    negative: Annotated[
        list[str] | None, typer.Option(metavar="X Y", help="A point beside the object; repeatable.")
    ] = None,
    polygon: OwnPolygons = None,
    shapes: OwnShapes = None,
    edge: EdgeError = None,
    orientation: ShapeOrientation = None,
    must_fit: FittingShape = None,
    gsd: GivenGsd = None,
    scale: ScaleFile = None,
    object_height: ObjectHeight = None,
    search: SearchAnyway = False,
    as_json: AsJson = False,
    overlay: Annotated[
        Path | None,
        typer.Option(
            metavar="OUT.png", help="Write the object with outline, vehicles and scale bar."
        ),
    ] = None,
    mask: MaskFile = None,
    outline: OutlineFile = None,
    segmenter: SegmenterFiles = None,
    strict: Strict = False,
    *,
    chosen: ParsedOptions,
) -> None:
    """Measure the area (square metres) of the object in a box or at a point, or of your shapes.

    The scale comes from the file if it is georeferenced, else from cars in the image, unless you
    give one.
    """

    def analyse(progress: Progress) -> AreaAnalysis | AreaCollection:
        engine = chosen.engine(segmenter=segmenter)
        known_scale = read_scale(scale, image)
        common: dict[str, Any] = {
            "gsd_m_per_px": gsd,
            "scale": known_scale,
            "object_height_m": object_height,
            "must_fit": _read_must_fit(must_fit),
            "file_scale": not search,
            "progress": progress,
        }
        points = _read_points(point, negative)
        if polygon is None and shapes is None:
            _refuse_shape_options(edge, orientation)
            return engine.analyse_area(image, box=box, points=points, **common)
        if box is not None or points is not None:
            raise PromptError("give a box or points, or your own --polygon or --shapes, not both")
        from vehanchor.analysis.measurement_analysis import AreaCollection

        own_shapes = _read_own_shapes(polygon, shapes, image, engine.options)
        analyses = engine.analyse_areas(
            image,
            own_shapes,
            edge_px=edge,
            orientation=cast("Orientation | None", orientation),
            **common,
        )
        return analyses[0] if len(analyses) == 1 else AreaCollection.of(analyses)

    files = {"outline": outline, "overlay": overlay, "mask": mask}
    show_measurement(image, analyse, facts=_facts, files=files, as_json=as_json, strict=strict)


def _refuse_shape_options(edge: float | None, orientation: str | None) -> None:
    if edge is not None or orientation is not None:
        raise PromptError("--edge and --orientation are about --polygon and --shapes: add one")


def _read_own_shapes(
    polygons: Sequence[str] | None, file: Path | None, image: str, options: ScaleOptions
) -> list[CallerShape]:
    """Read the polygons of the command line, then the shapes of a file."""
    from vehanchor.measure.shape_file import read_shape_file
    from vehanchor.measure.shapes import read_polygon

    own_shapes: list[CallerShape] = []
    for text in polygons or ():
        numbers = text.replace(",", " ").split()
        try:
            own_shapes.append(read_polygon([float(number) for number in numbers]))
        except PromptError as error:
            raise PromptError(f"--polygon: {error}") from None
        except ValueError:
            raise PromptError(
                f"--polygon is {text!r}: use numbers with commas, X1,Y1,X2,Y2,..."
            ) from None
    if file is not None:
        own_shapes += read_shape_file(file, image, limits=options.reading.limits)
    return own_shapes


def _read_must_fit(text: str | None) -> dict[str, float] | None:
    """Read a diameter, or length x width."""
    if text is None:
        return None
    try:
        sizes = [float(size) for size in text.lower().split("x")]
    except ValueError:
        sizes = []
    if len(sizes) == 1:
        return {"diameter_m": sizes[0]}
    if len(sizes) == 2:
        return {"length_m": sizes[0], "width_m": sizes[1]}
    raise PromptError(f"--must-fit is {text!r}: use metres, as 12 or 12x5")


def _read_points(
    on_object: Sequence[str] | None, beside_object: Sequence[str] | None
) -> list[tuple[float, float, bool]] | None:
    """Read the points of both options: x, y, whether on the object. None without any."""
    points = []
    for text in on_object or ():
        x, y = parse_point("--point", text)
        points.append((x, y, True))
    for text in beside_object or ():
        x, y = parse_point("--negative", text)
        points.append((x, y, False))
    return points or None


def _facts(record: AreaMeasurement) -> Facts:
    """List the facts of the record without its scale."""
    area = with_interval(
        record.area_m2,
        record.area_ci95_low_m2,
        high=record.area_ci95_high_m2,
        unit="m2",
        missing="none: there is no scale, or no mask",
    )
    facts = [("area", area)]
    if record.fit is not None:
        facts.append(("fits", _fit_text(record)))
    if record.area_m2 is not None:
        facts += _size_facts(record)
    if record.segmenter is None:
        facts.append(("shape", _shape_text(record)))
        return facts
    facts.append(("mask", f"{record.mask_area_px} px, score {record.mask_score or 0:.2f}"))
    for other_object in record.alternatives:
        facts.append(("or the object", _object_text(other_object)))
    assert record.segmenter_sha256 is not None
    sha256 = record.segmenter_sha256[:SHORT_SHA]
    facts.append(("segmenter", f"{record.segmenter} ({sha256})"))
    return facts


def _shape_text(record: AreaMeasurement) -> str:
    if record.polygon_area_px is None:
        return f"your mask, {record.mask_area_px} px"
    return f"your polygon, {significant(record.polygon_area_px, 4)} px"


def _size_facts(record: AreaMeasurement) -> Facts:
    """List sides, perimeter and largest circle of the object."""
    length = significant(record.length_m or 0, 4)
    width = significant(record.width_m or 0, 4)
    perimeter = significant(record.perimeter_m or 0, 4)
    circle = with_interval(
        record.inscribed_diameter_m,
        record.inscribed_diameter_ci95_low_m,
        high=record.inscribed_diameter_ci95_high_m,
        unit="m",
    )
    return [
        ("size", f"{length} x {width} m, perimeter {perimeter} m"),
        ("largest circle", circle),
    ]


def _fit_text(record: AreaMeasurement) -> str:
    """State the shape that must fit, its probability and its place."""
    fit = record.fit
    assert fit is not None
    if record.area_m2 is None:
        return fit_in_words(fit, has_scale=False)
    text = fit_in_words(fit)
    if record.status != "ok":
        text += "; do not act on it"
    if fit.center is not None:
        text += f"; best at x {fit.center.x_px:.0f}, y {fit.center.y_px:.0f}"
    if fit.heading_deg is not None:
        text += f", heading {fit.heading_deg:.0f} degrees"
    return text


def _object_text(other: OtherObject) -> str:
    """Describe another object that the points may mean."""
    size = f"{other.mask_area_px} px"
    if other.area_m2 is not None:
        size = f"{significant(other.area_m2)} m2"
    box = other.bounding_box
    across = f"x {box.x1_px:.0f} to {box.x2_px:.0f}"
    down = f"y {box.y1_px:.0f} to {box.y2_px:.0f}"
    return f"of {size}, score {other.mask_score:.2f}, at {across}, {down}: draw a box by eye"
