"""Shapes of the caller's own: polygons, masks, run lengths, GeoJSON, detections.

They are read and checked here without an image, and placed in one by ``measure.placing``. None of
the libraries whose objects are accepted is imported.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, TypeAlias, get_args

import numpy as np

from vehanchor.errors import PromptError
from vehanchor.imagery.metadata.georeference import is_in_pixels
from vehanchor.measure.polygon import area_of, find_crossing
from vehanchor.measure.run_lengths import read_run_lengths

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from vehanchor.measure.polygon import Corners, Part
    from vehanchor.measure.run_lengths import Runs
    from vehanchor.segmentation.shape import Mask

MAX_SHAPES = 1000
"""Most shapes of a call."""

MAX_CORNERS = 4000
"""Most corners of a polygon; all pairs of its sides are compared."""

MAX_CORNERS_OF_ALL = 200_000
"""Most corners of a call: comparing the sides of 50 polygons with most corners takes 3 s."""

MIN_CORNERS = 3

Orientation: TypeAlias = Literal["oriented", "stored"]
"""Whether shapes belong to the upright picture, or to the pixels as the file stores them."""

# Larger coordinates are in no image, and their products would overflow.
_MAX_COORDINATE = 1e7
_GEOMETRIES = ("Polygon", "MultiPolygon")
# Reference systems of RFC 7946, as QGIS and GDAL name them.
_DEGREES = ("CRS84", "EPSG::4326", "EPSG:4326", "WGS 84", "WGS84")
_EXPECTED = (
    "a shape is a polygon (x, y of its corners), a mask [h, w], COCO's run lengths or polygons, "
    "or GeoJSON"
)


@dataclass(frozen=True, eq=False)
class CallerPolygon:
    """Polygon in the caller's coordinates.

    Attributes:
        parts: the ring around each part, then those around its holes.
        in_degrees: whether the coordinates are longitude and latitude, if the image is
            georeferenced.
        name: the caller's name of it; may be empty.
        size: width and height of the picture in which it was drawn; None if unknown.
    """

    parts: tuple[Part, ...]
    in_degrees: bool = False
    name: str = ""
    size: tuple[int, int] | None = None


@dataclass(frozen=True, eq=False)
class CallerMask:
    """Mask in the pixels of the caller's picture.

    Attributes:
        mask: ``[h, w]`` bool: the whole picture, or a crop of it.
        size: width and height of the picture.
        left: column of the crop's first pixel.
        top: row of the crop's first pixel.
        name: the caller's name of it; may be empty.
    """

    mask: Mask
    size: tuple[int, int]
    left: int = 0
    top: int = 0
    name: str = ""


@dataclass(frozen=True, eq=False)
class CallerRuns:
    """Mask as COCO's run lengths; memory is taken once the size is known to be the image's.

    Attributes:
        runs: lengths of the runs ``[n]``.
        size: width and height of the picture.
        name: the caller's name of it; may be empty.
    """

    runs: Runs
    size: tuple[int, int]
    name: str = ""


CallerShape: TypeAlias = CallerPolygon | CallerMask | CallerRuns


def read_shapes(shapes: Any) -> tuple[CallerShape, ...]:
    """Read and check the caller's shapes, without an image.

    Args:
        shapes: a list of shapes; or one of: masks ``[n, h, w]`` or ``[h, w]``, supervision's
            ``Detections`` with masks or oriented boxes, GeoJSON. Each shape of a list is a polygon
            (pairs x, y, or one flat list of numbers), a list of flat lists (the parts of a polygon
            of COCO), a mask ``[h, w]``, run lengths or an annotation of COCO, GeoJSON, or an object
            with ``__geo_interface__``, such as a geometry of shapely, in pixels.

    Raises:
        PromptError: a shape is invalid; the message has its number.
    """
    read = _read_container(shapes)
    if not read:
        raise PromptError("there is no shape: give at least one")
    check_number(read)
    return tuple(read)


def check_number(shapes: Sequence[CallerShape]) -> None:
    """Check that there are not too many shapes or corners so far.

    Raises:
        PromptError: there are too many.
    """
    if len(shapes) > MAX_SHAPES:
        raise PromptError(f"there are too many shapes: give at most {MAX_SHAPES} a call")
    n_corners = 0
    for shape in shapes:
        if isinstance(shape, CallerPolygon):
            n_corners += sum(len(ring) for part in shape.parts for ring in part)
    if n_corners > MAX_CORNERS_OF_ALL:
        raise PromptError(
            f"the polygons have more than {MAX_CORNERS_OF_ALL} corners: simplify them, or give "
            "fewer a call"
        )


def read_polygon(numbers: Any) -> CallerPolygon:
    """Read a polygon of one ring from a flat list of numbers: x1, y1, x2, y2 and so on.

    Raises:
        PromptError: it has fewer than three corners or an odd number, or its lines cross.
    """
    return _checked_polygon([[_flat_ring(numbers)]])


def _read_container(shapes: Any) -> list[CallerShape]:
    """Read a list of shapes, or an object that holds several."""
    if hasattr(shapes, "xyxy"):
        return _read_detections(shapes)
    if hasattr(shapes, "__geo_interface__"):
        return _read_geojson(shapes.__geo_interface__, in_degrees=False)
    if isinstance(shapes, Mapping):
        return _read_mapping(shapes)
    if isinstance(shapes, str | bytes) or not isinstance(shapes, Iterable):
        raise PromptError(f"shapes is {_shown(shapes)}: give a list of shapes; {_EXPECTED}")
    if hasattr(shapes, "__array__"):
        return _read_masks(np.asarray(shapes))
    items = list(shapes)
    if len(items) >= MIN_CORNERS and (_is_flat(items) or all(_is_pair(item) for item in items)):
        raise PromptError(
            "shapes is one polygon: put it into a list, as shapes=[polygon], because several "
            "shapes can be measured at once"
        )
    read: list[CallerShape] = []
    for number, item in enumerate(items, 1):
        try:
            read += _read_item(item)
        except PromptError as error:
            raise PromptError(f"shape {number}: {error}") from None
        check_number(read)
    return read


def _read_item(item: Any) -> list[CallerShape]:
    """Read one shape of a list; GeoJSON of several gives several."""
    if isinstance(item, CallerPolygon | CallerMask | CallerRuns):
        return [item]
    if hasattr(item, "__geo_interface__"):
        return _read_geojson(item.__geo_interface__, in_degrees=False)
    if isinstance(item, Mapping):
        return _read_mapping(item)
    if hasattr(item, "__array__"):
        array = np.asarray(item)
        is_polygon = array.ndim == 2 and array.shape[1] == 2 and array.dtype != np.bool_
        if not is_polygon and array.ndim != 1:
            return _read_masks(array, one=True)
        item = array.tolist()
    if isinstance(item, str | bytes) or not isinstance(item, Iterable):
        raise PromptError(f"it is {_shown(item)}: {_EXPECTED}")
    return [_read_lists(list(item))]


def _read_lists(values: list[Any], name: str = "") -> CallerPolygon:
    """Read pairs, a flat list, or the flat lists of several parts."""
    if _is_flat(values):
        return _checked_polygon([[_flat_ring(values)]], name=name)
    if all(_is_pair(value) for value in values):
        return _checked_polygon([[_ring(values)]], name=name)
    # COCO's polygons of several parts have no holes.
    return _checked_polygon([[_flat_ring(value)] for value in values], name=name)


def _read_mapping(shape: Mapping[str, Any]) -> list[CallerShape]:
    """Read run lengths, an annotation or GeoJSON."""
    if "segmentation" in shape:
        return _read_segmentation(shape["segmentation"])
    if "counts" in shape:
        return _read_segmentation(shape)
    if "type" in shape:
        return _read_geojson(shape, in_degrees=True)
    keys = ", ".join(map(str, shape)) or "no key"
    raise PromptError(f"it has {keys}: {_EXPECTED}")


def _read_segmentation(segmentation: Any, name: str = "") -> list[CallerShape]:
    """Read the ``segmentation`` of an annotation of COCO, or of SAM's automatic masks."""
    if isinstance(segmentation, Mapping):
        runs, (height, width) = read_run_lengths(segmentation)
        return [CallerRuns(runs, (width, height), name=name)]
    if hasattr(segmentation, "__array__"):
        return _read_masks(np.asarray(segmentation), one=True)
    if not isinstance(segmentation, Sequence) or isinstance(segmentation, str | bytes):
        raise PromptError(f"its segmentation is {_shown(segmentation)}: {_EXPECTED}")
    if not segmentation:
        raise PromptError("its segmentation is empty: leave the annotation out")
    return [_read_lists(list(segmentation), name=name)]


