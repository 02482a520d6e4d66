"""Where in a large image cars may be."""

from __future__ import annotations

import numpy as np

from tests.models import blank_image
from vehanchor.detection.tile_prior import CELL_PX, car_prior, tile_prior_map, tile_prior_of
from vehanchor.imagery.raster import Window
from vehanchor.imagery.sources.opening import open_raster


def test_a_town_promises_more_than_fields_in_every_cell_of_it() -> None:
    image = blank_image(3000, 1100)
    image[:] += np.random.default_rng(0).integers(0, 5, (*image.shape[:2], 1), dtype=np.uint8)
    for x, y, grey in np.random.default_rng(1).integers((1024, 0, 0), (2016, 992, 255), (900, 3)):
        image[y : y + 24, x : x + 32] = grey  # roofs
    with open_raster(image) as raster:
        cells = tile_prior_map(raster)
    assert cells.shape == (3, 6)
    assert cells[:2, 2:4].min() > cells[:, [0, 1, 4, 5]].max() + 0.2
    assert ((cells >= 0) & (cells <= 1)).all()


def test_a_tile_has_the_mean_of_the_cells_that_it_touches_at_every_resolution() -> None:
    cells = np.arange(12, dtype=np.float64).reshape(3, 4)
    assert tile_prior_of(cells, Window(0, 0, CELL_PX, CELL_PX), 1) == 0
    assert tile_prior_of(cells, Window(CELL_PX - 1, 0, 2, CELL_PX + 1), 1) == np.mean([0, 1, 4, 5])
    assert tile_prior_of(cells, Window(CELL_PX // 2, 0, CELL_PX // 2, CELL_PX), 2) == np.mean([1, 5])
    assert tile_prior_of(cells, Window(4 * CELL_PX, 3 * CELL_PX, 10, 10), 1) == 11  # a reduced copy's last columns


def test_noise_is_no_town() -> None:
    noise = np.random.default_rng(1).integers(98, 104, (64, 64, 3), dtype=np.uint8)
    assert car_prior(noise).item() < 0.1
