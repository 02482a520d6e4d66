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
from functools import partial
from pathlib import PurePath
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from vehanchor.errors import InvalidParameterError
from vehanchor_evaluation.instance_masks import (
    AnnotatedImage,
    InstanceMask,
    decode_segmentation,
    read_pixels,
    split_instances,
)
from vehanchor_evaluation.known_scale import FileIssue

if TYPE_CHECKING:
    from pathlib import Path

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
