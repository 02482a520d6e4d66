"""An orthophoto in degrees over every surface: metres, coordinates, pictures and files.

The scene has square pixels of 0.1 m. Its file has as many columns and fewer rows, and says so.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import rasterio
from typer.testing import CliRunner

import vehanchor
from tests.models import POOL, pool_among_cars
from tests.oblong import ASPECT, anamorphic_film, in_degrees, turn_film
from vehanchor.cli.app import app
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.measure.targets import Target, measure_targets
from vehanchor.options import ScaleOptions
from vehanchor.options.pixel_grid import PixelGrid
from vehanchor.pictures.grid import draw_grid
from vehanchor.records import DistanceMeasurement
from vehanchor.segmentation.segmenter import Segmenter
from vehanchor_flight.video import sample_video

SIDE = 0.1
"""Side of the square pixels, metres: the shorter one of the file's."""

# Lines of the scene, in square pixels; the file's pixels are ASPECT times as high.
EAST = ((100, 150), (500, 150))
SOUTH = ((300, 100), (300, 400))
METRES = {EAST: 40.0, SOUTH: 30.0}


@pytest.fixture(scope="module")
def photo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return in_degrees(tmp_path_factory.mktemp("oblong") / "photo.tif", pool_among_cars(), SIDE)


def _in_file(point: tuple[float, float]) -> tuple[float, float]:
    return point[0], point[1] / ASPECT


def _cli(*arguments: object) -> str:
    result = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert result.exit_code == 0, result.stderr
    return result.stdout


def _by_python(photo: Path, line: Any, **options: Any) -> float:
    record = vehanchor.measure_distance(photo, line, gsd_m_per_px=SIDE, **options)
    assert record.distance_m is not None
    return record.distance_m


def _in_pixels(photo: Path, line: Any) -> float:
    return _by_python(photo, [_in_file(point) for point in line])


def _in_fractions(photo: Path, line: Any) -> float:
    shares = [(x / 800, y / 600) for x, y in line]
    return _by_python(photo, shares, coordinates="fraction")


def _in_a_square_copy(photo: Path, line: Any) -> float:
    return _by_python(photo, [(x / 2, y / 2) for x, y in line], frame=(400, 300))


def _in_a_copy_of_the_file(photo: Path, line: Any) -> float:
    halved = [(point[0] / 2, _in_file(point)[1] / 2) for point in line]
    return _by_python(photo, halved, frame=(400, 207))


def _by_command(photo: Path, line: Any) -> float:
    points: list[object] = []
    for point in line:
        points += ["--point", *_in_file(point)]
    return float(
        json.loads(_cli("distance", photo, *points, "--gsd", SIDE, "--json"))["distance_m"]
    )


def _by_geojson(photo: Path, line: Any) -> float:
    """Measure a line's degrees in the written map."""
    from rasterio.warp import transform

    path = photo.with_suffix(".geojson")
    points: list[object] = []
    for point in line:
        points += ["--point", *_in_file(point)]
    _cli("distance", photo, *points, "--gsd", SIDE, "--line", path)
    (feature,) = json.loads(path.read_text())["features"]
    longitudes, latitudes = zip(*feature["geometry"]["coordinates"], strict=True)
    east, north = transform("EPSG:4326", "EPSG:32632", longitudes, latitudes)
    return float(np.hypot(east[1] - east[0], north[1] - north[0]))


def _by_table(photo: Path, line: Any) -> float:
    """Measure a row of a table, as ``vehanchor batch --measure`` does."""
    (x1, y1), (x2, y2) = [_in_file(point) for point in line]
    other = SOUTH if line is EAST else EAST
    (x3, y3), (x4, y4) = [_in_file(point) for point in other]
    known = {"x1": x3, "y1": y3, "x2": x4, "y2": y4, "metres": METRES[other]}
    target = Target(photo.name, "", kind="line", numbers=(x1, y1, x2, y2))
    engine = vehanchor.Engine()
    options = ScaleOptions.of({"known_lengths": [known], "rulers": ("known_length",)})
    (row,) = measure_targets(str(photo), [target], engine.detector, engine.segmenter, options)
    assert isinstance(row.record, DistanceMeasurement)
    assert row.record.distance_m is not None
    return row.record.distance_m


def _by_known_length(photo: Path, line: Any) -> float:
    """Measure by the scale of a line of known length in the other direction."""
    other = SOUTH if line is EAST else EAST
    (x1, y1), (x2, y2) = [_in_file(point) for point in other]
    known = {"x1": x1, "y1": y1, "x2": x2, "y2": y2, "metres": METRES[other]}
    estimate = vehanchor.estimate_gsd(
        photo, known_lengths=[known], rulers=("known_length",), metadata=False
    )
    return _by_python_scale(photo, line, estimate)


def _by_python_scale(photo: Path, line: Any, estimate: Any) -> float:
    path = [_in_file(point) for point in line]
    record = vehanchor.measure_distance(photo, path, scale=estimate)
    assert record.distance_m is not None
    return record.distance_m


@pytest.mark.parametrize("line", [EAST, SOUTH], ids=["east", "south"])
@pytest.mark.parametrize(
    "measure",
    [
        _in_pixels,
        _in_fractions,
        _in_a_square_copy,
        _in_a_copy_of_the_file,
        _by_command,
        _by_geojson,
        _by_table,
        _by_known_length,
    ],
)
def test_a_line_has_its_length_on_every_surface(
    measure: Callable[[Path, Any], float], line: Any, photo: Path
) -> None:
    assert measure(photo, line) == pytest.approx(METRES[line], rel=0.01)


