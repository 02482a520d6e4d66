"""iSAID: instance masks of DOTA's images, in any unpacked layout.

Each image ``P0003.png`` has two label images, in any folder (Waqas Zamir et al., 2019, and its development kit):

* ``P0003_instance_id_RGB.png`` numbers the objects, ``R + 256 G + 65536 B``, with 0 for the background;
* ``P0003_instance_color_RGB.png`` shows each object in the colour of its category.

A folder without these is read from its COCO files (``iSAID_train.json``, ``instances_val.json``, ...). Their category
numbers differ between releases, so categories are identified by name.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path, PurePath
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from vehanchor.errors import InvalidParameterError
from vehanchor_evaluation.areas import read_pixels, split_instances
from vehanchor_evaluation.known_scale import FileIssue

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from vehanchor_evaluation.known_scale import KnownScaleSet

ID_SUFFIX, COLOUR_SUFFIX = "_instance_id_RGB.png", "_instance_color_RGB.png"
UNLABELLED = "unlabelled"
CATEGORY_RGB = {  # helpers/labels.py of the development kit
    "ship": (0, 0, 63),
    "storage-tank": (0, 63, 63),
    "baseball-diamond": (0, 63, 0),
    "tennis-court": (0, 63, 127),
    "basketball-court": (0, 63, 191),
    "ground-track-field": (0, 63, 255),
    "bridge": (0, 127, 63),
    "large-vehicle": (0, 127, 127),
    "small-vehicle": (0, 0, 127),
    "helicopter": (0, 0, 191),
    "swimming-pool": (0, 0, 255),
    "roundabout": (0, 191, 127),
    "soccer-ball-field": (0, 127, 191),
    "plane": (0, 127, 255),
    "harbor": (0, 100, 155),
}
_CATEGORY_OF = {red | green << 8 | blue << 16: name for name, (red, green, blue) in CATEGORY_RGB.items()}
_ALIASES = {"store-tank": "storage-tank", "harbour": "harbor"}


@dataclass(frozen=True, eq=False)
class InstanceMask:
    """Annotated object.

    Attributes:
        instance: its number in the image.
        category: its class, in lower case with hyphens.
        left_px: column of the mask's first pixel in the image.
        top_px: row of the mask's first pixel in the image.
        mask: ``[h, w]`` bool, cropped to the object.
    """

    instance: int
    category: str
    left_px: int
    top_px: int
    mask: NDArray[np.bool_]

    @property
    def box(self) -> tuple[float, float, float, float]:
        """Bounding box x1, y1, x2, y2 of the pixels; the image's first pixel spans 0 to 1."""
        height, width = self.mask.shape
        return self.left_px, self.top_px, self.left_px + width, self.top_px + height


@dataclass(frozen=True, eq=False)
class AnnotatedImage:
    """Image of known scale with annotated objects.

    Attributes:
        name: name of the image, unique in its data set.
        path: path of the image.
        gsd_m_per_px: its true GSD.
        read_masks: reads all its objects; raises OSError or ValueError on failure.
    """

    name: str
    path: Path
    gsd_m_per_px: float
    read_masks: Callable[[], list[InstanceMask]]


def find_annotated_images(folder: Path, known: KnownScaleSet) -> tuple[list[AnnotatedImage], list[FileIssue]]:
    """Find the images of a copy of iSAID whose scale is known from DOTA.

    Args:
        folder: folder with iSAID's label images or COCO files, at any depth.
        known: DOTA's images with their scales, from ``vehanchor_evaluation.dota.survey_dota``.

    Returns:
        The images by name, and issues: DOTA's, unreadable COCO files, images without annotations.

    Raises:
        InvalidParameterError: ``folder`` has neither label images nor COCO files with instances.
    """
    issues = list(known.issues)
    readers = _readers(folder, issues)
    images = []
    for image in known.images:
        reader = readers.get(image.path.stem)
        if reader is None:
            issues.append(FileIssue(image.path, "no_masks", f"{folder} has no annotation of it"))
        else:
            images.append(AnnotatedImage(image.path.stem, image.path, image.gsd_m_per_px, reader))
    return images, issues


