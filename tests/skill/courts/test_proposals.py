"""Where the network of courts looks: at an image's own pixels, or, of a large one, at its file's overviews."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from vehanchor.courts.proposals import load_court_network
from vehanchor.imagery.raster import Raster, StoredPixels
from vehanchor.models.runtime import Runtime

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from vehanchor.imagery.raster import Window


class _WithOverviews(Raster):
    """A blank image that keeps copies, and counts who reads what."""

    def __init__(self, side_px: int) -> None:
        super().__init__("blank", side_px, side_px)
        self.n_read = self.n_overviews = 0

    def _read_stored(self, window: Window) -> StoredPixels:
        self.n_read += 1
        return StoredPixels(np.zeros((window.height_px, window.width_px, 3), np.uint8), None)

    def read_overview(self, window: Window, factor: int) -> NDArray[np.uint8] | None:
        assert factor == 8
        self.n_overviews += 1
        return np.zeros((window.height_px, window.width_px, 3), np.uint8)


@pytest.mark.parametrize(("side_px", "by_overviews"), [(3992, False), (4000, True)])
def test_courts_of_a_large_image_are_looked_for_on_its_overviews(side_px: int, by_overviews: bool) -> None:
    network = load_court_network(Runtime(threads=1))
    assert network is not None
    raster = _WithOverviews(side_px)
    assert network.propose(raster, 8) == []
    assert (raster.n_overviews > 0) is by_overviews
    assert (raster.n_read == 0) is by_overviews
