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

_FINER = 4


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
    """A square RGB picture with a court in its middle, lines 8 cm wide; ``missing`` are indices of lines left out."""
    centre = side_px / 2 - 0.5
    if matrix is None:
        matrix = pose_matrix(Pose(centre, centre, math.radians(degrees), 1 / gsd_m_per_px))
    finer = np.diag([_FINER, _FINER, 1.0])
    finer[:2, 2] = (_FINER - 1) / 2
    canvas = np.full((side_px * _FINER, side_px * _FINER), 90, np.uint8)
    for index, line in enumerate(np.concatenate([template.lines, template.arcs])):
        if index not in missing:
            along = (line[2:] - line[:2]) / np.hypot(*(line[2:] - line[:2]))
            normal = np.array([-along[1], along[0]]) * 0.04
            ends = line.reshape(2, 2)
            band = np.array(
                [ends[0] + normal, ends[1] + normal, ends[1] - normal, ends[0] - normal]
            )
            points = np.rint(project(finer @ matrix, band) * 16).astype(np.int32)
            cv2.fillPoly(canvas, [points], 220, cv2.LINE_AA, 4)
    grey = cv2.resize(canvas, (side_px, side_px), interpolation=cv2.INTER_AREA).astype(np.float32)
    grey += np.random.default_rng(0).normal(0, noise_sd, grey.shape)
    return np.repeat(np.clip(grey, 0, 255).astype(np.uint8)[:, :, None], 3, axis=2)
