"""Arrays of xarray; a stand-in with its names and axes, for who has such an array brings xarray himself."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from rasterio.crs import CRS
from rasterio.transform import Affine

from tests.skill.imagery.files import RGB
from vehanchor.errors import ImageTooLargeError, InvalidParameterError
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.options import ImageLimits


class DataArray:
    """Values with named axes."""

    def __init__(self, values: np.ndarray, dims: tuple[str, ...], rio: Any = None) -> None:
        self.values = values
        self.dims = dims
        self.rio = rio

    @property
    def sizes(self) -> dict[str, int]:
        return dict(zip(self.dims, self.values.shape, strict=True))

    def transpose(self, *dims: str) -> DataArray:
        return DataArray(self.values.transpose([self.dims.index(name) for name in dims]), dims)


DataArray.__module__ = "xarray.core.dataarray"


@pytest.mark.parametrize("dims", [("band", "y", "x"), ("y", "x", "channel"), ("x", "y", "band")])
def test_axes_may_stand_in_any_order(dims: tuple[str, ...]) -> None:
    of_image = {"y": 0, "x": 1, "band": 2, "channel": 2}
    image = DataArray(RGB.transpose([of_image[name] for name in dims]), dims)
    np.testing.assert_array_equal(open_raster(image).read(), RGB)
    np.testing.assert_array_equal(open_raster(DataArray(RGB[:, :, 0], ("y", "x"))).read()[:, :, 1], RGB[:, :, 0])


def test_its_coordinates_are_reported_beside_the_estimate() -> None:
    height, width, _ = RGB.shape
    affine = Affine(0.25, 0, 500_000, 0, -0.25, 5_000_000)
    rio = SimpleNamespace(crs=CRS.from_epsg(32633), transform=lambda: affine, width=width, height=height)
    raster = open_raster(DataArray(RGB, ("y", "x", "band"), rio))
    assert raster.georeference_gsd_m_per_px == pytest.approx(0.25)
    rio.crs = None
    assert open_raster(DataArray(RGB, ("y", "x", "band"), rio)).georeference_gsd_m_per_px is None


@pytest.mark.parametrize("dims", [("time", "band", "y", "x"), ("row", "x", "band")])
def test_other_axes_are_refused_by_their_names(dims: tuple[str, ...]) -> None:
    image = DataArray(RGB.reshape(*(1,) * (len(dims) - 3), *RGB.shape), dims)
    with pytest.raises(InvalidParameterError, match=f"the axes {', '.join(dims)}"):
        open_raster(image)


def test_one_above_the_limit_is_not_computed() -> None:
    with pytest.raises(ImageTooLargeError, match="--max-megapixels"):
        open_raster(DataArray(RGB, ("y", "x", "band")), limits=ImageLimits(max_pixels=100))
