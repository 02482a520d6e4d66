from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from tests.models import blank_image
from vehanchor.imagery.detail import PATCH_PX, measure_detail_share, ring_spectrum, spectrum_share
from vehanchor.imagery.sources.opening import open_raster


def _texture(side: int, seed: int = 0) -> NDArray[np.uint8]:
    """Make a picture with edges at all scales, from overlapping rectangles.

    Its power falls with the square of the frequency.
    """
    rng = np.random.default_rng(seed)
    image = np.full((side, side, 3), 120, np.uint8)
    for _ in range(side * 3):
        corner = rng.integers(0, side, 2)
        size = np.exp(rng.uniform(0.5, 4, 2)).astype(int) + 1
        opposite = corner + size
        colour = rng.integers(0, 256, 3).tolist()
        cv2.rectangle(image, corner.tolist(), opposite.tolist(), colour, cv2.FILLED)
    return np.asarray(cv2.GaussianBlur(image, (0, 0), 0.4), dtype=np.uint8)


def _share(image: NDArray[np.uint8]) -> float:
    """Measure the detail share of a whole image."""
    step = PATCH_PX // 2
    height, width, _ = image.shape
    patches = [
        image[y : y + PATCH_PX, x : x + PATCH_PX]
        for y in range(0, height - PATCH_PX, step)
        for x in range(0, width - PATCH_PX, step)
    ]
    return spectrum_share(ring_spectrum(patches))


def test_a_sharp_image_has_all_its_detail() -> None:
    assert _share(_texture(128)) == 1.0


@pytest.mark.parametrize(
    ("factor", "interpolation"),
    [(2, cv2.INTER_LINEAR), (3, cv2.INTER_CUBIC), (4, cv2.INTER_LANCZOS4)],
)
def test_an_enlarged_image_has_the_detail_of_its_original(factor: int, interpolation: int) -> None:
    enlarged = cv2.resize(_texture(128), None, fx=factor, fy=factor, interpolation=interpolation)
    share = _share(np.asarray(enlarged, dtype=np.uint8))
    assert share == pytest.approx(1 / factor, rel=0.75)
    assert share < 0.8


def test_compression_does_not_reduce_the_detail() -> None:
    _, jpeg = cv2.imencode(".jpg", _texture(256), [cv2.IMWRITE_JPEG_QUALITY, 60])
    image = cv2.imdecode(jpeg, cv2.IMREAD_COLOR)
    assert _share(np.asarray(image, dtype=np.uint8)) == 1.0


def test_a_flat_image_does_not_lack_detail() -> None:
    assert _share(blank_image(200, 200)) == 1.0


def test_an_image_smaller_than_a_patch_does_not_lack_detail() -> None:
    with open_raster(blank_image(40, 40)) as raster:
        assert measure_detail_share(raster, np.array([[20.0, 20.0]])) == 1.0


def test_an_image_without_vehicles_does_not_lack_detail() -> None:
    with open_raster(_texture(128)) as raster:
        assert measure_detail_share(raster, np.zeros((0, 2))) == 1.0


@pytest.fixture(scope="module")
def enlarged() -> NDArray[np.uint8]:
    pixels = cv2.resize(_texture(256), None, fx=4, fy=4, interpolation=cv2.INTER_CUBIC)
    return np.asarray(pixels, dtype=np.uint8)


CENTRES = np.random.default_rng(0).uniform(100, 900, (20, 2))


def test_detail_is_measured_around_vehicles(enlarged: NDArray[np.uint8]) -> None:
    with open_raster(enlarged) as raster:
        assert measure_detail_share(raster, CENTRES, 1.0) < 0.5


def test_detail_is_measured_in_the_reduced_image(enlarged: NDArray[np.uint8]) -> None:
    with open_raster(enlarged) as raster:
        assert measure_detail_share(raster, CENTRES, 0.25) == 1.0
