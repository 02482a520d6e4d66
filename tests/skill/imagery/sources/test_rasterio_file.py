from __future__ import annotations

import io
import warnings
from pathlib import Path

import numpy as np
import pytest
import rasterio
from rasterio.errors import NotGeoreferencedWarning
from rasterio.transform import Affine
from rasterio.vrt import WarpedVRT

from tests.skill.imagery.files import (
    HEIGHT_PX,
    NOISE,
    RGB,
    WIDTH_PX,
    encoded,
    geotiff,
    pillow,
    read_all,
    smooth_rgb,
    without_rasterio,
)
from vehanchor.errors import (
    ImageDecodeError,
    ImageFormatError,
    ImageTooLargeError,
    InvalidParameterError,
    MissingExtraError,
)
from vehanchor.imagery.raster import Window
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.imagery.tiles import read_preview, read_reduced_window
from vehanchor.options import ImageLimits, Reading


def test_a_geotiff_is_read_from_a_path_or_from_bytes(tmp_path: Path) -> None:
    path = geotiff(tmp_path / "a.tif", RGB, tiled=True, blockxsize=16, blockysize=16)
    for image in (path, path.read_bytes(), io.BytesIO(path.read_bytes())):
        with open_raster(image) as raster:
            assert raster.georeference_gsd_m_per_px == pytest.approx(0.25)
            np.testing.assert_array_equal(raster.read(), RGB)


def test_a_cog_with_jpeg_colours_is_read(tmp_path: Path) -> None:
    large = smooth_rgb(512, 256)
    path = geotiff(
        tmp_path / "a.tif", large, driver="COG", compress="jpeg", quality=95, blocksize=256
    )
    assert np.abs(read_all(path).astype(int) - large).max() <= 8


def test_nodata_masks_and_alpha_are_black(tmp_path: Path) -> None:
    hole = np.s_[5:15, 10:30]
    expected = RGB.copy()
    expected[hole] = 0
    mask = np.full(RGB.shape[:2], 255, np.uint8)
    mask[hole] = 0
    with_mask = geotiff(tmp_path / "mask.tif", RGB, mask)
    with_alpha = geotiff(
        tmp_path / "alpha.tif", np.dstack([RGB, mask]), photometric="RGB", alpha="YES"
    )
    marked = RGB.copy()
    marked[hole] = 255
    with_nodata = geotiff(tmp_path / "nodata.tif", marked, nodata=255)
    for path in (with_mask, with_alpha, with_nodata):
        np.testing.assert_array_equal(read_all(path), expected)


def test_nan_in_a_geotiff_is_no_data(tmp_path: Path) -> None:
    values = (RGB / 255).astype(np.float32)
    values[:10] = np.nan
    for nodata in (None, np.nan):
        shown = read_all(geotiff(tmp_path / "a.tif", values, nodata=nodata))
        np.testing.assert_array_equal(shown[10:], RGB[10:])
        assert not shown[:10].any()


def test_a_palette_geotiff_shows_its_colours(tmp_path: Path) -> None:
    indices = (np.arange(20 * 20, dtype=np.uint8) % 3).reshape(20, 20, 1)
    path = geotiff(tmp_path / "a.tif", indices, photometric="palette")
    colours = {0: (10, 20, 30, 255), 1: (200, 100, 0, 255), 2: (7, 8, 9, 255)}
    with rasterio.open(path, "r+") as dataset:
        dataset.write_colormap(1, colours)
    expected = np.array([colours[i][:3] for i in range(3)])[indices[..., 0]]
    np.testing.assert_array_equal(read_all(path), expected)
    np.testing.assert_array_equal(read_all(path, bands=(3, 2, 1)), expected[..., ::-1])


