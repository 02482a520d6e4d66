"""Courts drawn by the tests, of exactly known size."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import cv2
import numpy as np

from vehanchor.courts.fit import pose_matrix, project
from vehanchor.courts.templates import Pose

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from vehanchor.courts.templates import Template

# The picture is drawn with so many times its pixels in each direction.
_FINER = 4
_HALF_LINE_M = 0.04


def draw_court(
    template: Template,
    gsd_m_per_px: float,
    *,
    degrees: float = 20.0,
    side_px: int = 256,
    missing: tuple[int, ...] = (),
    matrix: NDArray[np.float64] | None = None,
    noise_sd: float = 2.0,
) -> NDArray[np.uint8]:
    """Draw a court with lines 8 cm wide in the middle of a square picture.

    Args:
        template: template of the court.
        gsd_m_per_px: size of a pixel.
        degrees: direction of the long axis.
        side_px: side of the picture.
        missing: indices of lines that are left out.
        matrix: ``[3, 3]`` from metres to pixels, instead of the size and the direction.
        noise_sd: standard deviation of the noise, grey levels.

    Returns:
        ``[side, side, 3]`` uint8 RGB.
    """
    centre = side_px / 2 - 0.5
    if matrix is None:
        matrix = pose_matrix(Pose(centre, centre, math.radians(degrees), 1 / gsd_m_per_px))
    finer = np.diag([_FINER, _FINER, 1.0])
    finer[:2, 2] = (_FINER - 1) / 2
    canvas = np.full((side_px * _FINER, side_px * _FINER), 90, np.uint8)
    for index, line in enumerate(np.concatenate([template.lines, template.arcs])):
        if index in missing:
            continue
        start = line[:2]
        end = line[2:]
        along = (end - start) / np.hypot(*(end - start))
        across = np.array([-along[1], along[0]]) * _HALF_LINE_M
        band = np.array([start + across, end + across, end - across, start - across])
        points = np.rint(project(finer @ matrix, band) * 16).astype(np.int32)
        cv2.fillPoly(canvas, [points], 220, lineType=cv2.LINE_AA, shift=4)
    grey = cv2.resize(canvas, (side_px, side_px), interpolation=cv2.INTER_AREA).astype(np.float32)
    grey += np.random.default_rng(0).normal(0, noise_sd, grey.shape)
    levels = np.clip(grey, 0, 255).astype(np.uint8)
    return np.repeat(levels[:, :, None], 3, axis=2)
