"""Images of few grey levels."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from vehanchor.imagery.sources.opening import open_raster

PICTURE = np.random.default_rng(1).uniform(0, 1, (80, 100, 3))


@pytest.mark.parametrize(
    "faint",
    [
        (0.08 * PICTURE).astype(np.float32),
        (20 * PICTURE).astype(np.uint8),
        (100 + 20 * PICTURE).astype(np.uint8),
    ],
)
def test_a_faint_image_is_stretched_and_says_so(faint: NDArray[np.generic]) -> None:
    with open_raster(faint) as raster:
        assert [note.code for note in raster.warnings] == ["pixels_stretched"]
        assert np.ptp(raster.read()) == 255


@pytest.mark.parametrize("clear", [PICTURE.astype(np.float32), (200 * PICTURE).astype(np.uint8)])
def test_a_clear_image_stays_as_it_is(clear: NDArray[np.generic]) -> None:
    with open_raster(clear) as raster:
        assert raster.warnings == ()


def test_glints_do_not_hide_that_reflectances_are_faint() -> None:
    faint = (0.08 * PICTURE).astype(np.float32)
    faint[:2, :20] = 0.9
    with open_raster(faint) as raster:
        assert [note.code for note in raster.warnings] == ["pixels_stretched"]


def test_an_image_of_one_value_shows_nothing() -> None:
    with open_raster(np.full((80, 100, 3), 7, np.uint8)) as raster:
        assert [note.code for note in raster.warnings] == ["nothing_visible"]


def test_black_and_white_without_grey_shows_nothing() -> None:
    with open_raster(np.where(PICTURE > 0.5, 255, 0).astype(np.uint8)) as raster:
        assert [note.code for note in raster.warnings] == ["nothing_visible"]