def read_annotation(annotation: Mapping[str, Any], name: str) -> list[CallerShape]:
    """Read the shape of an annotation of COCO.

    Raises:
        PromptError: it has no valid ``segmentation``.
    """
    if "segmentation" not in annotation:
        raise PromptError("it has no segmentation: a box alone is not a shape")
    return _read_segmentation(annotation["segmentation"], name)


# --- Masks


def _read_masks(array: NDArray[Any], *, one: bool = False) -> list[CallerShape]:
    """Read masks ``[n, h, w]``, or one ``[h, w]``."""
    if array.ndim == 2:
        array = array[None]
    has_pixels = array.ndim == 3 and 0 not in array.shape[1:]
    if not has_pixels or (one and len(array) != 1):
        expected = "[h, w]" if one else "[n, h, w] or [h, w]"
        raise PromptError(f"the mask has the shape {array.shape}: use {expected}")
    height, width = array.shape[1:]
    masks = [_binary(mask) for mask in array]
    return [CallerMask(mask, (width, height)) for mask in masks]


def _binary(mask: NDArray[Any]) -> Mask:
    """Check that a mask has one value beside 0."""
    if mask.dtype == np.bool_:
        return mask
    if mask.dtype.kind not in "uif":
        raise PromptError(f"the mask has the type {mask.dtype}: use bool, or 0 and 1")
    if mask.dtype.kind == "f" and not np.isfinite(mask).all():
        raise PromptError("the mask has NaN or infinite values: use bool, or 0 and 1")
    is_object: Mask = mask != 0
    values = mask[is_object]
    if len(values) and (values != values[0]).any():
        raise PromptError(
            "the mask has several values beside 0: of ids give mask == id, of scores give "
            "mask > threshold"
        )
    return is_object


