from __future__ import annotations

from contextlib import suppress
from pathlib import Path

import cv2
import numpy as np
import pytest
from rasterio.errors import CRSError

from tests.skill.imagery.files import NOISE, encoded, geotiff
from vehanchor.errors import ImageDecodeError, OutOfMemoryError, VehAnchorError
from vehanchor.imagery.formats import decoding
from vehanchor.imagery.metadata.georeference import dataset_gsd_m_per_px
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.imagery.sources.rasterio_file import gdal_environment


@pytest.mark.parametrize(
    "error", [CRSError("bad"), ValueError("NULL color table"), KeyError(7), OverflowError(), OSError()]
)
def test_whatever_rasterio_raises_is_an_image_that_cannot_be_decoded(error: Exception) -> None:
    with pytest.raises(ImageDecodeError), gdal_environment("a.tif"):
        raise error


def test_want_of_memory_is_not_the_images_fault(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(OutOfMemoryError), gdal_environment("a.tif"):
        raise MemoryError

    def no_memory(*_: object) -> None:
        error = cv2.error("Insufficient memory")
        error.code, error.err = decoding._NO_MEMORY, "Insufficient memory"
        raise error

    monkeypatch.setattr(cv2, "imdecode", no_memory)
    with pytest.raises(OutOfMemoryError):
        open_raster(encoded(".png"))


class _Broken:
    width = height = 64

    @property
    def transform(self) -> object:
        import affine

        return affine.Affine(0.25, 0, 0, 0, -0.25, 0)

    @property
    def crs(self) -> None:
        raise CRSError("The WKT could not be parsed")


def test_a_coordinate_system_that_cannot_be_read_is_none() -> None:
    assert dataset_gsd_m_per_px(_Broken()) is None


def test_a_geotiff_with_any_byte_of_its_keys_changed_gives_pixels_or_an_error_of_ours(tmp_path: Path) -> None:
    data = geotiff(tmp_path / "a.tif", NOISE).read_bytes()
    random = np.random.default_rng(47)
    n_read = 0
    for _ in range(150):
        changed = bytearray(data)
        for at in random.integers(0, 600, 3):
            changed[at if at < 300 else len(data) - at + 299] = random.integers(0, 256)
        with suppress(VehAnchorError), open_raster(bytes(changed)) as raster:
            assert raster.width_px
            n_read += 1
    assert n_read > 10
