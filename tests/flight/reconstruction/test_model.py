from __future__ import annotations

import cv2
import numpy as np
import pytest

from vehanchor.errors import ReconstructionError
from vehanchor_flight.reconstruction.model import Lens

CORNERS = np.array([[0.0, 0.0], [800.0, 0.0], [800.0, 600.0], [400.0, 300.0], [130.0, 520.0]])


def _seen(lens: Lens, points: np.ndarray) -> np.ndarray:
    matrix = np.array([[lens.focal_x_px, 0, lens.centre_x_px], [0, lens.focal_y_px, lens.centre_y_px], [0, 0, 1.0]])
    still = np.zeros(3)
    if lens.fisheye:
        return cv2.fisheye.projectPoints(points[:, None], still, still, matrix, np.array(lens.distortion))[0][:, 0]
    return cv2.projectPoints(points, still, still, matrix, np.array(lens.distortion))[0][:, 0]


@pytest.mark.parametrize(
    ("distortion", "fisheye"),
    [
        ((), False),
        ((-0.08, 0.02, 0.0, 0.0), False),
        ((-0.05, 0.01, 0.001, -0.002, 0.003), False),
        ((0.02, -0.004, 0.0, 0.0), True),
        ((0.0, 0.0, 0.0, 0.0), True),
    ],
)
def test_a_ray_comes_back_to_its_pixel(distortion: tuple[float, ...], fisheye: bool) -> None:
    lens = Lens(800, 600, 700, 690, 410, 295, distortion, fisheye)
    rays = lens.directions(CORNERS)
    assert rays[:, 2] == pytest.approx(1.0)
    if distortion:
        assert _seen(lens, rays) == pytest.approx(CORNERS, abs=0.05)
    else:
        assert rays[:, 0] * 700 + 410 == pytest.approx(CORNERS[:, 0])


def test_a_reduced_copy_has_the_same_rays() -> None:
    lens = Lens(800, 600, 700, 690, 410, 295, (-0.08, 0.02, 0.0, 0.0))
    half = lens.of_size(400, 300)
    assert half.directions(CORNERS / 2) == pytest.approx(lens.directions(CORNERS))
    with pytest.raises(ReconstructionError, match="neither cropped nor turned"):
        lens.of_size(600, 800)
