"""Place the caller's shapes in an image: pixels, area, and the error of its edge."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np

from vehanchor.errors import ImageTooLargeError, PromptError
from vehanchor.imagery.metadata.georeference import to_pixels
from vehanchor.imagery.raster import Window, oriented, oriented_points
from vehanchor.measure.polygon import (
    area_of,
    bounds_of,
    extents_of,
    finer_cells,
    mask_of,
    perimeter_of,
)
from vehanchor.measure.run_lengths import mask_of_runs
from vehanchor.measure.shapes import CallerMask, CallerPolygon
from vehanchor.options.option import is_number
from vehanchor.options.reading import CoordinateFrame
from vehanchor.segmentation.object_mask import ObjectMask
from vehanchor.segmentation.shape import (
    Circle,
    inscribed_circle,
    mask_bounds,
    perimeter,
    rotated_extents,
)

if TYPE_CHECKING:
    from vehanchor.imagery.raster import Raster
    from vehanchor.measure.polygon import Corners, Part
    from vehanchor.measure.shapes import CallerRuns, CallerShape, Orientation
    from vehanchor.options import ScaleOptions
    from vehanchor.options.reading import Place

# How far the edge of a shape may lie from the object's, in pixels of the caller's picture. Both
# are choices: a corner is placed on a pixel, and a pixel belongs to a mask or not.
POLYGON_EDGE_PX = 0.5
MASK_EDGE_PX = 1.0
# Cells along the longer side of a polygon's box, for its largest circle, and most cells a pixel.
_FINE_SIDE = 512
_MOST_CELLS_PER_PX = 8
# Largest longitude and latitude, degrees: PROJ takes hours for coordinates far off the Earth.
_MAX_DEGREES = (360, 90)
# The pixels of a valid polygon differ from its area by less than this share of its perimeter.
_MAX_AREA_DIFFERENCE = 0.5


@dataclass(frozen=True, eq=False, kw_only=True)
class PlacedShape:
    """Shape of the caller in pixels of the image.

    Attributes:
        pixels: its pixels, those whose centres are inside a polygon.
        area_px: area: of a polygon by its corners, of a mask by its pixels.
        perimeter_px: length of its outline with its holes.
        extents_px: length and width of the smallest rotated rectangle around it.
        circle: the largest circle inside, in pixels of the image.
        edge_px: how far its edge may lie from the object's, either way.
        parts: rings of a polygon; empty for a mask.
    """

    pixels: ObjectMask
    area_px: float
    perimeter_px: float
    extents_px: tuple[float, float]
    circle: Circle
    edge_px: float
    parts: tuple[Part, ...] = ()


def place_shape(
    shape: CallerShape,
    raster: Raster,
    options: ScaleOptions,
    *,
    edge_px: float | None = None,
    orientation: Orientation | None = None,
) -> PlacedShape:
    """Place a shape of the caller in an image.

    Args:
        shape: result of ``read_shapes``.
        raster: the image.
        options: all options of the method; ``frame`` describes the caller's resized copy.
        edge_px: how far the edge may lie from the object's, in pixels of the caller's picture;
            None for half a pixel of a polygon, and one of a mask.
        orientation: whether the shape belongs to the upright picture or to the stored pixels; None
            where the size of a mask shows it. A polygon is upright by default.

    Raises:
        PromptError: the shape is empty, outside the image or of another size, or its orientation is
            unknown.
        ImageTooLargeError: the shape covers more pixels than the limits allow.
    """
    if isinstance(shape, CallerPolygon):
        return _place_polygon(shape, raster, options, edge_px=edge_px, orientation=orientation)
    return _place_mask(shape, raster, options, edge_px=edge_px, orientation=orientation)


# --- Polygons


def _place_polygon(
    polygon: CallerPolygon,
    raster: Raster,
    options: ScaleOptions,
    *,
    edge_px: float | None,
    orientation: Orientation | None,
) -> PlacedShape:
    coordinates = CoordinateFrame(options.frame, raster.grid)
    unit_px = max(coordinates.unit_px)
    if polygon.in_degrees and raster.ground is not None:
        unit_px = 1.0
        parts = _parts_in_degrees(polygon, raster)
    elif _is_stored_polygon(polygon, raster.in_file, options, orientation):
        _check_no_frame(options)
        parts = _stored_parts(polygon, raster)
    else:
        parts = tuple(
            tuple(_ring_in_image(ring, coordinates) for ring in part) for part in polygon.parts
        )
    bounds = bounds_of(parts)
    left, top, right, bottom = bounds
    window = Window(left, top, width_px=right - left, height_px=bottom - top)
    _check_pixels(window, options)
    mask = mask_of(parts, bounds)
    area_px = area_of(parts)
    if area_px <= 0 or not mask.any():
        raise PromptError("the polygon covers no pixel of the image: give a larger one")
    perimeter_px = perimeter_of(parts)
    cells_per_px = finer_cells(bounds, side_px=_FINE_SIDE, most=_MOST_CELLS_PER_PX)
    fine = mask
    if cells_per_px > 1:
        fine = mask_of(parts, bounds, cells_per_px)
    _check_area(area_px, float(fine.sum()) / cells_per_px**2, perimeter_px / cells_per_px)
    in_cells = inscribed_circle(fine)
    assert in_cells is not None, "a polygon with a pixel has a cell"
    circle = Circle(
        in_cells.x / cells_per_px + left,
        in_cells.y / cells_per_px + top,
        in_cells.diameter / cells_per_px,
    )
    edge = POLYGON_EDGE_PX if edge_px is None else edge_px
    return PlacedShape(
        pixels=ObjectMask(mask, window),
        area_px=area_px,
        perimeter_px=perimeter_px,
        extents_px=extents_of(parts),
        circle=circle,
        edge_px=edge * unit_px,
        parts=parts,
    )


def _is_stored_polygon(
    polygon: CallerPolygon,
    raster: Raster,
    options: ScaleOptions,
    orientation: Orientation | None,
) -> bool:
    """Decide whether a polygon is of the stored pixels, by the caller's word or its picture's size.

    Raises:
        PromptError: its picture has another size than the image.
    """
    if polygon.size is None:
        return orientation == "stored"
    if orientation is None and polygon.size == (raster.width_px, raster.height_px):
        orientation = "oriented"
    return _is_stored(polygon.size, raster, options, orientation, noun="picture of the polygon")


def _ring_in_image(ring: Corners, coordinates: CoordinateFrame) -> Corners:
    """Convert a ring to pixels of the full image, and check that it is inside."""
    places: list[Place] = [(x, y) for x, y in ring.tolist()]
    if not coordinates.inside(places):
        raise PromptError(
            f"the polygon is not inside the {coordinates.name}"
            f"{coordinates.other_reading(places) or ': clip it to what is visible'}"
        )
    return np.array([coordinates.in_image(x, y) for x, y in places])


def _parts_in_degrees(polygon: CallerPolygon, raster: Raster) -> tuple[Part, ...]:
    ground = raster.ground
    assert ground is not None
    parts = []
    for part in polygon.parts:
        corners = np.concatenate(part)
        if (np.abs(corners) > _MAX_DEGREES).any():
            raise PromptError(
                "the polygon is not in degrees of WGS 84, as GeoJSON of a georeferenced image is: "
                "longitude first, or state pixels by the crs that --outline writes"
            )
        rings = [to_pixels(ring, ground) for ring in part]
        for ring in rings:
            _check_inside(ring, raster.width_px, raster.height_px, read_as="degrees of WGS 84")
        parts.append(tuple(rings))
    return tuple(parts)


def _stored_parts(polygon: CallerPolygon, raster: Raster) -> tuple[Part, ...]:
    in_file = raster.in_file
    width_px, height_px = in_file.stored_size_px()
    parts = []
    for part in polygon.parts:
        rings = []
        for ring in part:
            _check_inside(ring, width_px, height_px, read_as="pixels as stored")
            upright = oriented_points(
                ring,
                in_file.orientation,
                width_px=in_file.width_px,
                height_px=in_file.height_px,
            )
            rings.append(raster.grid.to_square(upright))
        parts.append(tuple(rings))
    return tuple(parts)


def _check_inside(ring: Corners, width_px: int, height_px: int, *, read_as: str) -> None:
    """Check that a ring lies in an image, and move corners within a pixel of it onto its border."""
    low = ring.min(axis=0)
    high = ring.max(axis=0)
    size = np.array([width_px, height_px])
    begins_inside = (low > -1).all()
    ends_inside = (high < size + 1).all()
    if not (np.isfinite(ring).all() and begins_inside and ends_inside):
        raise PromptError(
            f"the polygon, read as {read_as}, is not inside the image: its corners span x "
            f"{low[0]:.6g} to {high[0]:.6g} and y {low[1]:.6g} to {high[1]:.6g} of its "
            f"{width_px} x {height_px} px"
        )
    np.clip(ring, 0, size, out=ring)


def _check_area(area_px: float, n_cells_px: float, perimeter_px: float) -> None:
    """Refuse rings that cross in a corner, parts that overlap and holes outside their part.

    Their area by the corners differs from that of the pixels inside an odd number of rings.
    """
    if abs(area_px - n_cells_px) > _MAX_AREA_DIFFERENCE * perimeter_px + 1:
        raise PromptError(
            "the polygon's rings cross in a corner, overlap, or a hole lies outside: give each "
            "part with its own holes"
        )


# --- Masks


def _place_mask(
    shape: CallerMask | CallerRuns,
    raster: Raster,
    options: ScaleOptions,
    *,
    edge_px: float | None,
    orientation: Orientation | None,
) -> PlacedShape:
    in_file = raster.in_file
    is_stored = _is_stored(shape.size, in_file, options, orientation)
    copy_size = options.frame.size or (in_file.width_px, in_file.height_px)
    if isinstance(shape, CallerMask):
        crop = shape
    else:
        width, height = shape.size
        _check_pixels(Window(0, 0, width_px=width, height_px=height), options)
        crop = CallerMask(mask_of_runs(shape.runs, (height, width)), shape.size)
    pixels = _pixels_of(crop)
    if is_stored:
        pixels = _upright(pixels, in_file)
    scale = 1.0
    if copy_size != (raster.width_px, raster.height_px):
        pixels = _enlarged(pixels, copy_size, raster)
        scale = max(raster.width_px / copy_size[0], raster.height_px / copy_size[1])
    _check_pixels(pixels.window, options)
    mask = pixels.mask
    circle = inscribed_circle(mask)
    assert circle is not None, "the mask is not empty"
    x = circle.x + pixels.window.x_px
    y = circle.y + pixels.window.y_px
    edge = MASK_EDGE_PX if edge_px is None else edge_px
    return PlacedShape(
        pixels=pixels,
        area_px=float(mask.sum()),
        perimeter_px=perimeter(mask),
        extents_px=rotated_extents(mask),
        circle=Circle(x, y, circle.diameter),
        edge_px=edge * scale,
    )


def _is_stored(
    size: tuple[int, int],
    raster: Raster,
    options: ScaleOptions,
    orientation: Orientation | None,
    noun: str = "mask",
) -> bool:
    """Decide whether a mask is of the stored pixels, by its size or by the caller's word."""
    upright_size = options.frame.size or (raster.width_px, raster.height_px)
    size_in_file = raster.stored_size_px()
    if orientation == "stored":
        _check_no_frame(options)
        _check_size(size, size_in_file, "the stored image", noun)
        return True
    is_turned = raster.orientation != 1
    if options.frame.size is not None:
        _check_size(size, upright_size, "the frame", noun)
        return False
    if orientation is None and is_turned and size == size_in_file:
        if size == upright_size:
            raise PromptError(
                f"the photograph's EXIF orientation is {raster.orientation}, and a mask of "
                "its stored pixels has the same size as an upright one: say orientation "
                '"oriented" (as viewers and supervision show it) or "stored"'
            )
        return True
    _check_size(size, upright_size, "the image", noun)
    return False


