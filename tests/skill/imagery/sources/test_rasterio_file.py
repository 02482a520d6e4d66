from __future__ import annotations

import io
import warnings
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from numpy.typing import NDArray
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

TILED: dict[str, Any] = {"tiled": True, "blockxsize": 16, "blockysize": 16}


@pytest.fixture(scope="module")
def tiled_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return geotiff(tmp_path_factory.mktemp("tiled") / "a.tif", RGB, **TILED)


@pytest.mark.parametrize(
    "make",
    [
        pytest.param(lambda path: path, id="path"),
        pytest.param(lambda path: path.read_bytes(), id="bytes"),
        pytest.param(lambda path: io.BytesIO(path.read_bytes()), id="file object"),
    ],
)
def test_a_geotiff_is_read_from_every_source(make: Callable[[Path], Any], tiled_path: Path) -> None:
    with open_raster(make(tiled_path)) as raster:
        assert raster.georeference_gsd_m_per_px == pytest.approx(0.25)
        np.testing.assert_array_equal(raster.read(), RGB)


def test_a_cog_with_jpeg_colours_is_read(tmp_path: Path) -> None:
    large = smooth_rgb(512, 256)
    path = geotiff(
        tmp_path / "a.tif", large, driver="COG", compress="jpeg", quality=95, blocksize=256
    )
    assert np.abs(read_all(path).astype(int) - large).max() <= 8


def test_a_plain_tiff_is_read_in_a_compression_that_opencv_lacks(tmp_path: Path) -> None:
    path = geotiff(
        tmp_path / "a.tif", RGB, crs=None, transform=None, compress="WEBP", WEBP_LOSSLESS="YES"
    )
    np.testing.assert_array_equal(read_all(path), RGB)


HOLE = np.s_[5:15, 10:30]
WITH_HOLE = RGB.copy()
WITH_HOLE[HOLE] = 0
MASK = np.full(RGB.shape[:2], 255, np.uint8)
MASK[HOLE] = 0


def _with_mask(path: Path) -> Path:
    return geotiff(path, RGB, MASK)


def _with_alpha(path: Path) -> Path:
    return geotiff(path, np.dstack([RGB, MASK]), photometric="RGB", alpha="YES")


def _with_nodata(path: Path) -> Path:
    marked = RGB.copy()
    marked[HOLE] = 255
    return geotiff(path, marked, nodata=255)


def _plain_with_mask(path: Path) -> Path:
    return geotiff(path, RGB, MASK, crs=None, transform=None)


@pytest.mark.parametrize("make", [_with_mask, _with_alpha, _with_nodata, _plain_with_mask])
def test_pixels_without_data_are_black(make: Callable[[Path], Path], tmp_path: Path) -> None:
    np.testing.assert_array_equal(read_all(make(tmp_path / "a.tif")), WITH_HOLE)


@pytest.mark.parametrize("nodata", [None, np.nan])
def test_nan_in_a_geotiff_is_no_data(nodata: float | None, tmp_path: Path) -> None:
    values = (RGB / 255).astype(np.float32)
    values[:10] = np.nan
    pixels = read_all(geotiff(tmp_path / "a.tif", values, nodata=nodata))
    np.testing.assert_array_equal(pixels[10:], RGB[10:])
    assert not pixels[:10].any()


PALETTE = np.array([(10, 20, 30), (200, 100, 0), (7, 8, 9)])
INDEXES = (np.arange(20 * 20, dtype=np.uint8) % 3).reshape(20, 20)


@pytest.fixture(scope="module")
def palette_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("palette") / "a.tif"
    geotiff(path, INDEXES[..., np.newaxis], photometric="palette")
    opaque = {index: (*colour, 255) for index, colour in enumerate(PALETTE.tolist())}
    with rasterio.open(path, "r+") as dataset:
        dataset.write_colormap(1, opaque)
    return path


def test_a_palette_geotiff_has_its_colours(palette_path: Path) -> None:
    np.testing.assert_array_equal(read_all(palette_path), PALETTE[INDEXES])


