"""Folders of images with numbered masks: an ``index.csv``, and a 16-bit label image for each image and category.

Columns: ``image`` and ``mask`` (relative to the folder), ``category``, ``gsd_m_per_px``, and optionally ``split``.
"""

from __future__ import annotations

import csv
import math
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from vehanchor.errors import ImageFormatError, InvalidParameterError
from vehanchor_evaluation.instance_masks import AnnotatedImage, InstanceMask, read_pixels, split_instances
from vehanchor_evaluation.known_scale import FileIssue

if TYPE_CHECKING:
    from pathlib import Path

_COLUMNS = ("image", "mask", "category", "gsd_m_per_px")


def find_annotated_images(folder: Path, split: str | None = None) -> tuple[list[AnnotatedImage], list[FileIssue]]:
    """Read the images of an index, one for each label image.

    Args:
        folder: folder with ``index.csv``.
        split: use only rows of this split; None uses all.

    Returns:
        The images in the index's order, and issues of rows that were left out.

    Raises:
        InvalidParameterError: the index or a column is missing, or the split has no rows.
    """
    index = folder / "index.csv"
    try:
        with index.open(newline="", encoding="utf-8") as handle:
            reader = csv.DictReader(handle)
            missing = [column for column in _COLUMNS if column not in (reader.fieldnames or ())]
            rows = list(enumerate(reader, start=2))
    except (OSError, UnicodeDecodeError) as error:
        raise InvalidParameterError(f"{index}: {error}; give a folder with an index.csv of masks") from None
    if missing:
        raise InvalidParameterError(f"{index} has no column {', '.join(missing)}: it needs {', '.join(_COLUMNS)}")
    chosen = [(line, row) for line, row in rows if split is None or row.get("split") == split]
    if not chosen:
        known = sorted({row.get("split") or "" for _, row in rows})
        raise InvalidParameterError(f"{index} has no rows of split {split!r}: it has {', '.join(known) or 'no rows'}")
    images, issues, seen = [], [], set()
    for line, row in chosen:
        try:
            gsd = float(row["gsd_m_per_px"])
        except (TypeError, ValueError):
            gsd = math.nan
        if not (math.isfinite(gsd) and gsd > 0 and all(row[column] for column in _COLUMNS)):
            issues.append(FileIssue(index, "malformed_row", f"line {line}: expected {','.join(_COLUMNS)}, gsd > 0"))
        elif row["mask"] in seen:
            issues.append(FileIssue(index, "duplicate_name", f"line {line}: {row['mask']} is already listed"))
        else:
            seen.add(row["mask"])
            path, mask = folder / row["image"], folder / row["mask"]
            name = f"{path.stem}-{row['category']}"
            images.append(AnnotatedImage(name, path, gsd, partial(read_numbered_masks, mask, row["category"])))
    return images, issues


def read_numbered_masks(path: Path, category: str) -> list[InstanceMask]:
    """Read the objects of a label image of 8 or 16 bit with 0 as background.

    Raises:
        ImageError: the file cannot be read, or is not a label image.
    """
    numbers = read_pixels(path)
    if numbers.ndim != 2 or numbers.dtype not in (np.uint8, np.uint16):
        raise ImageFormatError(f"{path}: masks must have one band of 8 or 16 bit, got {numbers.dtype} {numbers.shape}")
    return [InstanceMask(number, category, left, top, mask) for number, left, top, mask in split_instances(numbers)]
