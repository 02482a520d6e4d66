"""Writes iSAID and DOTA in their own layouts, for tests: what their readers and development kits expect."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

COLOURS = {  # of the development kit's helpers/labels.py
    "swimming-pool": (0, 0, 255),
    "tennis-court": (0, 63, 127),
    "soccer-ball-field": (0, 127, 191),
    "storage-tank": (0, 63, 63),
    "small-vehicle": (0, 0, 127),
}
Objects = Sequence[tuple[str, NDArray[np.bool_]]]


def write_dota_image(split: Path, name: str, image: NDArray[np.uint8], gsd: float | None, labels: str = "") -> Path:
    """``images/NAME.png`` and ``labelTxt-v1.5/NAME.txt`` with its header."""
    for folder in ("images", "labelTxt-v1.5"):
        (split / folder).mkdir(parents=True, exist_ok=True)
    (split / "labelTxt-v1.5" / f"{name}.txt").write_text(f"imagesource:GoogleEarth\ngsd:{gsd}\n{labels}")
    return _write(split / "images" / f"{name}.png", image)


def write_isaid_pictures(
    id_folder: Path, colour_folder: Path, name: str, size: tuple[int, int], objects: Objects, first: int = 1
) -> None:
    """The instance and the category picture of an image of ``size`` (height, width); numbers are 3001 apart."""
    ids, colours = np.zeros((*size, 3), np.uint8), np.zeros((*size, 3), np.uint8)
    for index, (category, mask) in enumerate(objects):
        number = first + 3001 * index
        ids[mask] = number & 255, number >> 8 & 255, number >> 16
        colours[mask] = COLOURS.get(category, (9, 9, 9))
    for folder, kind, picture in ((id_folder, "id", ids), (colour_folder, "color", colours)):
        folder.mkdir(parents=True, exist_ok=True)
        _write(folder / f"{name}_instance_{kind}_RGB.png", picture)


def _write(path: Path, rgb: NDArray[np.uint8]) -> Path:
    assert cv2.imwrite(str(path), rgb[:, :, ::-1])
    return path
