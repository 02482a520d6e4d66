from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest

from tests.models import blank_image
from vehanchor.imagery.detail import PATCH_PX, resolved_share, ring_spectrum, spectrum_share
from vehanchor.imagery.sources.opening import open_raster

if TYPE_CHECKING:
    from numpy.typing import NDArray


def _texture(side: int, seed: int = 0) -> NDArray[np.uint8]:
    """A picture with edges at all scales: overlapping rectangles, power falling with the square of the frequency."""
    rng = np.random.default_rng(seed)
    image = np.full((side, side, 3), 120, np.uint8)
    for _ in range(side * 3):
        x, y = rng.integers(0, side, 2)
        w, h = np.exp(rng.uniform(0.5, 4, 2)).astype(int) + 1
        cv2.rectangle(image, (int(x), int(y)), (int(x + w), int(y + h)), rng.integers(0, 256, 3).tolist(), -1)
    return np.asarray(cv2.GaussianBlur(image, (0, 0), 0.4), dtype=np.uint8)


def _share(image: NDArray[np.uint8]) -> float:
    step = PATCH_PX // 2
    return spectrum_share(
        ring_spectrum(
            image[y : y + PATCH_PX, x : x + PATCH_PX]
            for y in range(0, image.shape[0] - PATCH_PX, step)
            for x in range(0, image.shape[1] - PATCH_PX, step)
        )
    )


@pytest.mark.parametrize("way", [cv2.INTER_LINEAR, cv2.INTER_CUBIC, cv2.INTER_LANCZOS4])
@pytest.mark.parametrize("factor", [2, 3, 4])
def test_an_enlarged_image_has_the_detail_of_its_original(factor: int, way: int) -> None:
    original = _texture(128)
    assert _share(original) == 1.0
    enlarged = np.asarray(cv2.resize(original, None, fx=factor, fy=factor, interpolation=way), dtype=np.uint8)
    assert _share(enlarged) == pytest.approx(1 / factor, rel=0.75)
    assert _share(enlarged) < 0.8


def test_compression_and_a_flat_image_are_no_missing_detail() -> None:
    _, coded = cv2.imencode(".jpg", _texture(256), [cv2.IMWRITE_JPEG_QUALITY, 60])
    assert _share(np.asarray(cv2.imdecode(coded, cv2.IMREAD_COLOR), dtype=np.uint8)) == 1.0
    assert _share(blank_image(200, 200)) == 1.0
    with open_raster(blank_image(40, 40)) as raster:
        assert resolved_share(raster, np.array([[20.0, 20.0]])) == 1.0
    with open_raster(_texture(128)) as raster:
        assert resolved_share(raster, np.zeros((0, 2))) == 1.0


def test_detail_is_looked_for_in_the_copy_in_which_the_vehicles_were_found() -> None:
    original = _texture(256)
    enlarged = cv2.resize(original, None, fx=4, fy=4, interpolation=cv2.INTER_CUBIC)
    centres = np.random.default_rng(0).uniform(100, 900, (20, 2))
    with open_raster(np.asarray(enlarged, dtype=np.uint8)) as raster:
        assert resolved_share(raster, centres, 1.0) < 0.5
        assert resolved_share(raster, centres, 0.25) == 1.0
