"""Files of shapes: COCO JSON, GeoJSON, and PNG of ids."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any

from vehanchor.errors import ImageError, PromptError
from vehanchor.imagery.file_check import check_file
from vehanchor.imagery.formats.decoding import decode
from vehanchor.imagery.formats.ifd import in_memory
from vehanchor.imagery.formats.png import PNG
from vehanchor.imagery.limits import check_bytes, check_mask_bytes
from vehanchor.measure.id_image import masks_of
from vehanchor.measure.shapes import (
    MAX_SHAPES,
    CallerMask,
    CallerPolygon,
    check_number,
    read_annotation,
    read_shapes,
)
from vehanchor.options import ImageLimits
from vehanchor.storage.text import decoded

if TYPE_CHECKING:
    import os
    from collections.abc import Mapping, Sequence

    from vehanchor.measure.shapes import CallerShape

_ID_IMAGES = (".png",)
_TEXTS = (".json", ".geojson")
# COCO's files of whole collections have tens of megabytes.
_MAX_TEXT_BYTES = 256 << 20
# Lists and objects of a JSON, each of which takes 64 bytes or more, also if it is empty. A choice.
_MAX_CONTAINERS = 4_000_000


def read_shape_file(
    path: str | os.PathLike[str], image: str, *, limits: ImageLimits | None = None
) -> tuple[CallerShape, ...]:
    """Read the shapes of an image from a file.

    Args:
        path: COCO JSON, whose ``images`` name the image by ``file_name``; GeoJSON; or a PNG of
            ids, each number an object and 0 the background.
        image: path of the image.
        limits: limits on the cost of a PNG; None for the usual ones.

    Raises:
        PromptError: the file cannot be read, has no shape of the image, or a shape is invalid.
    """
    file = Path(path)
    suffix = file.suffix.lower()
    try:
        if suffix in _ID_IMAGES:
            return _read_ids(file, limits or ImageLimits())
        if suffix in _TEXTS:
            check_bytes(file.stat().st_size, _MAX_TEXT_BYTES)
            text = decoded(file.read_bytes())
            if text.count("[") + text.count("{") > _MAX_CONTAINERS:
                raise PromptError(
                    f"it has more than {_MAX_CONTAINERS} lists and objects: keep those of the image"
                )
            return _read_json(json.loads(text), image)
    except PromptError as error:
        raise PromptError(f"{str(file)!r}: {error}") from None
    except RecursionError:
        raise PromptError(f"{str(file)!r} cannot be read: it is nested too deeply") from None
    except (OSError, ImageError, ValueError) as error:
        raise PromptError(f"{str(file)!r} cannot be read: {error}") from None
    raise PromptError(
        f"{str(file)!r} is not a file of shapes: use {', '.join((*_TEXTS, *_ID_IMAGES))}"
    )


def _read_json(content: Any, image: str) -> tuple[CallerShape, ...]:
    """Read COCO JSON, or GeoJSON."""
    if not isinstance(content, dict):
        raise PromptError(
            "it is neither COCO JSON with images and annotations nor GeoJSON: results of COCO "
            "without images do not name the photograph"
        )
    if "annotations" not in content:
        return read_shapes(content)
    return _read_coco(content, image)


def _read_coco(content: Mapping[str, Any], image: str) -> tuple[CallerShape, ...]:
    """Read the annotations of one image; each is named by its category and id."""
    images = _records(content, "images")
    annotations = _records(content, "annotations")
    matches = _matching(images, image)
    if len(matches) != 1:
        found = "no image" if not matches else f"{len(matches)} images"
        raise PromptError(f"it has {found} with the file_name {Path(image).name!r}")
    (entry,) = matches
    labels = {}
    if content.get("categories"):
        for category in _records(content, "categories"):
            labels[str(category.get("id"))] = str(category.get("name", ""))
    shapes: list[CallerShape] = []
    for annotation in annotations:
        if annotation.get("image_id") != entry.get("id"):
            continue
        label = labels.get(str(annotation.get("category_id")), "")
        name = f"{label} {annotation.get('id', '')}".strip()
        try:
            shapes += read_annotation(annotation, name)
        except PromptError as error:
            raise PromptError(f"annotation {annotation.get('id')}: {error}") from None
        check_number(shapes)
    size = _size_of(entry)
    shapes = [
        replace(shape, size=size) if isinstance(shape, CallerPolygon) else shape for shape in shapes
    ]
    if not shapes:
        raise PromptError(f"it has no annotation of {Path(image).name!r}")
    return tuple(shapes)


def _size_of(entry: Mapping[str, Any]) -> tuple[int, int] | None:
    """Read width and height of an entry's image; None without them."""
    width = entry.get("width")
    height = entry.get("height")
    if not isinstance(width, int) or not isinstance(height, int):
        return None
    return (width, height) if width > 0 and height > 0 else None


def _records(content: Mapping[str, Any], name: str) -> Sequence[Mapping[str, Any]]:
    records = content.get(name)
    if not isinstance(records, list) or not all(isinstance(record, dict) for record in records):
        raise PromptError(f"it has no list of {name}, as COCO JSON has")
    return records


def _matching(images: Sequence[Mapping[str, Any]], image: str) -> list[Mapping[str, Any]]:
    """List the entries whose ``file_name`` is the end of the image's path; else, its last part."""
    parts = PurePosixPath(Path(image).resolve().as_posix()).parts
    by_path = []
    by_name = []
    for entry in images:
        file_name = str(entry.get("file_name", "")).replace("\\", "/")
        entry_parts = PurePosixPath(file_name).parts
        if not entry_parts:
            continue
        if entry_parts == parts[-len(entry_parts) :]:
            by_path.append(entry)
        if entry_parts[-1] == parts[-1]:
            by_name.append(entry)
    if len(by_path) > 1:
        # The longest file_name that fits names the image best.
        longest = max(len(str(entry["file_name"])) for entry in by_path)
        by_path = [entry for entry in by_path if len(str(entry["file_name"])) == longest]
    return by_path or by_name


def _read_ids(file: Path, limits: ImageLimits) -> tuple[CallerShape, ...]:
    """Read a PNG of ids; each shape is named by its number."""
    check_bytes(file.stat().st_size, limits.max_bytes)
    data = file.read_bytes()
    checked = check_file(in_memory(data), len(data), str(file), limits=limits, on_disk=False)
    header = checked.header
    if header.format != PNG.name:
        raise PromptError(f"it is a {header.format}: save ids as PNG")
    pixels = decode(data, str(file), header)
    size = (header.width_px, header.height_px)
    shapes: list[CallerShape] = []
    n_mask_bytes = 0
    for number, left, top, mask in masks_of(pixels, str(file)):
        if len(shapes) == MAX_SHAPES:
            raise PromptError(f"it has more than {MAX_SHAPES} ids: is it a picture?")
        n_mask_bytes += mask.nbytes
        check_mask_bytes(n_mask_bytes, limits)
        shapes.append(CallerMask(mask, size, left=left, top=top, name=str(number)))
    if not shapes:
        raise PromptError("all its pixels are 0: each object needs a number of its own")
    return tuple(shapes)
