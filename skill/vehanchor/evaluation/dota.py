"""DOTA text labels: ``x1 y1 x2 y2 x3 y3 x4 y4 class difficult`` a line, after ``imagesource:`` and ``gsd:`` lines."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

__all__ = ["DotaLabels", "parse_labels", "read_labels"]


@dataclass(frozen=True, eq=False)
class DotaLabels:
    """The labels of one image.

    Attributes:
        gsd_m_per_px: ground sampling distance of the header, or None where it is missing or ``None``.
        corners: ``[n, 4, 2]`` float64 corners in pixels, in order around each box.
        classes: ``n`` class names, as written.
        difficult: ``[n]`` bool, the last field.
    """

    gsd_m_per_px: float | None
    corners: NDArray[np.float64]
    classes: tuple[str, ...]
    difficult: NDArray[np.bool_]

    def of_class(self, *names: str) -> NDArray[np.float64]:
        """Corners ``[k, 4, 2]`` of the labels with one of these class names."""
        keep = np.array([name in names for name in self.classes], dtype=bool)
        return np.asarray(self.corners[keep])


def parse_labels(text: str) -> DotaLabels:
    """Parse the text of one label file.

    Raises:
        ValueError: a line is malformed; the message gives its number.
    """
    gsd: float | None = None
    corners: list[list[float]] = []
    classes: list[str] = []
    difficult: list[bool] = []
    for number, line in enumerate(text.splitlines(), start=1):
        stripped = line.strip()
        key, _, value = stripped.partition(":")
        if not stripped or key.lower() == "imagesource":
            continue
        try:
            if key.lower() == "gsd":
                gsd = None if value.strip().lower() in ("", "none", "null") else float(value)
                continue
            fields = stripped.split()
            corners.append([float(field) for field in fields[:8]])
            classes.append(fields[8])
            difficult.append(len(fields) > 9 and fields[9] != "0")
        except (ValueError, IndexError):
            raise ValueError(
                f"line {number}: expected 'x1 y1 x2 y2 x3 y3 x4 y4 class difficult', found {line!r}"
            ) from None
        if not np.isfinite(corners[-1]).all():
            raise ValueError(f"line {number}: a coordinate is not finite")
    return DotaLabels(
        gsd_m_per_px=gsd if gsd is None or (np.isfinite(gsd) and gsd > 0) else None,
        corners=np.array(corners, dtype=np.float64).reshape(-1, 4, 2),
        classes=tuple(classes),
        difficult=np.array(difficult, dtype=bool),
    )


def read_labels(path: Path) -> DotaLabels:
    """Read one label file.

    Raises:
        OSError: the file cannot be read.
        ValueError: a line is malformed; the message names the file and the line.
    """
    try:
        return parse_labels(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