def instance_numbers(rgb: NDArray[np.uint8]) -> NDArray[np.int32]:
    """Convert an instance image ``[h, w, 3]`` to numbers ``R + 256 G + 65536 B``: ``[h, w]``."""
    red, green, blue = (rgb[:, :, band].astype(np.int32) for band in range(3))
    return red | green << 8 | blue << 16


def read_instances(id_picture: Path, colour_picture: Path) -> list[InstanceMask]:
    """Read all objects of one image; the colour of most of its pixels decides an object's category.

    Objects of an unknown colour are ``unlabelled``.

    Args:
        id_picture: ``*_instance_id_RGB.png``.
        colour_picture: ``*_instance_color_RGB.png``.

    Raises:
        ImageError: an image cannot be read.
        ValueError: the images differ in size.
    """
    numbers = instance_numbers(read_pixels(id_picture, cv2.IMREAD_COLOR)[:, :, ::-1])
    painted = instance_numbers(read_pixels(colour_picture, cv2.IMREAD_COLOR)[:, :, ::-1])
    if numbers.shape != painted.shape:
        raise ValueError(f"{id_picture} has {_size(numbers)} px, {colour_picture.name} {_size(painted)} px")
    objects = []
    for number, left, top, mask in split_instances(numbers):
        colours, counts = np.unique(
            painted[top : top + mask.shape[0], left : left + mask.shape[1]][mask], return_counts=True
        )
        category = _CATEGORY_OF.get(int(colours[counts.argmax()]), UNLABELLED)
        objects.append(InstanceMask(number, category, left, top, mask))
    return objects


def _size(picture: NDArray[np.int32]) -> str:
    return f"{picture.shape[1]} x {picture.shape[0]}"


# --- Its files ------------------------------------------------------------------------------------------------------


def _readers(folder: Path, issues: list[FileIssue]) -> dict[str, Callable[[], list[InstanceMask]]]:
    """Find the reader of each annotated image's objects."""
    found: dict[str, Callable[[], list[InstanceMask]]] = {}
    for path in sorted(folder.rglob("*" + ID_SUFFIX)):
        name = path.name.removesuffix(ID_SUFFIX)
        colours = path.with_name(name + COLOUR_SUFFIX)
        if not colours.is_file():  # as downloaded, the two kinds are in separate folders
            colours = next(iter(sorted(folder.rglob(name + COLOUR_SUFFIX))), colours)
        if name in found:
            issues.append(FileIssue(path, "duplicate_name", "another image has the same name; only that is used"))
            continue
        found[name] = partial(read_instances, path, colours)
    if not found:
        for path in sorted(folder.rglob("*.json")):
            found |= _read_coco(path, issues)
    if not found:
        raise InvalidParameterError(
            f"{folder} has no iSAID annotations: neither *{ID_SUFFIX} nor a COCO file (*.json) with instances"
        )
    return found


# --- COCO files ------------------------------------------------------------------------------------------------------


def _read_coco(path: Path, issues: list[FileIssue]) -> dict[str, Callable[[], list[InstanceMask]]]:
    """Read the images of a COCO file; other files have none."""
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
        names = {entry["id"]: _category_name(entry["name"]) for entry in document["categories"]}
        images = {
            entry["id"]: (str(entry["file_name"]), int(entry["width"]), int(entry["height"]))
            for entry in document["images"]
        }
        by_image: dict[Any, list[tuple[int, str, Any]]] = {number: [] for number in images}
        for entry in document["annotations"]:
            by_image[entry["image_id"]].append((entry["id"], names[entry["category_id"]], entry["segmentation"]))
    except (OSError, ValueError, KeyError, TypeError) as error:
        issues.append(FileIssue(path, "not_coco", f"not a COCO file of instances: {type(error).__name__}: {error}"))
        return {}
    return {
        PurePath(file).stem: partial(_decode_annotations, file, width, height, by_image[number])
        for number, (file, width, height) in images.items()
    }


