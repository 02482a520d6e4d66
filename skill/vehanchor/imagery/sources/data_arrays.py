"""Arrays from xarray images. This module never imports xarray; callers with such an image have it."""

from __future__ import annotations

from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, Protocol, TypeGuard

import numpy as np

from vehanchor.errors import ImageTooLargeError, InvalidParameterError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from vehanchor.options import ImageLimits

_ROWS, _COLUMNS = ("y", "lat", "latitude", "northing"), ("x", "lon", "longitude", "easting")


class DataArray(Protocol):
    """Part of ``xarray.DataArray`` that this module uses."""

    @property
    def dims(self) -> Any:
        """Names of its axes."""

    @property
    def sizes(self) -> Any:
        """Lengths of its axes by name."""

    def transpose(self, *dims: Any) -> Any:
        """Reorder its axes."""


def is_data_array(image: Any) -> TypeGuard[DataArray]:
    """Test whether an object is an xarray DataArray, without importing xarray."""
    return any(kind.__module__.startswith("xarray.") and kind.__name__ == "DataArray" for kind in type(image).__mro__)


def data_array_pixels(image: DataArray, limits: ImageLimits) -> NDArray[Any]:
    """Read an array with the axes y, x and optionally bands, in any order; a lazy array is computed.

    Returns:
        ``[h, w]`` or ``[h, w, bands]``.

    Raises:
        InvalidParameterError: the array has other axes.
        ImageTooLargeError: the array has more pixels than the limits allow.
    """
    rows, columns, bands = _axes(image)
    height, width = image.sizes[rows], image.sizes[columns]
    if width * height > limits.max_pixels:
        raise ImageTooLargeError(
            f"the DataArray has {width} x {height} px, the limit is {limits.max_pixels} pixels "
            "(--max-megapixels, ImageLimits.max_pixels); give the path of its file, which is read by windows"
        )
    return np.asarray(image.transpose(rows, columns, *bands).values)


def data_array_gsd_m_per_px(image: Any) -> float | None:
    """Compute metres per pixel from the array's coordinates, as rioxarray reads them; None without coordinates."""
    located = getattr(image, "rio", None)
    if located is None or located.crs is None:
        return None
    from vehanchor.imagery.metadata.georeference import dataset_gsd_m_per_px

    dataset = SimpleNamespace(
        transform=located.transform(), crs=located.crs, width=located.width, height=located.height
    )
    return dataset_gsd_m_per_px(dataset)


def _axes(image: DataArray) -> tuple[Any, Any, list[Any]]:
    """Find the names of the row axis, the column axis and the band axis, if there is one."""
    rows = [name for name in image.dims if str(name).lower() in _ROWS]
    columns = [name for name in image.dims if str(name).lower() in _COLUMNS]
    bands = [name for name in image.dims if name not in (*rows, *columns)]
    if len(rows) != 1 or len(columns) != 1 or len(bands) > 1:
        raise InvalidParameterError(
            f"the DataArray has the axes {', '.join(map(str, image.dims))}: y and x are required, plus at most "
            "one for bands; select with isel, or rename"
        )
    return rows[0], columns[0], bands