def test_a_path_comes_back_in_pixels_of_the_file(photo: Path) -> None:
    line = [_in_file(point) for point in EAST]
    record = vehanchor.measure_distance(photo, line, gsd_m_per_px=SIDE)
    path = [(point.x_px, point.y_px) for point in record.path]
    assert np.array(path) == pytest.approx(np.array(line))
    assert (record.image_width_px, record.image_height_px) == (800, 414)
    assert record.pixel_aspect == pytest.approx(ASPECT, rel=1e-3)
    assert "pixels_not_square" in [notice.code for notice in record.warnings]


@pytest.fixture(scope="module")
def pool(photo: Path, segmenter: Segmenter) -> Any:
    x1, y1, x2, y2 = POOL
    box = (*_in_file((x1 - 10, y1 - 6)), *_in_file((x2 + 9, y2 + 6)))
    return vehanchor.Engine(segmenter=segmenter).analyse_area(photo, box=box, gsd_m_per_px=SIDE)


def test_an_area_is_in_square_metres(pool: Any) -> None:
    record = pool.measurement
    assert record.area_m2 == pytest.approx(4.8 * 9.6, rel=0.05)
    assert record.area_m2 == pytest.approx(record.mask_area_px * SIDE**2)


def test_a_mask_comes_back_in_pixels_of_the_file(pool: Any) -> None:
    mask = pool.full_mask()
    rows, columns = np.nonzero(mask)
    x1, y1, x2, y2 = POOL
    corners = (columns.min(), rows.min(), columns.max() + 1, rows.max() + 1)
    assert mask.shape == (414, 800)
    assert corners == pytest.approx((*_in_file((x1, y1)), *_in_file((x2, y2))), abs=4)


def test_boxes_and_outlines_come_back_in_pixels_of_the_file(pool: Any) -> None:
    record = pool.measurement
    x1, y1, x2, y2 = POOL
    expected = (*_in_file((x1, y1)), *_in_file((x2, y2)))
    box = record.bounding_box
    assert (box.x1_px, box.y1_px, box.x2_px, box.y2_px) == pytest.approx(expected, abs=4)
    ring = [(point.x_px, point.y_px) for point in record.outline[0].exterior.points]
    assert (*np.min(ring, axis=0), *np.max(ring, axis=0)) == pytest.approx(expected, abs=4)
    centre = record.inscribed_center
    assert centre.x_px == pytest.approx((expected[0] + expected[2]) / 2, abs=8)


def test_a_picture_of_an_object_is_square(pool: Any) -> None:
    """The pool is twice as high as wide on the ground, and in the picture."""
    picture = pool.overlay()
    blue = (np.abs(picture.astype(int) - (98, 133, 195)) < 40).all(axis=2)
    rows, columns = np.nonzero(blue)
    ratio = (np.ptp(rows) + 1) / (np.ptp(columns) + 1)
    assert ratio == pytest.approx(2.0, rel=0.1)


def test_a_metric_copy_has_square_pixels_of_its_scale(photo: Path, tmp_path: Path) -> None:
    from vehanchor.export.geotiff import write_metric_copy

    with open_raster(photo) as raster:
        write_metric_copy(tmp_path / "copy.tif", raster, SIDE)
    with rasterio.open(tmp_path / "copy.tif") as copy:
        assert copy.width * copy.transform.a == pytest.approx(80, rel=0.01)
        assert -copy.height * copy.transform.e == pytest.approx(60, rel=0.01)


def test_the_grid_of_a_picture_counts_the_files_pixels(photo: Path) -> None:
    with open_raster(photo) as raster:
        whole = raster.grid
        picture, step = draw_grid(
            raster,
            vehanchor_window(whole),
            long_side_px=800,
            max_enlargement=1,
            lines=True,
        )
    assert step == 100
    assert picture.shape[:2] == (600, 800)
    bright = np.flatnonzero(np.median(picture, axis=1).min(axis=1) > 100)
    assert bright.tolist() == pytest.approx([ASPECT * y for y in (100, 200, 300, 400)], abs=2)


def vehanchor_window(grid: PixelGrid) -> Any:
    from vehanchor.imagery.raster import Window

    return Window(0, 0, width_px=grid.square_width_px, height_px=grid.square_height_px)


def test_a_film_has_its_displayed_size(tmp_path: Path) -> None:
    frame = np.asarray(cv2.resize(pool_among_cars(), (562, 600)), np.uint8)
    path = anamorphic_film(tmp_path / "film.mp4", [frame] * 12, (64, 45))
    (photograph,) = sample_video(str(path), 2.0)
    pixels = np.asarray(photograph.image)
    assert pixels.shape == (600, 799, 3)
    rows, columns = np.nonzero((np.abs(pixels.astype(int) - (40, 140, 210)) < 40).all(axis=2))
    assert (np.ptp(rows) + 1) / (np.ptp(columns) + 1) == pytest.approx(2.0, rel=0.1)


def test_a_turned_film_has_its_displayed_size(tmp_path: Path) -> None:
    frame = np.zeros((600, 562, 3), np.uint8)
    frame[:300] = 255
    path = anamorphic_film(tmp_path / "film.mp4", [frame] * 12, (64, 45))
    turn_film(path)
    (photograph,) = sample_video(str(path), 2.0)
    assert np.asarray(photograph.image).shape == (799, 600, 3)


def test_a_film_of_square_pixels_keeps_its_size(tmp_path: Path) -> None:
    path = anamorphic_film(tmp_path / "film.mp4", [pool_among_cars()] * 12, (1, 1))
    (photograph,) = sample_video(str(path), 2.0)
    assert np.asarray(photograph.image).shape == (600, 800, 3)