def _decode_annotations(
    file: str, width_px: int, height_px: int, annotations: list[tuple[int, str, Any]]
) -> list[InstanceMask]:
    objects = []
    for number, category, segmentation in annotations:
        try:
            decoded = decode_segmentation(segmentation, width_px, height_px)
        except (TypeError, ValueError) as error:
            raise ValueError(f"{file}, annotation {number}: {error}") from None
        if decoded is not None:
            left, top, mask = decoded
            objects.append(InstanceMask(number, category, left, top, mask))
    return objects


def _category_name(written: str) -> str:
    name = written.strip().lower().replace("_", "-").replace(" ", "-")
    return _ALIASES.get(name, name)


# --- Polygons and run lengths ----------------------------------------------------------------------------------------


def decode_segmentation(segmentation: Any, width_px: int, height_px: int) -> tuple[int, int, NDArray[np.bool_]] | None:
    """Rasterise the ``segmentation`` of a COCO annotation.

    iSAID's tools write polygons as rings of pixel centres (``cv2.findContours``): one ring per piece of the object, no
    holes. Filling them with their outline, as here, restores the mask. ``pycocotools`` reads the same numbers as
    corners and loses half a pixel on every side.

    Args:
        segmentation: a list of rings ``[x1, y1, x2, y2, ...]``, or run lengths ``{"size": [h, w], "counts": ...}``.
        width_px: width of the image.
        height_px: height of the image.

    Returns:
        Left, top and the mask ``[h', w']`` bool; None if no pixel is inside the image.

    Raises:
        ValueError: the segmentation has neither form.
    """
    if isinstance(segmentation, dict):
        whole = _decode_run_lengths(segmentation, width_px, height_px)
        return next(((left, top, mask) for _, left, top, mask in split_instances(whole.astype(np.uint8))), None)
    rings = [np.asarray(ring, np.float64) for ring in segmentation]
    if not rings or any(
        ring.ndim != 1 or len(ring) < 2 or len(ring) % 2 or not np.isfinite(ring).all() for ring in rings
    ):
        raise ValueError("a segmentation must be a list of rings x1, y1, x2, y2, ... or run lengths")
    points = [np.rint(ring.reshape(-1, 2)).astype(np.int32) for ring in rings]
    every = np.concatenate(points)
    left, top = np.maximum(every.min(axis=0), 0)
    right, bottom = np.minimum(every.max(axis=0) + 1, (width_px, height_px))
    if right <= left or bottom <= top:
        return None
    canvas = np.zeros((bottom - top, right - left), np.uint8)
    for ring in points:  # one by one: in a single call, the overlap of two rings would become a hole
        cv2.fillPoly(canvas, [ring - np.array([left, top], np.int32)], 1)
    return (int(left), int(top), canvas > 0) if canvas.any() else None


def _decode_run_lengths(segmentation: dict[str, Any], width_px: int, height_px: int) -> NDArray[np.bool_]:
    """Decode COCO's run lengths, as numbers or text: background and object alternate, column by column."""
    counts = segmentation.get("counts")
    runs = _uncompress(counts) if isinstance(counts, str) else counts
    if segmentation.get("size") != [height_px, width_px] or not isinstance(runs, list):
        raise ValueError(f"run lengths must have counts and the image's size, [{height_px}, {width_px}]")
    lengths = np.asarray(runs, np.int64)
    if (lengths < 0).any() or lengths.sum() != width_px * height_px:
        raise ValueError(f"run lengths cover {lengths.sum()} pixels of {width_px * height_px}")
    values = np.repeat(np.arange(len(lengths)) % 2 == 1, lengths)
    return np.asarray(values.reshape(width_px, height_px).T)


def _uncompress(text: str) -> list[int]:
    """Decode COCO's compressed run lengths.

    Each character holds five bits, lowest first, and a sixth bit if more follow. From the third run on, numbers are
    differences to the run before the last.
    """
    runs: list[int] = []
    value = shift = 0
    for character in text:
        bits = ord(character) - 48
        value |= (bits & 0x1F) << shift
        shift += 5
        if not bits & 0x20:
            if bits & 0x10:
                value -= 1 << shift
            runs.append(value + (runs[-2] if len(runs) > 2 else 0))
            value = shift = 0
    return runs