def test_files_beside_a_tiff_are_not_looked_at(tmp_path: Path) -> None:
    path = geotiff(tmp_path / "a.tif", NOISE[..., [0, 1, 2, 0, 1]], crs=None, transform=None)
    (tmp_path / "a.tfw").write_text("0.5\n0\n0\n-0.5\n100\n200\n")
    aux = (
        "<PAMDataset><SRS>EPSG:32631</SRS><GeoTransform>0, 0.5, 0, 0, 0, "
        "-0.5</GeoTransform></PAMDataset>"
    )
    (tmp_path / "a.tif.aux.xml").write_text(aux)
    geotiff(tmp_path / "a.tif.msk", np.zeros((90, 130, 1), np.uint8), crs=None, transform=None)
    before = sorted(tmp_path.iterdir())
    with open_raster(path) as raster:
        assert raster.georeference_gsd_m_per_px is None
        np.testing.assert_array_equal(raster.read(), NOISE)
    assert sorted(tmp_path.iterdir()) == before


def test_without_rasterio_a_geotiff_names_the_extra_and_a_plain_tiff_opens(tmp_path: Path) -> None:
    path = geotiff(tmp_path / "a.tif", RGB)
    with without_rasterio():
        for image in (path, path.read_bytes()):
            with pytest.raises(
                MissingExtraError, match=r"pip install 'vehanchor\[geo\]'"
            ) as caught:
                open_raster(image)
            assert caught.value.code == "missing_extra"
        np.testing.assert_array_equal(read_all(encoded(".tif")), RGB)


@pytest.mark.parametrize("share", [0.3, 0.8])
def test_a_truncated_geotiff_is_undecodable(
    share: float, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    path = geotiff(
        tmp_path / "a.tif", NOISE, tiled=True, blockxsize=16, blockysize=16, compress="deflate"
    )
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * share)])
    for image in (path, path.read_bytes()):
        with pytest.raises(ImageDecodeError), open_raster(image) as raster:
            raster.read()
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("dtype", ["int16", "int32", "float32"])
def test_tiffs_that_cannot_be_measured(dtype: str, tmp_path: Path) -> None:
    values = np.full((20, 20, 1), np.nan if dtype == "float32" else 7).astype(dtype)
    path = geotiff(tmp_path / "a.tif", values, crs=None, transform=None)
    with pytest.raises(ImageFormatError, match="NaN" if dtype == "float32" else dtype):
        open_raster(path)


def test_a_cmyk_tiff_is_refused_and_told_why() -> None:
    with pytest.raises(ImageFormatError, match="photometric interpretation 5"):
        open_raster(pillow("TIFF", "CMYK"))


# --- Datasets that the caller has opened ---


def test_an_open_dataset_is_an_image_and_stays_open(tmp_path: Path) -> None:
    path = geotiff(tmp_path / "a.tif", RGB, tiled=True, blockxsize=16, blockysize=16)
    with rasterio.open(path) as dataset:
        for _ in range(2):
            with open_raster(dataset) as raster:
                assert raster.source == "dataset"
                assert raster.georeference_gsd_m_per_px == pytest.approx(0.25)
                assert (raster.width_px, raster.height_px) == (WIDTH_PX, HEIGHT_PX)
                np.testing.assert_array_equal(raster.read(), RGB)
                np.testing.assert_array_equal(
                    raster.read(Window(3, 5, width_px=20, height_px=7)), RGB[5:12, 3:23]
                )
            assert not dataset.closed
        np.testing.assert_array_equal(read_all(dataset, bands=(3, 1, 1)), RGB[..., [2, 0, 0]])


def test_datasets_of_every_kind_are_read_like_their_files(tmp_path: Path) -> None:
    deep = geotiff(tmp_path / "deep.tif", RGB.astype(np.uint16) * 20)
    grey = tmp_path / "grey.png"
    grey.write_bytes(encoded(".png", RGB[..., 0]))
    with rasterio.open(deep) as dataset:
        np.testing.assert_array_equal(read_all(dataset), read_all(deep))
        with WarpedVRT(dataset, crs=dataset.crs) as warped:
            np.testing.assert_array_equal(read_all(warped), read_all(deep))
    with rasterio.open(deep, "r+") as dataset:
        np.testing.assert_array_equal(read_all(dataset), read_all(deep))
    with rasterio.MemoryFile(deep.read_bytes()) as memory, memory.open() as dataset:
        np.testing.assert_array_equal(read_all(dataset), read_all(deep))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        with rasterio.open(grey) as dataset:
            np.testing.assert_array_equal(read_all(dataset), read_all(grey))