# --- Polygons


def _is_flat(values: Sequence[Any]) -> bool:
    """Test whether values are numbers, at least one."""
    # Not "if not values": a value may be an array.
    if len(values) == 0:
        return False
    return all(isinstance(value, int | float | np.number) for value in values)


def _is_pair(value: Any) -> bool:
    """Test whether a value is x and y."""
    try:
        return len(value) == 2 and _is_flat(value)
    except TypeError:
        return False


def _flat_ring(numbers: Any) -> Corners:
    """Read x1, y1, x2, y2 and so on."""
    values = _numbers(numbers)
    if values.ndim != 1 or len(values) % 2:
        raise PromptError("the polygon has an odd number of values: give x and y of each corner")
    return _ring(values.reshape(-1, 2))


def _ring(points: Any) -> Corners:
    """Read the corners of a ring; the repeated first corner of a closed one is left out."""
    corners = _numbers(points)
    if corners.ndim != 2 or corners.shape[1] < 2:
        raise PromptError("the polygon is not a list of corners: give x and y of each corner")
    # A third coordinate is a height.
    corners = corners[:, :2]
    if not np.isfinite(corners).all():
        raise PromptError("the polygon has NaN or infinite coordinates: use finite numbers")
    if np.abs(corners).max(initial=0) > _MAX_COORDINATE:
        raise PromptError("the polygon lies outside any image: give pixels, or degrees of WGS 84")
    before = np.roll(corners, 1, axis=0)
    is_new = (corners != before).any(axis=1)
    corners = np.asarray(corners[is_new])
    if len(corners) < MIN_CORNERS:
        raise PromptError(
            f"the polygon has fewer than {MIN_CORNERS} different corners: give all of them"
        )
    return corners


def _numbers(values: Any) -> NDArray[np.float64]:
    try:
        numbers: NDArray[np.float64] = np.array(values, dtype=np.float64)
    except (OverflowError, TypeError, ValueError):
        raise PromptError("the polygon is not a list of numbers: give x and y of corners") from None
    return numbers


def _checked_polygon(
    parts: Sequence[Sequence[Corners]], *, in_degrees: bool = False, name: str = ""
) -> CallerPolygon:
    """Check what holds in any image: the number of corners, an area, and that no lines cross."""
    if not parts:
        raise PromptError("the polygon is empty: give its corners")
    rings = [ring for part in parts for ring in part]
    n_corners = sum(len(ring) for ring in rings)
    if n_corners > MAX_CORNERS:
        raise PromptError(
            f"the polygon has {n_corners} corners: simplify it to at most {MAX_CORNERS}, or give "
            "a mask"
        )
    crossing = find_crossing(rings)
    if crossing is not None:
        x, y = crossing
        raise PromptError(
            f"the polygon's lines cross at {x:.6g}, {y:.6g}: give its corners in order, and parts "
            "that do not overlap"
        )
    if area_of(parts) <= 0:
        raise PromptError("the polygon has no area: give its corners in order")
    return CallerPolygon(tuple(tuple(part) for part in parts), in_degrees=in_degrees, name=name)


