"""iSAID: instance masks of DOTA's images, in any unpacked layout.

Each image ``P0003.png`` has two label images, in any folder (Waqas Zamir et al., 2019, and its
development kit):

* ``P0003_instance_id_RGB.png`` numbers the objects, ``R + 256 G + 65536 B``, with 0 for the
  background;
* ``P0003_instance_color_RGB.png`` shows each object in the colour of its category.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from vehanchor.errors import InvalidParameterError
from vehanchor.measure.id_image import read_pixels, split_instances
from vehanchor_evaluation.known_scale import FileIssue

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from vehanchor_evaluation.known_scale import KnownScaleSet

ID_SUFFIX = "_instance_id_RGB.png"
COLOUR_SUFFIX = "_instance_color_RGB.png"
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
_CATEGORY_OF = {
    red | green << 8 | blue << 16: name for name, (red, green, blue) in CATEGORY_RGB.items()
}


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


def find_annotated_images(
    folder: Path, data: KnownScaleSet
) -> tuple[list[AnnotatedImage], list[FileIssue]]:
    """Find the images of a copy of iSAID whose scale is known from DOTA.

    Args:
        folder: folder with iSAID's label images, at any depth.
        data: DOTA's images with their scales, from ``vehanchor_evaluation.dota.survey_dota``.

    Returns:
        The images by name, and issues: DOTA's, and images without annotations.

    Raises:
        InvalidParameterError: ``folder`` has no label images.
    """
    issues = list(data.issues)
    readers = _readers(folder, issues)
    images = []
    for image in data.images:
        reader = readers.get(image.path.stem)
        if reader is None:
            issues.append(FileIssue(image.path, "no_masks", f"{folder} has no annotation of it"))
        else:
            images.append(
                AnnotatedImage(
                    image.path.stem, image.path, gsd_m_per_px=image.gsd_m_per_px, read_masks=reader
                )
            )
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
        raise ValueError(
            f"{id_picture} has {_size(numbers)} px, {colour_picture.name} {_size(painted)} px"
        )
    objects = []
    for number, left, top, mask in split_instances(numbers):
        colours, counts = np.unique(
            painted[top : top + mask.shape[0], left : left + mask.shape[1]][mask],
            return_counts=True,
        )
        category = _CATEGORY_OF.get(int(colours[counts.argmax()]), UNLABELLED)
        objects.append(InstanceMask(number, category, left_px=left, top_px=top, mask=mask))
    return objects


def _size(picture: NDArray[np.int32]) -> str:
    return f"{picture.shape[1]} x {picture.shape[0]}"


# --- Its files


def _readers(folder: Path, issues: list[FileIssue]) -> dict[str, Callable[[], list[InstanceMask]]]:
    """Find the reader of each annotated image's objects."""
    by_image: dict[str, Callable[[], list[InstanceMask]]] = {}
    for path in sorted(folder.rglob("*" + ID_SUFFIX)):
        name = path.name.removesuffix(ID_SUFFIX)
        colours = path.with_name(name + COLOUR_SUFFIX)
        if not colours.is_file():  # as downloaded, the two kinds are in separate folders
            colours = next(iter(sorted(folder.rglob(name + COLOUR_SUFFIX))), colours)
        if name in by_image:
            issues.append(
                FileIssue(
                    path, "duplicate_name", "another image has the same name; only that is used"
                )
            )
            continue
        by_image[name] = partial(read_instances, path, colours)
    if not by_image:
        raise InvalidParameterError(f"{folder} has no iSAID annotations: no *{ID_SUFFIX}")
    return by_image