def test_a_dataset_that_cannot_be_read_is_a_wrong_parameter(tmp_path: Path) -> None:
    path = geotiff(tmp_path / "a.tif", RGB)
    with rasterio.open(path) as dataset:
        pass
    with pytest.raises(InvalidParameterError, match="closed"):
        open_raster(dataset)
    form = {
        "width": 20,
        "height": 20,
        "count": 3,
        "dtype": "uint8",
        "transform": Affine(0.25, 0, 0, 0, -0.25, 0),
    }
    with (
        rasterio.open(path, "w", driver="GTiff", **form) as writing,
        pytest.raises(InvalidParameterError, match="mode 'w'"),
    ):
        open_raster(writing)


def test_the_limits_hold_for_datasets(tmp_path: Path) -> None:
    with rasterio.open(geotiff(tmp_path / "a.tif", NOISE, blockysize=NOISE.shape[0])) as dataset:
        with pytest.raises(ImageTooLargeError, match="dataset declares 130 x 90 px"):
            open_raster(
                dataset, Reading(limits=ImageLimits(max_windowed_pixels=NOISE[..., 0].size - 1))
            )
        with pytest.raises(ImageTooLargeError, match="store it tiled"):
            open_raster(dataset, Reading(limits=ImageLimits(max_pixels=2000)))
        np.testing.assert_array_equal(
            read_all(dataset, limits=ImageLimits(max_pixels=20_000)), NOISE
        )
    low = geotiff(tmp_path / "b.tif", RGB[:15])
    with rasterio.open(low) as dataset, pytest.raises(ImageFormatError, match="60 x 15 px"):
        open_raster(dataset)


def test_overviews_show_where_to_look_without_reading_the_whole_file(tmp_path: Path) -> None:
    path = geotiff(
        tmp_path / "a.tif", smooth_rgb(1200, 900), tiled=True, blockxsize=256, blockysize=256
    )
    with open_raster(path) as raster:
        assert raster.read_overview(Window(0, 0, width_px=20, height_px=20), 8) is None
        expected = read_reduced_window(raster, Window(3, 2, width_px=40, height_px=30), 8)
        np.testing.assert_array_equal(
            read_preview(raster, Window(3, 2, width_px=40, height_px=30), 8), expected
        )
    with rasterio.open(path, "r+") as dataset:
        dataset.build_overviews([2, 4, 8], rasterio.enums.Resampling.average)
    with open_raster(path) as raster:
        seen = raster.read_overview(Window(3, 2, width_px=40, height_px=30), 8)
        assert seen is not None
        assert np.abs(seen.astype(int) - expected).max() <= 1
        np.testing.assert_array_equal(
            read_reduced_window(raster, Window(3, 2, width_px=40, height_px=30), 8), expected
        )
        next_finer = raster.read_overview(Window(3, 2, width_px=30, height_px=20), 16)
        assert next_finer is not None
        assert (
            np.abs(
                next_finer.astype(int)
                - read_reduced_window(raster, Window(3, 2, width_px=30, height_px=20), 16)
            ).max()
            <= 1
        )
        assert raster.read_overview(Window(0, 0, width_px=20, height_px=10), 32) is None


def test_datasets_that_cannot_be_measured(tmp_path: Path) -> None:
    signed = geotiff(tmp_path / "a.tif", RGB.astype(np.int16))
    with rasterio.open(signed) as dataset, pytest.raises(ImageFormatError, match="int16"):
        open_raster(dataset)
    inks = geotiff(
        tmp_path / "b.tif", np.dstack([RGB, RGB[..., 0]]).astype(np.uint16), photometric="CMYK"
    )
    with (
        rasterio.open(inks) as dataset,
        pytest.raises(ImageFormatError, match="black, cyan, magenta, yellow: convert"),
    ):
        open_raster(dataset)