def test_bands_choose_the_colours_of_a_palette(palette_path: Path) -> None:
    reversed_colours = PALETTE[INDEXES][..., ::-1]
    np.testing.assert_array_equal(read_all(palette_path, bands=(3, 2, 1)), reversed_colours)


@pytest.fixture
def tiff_with_sidecars(tmp_path: Path) -> Path:
    """A TIFF beside which other files state a transform and no-data."""
    five_bands = NOISE[..., [0, 1, 2, 0, 1]]
    path = geotiff(tmp_path / "a.tif", five_bands, crs=None, transform=None)
    (tmp_path / "a.tfw").write_text("0.5\n0\n0\n-0.5\n100\n200\n")
    (tmp_path / "a.tif.aux.xml").write_text(
        "<PAMDataset><GeoTransform>0, 0.5, 0, 0, 0, -0.5</GeoTransform>"
        f'<PAMRasterBand band="1"><NoDataValue>{NOISE[0, 0, 0]}</NoDataValue></PAMRasterBand>'
        "</PAMDataset>"
    )
    return path


def test_gdal_reads_no_files_beside_a_tiff(tiff_with_sidecars: Path) -> None:
    with open_raster(tiff_with_sidecars) as raster:
        assert raster.georeference_gsd_m_per_px is None
        np.testing.assert_array_equal(raster.read(), NOISE)


def test_no_file_is_written_beside_a_tiff(tiff_with_sidecars: Path) -> None:
    folder = tiff_with_sidecars.parent
    before = sorted(folder.iterdir())
    with open_raster(tiff_with_sidecars) as raster:
        raster.read()
    assert sorted(folder.iterdir()) == before


@pytest.mark.parametrize("read", [Path, Path.read_bytes])
def test_without_rasterio_a_geotiff_names_the_extra(
    read: Callable[[Path], Any], tiled_path: Path
) -> None:
    with (
        without_rasterio(),
        pytest.raises(MissingExtraError, match=r"pip install '\.\[geo\]'") as caught,
    ):
        open_raster(read(tiled_path))
    assert caught.value.code == "missing_extra"


def test_without_rasterio_a_plain_tiff_opens() -> None:
    with without_rasterio():
        np.testing.assert_array_equal(read_all(encoded(".tif")), RGB)