# --- GeoJSON


def _read_geojson(shape: Mapping[str, Any], *, in_degrees: bool) -> list[CallerShape]:
    """Read polygons of GeoJSON.

    Args:
        shape: geometry, feature or collection of features.
        in_degrees: whether it is in degrees, as RFC 7946 requires, unless it states pixels.
    """
    kind = shape.get("type")
    if kind != "FeatureCollection":
        return [_read_feature(shape, in_degrees=in_degrees)]
    features = shape.get("features")
    if not isinstance(features, Sequence):
        raise PromptError("the GeoJSON has no list of features")
    if in_degrees:
        in_degrees = not is_in_pixels(shape)
    if in_degrees:
        _check_reference_system(shape)
    read: list[CallerShape] = []
    for number, feature in enumerate(features, 1):
        try:
            read.append(_read_feature(feature, in_degrees=in_degrees))
        except PromptError as error:
            raise PromptError(f"feature {number}: {error}") from None
        check_number(read)
    return read


def _check_reference_system(collection: Mapping[str, Any]) -> None:
    """Refuse coordinates that are neither pixels nor degrees of WGS 84."""
    crs = collection.get("crs")
    if crs is None:
        return
    name = str(crs)
    if isinstance(crs, Mapping) and isinstance(crs.get("properties"), Mapping):
        name = str(crs["properties"].get("name"))
    if not any(known in name for known in _DEGREES):
        raise PromptError(
            f"the GeoJSON is in {name}: reproject it to WGS 84, as "
            "ogr2ogr -t_srs EPSG:4326 OUT.geojson IN.geojson"
        )


def _read_feature(feature: Any, *, in_degrees: bool) -> CallerShape:
    """Read a feature or a geometry."""
    if not isinstance(feature, Mapping):
        raise PromptError(f"it is {_shown(feature)}: give polygons")
    name = ""
    geometry = feature
    if feature.get("type") == "Feature":
        geometry = _mapping(feature.get("geometry"))
        properties = _mapping(feature.get("properties"))
        name = str(properties.get("name") or feature.get("id") or "")
    kind = geometry.get("type")
    if kind not in _GEOMETRIES:
        raise PromptError(f"the geometry is {_shown(kind)}: give Polygon or MultiPolygon")
    coordinates: Any = geometry.get("coordinates")
    polygons: Any = [coordinates] if kind == "Polygon" else coordinates
    try:
        parts = [[_ring(ring) for ring in polygon] for polygon in polygons]
    except TypeError:
        raise PromptError("the geometry has no valid coordinates") from None
    parts = [part for part in parts if part]
    return _checked_polygon(parts, in_degrees=in_degrees, name=name)


# --- Detections of supervision


def _read_detections(detections: Any) -> list[CallerShape]:
    """Read masks of detections, compact ones crop by crop; without masks, oriented boxes."""
    masks = detections.mask
    if masks is None:
        corners = detections.data.get("xyxyxyxy")
        if corners is None:
            raise PromptError(
                "the detections have neither masks nor oriented boxes: give box=detections[i : "
                "i + 1] to measure_area, which segments the object"
            )
        return [_checked_polygon([[_ring(box)]]) for box in np.asarray(corners)]
    if not hasattr(masks, "crop"):
        return _read_masks(np.asarray(masks))
    height, width = masks.image_shape
    read: list[CallerShape] = []
    for index in range(len(masks)):
        left, top = masks.offsets[index].tolist()
        crop = masks.crop(index)
        read.append(CallerMask(crop, (width, height), left=left, top=top))
    return read


def check_orientation(orientation: str | None) -> None:
    """Check the caller's word about the orientation of shapes.

    Raises:
        PromptError: it is neither "oriented" nor "stored".
    """
    known = get_args(Orientation)
    if orientation is not None and orientation not in known:
        raise PromptError(f"orientation is {orientation!r}: use {' or '.join(known)}")


def _mapping(value: Any) -> Mapping[str, Any]:
    """Return a mapping; an empty one for any other value."""
    return value if isinstance(value, Mapping) else {}


def _shown(value: Any) -> str:
    """Show a value in a message, shortened."""
    text = repr(value)
    return text if len(text) <= 80 else f"{text[:77]}..."