def _check_size(size: tuple[int, int], expected: tuple[int, int], owner: str, noun: str) -> None:
    if size != expected:
        raise PromptError(
            f"the {noun} has {size[0]} x {size[1]} px, {owner} {expected[0]} x {expected[1]}: give "
            "one of the image in full size, or the size of your uncropped copy as frame"
        )


def _check_no_frame(options: ScaleOptions) -> None:
    if options.frame.size is not None or options.frame.coordinates != "pixels":
        raise PromptError(
            "stored shapes are in pixels of the file in full size: leave frame and coordinates out"
        )


def _check_pixels(window: Window, options: ScaleOptions) -> None:
    max_pixels = options.reading.limits.max_pixels
    if window.width_px * window.height_px > max_pixels:
        raise ImageTooLargeError(
            f"the shape covers {window.width_px} x {window.height_px} px, the limit is "
            f"{max_pixels} pixels: measure in a reduced copy, or in parts"
        )


def _pixels_of(crop: CallerMask) -> ObjectMask:
    """Cut a mask to its object."""
    bounds = mask_bounds(crop.mask)
    if bounds is None:
        raise PromptError("the mask is empty: leave it out")
    x1, y1, x2, y2 = bounds
    left = crop.left + x1
    top = crop.top + y1
    window = Window(left, top, width_px=x2 - x1, height_px=y2 - y1)
    width, height = crop.size
    right = crop.left + x2
    bottom = crop.top + y2
    if window.x_px < 0 or window.y_px < 0 or right > width or bottom > height:
        raise PromptError("the mask's crop reaches outside its image: give crops inside it")
    return ObjectMask(np.ascontiguousarray(crop.mask[y1:y2, x1:x2]), window)


