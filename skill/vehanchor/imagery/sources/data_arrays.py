"""xarray's images as arrays, without importing xarray: who has such an image has it."""

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
    """What is used of ``xarray.DataArray``."""

    @property
    def dims(self) -> Any:
        """Names of its axes."""

    @property
    def sizes(self) -> Any:
        """Lengths of its axes by name."""

    def transpose(self, *dims: Any) -> Any:
        """The same with its axes in another order."""


def is_data_array(image: Any) -> TypeGuard[DataArray]:
    """Whether something is an array of xarray."""
    return any(kind.__module__.startswith("xarray.") and kind.__name__ == "DataArray" for kind in type(image).__mro__)


def data_array_pixels(image: DataArray, limits: ImageLimits) -> NDArray[Any]:
    """Read an array of axes y, x and perhaps one of bands, in any order; one that is lazy is computed.

    Returns:
        ``[h, w]`` or ``[h, w, bands]``.

    Raises:
        InvalidParameterError: its axes are others.
        ImageTooLargeError: it has more pixels than the limits allow.
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
    """Metres per pixel by the array's own coordinates, as rioxarray knows them; None without these."""
    located = getattr(image, "rio", None)
    if located is None or located.crs is None:
        return None
    from vehanchor.imagery.metadata.georeference import dataset_gsd_m_per_px

    dataset = SimpleNamespace(
        transform=located.transform(), crs=located.crs, width=located.width, height=located.height
    )
    return dataset_gsd_m_per_px(dataset)


def _axes(image: DataArray) -> tuple[Any, Any, list[Any]]:
    """Names of the rows' axis, the columns', and of the bands' where there is one."""
    rows = [name for name in image.dims if str(name).lower() in _ROWS]
    columns = [name for name in image.dims if str(name).lower() in _COLUMNS]
    bands = [name for name in image.dims if name not in (*rows, *columns)]
    if len(rows) != 1 or len(columns) != 1 or len(bands) > 1:
        raise InvalidParameterError(
            f"the DataArray has the axes {', '.join(map(str, image.dims))}: y and x are needed, and at most one of "
            "bands; choose with isel, or rename"
        )
    return rows[0], columns[0], bands
