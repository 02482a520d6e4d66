from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from vehanchor.errors import ReconstructionError
from vehanchor_flight.reconstruction.model import Lens

PIXELS = np.array([[0.0, 0.0], [800.0, 0.0], [800.0, 600.0], [400.0, 300.0], [130.0, 520.0]])


def _lens(distortion: tuple[float, ...], *, fisheye: bool = False) -> Lens:
    return Lens(
        width_px=800,
        height_px=600,
        focal_x_px=700,
        focal_y_px=690,
        centre_x_px=410,
        centre_y_px=295,
        distortion=distortion,
        fisheye=fisheye,
    )


def _projected(lens: Lens, rays: NDArray[np.float64]) -> NDArray[np.float64]:
    """Project rays to pixels with OpenCV."""
    matrix = np.array([[700, 0, 410], [0, 690, 295], [0, 0, 1.0]])
    distortion = np.array(lens.distortion)
    still = np.zeros(3)
    if lens.fisheye:
        pixels, _ = cv2.fisheye.projectPoints(rays[:, None], still, still, matrix, distortion)
    else:
        pixels, _ = cv2.projectPoints(rays, still, still, matrix, distortion)
    return np.asarray(pixels, dtype=np.float64).reshape(-1, 2)


@pytest.mark.parametrize(
    ("distortion", "fisheye"),
    [
        ((-0.08, 0.02, 0.0, 0.0), False),
        ((-0.05, 0.01, 0.001, -0.002, 0.003), False),
        ((0.02, -0.004, 0.0, 0.0), True),
        ((0.0, 0.0, 0.0, 0.0), True),
    ],
)
def test_a_ray_comes_back_to_its_pixel(distortion: tuple[float, ...], fisheye: bool) -> None:
    lens = _lens(distortion, fisheye=fisheye)
    rays = lens.directions(PIXELS)
    assert rays[:, 2] == pytest.approx(1.0)
    assert _projected(lens, rays) == pytest.approx(PIXELS, abs=0.05)


def test_a_lens_without_distortion_is_a_pinhole() -> None:
    rays = _lens(()).directions(PIXELS)
    assert rays[:, 2] == pytest.approx(1.0)
    assert rays[:, 0] * 700 + 410 == pytest.approx(PIXELS[:, 0])


def test_a_reduced_copy_has_the_same_rays() -> None:
    lens = _lens((-0.08, 0.02, 0.0, 0.0))
    half = lens.of_size(400, 300)
    assert half.directions(PIXELS / 2) == pytest.approx(lens.directions(PIXELS))


def test_a_copy_of_another_shape_is_refused() -> None:
    with pytest.raises(ReconstructionError, match="neither cropped nor turned"):
        _lens(()).of_size(600, 800)