@pytest.mark.parametrize("share", [0.3, 0.8])
def test_a_truncated_geotiff_is_undecodable(
    share: float, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    path = geotiff(tmp_path / "a.tif", NOISE, compress="deflate", **TILED)
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


def test_a_cmyk_tiff_is_refused_with_the_reason() -> None:
    with pytest.raises(ImageFormatError, match="photometric interpretation 5"):
        open_raster(pillow("TIFF", "CMYK"))


def test_an_open_dataset_is_an_image(tiled_path: Path) -> None:
    with rasterio.open(tiled_path) as dataset, open_raster(dataset) as raster:
        assert raster.source == "dataset"
        assert raster.georeference_gsd_m_per_px == pytest.approx(0.25)
        assert (raster.width_px, raster.height_px) == (WIDTH_PX, HEIGHT_PX)
        np.testing.assert_array_equal(raster.read(), RGB)


def test_a_window_of_a_dataset_is_read(tiled_path: Path) -> None:
    with rasterio.open(tiled_path) as dataset, open_raster(dataset) as raster:
        part = raster.read(Window(3, 5, width_px=20, height_px=7))
    np.testing.assert_array_equal(part, RGB[5:12, 3:23])


def test_a_dataset_stays_open(tiled_path: Path) -> None:
    with rasterio.open(tiled_path) as dataset:
        for _ in range(2):
            np.testing.assert_array_equal(read_all(dataset), RGB)
            assert not dataset.closed


def test_bands_of_a_dataset_can_be_chosen(tiled_path: Path) -> None:
    with rasterio.open(tiled_path) as dataset:
        np.testing.assert_array_equal(read_all(dataset, bands=(3, 1, 1)), RGB[..., [2, 0, 0]])


@pytest.fixture(scope="module")
def deep_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return geotiff(tmp_path_factory.mktemp("deep") / "a.tif", RGB.astype(np.uint16) * 20)


def test_a_deep_dataset_is_read_as_its_file(deep_path: Path) -> None:
    with rasterio.open(deep_path) as dataset:
        np.testing.assert_array_equal(read_all(dataset), read_all(deep_path))


def test_a_warped_dataset_is_read_as_its_file(deep_path: Path) -> None:
    with (
        rasterio.open(deep_path) as dataset,
        WarpedVRT(dataset, crs=dataset.crs) as warped,
    ):
        np.testing.assert_array_equal(read_all(warped), read_all(deep_path))


def test_a_dataset_open_for_updates_is_read_as_its_file(deep_path: Path) -> None:
    with rasterio.open(deep_path, "r+") as dataset:
        np.testing.assert_array_equal(read_all(dataset), read_all(deep_path))


def test_a_dataset_in_memory_is_read_as_its_file(deep_path: Path) -> None:
    with rasterio.MemoryFile(deep_path.read_bytes()) as memory, memory.open() as dataset:
        np.testing.assert_array_equal(read_all(dataset), read_all(deep_path))


def test_a_grey_dataset_is_read_as_its_file(tmp_path: Path) -> None:
    path = tmp_path / "grey.png"
    path.write_bytes(encoded(".png", RGB[..., 0]))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        with rasterio.open(path) as dataset:
            np.testing.assert_array_equal(read_all(dataset), read_all(path))


def test_a_closed_dataset_is_a_wrong_parameter(tiled_path: Path) -> None:
    with rasterio.open(tiled_path) as dataset:
        pass
    with pytest.raises(InvalidParameterError, match="closed"):
        open_raster(dataset)


def test_a_dataset_open_for_writing_is_a_wrong_parameter(tmp_path: Path) -> None:
    profile = {
        "driver": "GTiff",
        "width": 20,
        "height": 20,
        "count": 3,
        "dtype": "uint8",
        "transform": Affine(0.25, 0, 0, 0, -0.25, 0),
    }
    with (
        rasterio.open(tmp_path / "a.tif", "w", **profile) as dataset,
        pytest.raises(InvalidParameterError, match="mode 'w'"),
    ):
        open_raster(dataset)


@pytest.fixture(scope="module")
def one_strip_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("strip") / "a.tif"
    return geotiff(path, NOISE, blockysize=NOISE.shape[0])


def test_the_limit_on_pixels_holds_for_datasets(one_strip_path: Path) -> None:
    limits = ImageLimits(max_windowed_pixels=NOISE[..., 0].size - 1)
    with (
        rasterio.open(one_strip_path) as dataset,
        pytest.raises(ImageTooLargeError, match="dataset has 130 x 90 px"),
    ):
        open_raster(dataset, Reading(limits=limits))


def test_the_limit_on_blocks_holds_for_datasets(one_strip_path: Path) -> None:
    enough = ImageLimits(max_pixels=20_000)
    tight = ImageLimits(max_pixels=2000)
    with rasterio.open(one_strip_path) as dataset:
        np.testing.assert_array_equal(read_all(dataset, limits=enough), NOISE)
        with pytest.raises(ImageTooLargeError, match="store it tiled"):
            open_raster(dataset, Reading(limits=tight))


def test_too_small_a_dataset_cannot_be_measured(tmp_path: Path) -> None:
    path = geotiff(tmp_path / "a.tif", RGB[:15])
    with rasterio.open(path) as dataset, pytest.raises(ImageFormatError, match="60 x 15 px"):
        open_raster(dataset)


WINDOW = Window(3, 2, width_px=40, height_px=30)
"""Window of an image reduced by 8."""


@pytest.fixture(scope="module")
def plain_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("overviews") / "plain.tif"
    return geotiff(path, smooth_rgb(1200, 900), tiled=True, blockxsize=256, blockysize=256)


@pytest.fixture(scope="module")
def path_with_overviews(plain_path: Path) -> Path:
    """A file with the pixels of ``plain_path`` and overviews reduced by 2, 4 and 8."""
    path = plain_path.with_name("overviews.tif")
    path.write_bytes(plain_path.read_bytes())
    with rasterio.open(path, "r+") as dataset:
        dataset.build_overviews([2, 4, 8], rasterio.enums.Resampling.average)
    return path


@pytest.fixture(scope="module")
def reduced(plain_path: Path) -> NDArray[np.uint8]:
    with open_raster(plain_path) as raster:
        return read_reduced_window(raster, WINDOW, 8)


def test_a_file_without_overviews_has_none(plain_path: Path) -> None:
    with open_raster(plain_path) as raster:
        assert raster.read_overview(Window(0, 0, width_px=20, height_px=20), 8) is None


def test_a_preview_without_overviews_is_the_reduced_window(
    plain_path: Path, reduced: NDArray[np.uint8]
) -> None:
    with open_raster(plain_path) as raster:
        np.testing.assert_array_equal(read_preview(raster, WINDOW, 8), reduced)


def test_an_overview_shows_the_reduced_window(
    path_with_overviews: Path, reduced: NDArray[np.uint8]
) -> None:
    with open_raster(path_with_overviews) as raster:
        overview = raster.read_overview(WINDOW, 8)
    assert overview is not None
    assert np.abs(overview.astype(int) - reduced).max() <= 1


def test_overviews_do_not_change_the_reduced_window(
    path_with_overviews: Path, reduced: NDArray[np.uint8]
) -> None:
    with open_raster(path_with_overviews) as raster:
        np.testing.assert_array_equal(read_reduced_window(raster, WINDOW, 8), reduced)


def test_the_next_finer_overview_is_reduced(path_with_overviews: Path) -> None:
    window = Window(3, 2, width_px=30, height_px=20)
    with open_raster(path_with_overviews) as raster:
        overview = raster.read_overview(window, 16)
        expected = read_reduced_window(raster, window, 16)
    assert overview is not None
    assert np.abs(overview.astype(int) - expected).max() <= 1


def test_overviews_that_are_much_finer_are_not_used(path_with_overviews: Path) -> None:
    with open_raster(path_with_overviews) as raster:
        assert raster.read_overview(Window(0, 0, width_px=20, height_px=10), 32) is None


def test_a_dataset_of_signed_integers_cannot_be_measured(tmp_path: Path) -> None:
    path = geotiff(tmp_path / "a.tif", RGB.astype(np.int16))
    with rasterio.open(path) as dataset, pytest.raises(ImageFormatError, match="int16"):
        open_raster(dataset)


def test_a_dataset_of_inks_cannot_be_measured(tmp_path: Path) -> None:
    four_bands = np.dstack([RGB, RGB[..., 0]]).astype(np.uint16)
    path = geotiff(tmp_path / "a.tif", four_bands, photometric="CMYK")
    with (
        rasterio.open(path) as dataset,
        pytest.raises(ImageFormatError, match="black, cyan, magenta, yellow: convert"),
    ):
        open_raster(dataset)


@pytest.mark.parametrize("dtype", ["uint8", "uint16"])
@pytest.mark.parametrize("warped", [False, True], ids=["as it is", "warped"])
def test_a_dataset_whose_white_is_zero_is_refused(tmp_path: Path, dtype: str, warped: bool) -> None:
    grey = np.full((64, 64, 1), 200, dtype)
    path = geotiff(tmp_path / "a.tif", grey, photometric="MINISWHITE")
    with ExitStack() as stack:
        dataset: Any = stack.enter_context(rasterio.open(path))
        if warped:
            dataset = stack.enter_context(WarpedVRT(dataset))
        with pytest.raises(ImageFormatError, match="its white is zero"):
            open_raster(dataset)


def test_a_dataset_of_one_bit_whose_white_is_zero_is_read_by_its_palette(tmp_path: Path) -> None:
    ones = np.ones((64, 64, 1), np.uint8)
    path = geotiff(tmp_path / "a.tif", ones, photometric="MINISWHITE", nbits=1)
    with rasterio.open(path) as dataset, open_raster(dataset) as raster:
        assert not raster.read().any()
