"""DOTA data: ``images/``, and a text file with labels for each image in ``labelTxt*/``.

A line of labels is ``x1 y1 x2 y2 x3 y3 x4 y4 class difficult``. In versions 1.0 and 1.5 the files
start with ``imagesource:`` and ``gsd:`` lines; version 2.0 has these in ``meta/``.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from vehanchor.detection.boxes import boxes_from_corners
from vehanchor.errors import InvalidParameterError
from vehanchor_evaluation.known_scale import FileIssue, KnownScaleImage, KnownScaleSet, image_files

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    Corners: TypeAlias = NDArray[np.float64]
    """Corners ``[n, 4, 2]`` of boxes, pixels."""

    Boxes: TypeAlias = NDArray[np.float64]
    """Boxes ``[n, 5]``: x, y, length, width, angle."""

SMALL_VEHICLE = "small-vehicle"
# Folders of axis-aligned boxes, whose sides are not the vehicles' lengths.
_AXIS_ALIGNED = re.compile(r"hbb|task2|reclabel", re.IGNORECASE)
_HEADER_KEYS = ("imagesource", "acquisition dates")
_MAX_SHOWN_PROBLEMS = 3


@dataclass(frozen=True, eq=False)
class DotaLabels:
    """Labels of one image.

    Attributes:
        gsd_m_per_px: ground sampling distance in the header; None if it is missing or ``None``.
        corners: ``[n, 4, 2]`` float64 corners in pixels, in order around each box.
        classes: ``n`` class names, as written.
        difficult: ``[n]`` bool, the last field.
    """

    gsd_m_per_px: float | None
    corners: Corners
    classes: tuple[str, ...]
    difficult: NDArray[np.bool_]

    def of_class(self, *names: str) -> Corners:
        """Select the corners ``[k, 4, 2]`` of the labels with one of these class names."""
        keep = np.array([name in names for name in self.classes], dtype=bool)
        return np.asarray(self.corners[keep])


def parse_labels(text: str, problems: list[str] | None = None) -> DotaLabels:
    """Parse the text of one label file.

    Args:
        text: content of the file.
        problems: collects a message for each malformed line, which is skipped; None raises an error
            instead.

    Raises:
        ValueError: a line is malformed and ``problems`` is None; the message has its number.
    """
    gsd: float | None = None
    corners: list[list[float]] = []
    classes: list[str] = []
    difficult: list[bool] = []
    for number, line in enumerate(text.splitlines(), start=1):
        stripped = line.strip()
        key, colon, value = stripped.partition(":")
        # Versions 1.0 and 1.5 start with a header, of which only the scale counts.
        if not stripped or (colon and key.lower() in _HEADER_KEYS):
            continue
        try:
            if key.lower() == "gsd":
                gsd = _header_gsd(value)
                continue
            fields = stripped.split()
            points = [float(field) for field in fields[:8]]
            name = fields[8]
            if not np.isfinite(points).all():
                raise ValueError
        except (ValueError, IndexError):
            message = (
                f"line {number}: expected 'x1 y1 x2 y2 x3 y3 x4 y4 class difficult', "
                f"found {line[:120]!r}"
            )
            if problems is None:
                raise ValueError(message) from None
            problems.append(message)
            continue
        corners.append(points)
        classes.append(name)
        is_difficult = len(fields) > 9 and fields[9] != "0"
        difficult.append(is_difficult)
    # Without labels the array is empty, and needs the shape all the same.
    corners_px = np.array(corners, dtype=np.float64).reshape(-1, 4, 2)
    return DotaLabels(
        gsd_m_per_px=gsd,
        corners=corners_px,
        classes=tuple(classes),
        difficult=np.array(difficult, dtype=bool),
    )


def _header_gsd(text: str) -> float | None:
    """Parse the value of a ``gsd:`` line; None if it is missing or not a positive number."""
    value = text.strip().lower()
    if value in ("", "none", "null"):
        return None
    gsd = float(text)
    if not np.isfinite(gsd) or gsd <= 0:
        return None
    return gsd


def read_labels(path: Path, problems: list[str] | None = None) -> DotaLabels:
    """Read one label file; see ``parse_labels``.

    Raises:
        OSError: the file cannot be read.
        ValueError: the file is not text, or a line is malformed and ``problems`` is None.
    """
    try:
        return parse_labels(path.read_text(encoding="utf-8-sig"), problems)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def labelled_boxes(path: Path, classes: Sequence[str] = (SMALL_VEHICLE,)) -> Boxes:
    """Read the labelled vehicles of one image, difficult ones included.

    Malformed lines are skipped; ``survey_dota`` and other surveys report them.

    Returns:
        ``[n, 5]`` (x, y, length, width, angle).

    Raises:
        OSError: the file cannot be read.
        ValueError: the file is not text.
    """
    ignored_problems: list[str] = []
    labels = read_labels(path, ignored_problems)
    boxes = boxes_from_corners(labels.of_class(*classes))
    # A label whose corners coincide has no length to measure.
    lengths = boxes[:, 2]
    return np.asarray(boxes[lengths > 0])


def survey_dota(folder: Path, labels: Path | None = None) -> KnownScaleSet:
    """Find the images of one split of DOTA and their scales.

    Args:
        folder: folder of a split, with ``images/`` (searched recursively) and ``labelTxt*/``; the
            latest version with oriented boxes is used.
        labels: another folder of labels.

    Returns:
        The images with a ``gsd:``; the issues list other images, labels without an image, and
        malformed lines.

    Raises:
        InvalidParameterError: a folder is missing.
    """
    label_folder = _label_folder(folder, labels)
    files = sorted(label_folder.rglob("*.txt"))
    oriented = [path for path in files if not _is_axis_aligned(path, label_folder)]
    texts = {path.stem: path for path in oriented}
    images = []
    issues = []
    image_by_stem: dict[str, Path] = {}
    for path in image_files(folder / "images"):
        stem = path.stem
        if stem in image_by_stem:
            first = image_by_stem[stem]
            message = f"{first} has the same name, and only that one is used"
            issues.append(FileIssue(path, "duplicate_name", message))
            continue
        image_by_stem[stem] = path
        text = texts.get(stem)
        if text is None:
            message = f"no {stem}.txt in {label_folder}"
            issues.append(FileIssue(path, "no_label", message))
            continue
        image = _labelled_image(path, text, folder / "meta", issues)
        if image is not None:
            images.append(image)
    issues += [
        FileIssue(text, "no_image", "labels without an image")
        for stem, text in texts.items()
        if stem not in image_by_stem
    ]
    return KnownScaleSet(str(folder), tuple(images), tuple(issues))


def _label_folder(folder: Path, labels: Path | None) -> Path:
    """Check the folder of a split, and find its labels unless they are given."""
    if not (folder / "images").is_dir():
        folders = [path for path in folder.glob("*/images") if path.is_dir()]
        splits = sorted(path.parent.name for path in folders)
        hint = ""
        # The folder above the splits was given.
        if splits:
            names = ", ".join(splits)
            hint = f"; name one of its splits: {names}"
        raise InvalidParameterError(f"no images/ folder in {str(folder)!r}{hint}")
    label_folder = labels or _latest_labels(folder)
    if not label_folder.is_dir():
        raise InvalidParameterError(f"no label folder at {str(label_folder)!r}")
    return label_folder


def _labelled_image(
    path: Path, text: Path, meta: Path, issues: list[FileIssue]
) -> KnownScaleImage | None:
    """Read scale and labels of one image.

    Args:
        path: the image.
        text: its labels.
        meta: folder ``meta/`` of version 2.0.
        issues: collects the problems.

    Returns:
        The image; None if its labels are unreadable or lack a scale.
    """
    problems: list[str] = []
    try:
        labels = read_labels(text, problems)
        gsd = labels.gsd_m_per_px or _meta_gsd(meta / text.name)
    except (OSError, ValueError) as error:
        issues.append(FileIssue(text, "unreadable_labels", str(error)))
        return None
    if problems:
        message = "; ".join(problems[:_MAX_SHOWN_PROBLEMS])
        if len(problems) > _MAX_SHOWN_PROBLEMS:
            n_more = len(problems) - _MAX_SHOWN_PROBLEMS
            message += f" and {n_more} more"
        # The other labels of the image are good, so the image is used.
        issue = FileIssue(text, "malformed_labels", message, skipped=False)
        issues.append(issue)
    if gsd is None:
        message = "its labels have no 'gsd:' line with a number"
        issues.append(FileIssue(path, "no_gsd", message))
        return None
    n_vehicles = sum(name == SMALL_VEHICLE for name in labels.classes)
    return KnownScaleImage(path, gsd, labelled_vehicles=n_vehicles, labels=text)


def _latest_labels(folder: Path) -> Path:
    """Find the label folder of the highest version with oriented boxes."""
    folders = [
        path
        for path in folder.glob("labelTxt*")
        if path.is_dir() and not _AXIS_ALIGNED.search(path.name)
    ]
    if folders:
        return max(folders, key=_version)
    if (folder / "labels").is_dir():
        return folder / "labels"
    raise InvalidParameterError(
        f"no labelTxt*/ (or labels/) folder in {str(folder)!r}; name one with --labels"
    )


def _version(path: Path) -> tuple[list[int], str]:
    """Order ``labelTxt-v1.0`` before ``labelTxt-v1.5`` and ``labelTxt-v2.0``."""
    numbers = re.findall(r"\d+", path.name)
    return [int(number) for number in numbers], path.name


def _is_axis_aligned(path: Path, label_folder: Path) -> bool:
    folders = path.relative_to(label_folder).parts[:-1]
    return any(_AXIS_ALIGNED.search(name) for name in folders)


def _meta_gsd(path: Path) -> float | None:
    """Read the ``gsd:`` of a file in ``meta/`` of version 2.0."""
    if not path.is_file():
        return None
    for line in path.read_text(encoding="utf-8-sig").splitlines():
        key, _, value = line.partition(":")
        if key.strip().lower() == "gsd":
            return _header_gsd(value)
    return None
