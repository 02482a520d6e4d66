"""DOTA's text for training detectors: four corners in pixels, class and difficulty."""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np

from vehanchor.export.layer import rings

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from vehanchor.export.layer import Layer


def write_dota(path: Path, layers: Sequence[Layer]) -> None:
    """Write boxes, or the smallest rotated rectangles of other outlines, always in pixels."""
    lines = []
    for layer, feature in ((each, feature) for each in layers for feature in each.features):
        found = rings(feature["geometry"])
        corners = np.array(found[0][:4])
        if layer.kind != "Polygon":
            corners = cv2.boxPoints(cv2.minAreaRect(np.concatenate(found).astype(np.float32))).astype(float)
        lines.append(" ".join(f"{value:.1f}" for value in corners.ravel()) + f" {layer.category} 0\n")
    path.write_text("".join(lines), encoding="utf-8")