def _upright(pixels: ObjectMask, raster: Raster) -> ObjectMask:
    """Turn a mask of the stored pixels upright."""
    window = pixels.window
    corners = np.array(
        [
            (window.x_px, window.y_px),
            (window.x_px + window.width_px, window.y_px + window.height_px),
        ],
        dtype=np.float64,
    )
    turned = oriented_points(
        corners, raster.orientation, width_px=raster.width_px, height_px=raster.height_px
    )
    left, top = turned.min(axis=0).astype(int).tolist()
    mask = np.ascontiguousarray(oriented(pixels.mask, raster.orientation))
    height, width = mask.shape
    return ObjectMask(mask, Window(left, top, width_px=width, height_px=height))


def _enlarged(pixels: ObjectMask, copy_size: tuple[int, int], raster: Raster) -> ObjectMask:
    """Convert a mask of the caller's resized copy to the full image, pixel by pixel."""
    window = pixels.window
    across = raster.width_px / copy_size[0]
    down = raster.height_px / copy_size[1]
    left = round(window.x_px * across)
    top = round(window.y_px * down)
    right = round((window.x_px + window.width_px) * across)
    bottom = round((window.y_px + window.height_px) * down)
    width = max(1, right - left)
    height = max(1, bottom - top)
    resized = cv2.resize(
        pixels.mask.view(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST_EXACT
    )
    mask = resized.astype(np.bool_)
    if not mask.any():
        raise PromptError("the mask covers no pixel of the image: give a larger one")
    return ObjectMask(mask, Window(left, top, width_px=width, height_px=height))


def check_edge(edge_px: float | None) -> None:
    """Check the caller's error of the edge.

    Raises:
        PromptError: it is not a number of at least 0.
    """
    if edge_px is None:
        return
    if not is_number(edge_px) or not 0 <= edge_px < np.inf:
        raise PromptError(f"edge_px is {edge_px!r}: use pixels of at least 0")
